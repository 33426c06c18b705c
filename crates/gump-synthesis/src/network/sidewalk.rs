//! Sidewalks along the curbs, around the corners and across the road.

use gump_geometry::{Pose, wrap_angle};

use crate::curve::{Track, connect, line};
use crate::network::leg::{CROSSWALK_DEPTH, Leg, STOP_GAP};
use crate::network::{Crosswalk, Network, Walk};
use crate::plan::Plan;

/// Distance of a sidewalk's middle from the curb, metres: people keep up to 1.1 m beside the
/// middle, so half of it is left between them and the road.
const BESIDE: f64 = 2.2;

/// Distance of a crosswalk's middle from the mouth of its leg, towards the junction, metres.
pub(crate) const CROSSWALK_INSIDE: f64 = STOP_GAP + CROSSWALK_DEPTH / 2.0;

impl Network {
    /// Lays the walks; a walk along a road runs between the crosswalks at its ends or the border.
    pub(crate) fn lay_walks(&mut self, plan: &Plan, legs: &[Vec<Leg>], trimmed: &[Track]) {
        // Two nodes per road end (left and right of the reference): 4 per road.
        self.n_walk_nodes = 4 * plan.roads.len();
        let node = |road: usize, at_start: bool, left: bool| {
            4 * road + 2 * usize::from(!at_start) + usize::from(left)
        };
        for (road, r) in plan.roads.iter().enumerate().filter(|(_, r)| r.sidewalks) {
            for left in [false, true] {
                let beside = r.half_width(!left) + BESIDE;
                let track = trimmed[road].offset(if left { beside } else { -beside });
                let ends = [node(road, true, left), node(road, false, left)];
                self.walks.push(Walk {
                    track,
                    ends,
                    crosswalk: None,
                });
            }
        }
        for (junction, legs) in legs.iter().enumerate() {
            for (i, leg) in legs.iter().enumerate() {
                // Looking outward from the far end, left and right change sides.
                let side =
                    |leg: &Leg, left: bool| node(leg.road, leg.at_start, left == leg.at_start);
                let next = &legs[(i + 1) % legs.len()];
                if plan.roads[leg.road].sidewalks && plan.roads[next.road].sidewalks {
                    let inset = if plan.nodes[junction].crosswalks {
                        CROSSWALK_INSIDE
                    } else {
                        0.0
                    };
                    let (from, to) = (beside_left(leg, inset), beside_right(next, inset));
                    let points = connect(from, to, [0.0; 2], 6.0);
                    let ends = [side(leg, true), side(next, false)];
                    self.walks.push(Walk {
                        track: Track::through(&points),
                        ends,
                        crosswalk: None,
                    });
                }
                let is_first = legs.len() > 2 || i == 0;
                if plan.nodes[junction].crosswalks && plan.roads[leg.road].sidewalks && is_first {
                    self.lay_crosswalk(junction, i, leg, [side(leg, false), side(leg, true)]);
                }
            }
        }
    }

    fn lay_crosswalk(&mut self, junction: usize, i: usize, leg: &Leg, ends: [usize; 2]) {
        let at = |outward: f64, left: f64| leg.point(outward - CROSSWALK_INSIDE, left);
        let half = CROSSWALK_DEPTH / 2.0;
        let track = Track::through(&line(
            at(0.0, -leg.right - BESIDE),
            at(0.0, leg.left + BESIDE),
        ));
        self.walks.push(Walk {
            track,
            ends,
            crosswalk: Some(self.crosswalks.len()),
        });
        self.crosswalks.push(Crosswalk {
            junction,
            leg: i,
            ring: vec![
                at(-half, -leg.right),
                at(half, -leg.right),
                at(half, leg.left),
                at(-half, leg.left),
            ],
            on_road: (BESIDE, BESIDE + leg.right + leg.left),
            passed_by: Vec::new(),
        });
    }
}

fn beside_left(leg: &Leg, inset: f64) -> Pose {
    Pose {
        position: leg.point(-inset, leg.left + BESIDE),
        heading: wrap_angle(leg.mouth.heading + std::f64::consts::PI),
    }
}

fn beside_right(leg: &Leg, inset: f64) -> Pose {
    Pose {
        position: leg.point(-inset, -leg.right - BESIDE),
        heading: leg.mouth.heading,
    }
}
