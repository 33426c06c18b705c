//! The legs of a junction: the ends of its roads, where the space inside begins.

use gump_geometry::{DVec2, Pose, angle_difference, wrap_angle};

use crate::network::LaneIdx;
use crate::plan::{Control, NodePlan, Plan, RoadPlan};

/// Depth of a crosswalk along the road, metres. Chosen by hand; the Manual on Uniform Traffic
/// Control Devices asks for at least 1.8 m.
pub(crate) const CROSSWALK_DEPTH: f64 = 3.2;
/// From the stop line to the crosswalk, metres; that manual asks for at least 1.2 m.
pub(crate) const STOP_GAP: f64 = 1.3;
/// From the crosswalk to the rounding of the curb, metres. Chosen by eye.
const CURB_GAP: f64 = 0.5;
/// What the driveway of a car park keeps for itself and for the junction behind it, metres. Chosen by
/// hand.
const DRIVEWAY_M: f64 = 4.5;

/// One road end at a junction, seen looking away from the junction.
#[derive(Clone, Debug)]
pub(crate) struct Leg {
    pub(crate) road: usize,
    /// True if the road's reference starts here.
    pub(crate) at_start: bool,
    /// The end of the junction on the reference, looking away from the junction.
    pub(crate) mouth: Pose,
    /// Curvature of the reference at the mouth when leaving, radians per metre.
    pub(crate) curvature: f64,
    /// Reference metres between the node and the mouth.
    pub(crate) setback: f64,
    /// From the reference to the left curb (traffic towards the junction), metres.
    pub(crate) left: f64,
    /// From the reference to the right curb (traffic away from it), metres.
    pub(crate) right: f64,
    /// Traffic never waits at its end.
    pub(crate) is_open: bool,
    /// Joins the road beyond on its outside, as a ramp does.
    pub(crate) joins: bool,
    /// Lanes towards the junction, innermost first.
    pub(crate) incoming: Vec<LaneIdx>,
    /// Lanes away from it, innermost first.
    pub(crate) outgoing: Vec<LaneIdx>,
    /// Bicycle lane towards the junction.
    pub(crate) bike_in: Option<LaneIdx>,
    /// Bicycle lane away from it.
    pub(crate) bike_out: Option<LaneIdx>,
}

impl Leg {
    /// A point `outward` metres beyond the mouth and `left` metres left of the reference.
    pub(crate) fn point(&self, outward: f64, left: f64) -> DVec2 {
        self.mouth * DVec2::new(outward, left)
    }

    /// The pose on the left curb looking into the junction.
    pub(crate) fn left_curb(&self) -> Pose {
        Pose {
            position: self.point(0.0, self.left),
            heading: wrap_angle(self.mouth.heading + std::f64::consts::PI),
        }
    }

    /// The pose on the right curb looking away from the junction.
    pub(crate) fn right_curb(&self) -> Pose {
        Pose {
            position: self.point(0.0, -self.right),
            heading: self.mouth.heading,
        }
    }
}

/// The legs of `node`, counter-clockwise, without lanes yet.
pub(crate) fn legs_of(plan: &Plan, node: usize) -> Vec<Leg> {
    let ends = plan.roads.iter().enumerate().flat_map(|(road, r)| {
        [0, 1]
            .into_iter()
            .filter(move |&end| r.ends[end] == Some(node))
            .map(move |end| (road, end == 0))
    });
    let mut ends: Vec<_> = ends.collect();
    let direction = |&(road, at_start): &(usize, bool)| outward(&plan.roads[road], at_start, 6.0);
    ends.sort_by(|a, b| direction(a).heading.total_cmp(&direction(b).heading));
    let setbacks = setbacks(plan, &plan.nodes[node], &ends);
    ends.iter()
        .zip(setbacks)
        .map(|(&(road, at_start), setback)| {
            let r = &plan.roads[road];
            let s = if at_start {
                setback
            } else {
                r.reference.length() - setback
            };
            let sign = if at_start { 1.0 } else { -1.0 };
            Leg {
                road,
                at_start,
                mouth: outward(r, at_start, setback),
                curvature: r.reference.curvature_at(s) * sign,
                setback,
                left: r.half_width(!at_start),
                right: r.half_width(at_start),
                is_open: plan.nodes[node].control == Control::Free,
                joins: plan.nodes[node].control == Control::Free && !r.major,
                incoming: Vec::new(),
                outgoing: Vec::new(),
                bike_in: None,
                bike_out: None,
            }
        })
        .collect()
}

/// The pose on the reference `distance` metres from an end, looking away from that end.
fn outward(road: &RoadPlan, at_start: bool, distance: f64) -> Pose {
    if at_start {
        return road.reference.pose_at(distance);
    }
    let pose = road.reference.pose_at(road.reference.length() - distance);
    Pose {
        heading: wrap_angle(pose.heading + std::f64::consts::PI),
        ..pose
    }
}

/// Returns the distance from the node, metres, at which each leg must stop so that curbs can round
/// the corners and crosswalks fit before the rounding.
fn setbacks(plan: &Plan, node: &NodePlan, ends: &[(usize, bool)]) -> Vec<f64> {
    let mut setbacks = vec![node.min_setback; ends.len()];
    for i in 0..ends.len() {
        let j = (i + 1) % ends.len();
        let (a, b) = (&plan.roads[ends[i].0], &plan.roads[ends[j].0]);
        // Roads may bend, so their direction is taken near the corner.
        let heading = |k: usize| {
            let (road, at_start) = (&plan.roads[ends[k].0], ends[k].1);
            outward(road, at_start, (0.25 * road.reference.length()).min(15.0)).heading
        };
        let angle = angle_difference(heading(j), heading(i)).rem_euclid(std::f64::consts::TAU);
        if node.control == Control::Free || !(0.1..2.6).contains(&angle) {
            continue;
        }
        // Left curb of leg i and right curb of leg j meet this far along either leg.
        let (left, right) = (a.half_width(!ends[i].1), b.half_width(ends[j].1));
        let (sin, cos) = angle.sin_cos();
        let tangent = node.corner_radius / (angle / 2.0).tan();
        // A driveway begins at the curb of its road, which may be wide, and leads to a small junction.
        let limit = |road: &RoadPlan| match road.is_inner() {
            true => road.reference.length() - DRIVEWAY_M,
            false => 0.4 * road.reference.length(),
        };
        let along = |mine: f64, other: f64| (other + mine * cos) / sin + tangent.min(12.0);
        setbacks[i] = f64::max(setbacks[i], along(left, right).min(limit(a)));
        setbacks[j] = f64::max(setbacks[j], along(right, left).min(limit(b)));
    }
    if node.crosswalks {
        let depth = if ends.len() == 2 {
            // One crosswalk serves both legs; a little more keeps its sidewalks apart.
            CROSSWALK_DEPTH / 2.0 + STOP_GAP + 0.7
        } else {
            CURB_GAP + CROSSWALK_DEPTH + STOP_GAP
        };
        for setback in &mut setbacks {
            *setback += depth;
        }
    }
    setbacks
}
