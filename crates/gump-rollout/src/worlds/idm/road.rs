//! A map prepared for driving: simplified lane centres, and the lanes that a vehicle may be on.

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_geometry::{DVec2, angle_difference};
use gump_scene::{AgentState, Lane, LaneId, LaneKind, MapGraph};

/// Largest sideways error of a simplified line, metres: far less than vehicles stray in their lane.
const TOLERANCE: f64 = 0.05;
/// Longest segment of a simplified line, metres; headings are interpolated along segments.
const SPACING: f64 = 5.0;
/// A vehicle is on a lane if it points along it within this, radians: nearer to along than across.
const MAX_TURN: f64 = std::f64::consts::FRAC_PI_4;
/// A vehicle slower than this is standing, metres per second (docs/glossary.md).
pub(super) const STANDING: f64 = 0.3;
/// A moving vehicle this close to a lane's centre is on it or about to be, metres: less than the
/// width of a lane. Chosen by hand.
const ENTERING: f64 = 3.0;
/// Half the width of the widest lane, metres, for the search only. Chosen by hand.
const WIDEST: f64 = 4.0;
/// Cost of a radian off the lane's direction when lanes are compared, in metres off its centre:
/// where lanes fork or cross, the direction decides. Chosen by hand.
const METRES_PER_RADIAN: f64 = 3.0;
/// Lanes that fit this much worse than the best are still within reach, metres: branches of one lane
/// near its fork, but not the next lane. Chosen by hand.
const REACH: f64 = 0.5;

/// Simplified centre lines of all lanes a vehicle may take.
#[derive(Debug)]
pub(super) struct Road {
    map: Arc<MapGraph>,
    centers: BTreeMap<LaneId, Vec<DVec2>>,
}

impl Road {
    pub(super) fn new(map: &Arc<MapGraph>) -> Self {
        let drivable = map.lanes().iter().filter(|lane| is_for_vehicles(lane));
        let centers = drivable
            .map(|lane| (lane.id, simplify(lane.centerline.points())))
            .collect();
        Self {
            map: Arc::clone(map),
            centers,
        }
    }

    pub(super) fn lane(&self, id: LaneId) -> Option<&Lane> {
        self.map.lane(id)
    }

    /// The simplified centre line; none for lanes vehicles do not take.
    pub(super) fn center(&self, id: LaneId) -> Option<&[DVec2]> {
        self.centers.get(&id).map(Vec::as_slice)
    }

    /// The lanes that vehicles may take after `id`.
    pub(super) fn next(&self, id: LaneId) -> Vec<LaneId> {
        let lanes = self.map.successors(id);
        lanes
            .filter(|lane| is_for_vehicles(lane))
            .map(|lane| lane.id)
            .collect()
    }

    /// The lanes that a vehicle may be on, with its signed offset from their centre: the best fit
    /// first, then others nearly as good.
    pub(super) fn lanes_of(&self, state: &AgentState) -> Vec<(LaneId, f64)> {
        let position = state.pose.position;
        // Half of a narrow lane.
        let reach = if state.speed() < STANDING {
            1.5
        } else {
            ENTERING
        };
        let mut fits: Vec<(f64, LaneId, f64)> = self
            .map
            .lanes_near(position, WIDEST)
            .filter(|(lane, _)| is_for_vehicles(lane))
            .filter_map(|(lane, _)| {
                let foot = lane.centerline.project(position);
                let direction = lane.centerline.pose_at(foot.arc_length).heading;
                let turn = angle_difference(state.pose.heading, direction).abs();
                let on_it = foot.distance <= reach.max(lane.width / 2.0) && turn < MAX_TURN;
                let cost = foot.distance + METRES_PER_RADIAN * turn;
                on_it.then_some((cost, lane.id, foot.lateral))
            })
            .collect();
        fits.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let best = fits.first().map_or(0.0, |fit| fit.0);
        let near = fits.into_iter().take_while(|fit| fit.0 <= best + REACH);
        near.map(|(_, lane, lateral)| (lane, lateral)).collect()
    }
}

fn is_for_vehicles(lane: &Lane) -> bool {
    lane.kind != LaneKind::BikeLane
}

/// The same line within [`TOLERANCE`], with segments of at most [`SPACING`] and no repeated points.
pub(super) fn simplify(points: &[DVec2]) -> Vec<DVec2> {
    let mut line: Vec<DVec2> = Vec::new();
    for i in gump_geometry::simplify(points, TOLERANCE) {
        let point = points[i];
        if let Some(&last) = line.last() {
            let n = (last.distance(point) / SPACING).ceil() as usize;
            line.extend((1..n).map(|i| last.lerp(point, i as f64 / n as f64)));
            if n == 0 {
                continue;
            }
        }
        line.push(point);
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::{Polyline, dvec2};

    #[test]
    fn simplified_lines_stay_close_and_get_short() {
        let arc: Vec<DVec2> = (0..=200)
            .map(|i| DVec2::from_angle(f64::from(i) * 0.0075) * 20.0)
            .collect();
        let simple = simplify(&arc);
        assert!(simple.len() < 20, "{} points", simple.len());
        let line = Polyline::new(simple).unwrap();
        assert!(arc.iter().all(|&p| line.project(p).distance <= TOLERANCE));
        assert_eq!(line.points().first(), arc.first());
        assert_eq!(line.points().last(), arc.last());
    }

    #[test]
    fn long_segments_are_divided_and_repeated_points_dropped() {
        let a = dvec2(0.0, 0.0);
        let line = simplify(&[a, a, dvec2(12.0, 0.0)]);
        assert_eq!(
            line,
            [a, dvec2(4.0, 0.0), dvec2(8.0, 0.0), dvec2(12.0, 0.0)]
        );
        assert_eq!(simplify(&[a]), [a]);
        assert!(simplify(&[]).is_empty());
    }
}
