//! Contacts with the ego, and fault.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::FRAC_PI_6;

use gump_geometry::{OrientedBox, Pose};
use gump_scene::{Agent, AgentId, AgentState, Frame, MapGraph};

use super::Attempt;
use crate::behaviour::reach;
use crate::encounter::classify;

/// Shallower overlaps do not count, metres: they are within tracker errors.
const DEEP_M: f64 = 0.1;
/// An agent slower than this stands and runs into no other, m/s: trackers have as much jitter.
/// (nuPlan's bound of 0.05 is for simulated motion.)
const STANDS: f64 = 0.3;
/// The ego keeps its lane within this distance of the centre line, metres: a car of 2 m is then
/// still on a lane of usual width.
const KEEPS_M: f64 = 0.9;
/// Boxes farther above one another do not meet, metres: bridges are higher, slopes within a box's
/// length lower.
const ABOVE_M: f64 = 3.0;
/// Distance of a car's rear axle behind its centre, as a share of its length.
///
/// Source: 1.46 m of 5.18 m, nuPlan's Pacifica.
const AXLE: f64 = 0.28;

/// A first contact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// The other agent.
    pub agent: AgentId,
    /// Time at which the boxes began to overlap, seconds after the present.
    pub at_s: f64,
}

/// The contacts of a future.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcome {
    /// Near agents that ran into the ego, in order of time.
    pub run_into_ego: Vec<Contact>,
    /// The same of agents that were not near.
    pub others: Vec<Contact>,
    /// The agent that the ego ran into; later contacts are not counted.
    pub ego_runs_into: Option<Contact>,
}

/// The agent at fault for a contact.
enum Blame {
    Other,
    Ego,
    /// Neither moves, for instance where a tracker's boxes grow.
    Nobody,
}

impl Attempt<'_> {
    /// Examines frames from the one after the present; the ego follows the plan.
    pub(super) fn judge(&self, frames: &[Frame]) -> Outcome {
        let mut outcome = Outcome::default();
        let Some(ego) = self.scenario.log[self.scenario.now].agent(self.scenario.ego) else {
            return outcome;
        };
        let mut met = self.touching(ego);
        // Start of the current overlap, by agent.
        let mut began: BTreeMap<AgentId, (usize, Agent)> = BTreeMap::new();
        for (k, frame) in (1..self.plan.len()).zip(frames) {
            let ego = self.ego_in(frame, ego, k);
            let own = ego.oriented_box();
            for agent in frame.agents() {
                let is_other = agent.id != ego.id && agent.kind.is_moving();
                if !is_other || met.contains(&agent.id) {
                    continue;
                }
                let box_ = agent.oriented_box();
                let is_over = (agent.elevation - ego.elevation).abs() > ABOVE_M;
                if is_over || !own.overlaps(&box_) {
                    began.remove(&agent.id);
                    continue;
                }
                let &mut (since, first) = began.entry(agent.id).or_insert((k, *agent));
                if own.signed_distance(&box_) < -DEEP_M {
                    met.insert(agent.id);
                    self.note(&mut outcome, since, &first);
                }
            }
            if outcome.ego_runs_into.is_some() {
                break;
            }
        }
        outcome
    }

    /// Agents that overlap the ego in the present.
    fn touching(&self, ego: &Agent) -> BTreeSet<AgentId> {
        let present = &self.scenario.log[self.scenario.now];
        crate::overlapping(present, ego).collect()
    }

    /// The ego in its planned state, at its height in the world.
    fn ego_in(&self, frame: &Frame, ego: &Agent, k: usize) -> Agent {
        let known = frame.agent(ego.id).unwrap_or(ego);
        Agent {
            elevation: known.elevation,
            ..ego.with_state(self.plan[k])
        }
    }

    fn note(&self, outcome: &mut Outcome, k: usize, other: &Agent) {
        let contact = Contact {
            agent: other.id,
            at_s: k as f64 * self.scenario.dt,
        };
        match self.blame(k, other) {
            Blame::Other if self.near.binary_search(&other.id).is_ok() => {
                outcome.run_into_ego.push(contact);
            }
            Blame::Other => outcome.others.push(contact),
            Blame::Ego => {
                outcome.ego_runs_into.get_or_insert(contact);
            }
            Blame::Nobody => {}
        }
    }

    fn blame(&self, k: usize, other: &Agent) -> Blame {
        let Some(ego) = self.scenario.log[self.scenario.now].agent(self.scenario.ego) else {
            return Blame::Nobody;
        };
        let state = self.plan[k];
        let speed = state.speed();
        if other.state.speed() < STANDS {
            return if speed < STANDS {
                Blame::Nobody
            } else {
                Blame::Ego
            };
        }
        let footprint = OrientedBox {
            pose: state.pose,
            length: ego.length,
            width: ego.width,
        };
        let axle = state.pose * Pose::new(-AXLE * ego.length, 0.0, 0.0);
        match classify(&footprint, axle, speed, other).is_at_fault(self.keeps_lane[k]) {
            true => Blame::Ego,
            false => Blame::Other,
        }
    }
}

/// Whether an ego in these states keeps its lane.
pub(super) fn keeps_lane(map: &MapGraph, plan: &[AgentState]) -> Vec<bool> {
    let keeps = |state: &AgentState| {
        map.lanes().is_empty() || reach::nearest(map, state.pose, KEEPS_M, FRAC_PI_6).is_some()
    };
    plan.iter().map(keeps).collect()
}
