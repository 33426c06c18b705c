//! What single agents do, and who is to be looked at first.

use std::collections::{BTreeMap, BTreeSet};

use gump_scene::{Agent, AgentId, AgentKind, Rollout};
use rayon::prelude::*;

use super::{Behaviour, Measure, Seen};
use crate::logged;
use crate::summary::{is_on_road, leaves_road};

/// Something that a driver would not do, and that the log of the agent does not show.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Deed {
    /// One of the measures of this module.
    Measured(Measure),
    /// A vehicle that is on the road in the present leaves it.
    OffRoad,
}

impl Deed {
    /// Name in reports, `snake_case`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Measured(measure) => measure.name(),
            Self::OffRoad => "off_road",
        }
    }

    /// The deed that a measure is, if it is one: to stand, to set off and to change lanes is
    /// nothing strange of a single agent.
    fn of(measure: Measure) -> Option<Self> {
        matches!(
            measure,
            Measure::ParkedMove
                | Measure::FreeRoadStop
                | Measure::NewOverlap
                | Measure::HardAcceleration
                | Measure::Slip
                | Measure::RedLight
        )
        .then_some(Self::Measured(measure))
    }
}

/// What one agent does in the futures of a scene and not in its log.
#[derive(Clone, Debug, PartialEq)]
pub struct Conduct {
    /// The agent.
    pub agent: AgentId,
    /// What it is.
    pub kind: AgentKind,
    /// In which share of the futures it does what, 0 to 1, the most frequent first.
    pub deeds: Vec<(Deed, f64)>,
    /// In which share of the futures it does any of it.
    pub any: f64,
}

impl Behaviour<'_> {
    /// What every agent of the present that moves by itself does, by id.
    pub fn conduct(&self, rollouts: &[Rollout]) -> Vec<Conduct> {
        let log = self.deeds(&self.log(), &logged(self.scenario));
        let done: Vec<BTreeSet<(AgentId, Deed)>> = rollouts
            .par_iter()
            .map(|rollout| &self.deeds(&self.of(rollout), rollout) - &log)
            .collect();
        let present = self.scenario.present();
        let agents = present.now().agents().iter();
        let moving = agents.filter(|agent| agent.kind.is_moving());
        moving.map(|agent| conduct_of(agent, &done)).collect()
    }

    /// Who does what in one future or the log.
    fn deeds(&self, seen: &Seen, rollout: &Rollout) -> BTreeSet<(AgentId, Deed)> {
        let found = seen.incidents.iter();
        let found = found.filter_map(|one| Some((one.agent, Deed::of(one.measure)?)));
        let agents = rollout.start().agents().iter();
        let off = agents
            .filter(|agent| is_on_road(&rollout.at(0), agent))
            .filter(|agent| leaves_road(rollout, agent.id))
            .map(|agent| (agent.id, Deed::OffRoad));
        found.chain(off).collect()
    }
}

/// What one agent does, of what everyone does in every future.
fn conduct_of(agent: &Agent, done: &[BTreeSet<(AgentId, Deed)>]) -> Conduct {
    let share = |n: usize| n as f64 / done.len().max(1) as f64;
    let mut counts: BTreeMap<Deed, usize> = BTreeMap::new();
    let mut any = 0;
    for done in done {
        let own = done.iter().filter(|(id, _)| *id == agent.id);
        let mut does = false;
        for (_, deed) in own {
            *counts.entry(*deed).or_default() += 1;
            does = true;
        }
        any += usize::from(does);
    }
    let deeds = counts.into_iter().map(|(deed, n)| (deed, share(n)));
    let mut deeds: Vec<_> = deeds.collect();
    deeds.sort_by(|a, b| b.1.total_cmp(&a.1));
    Conduct {
        agent: agent.id,
        kind: agent.kind,
        deeds,
        any: share(any),
    }
}

/// How plausible one agent's futures are.
#[derive(Clone, Debug, PartialEq)]
pub struct Judged {
    /// What it does.
    pub conduct: Conduct,
    /// How likely its log is under the futures, 0 to 1, where that was scored.
    pub realism: Option<f64>,
    /// Realism (1 where it was not scored) times the share of futures in which the agent does
    /// nothing that a driver would not do: 0 for a parked car that pulls out in all of them,
    /// however likely its log is.
    pub plausibility: f64,
}

/// Sets realism, as far as agents have one, and conduct side by side, the least plausible agent
/// first; ties by id.
///
/// The official score is not touched: this ranks whom to look at.
pub fn judge(
    realism: impl IntoIterator<Item = (AgentId, f64)>,
    conduct: Vec<Conduct>,
) -> Vec<Judged> {
    let realism: BTreeMap<AgentId, f64> = realism.into_iter().collect();
    let judged = conduct.into_iter().map(|conduct| {
        let realism = realism.get(&conduct.agent).copied();
        Judged {
            realism,
            plausibility: realism.unwrap_or(1.0) * (1.0 - conduct.any),
            conduct,
        }
    });
    let mut judged: Vec<Judged> = judged.collect();
    judged.sort_by(|a, b| {
        let order = a.plausibility.total_cmp(&b.plausibility);
        // Of several who are as implausible as can be, who does most comes first.
        let sum = |judged: &Judged| {
            judged
                .conduct
                .deeds
                .iter()
                .map(|(_, share)| share)
                .sum::<f64>()
        };
        order.then(sum(b).total_cmp(&sum(a)))
    });
    judged
}
