//! Lanes given by their left and right bounds: centre line, width and outline.
//!
//! Used by Argoverse 2, CommonRoad and Lanelet2.

use gump_geometry::{DVec2, DVec3, Polygon, Polyline};
use gump_scene::{Lane, LaneKind};

use crate::ReadReport;
use crate::complete::features;

/// Metres between points of a bound that is measured anew at most: bends must be followed.
const SPACING: f64 = 2.0;
/// At most so many points of one lane: a damaged file may claim lanes around the world.
const MAX_POINTS: usize = 2000;

/// A lane between two bounds, both in the direction of travel, with its outline and its median
/// width; `None` and a count for fewer than two points on a side.
pub(crate) fn lane(
    id: i64,
    kind: LaneKind,
    left: &[DVec3],
    right: &[DVec3],
    report: &mut ReadReport,
) -> Option<Lane> {
    let (left, right) = (
        features::sound_points(id, left, report),
        features::sound_points(id, right, report),
    );
    if left.len() < 2 || right.len() < 2 {
        report.drop("lane without two bounds", 1);
        return None;
    }
    let outline = left.iter().chain(right.iter().rev()).map(|p| p.truncate());
    let mut outline: Vec<DVec2> = outline.collect();
    outline.dedup();
    let outline = Polygon::new(outline);
    let (left, right) = paired(&left, &right);
    let pairs = || left.iter().zip(&right);
    let mut widths: Vec<f64> = pairs()
        .map(|(l, r)| l.truncate().distance(r.truncate()))
        .collect();
    widths.sort_by(f64::total_cmp);
    let width = widths[widths.len() / 2];
    let centre: Vec<DVec3> = pairs().map(|(l, r)| l.midpoint(*r)).collect();
    let lane = features::lane(id, kind, &centre, report)?;
    Some(Lane {
        outline,
        width: if width > 0.0 { width } else { lane.width },
        ..lane
    })
}

/// As many points on both bounds: the given ones if they are as many, or else at the same
/// fractions of their lengths.
fn paired(left: &[DVec3], right: &[DVec3]) -> (Vec<DVec3>, Vec<DVec3>) {
    if left.len() == right.len() {
        return (left.to_vec(), right.to_vec());
    }
    let length = |line: &[DVec3]| line.windows(2).map(|p| p[0].distance(p[1])).sum::<f64>();
    let longest = length(left).max(length(right));
    let fine = (longest / SPACING).ceil().min(MAX_POINTS as f64) as usize + 1;
    let n = left.len().max(right.len()).max(fine);
    (spread(left, n), spread(right, n))
}

/// `n` points at equal distances along a line of at least two points.
fn spread(line: &[DVec3], n: usize) -> Vec<DVec3> {
    let flat = Polyline::new(line.iter().map(|p| p.truncate()).collect());
    let flat = flat.expect("there are points");
    let lengths = flat.arc_lengths();
    let last = line.len() - 1;
    (0..n)
        .map(|i| {
            let s = flat.length() * i as f64 / (n - 1) as f64;
            let after = lengths.partition_point(|&l| l < s).clamp(1, last);
            let span = lengths[after] - lengths[after - 1];
            let t = if span > 0.0 {
                (s - lengths[after - 1]) / span
            } else {
                0.0
            };
            line[after - 1].lerp(line[after], t.clamp(0.0, 1.0))
        })
        .collect()
}

/// Puts a bound that may be given in either direction into that of the other.
pub(crate) fn align(reference: &[DVec3], bound: &mut [DVec3]) {
    let ends = |line: &[DVec3]| line.first().copied().zip(line.last().copied());
    if let (Some((a, b)), Some((c, d))) = (ends(reference), ends(bound))
        && a.distance(c) + b.distance(d) > a.distance(d) + b.distance(c)
    {
        bound.reverse();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec3;

    #[test]
    fn the_centre_runs_between_the_bounds() {
        let left = [dvec3(0.0, 2.0, 1.0), dvec3(8.0, 2.0, 1.0)];
        let right = [
            dvec3(0.0, -2.0, 1.0),
            dvec3(3.0, -2.0, 1.0),
            dvec3(8.0, -2.0, 3.0),
        ];
        let mut report = ReadReport::default();
        let lane = lane(1, LaneKind::SurfaceStreet, &left, &right, &mut report).unwrap();
        assert_eq!((lane.width, lane.centerline.length()), (4.0, 8.0));
        assert!(lane.centerline.points().iter().all(|p| p.y == 0.0));
        assert_eq!(
            (lane.elevation[0], *lane.elevation.last().unwrap()),
            (1.0, 2.0)
        );
        assert_eq!(lane.outline.unwrap().signed_area().abs(), 32.0);
        assert!(super::lane(2, LaneKind::BikeLane, &left[..1], &right, &mut report).is_none());
        assert_eq!(report.dropped["lane without two bounds"], 1);
    }

    #[test]
    fn a_bound_given_backwards_is_turned_round() {
        let left = [dvec3(0.0, 2.0, 0.0), dvec3(8.0, 2.0, 0.0)];
        let mut right = [dvec3(8.0, -2.0, 0.0), dvec3(0.0, -2.0, 0.0)];
        align(&left, &mut right);
        assert_eq!(right[0].x, 0.0);
        align(&left, &mut right);
        assert_eq!(right[0].x, 0.0);
    }
}
