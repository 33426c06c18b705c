//! Curbs, paint, surfaces and signs.

use gump_geometry::DVec2;
use gump_scene::{AreaKind, RoadEdgeKind, RoadLineKind};

use crate::curve::{Track, connect};
use crate::network::leg::{Leg, STOP_GAP};
use crate::network::{Mouth, Network};
use crate::plan::{BIKE_LANE_WIDTH, Control, Plan, RoadPlan};

/// Medians narrower than this are paint, wider ones have curbs; metres. [`crate::layout`] draws up
/// to 1 m for the former and 1.8 m or more for the latter.
const CURBED_MEDIAN: f64 = 1.2;

impl Network {
    /// Adds the features that are drawn but not driven along.
    pub(crate) fn furnish(&mut self, plan: &Plan, legs: &[Vec<Leg>], trimmed: &[Track]) {
        for (road, track) in plan.roads.iter().zip(trimmed) {
            let first = self.furniture.edges.len();
            self.furnish_road(road, track);
            if road.is_inner() {
                self.inner_edges.extend(first..self.furniture.edges.len());
            }
        }
        for (node, legs) in legs.iter().enumerate() {
            self.furnish_junction(plan, node, legs);
        }
    }

    fn furnish_road(&mut self, road: &RoadPlan, track: &Track) {
        let at = |offset: f64| track.offset(offset).points().to_vec();
        let (right, left) = (road.half_width(true), road.half_width(false));
        self.furniture
            .edges
            .push((RoadEdgeKind::Boundary, at(-right)));
        self.furniture
            .edges
            .push((RoadEdgeKind::Boundary, backwards(at(left))));
        self.paint_lanes(road, track);
        let both = road.forward > 0 && road.backward > 0;
        let half_median = road.median / 2.0 - 0.3;
        if both && road.median >= CURBED_MEDIAN {
            let mut ring = backwards(at(-half_median));
            ring.extend(at(half_median));
            ring.push(ring[0]);
            self.furniture.edges.push((RoadEdgeKind::Median, ring));
            self.furniture
                .drivable
                .push(strip(at(-right), at(-half_median)));
            self.furniture
                .drivable
                .push(strip(at(half_median), at(left)));
        } else {
            self.furniture.drivable.push(strip(at(-right), at(left)));
        }
    }

    fn paint_lanes(&mut self, road: &RoadPlan, track: &Track) {
        let mut paint = |kind, offset: f64| {
            let points = track.offset(offset).points().to_vec();
            self.furniture.lines.push((kind, points));
        };
        let many = road.forward + road.backward > 2;
        match (road.forward > 0 && road.backward > 0, road.median) {
            (true, median) if median >= 0.4 => {
                paint(RoadLineKind::SolidSingleYellow, -median / 2.0);
                paint(RoadLineKind::SolidSingleYellow, median / 2.0);
            }
            (true, _) if many => paint(RoadLineKind::SolidDoubleYellow, 0.0),
            (true, _) => paint(RoadLineKind::BrokenSingleYellow, 0.0),
            (false, _) => paint(RoadLineKind::SolidSingleYellow, 0.0),
        }
        for (forward, sign) in [(true, -1.0), (false, 1.0)] {
            let n = road.n_lanes(forward);
            for k in 1..n {
                let offset = road.lane_offset(k) - road.lane_width / 2.0;
                paint(RoadLineKind::BrokenSingleWhite, sign * offset);
            }
            let outer = road.lanes_half_width(forward);
            let strip = road.parking && !road.parks_in_lane;
            if n > 0 && (road.bike_lanes || strip || road.freeway) {
                paint(RoadLineKind::SolidSingleWhite, sign * outer);
            }
            if n > 0 && road.bike_lanes && road.parking {
                paint(
                    RoadLineKind::SolidSingleWhite,
                    sign * (outer + BIKE_LANE_WIDTH),
                );
            }
        }
    }

    fn furnish_junction(&mut self, plan: &Plan, node: usize, legs: &[Leg]) {
        let mut ring: Vec<DVec2> = Vec::new();
        let first_edge = self.furniture.edges.len();
        for (i, leg) in legs.iter().enumerate() {
            let next = &legs[(i + 1) % legs.len()];
            let curvatures = [-leg.curvature, next.curvature];
            let corner = connect(leg.left_curb(), next.right_curb(), curvatures, 14.0);
            let corner = Track::through(&corner).points().to_vec();
            ring.push(leg.point(0.0, -leg.right));
            ring.extend(&corner);
            self.furniture.edges.push((RoadEdgeKind::Boundary, corner));
        }
        self.find_mouths(plan, legs, first_edge);
        let control = plan.nodes[node].control;
        if control != Control::Free {
            self.furniture
                .areas
                .push((AreaKind::Intersection, ring.clone()));
        }
        self.furniture.drivable.push(ring);
        for (i, leg) in legs
            .iter()
            .enumerate()
            .filter(|(_, leg)| !leg.incoming.is_empty())
        {
            self.mark_entry(plan, node, i, leg);
        }
    }

    /// The legs of a junction that lead into a car park or yard; `first_edge` is the corner after
    /// the first leg.
    fn find_mouths(&mut self, plan: &Plan, legs: &[Leg], first_edge: usize) {
        let n = legs.len();
        let is_inner = |leg: &Leg| plan.roads[leg.road].is_inner();
        if legs.iter().all(is_inner) {
            self.inner_edges.extend(first_edge..first_edge + n);
            return;
        }
        for (i, _) in legs.iter().enumerate().filter(|(_, leg)| is_inner(leg)) {
            let (before, after) = ((i + n - 1) % n, (i + 1) % n);
            if n < 3 || is_inner(&legs[before]) || is_inner(&legs[after]) {
                continue;
            }
            let (from, to) = (&legs[before], &legs[after]);
            let curvatures = [-from.curvature, to.curvature];
            let curb = connect(from.left_curb(), to.right_curb(), curvatures, 14.0);
            let curb = Track::through(&curb).points().to_vec();
            let corners = [first_edge + before, first_edge + i];
            self.mouths.push(Mouth { corners, curb });
        }
    }

    /// Stop line and stop sign where a leg enters its junction.
    fn mark_entry(&mut self, plan: &Plan, node: usize, i: usize, leg: &Leg) {
        let road = &plan.roads[leg.road];
        let stops = match plan.nodes[node].control {
            Control::AllWayStop => true,
            Control::MinorStop => !road.major,
            _ => false,
        };
        let inner = road.median / 2.0;
        let outer = road.lanes_half_width(!leg.at_start);
        if stops || plan.nodes[node].control == Control::Signals || plan.nodes[node].crosswalks {
            // Between the waiting vehicles and the crosswalk.
            let (near, far) = (-0.4, -0.8_f64.min(STOP_GAP));
            self.furniture.areas.push((
                AreaKind::StopLine,
                vec![
                    leg.point(near, inner),
                    leg.point(far, inner),
                    leg.point(far, outer),
                    leg.point(near, outer),
                ],
            ));
        }
        if stops {
            let ruled = self.junctions[node]
                .connectors
                .iter()
                .copied()
                .filter(|&lane| {
                    let lane = &self.lanes[lane];
                    lane.connector.as_ref().is_some_and(|c| c.from_leg == i) && !lane.is_bike_lane()
                });
            let ruled = ruled.collect();
            self.furniture
                .stop_signs
                .push((leg.point(0.0, leg.left + 0.8), ruled));
        }
    }
}

/// The ring around the strip between two lines that run side by side.
fn strip(right: Vec<DVec2>, left: Vec<DVec2>) -> Vec<DVec2> {
    let mut ring = right;
    ring.extend(backwards(left));
    ring
}

fn backwards(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.reverse();
    points
}
