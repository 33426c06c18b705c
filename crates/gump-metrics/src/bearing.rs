//! Directions and gaps as seen from the ego.

use std::f64::consts::PI;

use gump_geometry::{DVec2, OrientedBox, Pose};

/// Half the cone in which something counts as ahead or behind, radians.
///
/// Source: nuplan-devkit.
const CONE: f64 = PI / 6.0;

/// Unsigned angle between a pose's heading and the direction to `point`, radians in [0, π]; NaN if
/// they coincide.
pub fn bearing(from: Pose, point: DVec2) -> f64 {
    let offset = point - from.position;
    (from.direction().dot(offset) / offset.length())
        .clamp(-1.0, 1.0)
        .acos()
}

/// True if `point` lies within 30 degrees of straight ahead.
pub fn is_ahead(from: Pose, point: DVec2) -> bool {
    bearing(from, point) < CONE
}

/// True if `point` lies within 30 degrees of straight behind.
pub fn is_behind(from: Pose, point: DVec2) -> bool {
    bearing(from, point) > PI - CONE
}

/// The sideways gap between a body of width `width` at `from` and a box, metres: positive if the
/// box is on the left, negative if on the right, 0 if they overlap sideways.
///
/// Source: the signed lateral distance of nuplan-devkit.
pub fn signed_lateral_gap(from: Pose, width: f64, other: &OrientedBox) -> f64 {
    let left = from.direction().perp();
    let sides = other
        .corners()
        .map(|corner| (corner - from.position).dot(left));
    let to_left = sides.into_iter().fold(f64::INFINITY, f64::min) - width / 2.0;
    let to_right = sides.into_iter().fold(f64::NEG_INFINITY, f64::max) + width / 2.0;
    if to_left > 0.0 {
        to_left
    } else {
        to_right.min(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cones_are_30_degrees_to_either_side() {
        let from = Pose::new(1.0, 1.0, 0.5);
        let at = |degrees: f64| from * (DVec2::from_angle(degrees.to_radians()) * 10.0);
        assert!(is_ahead(from, at(-29.9)) && !is_ahead(from, at(30.1)));
        assert!(is_behind(from, at(150.1)) && !is_behind(from, at(-149.9)));
        // What coincides is nowhere.
        assert!(!is_ahead(from, from.position) && !is_behind(from, from.position));
    }

    #[test]
    fn gaps_have_a_side() {
        let gap = |y: f64| {
            let other = OrientedBox {
                pose: Pose::new(10.0, y, 0.0),
                length: 4.0,
                width: 2.0,
            };
            signed_lateral_gap(Pose::IDENTITY, 2.0, &other)
        };
        assert_eq!((gap(5.0), gap(-5.0)), (3.0, -3.0));
        assert_eq!((gap(1.5), gap(-1.5)), (0.0, 0.0));
    }
}
