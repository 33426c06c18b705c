//! Scores of the tracked proposals.
//!
//! Definitions shared with nuPlan's metrics (fault of collisions, what is ahead, comfort) come from
//! `gump_nuplan::metrics`; this module has PDM's own. All constants are tuPlan Garage's.

use std::collections::BTreeSet;

use gump_geometry::{DVec2, OrientedBox, Quad};
use gump_nuplan::metrics::{classify, is_ahead, is_behind};
use gump_scene::{EgoState, VehicleParameters};

use super::comfort::ComfortFilters;
use super::forecast::{Forecast, MOMENTS, Object, Token};
use super::ground::{Footing, Ground};
use super::propose::Line;

/// Distances driven against the traffic that halve the score, and that set it to 0, metres.
const WRONG_WAY: [f64; 2] = [2.0, 6.0];
/// If no proposal gets farther than this, metres, progress does not count.
pub(crate) const NO_PROGRESS: f64 = 0.1;
/// Steps ahead at which a collision at constant speed is looked for.
const TTC_STEPS: [usize; 4] = [0, 3, 6, 9];
/// Below this speed, metres per second, an agent cannot run into another.
const TTC_STANDING: f64 = 0.005;
/// Distance that is kept behind who stands, metres: the one at which PDM's own drivers stop.
pub(crate) const STANDSTILL_GAP_M: f64 = 1.0;
/// Weights of progress, time to collision and comfort.
pub(crate) const WEIGHTS: [f64; 3] = [5.0, 5.0, 2.0];

/// The score of a proposal with its parts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PdmScore {
    /// The total: the product of the first three parts times the weighted mean of the others.
    pub total: f64,
    /// 1, 0.5 if a static object is hit, 0 if any other agent is, at the ego's fault.
    pub no_at_fault_collision: f64,
    /// 1 if the ego stays on the road, else 0.
    pub drivable_area: f64,
    /// 1, 0.5 or 0 by how far the ego drives against the traffic.
    pub driving_direction: f64,
    /// Progress relative to the proposal that gets farthest.
    pub progress: f64,
    /// 1 if nothing is hit within a second at constant speed, else 0.
    pub time_to_collision: f64,
    /// 1 if it is comfortable, else 0.
    pub comfort: f64,
    /// Progress along the centre line, metres.
    pub progress_m: f64,
    /// Step of the first collision at the ego's fault.
    pub collision_step: Option<usize>,
    /// First step off the road.
    pub off_road_step: Option<usize>,
    /// First step with a collision ahead.
    pub ttc_step: Option<usize>,
}

impl PdmScore {
    pub(crate) fn gates(&self) -> f64 {
        self.no_at_fault_collision * self.drivable_area * self.driving_direction
    }
}

/// Inputs of scoring.
#[derive(Clone, Copy)]
pub(crate) struct Judge<'a> {
    pub(crate) vehicle: &'a VehicleParameters,
    pub(crate) forecast: &'a Forecast,
    pub(crate) ground: &'a Ground,
    pub(crate) centerline: &'a Line,
}

/// One proposal as simulated.
struct Tracked<'a> {
    states: &'a [EgoState],
    boxes: Vec<OrientedBox>,
    quads: Vec<Quad>,
    footings: Vec<Footing>,
}

impl Tracked<'_> {
    fn off_lane(&self, step: usize) -> bool {
        self.footings[step].multiple_lanes || self.footings[step].off_road
    }
}

impl Judge<'_> {
    /// One score per proposal.
    pub(crate) fn judge(
        &self,
        drives: &[Vec<EgoState>],
        comfort: &mut ComfortFilters,
    ) -> Vec<PdmScore> {
        let judged = drives.iter().map(|states| {
            let comfortable = comfort.are_comfortable(states);
            self.parts(states, comfortable)
        });
        let mut scores: Vec<PdmScore> = judged.collect();
        normalize(&mut scores);
        scores
    }

    /// The parts of a score that do not depend on other proposals; [`normalize`] adds the rest.
    pub(crate) fn parts(&self, states: &[EgoState], comfortable: bool) -> PdmScore {
        let tracked = self.track(states);
        let (no_at_fault_collision, collision_step) = self.collision(&tracked);
        let ttc_step = self.time_to_collision(&tracked);
        let off_road_step = tracked.footings.iter().position(|footing| footing.off_road);
        PdmScore {
            no_at_fault_collision,
            collision_step,
            off_road_step,
            ttc_step,
            time_to_collision: f64::from(u8::from(ttc_step.is_none())),
            drivable_area: f64::from(u8::from(off_road_step.is_none())),
            driving_direction: driving_direction(&tracked),
            comfort: f64::from(u8::from(comfortable)),
            progress_m: self.progress(&tracked),
            ..PdmScore::default()
        }
    }

    /// Arc length of the vehicle's centre on the centre line, metres.
    pub(crate) fn place(&self, state: &EgoState) -> f64 {
        let center = self.vehicle.center_of(state.rear_axle);
        self.centerline.project(center.position)
    }

    /// The step from which on, until the last, the ego is less than [`STANDSTILL_GAP_M`] behind
    /// something that stands.
    pub(crate) fn closes_up_at(&self, states: &[EgoState]) -> Option<usize> {
        let is_close = |step: usize| {
            let state = &states[step];
            let shape = self.vehicle.footprint(state.rear_axle);
            let way = state.rear_axle.direction() * STANDSTILL_GAP_M;
            let ahead = Quad::new(shape.corners().map(|corner| corner + way));
            self.forecast.objects.iter().any(|object| {
                touches(&ahead, object, step / 2)
                    && object.stands(step / 2)
                    && is_ahead(state.rear_axle, object.center(step / 2))
            })
        };
        let steps = (0..states.len()).rev();
        steps.take_while(|&step| is_close(step)).last()
    }

    /// True if nothing after these states can open the gates of the score again.
    pub(crate) fn is_lost(&self, states: &[EgoState]) -> bool {
        let tracked = self.track(states);
        tracked.footings.iter().any(|footing| footing.off_road) || self.collision(&tracked).0 == 0.0
    }

    fn track<'s>(&self, states: &'s [EgoState]) -> Tracked<'s> {
        let boxes: Vec<OrientedBox> = states
            .iter()
            .map(|state| self.vehicle.footprint(state.rear_axle))
            .collect();
        let quads: Vec<Quad> = boxes.iter().map(Quad::from).collect();
        let none = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let (min, max) = quads
            .iter()
            .map(Quad::bounds)
            .fold(none, |all, (min, max)| (all.0.min(min), all.1.max(max)));
        let mut surfaces = Vec::new();
        self.ground.within(min, max, &mut surfaces);
        let footings = quads
            .iter()
            .zip(&boxes)
            .map(|(quad, shape)| {
                self.ground
                    .footing(quad.corners(), shape.pose.position, &surfaces)
            })
            .collect();
        Tracked {
            states,
            boxes,
            quads,
            footings,
        }
    }

    fn progress(&self, tracked: &Tracked<'_>) -> f64 {
        let at = |shape: &OrientedBox| self.centerline.project(shape.pose.position);
        let (first, last) = (&tracked.boxes[0], &tracked.boxes[tracked.boxes.len() - 1]);
        (at(last) - at(first)).max(0.0)
    }

    /// The factor for collisions, and the step of the first one at the ego's fault.
    fn collision(&self, tracked: &Tracked<'_>) -> (f64, Option<usize>) {
        let mut ignored = self.forecast.collided.clone();
        let (mut score, mut first) = (1.0, None);
        let nearby = self.nearby(tracked.quads.iter());
        for (step, quad) in tracked.quads.iter().enumerate() {
            for object in &nearby {
                if !touches(quad, object, step / 2) || ignored.contains(&object.token()) {
                    continue;
                }
                let state = &tracked.states[step];
                let met = object.agent(step / 2);
                let kind = classify(&tracked.boxes[step], state.rear_axle, state.speed(), &met);
                if kind.is_at_fault(!tracked.off_lane(step)) {
                    let factor = if object.agent.kind.is_moving() {
                        0.0
                    } else {
                        0.5
                    };
                    score = f64::min(score, factor);
                    first = first.or(Some(step));
                } else {
                    ignored.insert(object.token());
                }
            }
        }
        (score, first)
    }

    /// The first step at which the ego, going straight on, would hit something within a second.
    fn time_to_collision(&self, tracked: &Tracked<'_>) -> Option<usize> {
        let mut ignored: BTreeSet<Token> = self.forecast.collided.clone();
        let ahead = |step: usize, ahead: usize| {
            let state = &tracked.states[step];
            let way = state.rear_axle.direction() * (state.speed() * 0.1 * ahead as f64);
            Quad::new(tracked.quads[step].corners().map(|corner| corner + way))
        };
        let last = TTC_STEPS[TTC_STEPS.len() - 1];
        let far: Vec<Quad> = (0..tracked.quads.len())
            .map(|step| ahead(step, last))
            .collect();
        let nearby = self.nearby(tracked.quads.iter().chain(&far));
        if nearby.is_empty() {
            return None;
        }
        for (step, state) in tracked.states.iter().enumerate() {
            if state.speed() < TTC_STANDING {
                continue;
            }
            let mut careful: Option<bool> = None;
            for later in TTC_STEPS {
                let quad = ahead(step, later);
                let moment = (step + later) / 2;
                for object in &nearby {
                    if !touches(&quad, object, moment) || ignored.contains(&object.token()) {
                        continue;
                    }
                    let place = object.center(moment);
                    let rear_axle = state.rear_axle;
                    let careful = *careful.get_or_insert_with(|| {
                        tracked.off_lane(step) || self.ground.is_in_intersection(rear_axle.position)
                    });
                    if is_ahead(rear_axle, place) || (careful && !is_behind(rear_axle, place)) {
                        return Some(step);
                    }
                    ignored.insert(object.token());
                }
            }
        }
        None
    }

    /// Objects that may ever touch one of these boxes.
    fn nearby<'q>(&self, quads: impl Iterator<Item = &'q Quad>) -> Vec<&Object> {
        let none = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let (low, high) = quads
            .map(Quad::bounds)
            .fold(none, |all, (min, max)| (all.0.min(min), all.1.max(max)));
        let objects = self.forecast.objects.iter();
        objects
            .filter(|object| {
                let (min, max) = object.swept();
                min.cmple(high).all() && low.cmple(max).all()
            })
            .collect()
    }
}

fn touches(quad: &Quad, object: &Object, moment: usize) -> bool {
    let (low, high) = object.bounds(moment.min(MOMENTS - 1));
    let (min, max) = quad.bounds();
    min.cmple(high).all() && low.cmple(max).all() && quad.intersects(&object.quad(moment))
}

/// The factor for the longest stretch driven against the traffic.
fn driving_direction(tracked: &Tracked<'_>) -> f64 {
    let (mut longest, mut stretch) = (0.0f64, 0.0);
    for (step, footing) in tracked.footings.iter().enumerate() {
        if !footing.oncoming {
            stretch = 0.0;
        } else if step > 0 {
            let place = |i: usize| tracked.boxes[i].pose.position;
            stretch += place(step).distance(place(step - 1));
        }
        longest = longest.max(stretch);
    }
    match longest {
        l if l < WRONG_WAY[0] => 1.0,
        l if l < WRONG_WAY[1] => 0.5,
        _ => 0.0,
    }
}

/// Relates progress to the farthest proposal and computes totals.
pub(crate) fn normalize(scores: &mut [PdmScore]) {
    let farthest = scores
        .iter()
        .map(|score| score.progress_m * score.gates())
        .fold(0.0, f64::max);
    for score in scores {
        let gates = score.gates();
        score.progress = if farthest > NO_PROGRESS {
            score.progress_m * gates / farthest
        } else {
            f64::from(u8::from(gates != 0.0))
        };
        let parts = [score.progress, score.time_to_collision, score.comfort];
        let sum: f64 = parts
            .iter()
            .zip(WEIGHTS)
            .map(|(part, weight)| part * weight)
            .sum();
        score.total = gates * sum / WEIGHTS.iter().sum::<f64>();
    }
}
