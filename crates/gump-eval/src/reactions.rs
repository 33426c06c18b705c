//! Lets the ego leave its log in several worlds and records the agents that run into it.
//!
//! [`ReactionEvaluation`] tries every manoeuvre of a scenario in every world; the results are
//! stored as [`ScenarioReactions`]. Manoeuvres, the agents that they concern and the definition of
//! a contact are in [`gump_metrics::reactions`].

use std::collections::BTreeMap;

use gump_metrics::reactions::{Attempt, Contact, Manoeuvre, Outcome, Reactions, Reason, Unfit};
use gump_model::Device;
use gump_rollout::{Policy, Scripted};
use gump_scene::{Rollout, Scenario, Seed};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::decoding::{DecodedWorld, DecodedWorldName, columns};
use crate::imagine::{frames, imagine_around};
use crate::results::Entry;
use crate::worlds::Worlds;
use crate::{EvalError, Monitor, ResultsError};

/// Name of the benchmark in stored results.
pub const BENCHMARK: &str = "reactions";

/// The settings that a scenario's results depend on, as they are stored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReactionSettings {
    /// The set, or the name of the file or folder.
    pub scenarios: String,
    /// [`Manoeuvre::name`] of each, in the order of tables.
    pub manoeuvres: Vec<String>,
    /// Length of the futures, seconds.
    pub seconds: u32,
    /// Futures of each manoeuvre.
    pub futures: usize,
    /// Number of scenarios at most.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub limit: Option<usize>,
    /// Sampling of learned worlds, as JSON.
    pub sampling: String,
    /// The seed, in decimal digits.
    pub seed: String,
    /// The worlds, in order.
    pub worlds: Vec<DecodedWorldName>,
}

/// The results of one scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScenarioReactions {
    /// Why nothing can be tried in it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unfit: Option<String>,
    /// In the order of the settings; empty if nothing can be tried.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub tried: Vec<TriedManoeuvre>,
}

/// The results of one manoeuvre.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TriedManoeuvre {
    /// [`Manoeuvre::name`].
    pub manoeuvre: String,
    /// Why it is not scored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
    /// Number of agents near.
    #[serde(default)]
    pub agents: usize,
    /// Number of them that run into the ego where they follow their logs.
    #[serde(default)]
    pub log: usize,
    /// In the order of the settings; empty if it is not scored.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub worlds: Vec<WorldReaction>,
}

/// The futures of one world around one manoeuvre.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WorldReaction {
    /// Number of futures.
    pub futures: usize,
    /// Number of futures in which the ego itself ran into another agent.
    pub ego_at_fault: usize,
    /// Agents that ran into the ego, future by future, in order of time.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub hits: Vec<EgoHit>,
}

/// An agent that ran into the ego.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EgoHit {
    /// The future.
    pub future: usize,
    /// Id of the agent.
    pub agent: i64,
    /// Seconds after the present.
    pub at_s: f64,
    /// Whether it is one of those that are near.
    pub near: bool,
}

impl ScenarioReactions {
    fn unfit(why: &Unfit) -> Self {
        let unfit = Some(why.to_string());
        let tried = Vec::new();
        Self { unfit, tried }
    }
}

impl TriedManoeuvre {
    fn not_scored(manoeuvre: Manoeuvre, why: Reason) -> Self {
        Self {
            manoeuvre: manoeuvre.name().into(),
            why: Some(why.name().into()),
            agents: 0,
            log: 0,
            worlds: Vec::new(),
        }
    }

    fn scored(manoeuvre: Manoeuvre, attempt: &Attempt<'_>, worlds: Vec<WorldReaction>) -> Self {
        Self {
            manoeuvre: manoeuvre.name().into(),
            why: None,
            agents: attempt.near().len(),
            log: attempt.replayed().run_into_ego.len(),
            worlds,
        }
    }
}

impl WorldReaction {
    /// The contacts of an attempt in some futures.
    pub fn of(attempt: &Attempt<'_>, rollouts: &[Rollout]) -> Self {
        let outcomes: Vec<Outcome> = rollouts
            .par_iter()
            .map(|rollout| attempt.outcome(rollout))
            .collect();
        let is_own = |outcome: &&Outcome| outcome.ego_runs_into.is_some();
        let ego_at_fault = outcomes.iter().filter(is_own).count();
        let mut hits = Vec::new();
        for (future, outcome) in outcomes.iter().enumerate() {
            let hit = |contact: &Contact, near: bool| EgoHit {
                future,
                agent: contact.agent.0,
                at_s: contact.at_s,
                near,
            };
            hits.extend(outcome.run_into_ego.iter().map(|c| hit(c, true)));
            hits.extend(outcome.others.iter().map(|c| hit(c, false)));
        }
        Self {
            futures: rollouts.len(),
            ego_at_fault,
            hits,
        }
    }

    /// Number of agents near that ran into the ego, mean over futures.
    pub fn run_into(&self) -> f64 {
        let near = self.hits.iter().filter(|hit| hit.near).count();
        near as f64 / self.futures.max(1) as f64
    }

    /// Share of futures in which any agent ran into the ego.
    pub fn struck(&self) -> f64 {
        let mut futures: Vec<usize> = self.hits.iter().map(|hit| hit.future).collect();
        futures.sort_unstable();
        futures.dedup();
        futures.len() as f64 / self.futures.max(1) as f64
    }

    /// Share of futures in which the ego ran into another agent.
    pub fn at_fault(&self) -> f64 {
        self.ego_at_fault as f64 / self.futures.max(1) as f64
    }
}

/// Manoeuvres to try, and settings of the futures.
#[derive(Clone, Debug, PartialEq)]
pub struct ReactionConfig {
    /// The manoeuvres, in the order of tables.
    pub manoeuvres: Vec<Manoeuvre>,
    /// Length of the futures, seconds; the log must be as long.
    pub seconds: u32,
    /// Futures of each manoeuvre; worlds without chance have one.
    pub futures: usize,
    /// The seed, from which that of every scenario is forked by its position.
    pub seed: Seed,
}

/// Tries manoeuvres in several worlds, each loaded once.
pub struct ReactionEvaluation<'a> {
    config: ReactionConfig,
    worlds: Vec<(&'a DecodedWorld, Worlds<'a>)>,
}

impl<'a> ReactionEvaluation<'a> {
    /// Nothing is loaded yet.
    pub fn new(device: &Device, worlds: &'a [DecodedWorld], config: ReactionConfig) -> Self {
        let worlds = columns(device, worlds);
        Self { config, worlds }
    }

    /// The results of the scenario at position `index` of the set; the monitor gets a part for each
    /// simulation.
    ///
    /// # Errors
    /// As [`Worlds::of`] and [`imagine_around`].
    pub fn score(
        &mut self,
        index: usize,
        scenario: &Scenario,
        monitor: &dyn Monitor,
    ) -> Result<ScenarioReactions, EvalError> {
        let reactions = match Reactions::new(scenario, self.config.seconds.into()) {
            Ok(reactions) => reactions,
            Err(unfit) => return Ok(ScenarioReactions::unfit(&unfit)),
        };
        let seed = self.config.seed.fork(index as u64);
        let mut tried = Vec::new();
        for manoeuvre in self.config.manoeuvres.clone() {
            let attempt = match reactions.attempt(manoeuvre) {
                Ok(attempt) => attempt,
                Err(reason) => {
                    tried.push(TriedManoeuvre::not_scored(manoeuvre, reason));
                    continue;
                }
            };
            let worlds = self.drive(scenario, &attempt, seed, monitor)?;
            tried.push(TriedManoeuvre::scored(manoeuvre, &attempt, worlds));
        }
        Ok(ScenarioReactions { unfit: None, tried })
    }

    /// One manoeuvre in every world.
    fn drive(
        &mut self,
        scenario: &Scenario,
        attempt: &Attempt<'_>,
        seed: Seed,
        monitor: &dyn Monitor,
    ) -> Result<Vec<WorldReaction>, EvalError> {
        let mut reactions = Vec::with_capacity(self.worlds.len());
        for (column, worlds) in &mut self.worlds {
            let world = worlds.of(scenario)?;
            let n = column.futures(self.config.futures);
            let simulate = column.decoding.frames(self.config.seconds.into());
            let part = monitor.part("simulating", frames(scenario, n, &simulate), "frames");
            let mut ego = Scripted::new(attempt.plan(), scenario.dt);
            let driver = Some(&mut ego as &mut dyn Policy);
            let imagined = imagine_around(world, scenario, n, &simulate, seed, driver, &*part)?;
            reactions.push(WorldReaction::of(attempt, &imagined.rollouts));
        }
        Ok(reactions)
    }
}

/// Fails with the most frequent reason if no manoeuvre of any scenario is scored.
///
/// # Errors
/// [`ResultsError::NoManoeuvre`].
pub fn any_scored(entries: &[Entry<ScenarioReactions>]) -> Result<(), EvalError> {
    let tried = || entries.iter().flat_map(|entry| &entry.scores.tried);
    if tried().any(|one| one.why.is_none()) {
        return Ok(());
    }
    let unfit = entries.iter().filter_map(|e| e.scores.unfit.as_deref());
    let reasons = tried().filter_map(|one| one.why.as_deref()).chain(unfit);
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for reason in reasons {
        *counts.entry(reason).or_default() += 1;
    }
    let most = counts.iter().max_by_key(|(_, n)| **n);
    Err(ResultsError::NoManoeuvre {
        scenarios: entries.len(),
        reason: most.map(|(reason, _)| (*reason).to_owned()),
    }
    .into())
}

#[cfg(test)]
mod tests {
    use gump_engine::SamplingConfig;

    use super::*;
    use crate::decoding::Decoding;
    use crate::worlds::WorldName;

    fn config() -> ReactionConfig {
        ReactionConfig {
            manoeuvres: vec![Manoeuvre::Log, Manoeuvre::Brake],
            seconds: 8,
            futures: 4,
            seed: Seed(0),
        }
    }

    fn reactions(text: &str) -> ScenarioReactions {
        let scenario = gump_scene::fixture::scenario(text).unwrap();
        let world = WorldName::Log;
        let log = DecodedWorld {
            decoding: Decoding::of(SamplingConfig::default()).for_world(&world),
            world,
        };
        let columns = [log];
        let mut evaluation = ReactionEvaluation::new(&Device::Cpu, &columns, config());
        evaluation.score(0, &scenario, &()).unwrap()
    }

    #[test]
    fn whoever_follows_closely_in_the_log_runs_into_an_ego_that_brakes() {
        let found = reactions(
            "lane 1: -100,0 250,0\nego vehicle 3: 0,0 velocity 12,0\n\
             agent vehicle 4: -10,0 velocity 12,0\nhistory 1 future 8 dt 0.1",
        );
        let [log, brake] = &found.tried[..] else {
            panic!("{found:?}")
        };
        assert_eq!((log.worlds[0].run_into(), log.worlds[0].futures), (0.0, 1));
        assert_eq!(brake.why, None);
        assert_eq!((brake.agents, brake.log), (1, 1));
        assert_eq!(brake.worlds[0].run_into(), 1.0);
        assert_eq!(brake.worlds[0].struck(), 1.0);
        assert_eq!(brake.worlds[0].at_fault(), 0.0);
        let text = toml::to_string(&found).unwrap();
        assert_eq!(toml::from_str::<ScenarioReactions>(&text).unwrap(), found);
    }

    #[test]
    fn scenarios_in_which_nothing_can_be_tried_say_why() {
        let found = reactions(
            "lane 1: 0,0 99,0\nego vehicle 3: 0,0 velocity 12,0\nhistory 1 future 2 dt 0.1",
        );
        let why = found.unfit.clone().unwrap();
        let entry = Entry {
            index: 0,
            id: "s".into(),
            scores: found,
        };
        let error = any_scored(&[entry]).unwrap_err().to_string();
        assert!(error.ends_with(&format!("most often {why}")), "{error}");
    }
}
