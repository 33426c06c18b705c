//! Distances between points and segments, the arithmetic under everything else here.

use glam::DVec2;

/// The z component of the cross product `a` x `b`: positive if `b` is to the left of `a`.
pub fn cross(a: DVec2, b: DVec2) -> f64 {
    a.perp_dot(b)
}

/// The fraction in [0, 1] along the segment `a`–`b` nearest to `point`; 0 for a point-like segment.
pub fn project_on_segment(point: DVec2, a: DVec2, b: DVec2) -> f64 {
    let along = b - a;
    let squared_length = along.length_squared();
    if squared_length == 0.0 {
        return 0.0;
    }
    ((point - a).dot(along) / squared_length).clamp(0.0, 1.0)
}

/// The distance in metres from `point` to the segment `a`–`b`.
pub fn distance_to_segment(point: DVec2, a: DVec2, b: DVec2) -> f64 {
    point.distance(a.lerp(b, project_on_segment(point, a, b)))
}

/// True if the segments `a`–`b` and `c`–`d` cross or touch.
pub fn segments_intersect(a: DVec2, b: DVec2, c: DVec2, d: DVec2) -> bool {
    let side = |p: DVec2, q: DVec2, r: DVec2| cross(q - p, r - p);
    let (abc, abd) = (side(a, b, c), side(a, b, d));
    let (cda, cdb) = (side(c, d, a), side(c, d, b));
    if abc * abd < 0.0 && cda * cdb < 0.0 {
        return true;
    }
    let touches = |p: DVec2, q: DVec2, r: DVec2, cross: f64| {
        cross == 0.0 && r.cmpge(p.min(q)).all() && r.cmple(p.max(q)).all()
    };
    touches(a, b, c, abc) || touches(a, b, d, abd) || touches(c, d, a, cda) || touches(c, d, b, cdb)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::dvec2;

    #[test]
    fn the_nearest_point_is_clamped_to_the_ends() {
        let (a, b) = (dvec2(0.0, 0.0), dvec2(10.0, 0.0));
        assert_eq!(distance_to_segment(dvec2(-3.0, 4.0), a, b), 5.0);
        assert_eq!(distance_to_segment(dvec2(5.0, -2.0), a, b), 2.0);
        assert_eq!(distance_to_segment(dvec2(3.0, 4.0), a, a), 5.0);
    }

    #[test]
    fn segments_that_touch_intersect() {
        let check = |c, d| segments_intersect(dvec2(0.0, 0.0), dvec2(2.0, 0.0), c, d);
        assert!(check(dvec2(1.0, -1.0), dvec2(1.0, 1.0)));
        assert!(check(dvec2(2.0, 0.0), dvec2(3.0, 1.0)));
        assert!(!check(dvec2(2.1, -1.0), dvec2(2.1, 1.0)));
        assert!(!check(dvec2(0.0, 1.0), dvec2(2.0, 1.0)));
    }
}
