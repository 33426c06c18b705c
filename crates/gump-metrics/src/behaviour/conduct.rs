//! Implausible actions (deeds) of single agents, and a ranking of agents by plausibility.

use std::collections::{BTreeMap, BTreeSet};

use gump_scene::{Agent, AgentId, AgentKind, Rollout};
use rayon::prelude::*;

use super::{Behaviour, Measure, Seen};
use crate::logged;
use crate::summary::{is_on_road, leaves_road};

/// An implausible action that the log of the agent does not show.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
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

    /// The deed of a measure, if it is one: standing, starting and changing lanes are normal.
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

/// The deeds of one agent in the futures of a scene that its log does not show.
#[derive(Clone, Debug, PartialEq)]
pub struct Conduct {
    /// The agent.
    pub agent: AgentId,
    /// Its kind.
    pub kind: AgentKind,
    /// Each deed with its share of futures, 0 to 1, the most frequent first.
    pub deeds: Vec<(Deed, f64)>,
    /// Share of futures with any deed.
    pub any: f64,
}

impl Behaviour<'_> {
    /// The deeds of every moving agent of the present, by id.
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

    /// Deeds by agent, in one future or the log.
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

/// The deeds of one agent, from those of all agents in all futures.
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

/// Plausibility of one agent's futures.
#[derive(Clone, Debug, PartialEq)]
pub struct Judged {
    /// Its deeds.
    pub conduct: Conduct,
    /// Likelihood of its log under the futures, 0 to 1, where that was scored.
    pub realism: Option<f64>,
    /// Realism (1 where it was not scored) times the share of futures without deeds of the agent: 0
    /// for a parked car that pulls out in all of them, even if its log is likely.
    pub plausibility: f64,
}

/// Combines realism, of the agents that have one, with conduct, the least plausible agent first;
/// ties by id.
///
/// The official score is not changed; this is a ranking for inspection.
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
        // Among equally implausible agents, the one with the highest sum comes first.
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
