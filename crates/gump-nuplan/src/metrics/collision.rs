//! Collisions of the ego: fault and severity. [`classify`] determines their kinds.

use std::collections::BTreeSet;

use gump_metrics::encounter::{CollisionKind, classify, speed};
use gump_scene::{AgentId, AgentKind};

use super::history::SimulationHistory;

/// The first contact with one agent; later contacts with the same do not count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CollisionEvent {
    /// Index of the sample.
    pub sample: usize,
    /// Time of the sample, microseconds.
    pub time_us: i64,
    /// The other agent.
    pub agent: AgentId,
    /// Its kind.
    pub agent_kind: AgentKind,
    /// The kind of contact.
    pub kind: CollisionKind,
    /// True if the ego is at fault.
    pub at_fault: bool,
    /// Half the relative speed, metres per second.
    pub energy: f64,
}

/// All first contacts of a drive and their score.
#[derive(Clone, Debug, PartialEq)]
pub struct Collisions {
    /// 1 if none is the ego's fault, 0.5 for one with an object, else 0.
    pub score: f64,
    /// First contacts in order of time, within a sample by id.
    pub events: Vec<CollisionEvent>,
}

impl Collisions {
    /// Those that are the ego's fault.
    pub fn at_fault(&self) -> impl Iterator<Item = &CollisionEvent> {
        self.events.iter().filter(|event| event.at_fault)
    }

    /// Number of collisions at the ego's fault with agents for which `counts`.
    pub fn n_at_fault(&self, counts: impl Fn(AgentKind) -> bool) -> usize {
        self.at_fault().filter(|e| counts(e.agent_kind)).count()
    }
}

/// Finds the collisions of a drive.
///
/// `in_one_lane` states for each sample whether the ego is within a lane or within connected ones;
/// elsewhere side contacts are also the ego's fault.
///
/// Source: nuPlan's `no_ego_at_fault_collisions`; per group the score is `1 - n / (allowed + 1)`,
/// at least 0, with one collision allowed with objects and none with road users.
pub fn collisions(drive: &SimulationHistory<'_>, in_one_lane: &[bool]) -> Collisions {
    let mut hit = BTreeSet::new();
    let mut events = Vec::new();
    for (i, sample) in drive.samples.iter().enumerate() {
        let footprint = drive.footprint(sample);
        for agent in drive.others(sample) {
            let known = hit.contains(&agent.id);
            if known || !footprint.touches(&agent.oriented_box()) {
                continue;
            }
            hit.insert(agent.id);
            let ego = &sample.ego;
            let kind = classify(&footprint, ego.rear_axle, ego.speed(), agent);
            let turn = ego.rear_axle.heading - agent.state.pose.heading;
            let (own, its) = (ego.speed(), speed(agent));
            let squared = own * own + its * its - 2.0 * own * its * turn.cos();
            events.push(CollisionEvent {
                sample: i,
                time_us: ego.time_us,
                agent: agent.id,
                agent_kind: agent.kind,
                kind,
                at_fault: kind.is_at_fault(in_one_lane[i]),
                energy: 0.5 * squared.max(0.0).sqrt(),
            });
        }
    }
    let mut found = Collisions { score: 1.0, events };
    let factor = |n: usize, allowed: f64| (1.0 - n as f64 / (allowed + 1.0)).max(0.0);
    let is_vru = |kind| matches!(kind, AgentKind::Pedestrian | AgentKind::Bicycle);
    let is_vehicle = |kind| kind == AgentKind::Vehicle;
    let is_object = |kind| !AgentKind::MOVING.contains(&kind);
    found.score = factor(found.n_at_fault(is_vru), 0.0)
        * factor(found.n_at_fault(is_vehicle), 0.0)
        * factor(found.n_at_fault(is_object), 1.0);
    found
}
