//! The driver inside a proposal: how fast along the way, and how to come to its line.

use gump_geometry::{Pose, angle_difference, wrap_angle};
use gump_rollout::worlds::idm_acceleration;
use gump_scene::AgentState;

use crate::ProposalConfig;
use crate::obstacle::{Forecast, Strip};
use crate::path_ahead::PathAhead;

/// Seconds between two decisions of the driver inside a proposal.
pub(crate) const DECISION: f64 = 0.1;
/// Time gained sideways is paid in lateral acceleration; this is what a proposal may cost, metres
/// per second squared. A third of the comfort bound of 4.89 of nuPlan, as curves need some too.
const SIDEWAYS: f64 = 1.5;
/// The shortest way over which a vehicle comes to its line, metres; sharper would exceed what a
/// car can steer.
const SHORTEST_MERGE: f64 = 5.0;

/// How the ego comes from where it is to a line beside the centre of its way.
///
/// The offset obeys the critically damped oscillator over distance driven: place and direction
/// are continuous, and a standing vehicle does not slide.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Merge {
    start: Pose,
    start_s: f64,
    /// Where it goes, metres to the left of the centre.
    target: f64,
    /// How far from there it starts, metres.
    offset: f64,
    /// Change of the offset per metre of the way at the start.
    slope: f64,
    /// Distance over which most of the offset vanishes, metres.
    length: f64,
}

impl Merge {
    pub(crate) fn new(ego: &AgentState, path: &PathAhead, target: f64) -> Self {
        let start_s = path.ego_s;
        let center = path.pose_at(start_s);
        let now = (center.inverse() * ego.pose.position).y;
        let turn = angle_difference(ego.pose.heading, center.heading).clamp(-1.0, 1.0);
        let offset = now - target;
        let gentle = ego.speed() * (offset.abs() / SIDEWAYS).sqrt();
        Self {
            start: ego.pose,
            start_s,
            target,
            offset,
            slope: turn.tan() * along(path, start_s, now),
            length: gentle.max(ego.speed()).max(SHORTEST_MERGE),
        }
    }

    /// Metres to the left of the centre at arc length `s`, and its change per metre of the way.
    fn lateral(&self, s: f64) -> (f64, f64) {
        let driven = (s - self.start_s).max(0.0);
        let rate = self.slope + self.offset / self.length;
        let decay = (-driven / self.length).exp();
        let offset = (self.offset + rate * driven) * decay;
        (self.target + offset, rate * decay - offset / self.length)
    }

    /// Metres driven per metre of the way at `s`.
    fn stretch(&self, path: &PathAhead, s: f64) -> f64 {
        let (lateral, slope) = self.lateral(s);
        along(path, s, lateral).hypot(slope)
    }

    /// The pose at `s`; exactly the present one until the vehicle has moved.
    fn pose(&self, path: &PathAhead, s: f64) -> Pose {
        if s == self.start_s {
            return self.start;
        }
        let (lateral, slope) = self.lateral(s);
        let center = path.pose_at(s);
        let turn = slope.atan2(along(path, s, lateral));
        Pose {
            position: center.position + center.direction().perp() * lateral,
            heading: wrap_angle(center.heading + turn),
        }
    }
}

/// Metres driven along a line `lateral` metres to the left per metre of the centre line: less on
/// the inside of a curve.
fn along(path: &PathAhead, s: f64, lateral: f64) -> f64 {
    // Bounded, because at the centre of a curve there would be no way at all.
    (1.0 - path.curvature_at(s) * lateral).max(0.2)
}

/// One proposal in the making.
pub(crate) struct Driver<'a> {
    pub(crate) config: &'a ProposalConfig,
    pub(crate) path: &'a PathAhead,
    pub(crate) merge: Merge,
    pub(crate) forecast: &'a Forecast,
    /// Arc length of a red light's stop line.
    pub(crate) stop: Option<f64>,
    /// Length and width of the ego, metres.
    pub(crate) size: (f64, f64),
    /// Metres per second.
    pub(crate) desired_speed: f64,
}

impl Driver<'_> {
    pub(crate) fn drive(&self, ego: &AgentState, n_decisions: usize) -> Vec<AgentState> {
        let mut s = self.path.ego_s;
        let mut speed = ego.velocity.dot(ego.pose.direction()).max(0.0);
        let mut states = Vec::new();
        for decision in 0..n_decisions {
            let acceleration = self.acceleration(decision, s, speed);
            let end = (speed + acceleration * DECISION).max(0.0);
            // Less than a whole decision if it comes to rest within.
            let moving = if acceleration < 0.0 {
                DECISION.min(speed / -acceleration)
            } else {
                DECISION
            };
            s += (speed + end) / 2.0 * moving / self.merge.stretch(self.path, s);
            speed = end;
            if (decision + 1).is_multiple_of(self.config.n_decisions_per_state()) {
                let pose = self.merge.pose(self.path, s);
                states.push(AgentState {
                    pose,
                    velocity: pose.direction() * speed,
                });
            }
        }
        states
    }

    /// The most careful answer to everyone ahead and to the red light.
    fn acceleration(&self, decision: usize, s: f64, speed: f64) -> f64 {
        let idm = &self.config.idm;
        let front = s + self.size.0 / 2.0;
        let lateral = |at: f64| self.merge.lateral(at).0;
        let strip = Strip {
            s,
            half_width: self.size.1 / 2.0,
            lateral: &lateral,
        };
        let leads = self.forecast.ahead(decision, &strip);
        let stop = self.stop.map(|stop| (stop - front, 0.0));
        // Beyond this speed the desired gap would be negative and its square would brake.
        let harmless =
            speed + 2.0 * (idm.max_acceleration * idm.max_deceleration).sqrt() * idm.headway;
        leads
            .map(|lead| (lead.rear - front, lead.speed.min(harmless)))
            .chain(stop)
            .chain([(f64::INFINITY, 0.0)])
            .filter(|(gap, _)| *gap < idm.look_ahead || gap.is_infinite())
            .map(|(gap, lead)| idm_acceleration(idm, speed, self.desired_speed, gap, lead))
            .fold(f64::INFINITY, f64::min)
            .clamp(-idm.emergency_deceleration, idm.max_acceleration)
    }
}
