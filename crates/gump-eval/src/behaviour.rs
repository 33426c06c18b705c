//! Counts of implausible actions, in worlds and in the log.
//!
//! [`BehaviourEvaluation`] simulates the futures of one scenario in every world and counts; the
//! counts are stored as [`ScenarioCounts`], which [`ScenarioTallies`] reads back. What is counted,
//! and per what, is in [`gump_metrics::behaviour`].

use std::collections::BTreeMap;

use gump_metrics::behaviour::{Behaviour, Class, Count, Key, Measure, Tally};
use gump_model::Device;
use gump_scene::{Scenario, Seed};
use serde::{Deserialize, Serialize};

use crate::decoding::{DecodedWorld, DecodedWorldName, columns};
use crate::imagine::{frames, imagine};
use crate::results::Entry;
use crate::worlds::Worlds;
use crate::{EvalError, Monitor, Note, Notes, ResultsError};

/// Name of the benchmark in stored results.
pub const BENCHMARK: &str = "behaviour";

/// The settings that the counts of a scenario depend on, as they are stored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BehaviourSettings {
    /// The set, or the name of the file or folder.
    pub scenarios: String,
    /// Length of the futures, seconds.
    pub seconds: u32,
    /// Futures of each scenario.
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

/// The counts of one scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScenarioCounts {
    /// Of the log.
    pub log: StoredTally,
    /// Of the worlds, in the order of the settings.
    pub worlds: Vec<StoredTally>,
    /// Number of cases by [`Note::name`].
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub notes: BTreeMap<String, usize>,
}

impl ScenarioCounts {
    /// What the scene lacks for signals and arrivals, which are the same in every world that has
    /// them. Notes of unknown names are left out.
    pub fn notes(&self) -> Notes {
        let mut notes = Notes::default();
        for (name, cases) in &self.notes {
            if let Some(note) = Note::of_name(name) {
                notes.add(note, *cases);
            }
        }
        notes
    }

    /// Keeps the notes of the first world that has any.
    fn note(&mut self, notes: &Notes) {
        if self.notes.is_empty() {
            let stored = notes
                .iter()
                .map(|(note, count)| (note.name().into(), count.cases));
            self.notes = stored.collect();
        }
    }
}

/// A [`Tally`] as it is stored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StoredTally {
    /// One for each key.
    #[serde(default)]
    pub cells: Vec<StoredCount>,
}

/// A [`Count`] with its [`Key`], as it is stored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StoredCount {
    /// [`Measure::name`].
    pub measure: String,
    /// [`Class::name`].
    pub class: String,
    /// Seconds after the present.
    pub seconds: u32,
    /// Number of events.
    pub events: f64,
    /// Number of agents, or minutes, that the events are divided by.
    pub of: f64,
}

impl StoredTally {
    /// The stored form of a tally.
    pub fn of(tally: &Tally) -> Self {
        let cell = |(key, count): (&Key, &Count)| StoredCount {
            measure: key.measure.name().into(),
            class: key.class.name().into(),
            seconds: key.seconds,
            events: count.events,
            of: count.of,
        };
        let cells = tally.0.iter().map(cell).collect();
        Self { cells }
    }

    /// The tally.
    ///
    /// # Errors
    /// [`ResultsError::UnknownCount`].
    pub fn tally(&self) -> Result<Tally, EvalError> {
        let mut tally = Tally::default();
        for cell in &self.cells {
            let measure = Measure::of_name(&cell.measure);
            let class = Class::of_name(&cell.class);
            let (measure, class) = measure.zip(class).ok_or_else(|| {
                let (measure, class) = (cell.measure.clone(), cell.class.clone());
                ResultsError::UnknownCount { measure, class }
            })?;
            let key = Key {
                measure,
                class,
                seconds: cell.seconds,
            };
            let (events, of) = (cell.events, cell.of);
            tally.add(key, Count { events, of });
        }
        Ok(tally)
    }
}

/// The tallies of several scenarios.
#[derive(Clone, Debug)]
pub struct ScenarioTallies {
    /// Of the log, one for each scenario.
    pub log: Vec<Tally>,
    /// World by world, one for each scenario.
    pub worlds: Vec<Vec<Tally>>,
}

impl ScenarioTallies {
    /// The tallies of stored results of `n_worlds` worlds; a world that an entry lacks counts
    /// nothing there.
    ///
    /// # Errors
    /// As [`StoredTally::tally`].
    pub fn of(entries: &[Entry<ScenarioCounts>], n_worlds: usize) -> Result<Self, EvalError> {
        let mut tallies = Self {
            log: Vec::with_capacity(entries.len()),
            worlds: vec![Vec::with_capacity(entries.len()); n_worlds],
        };
        for Entry { scores, .. } in entries {
            tallies.log.push(scores.log.tally()?);
            for (i, world) in tallies.worlds.iter_mut().enumerate() {
                let stored = scores.worlds.get(i).map(StoredTally::tally);
                world.push(stored.transpose()?.unwrap_or_default());
            }
        }
        Ok(tallies)
    }
}

/// Settings of the futures and of the counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BehaviourConfig {
    /// Length of the futures, seconds; of a shorter log, only what there is counts.
    pub seconds: u32,
    /// Futures of each scenario; deterministic worlds have one.
    pub futures: usize,
    /// Whether agents that a world spawns are counted too.
    pub spawning: bool,
    /// The seed, from which that of every scenario is forked by its position.
    pub seed: Seed,
}

/// Counts in several worlds, each loaded once.
pub struct BehaviourEvaluation<'a> {
    config: BehaviourConfig,
    worlds: Vec<(&'a DecodedWorld, Worlds<'a>)>,
}

impl<'a> BehaviourEvaluation<'a> {
    /// Nothing is loaded yet.
    pub fn new(device: &Device, worlds: &'a [DecodedWorld], config: BehaviourConfig) -> Self {
        let worlds = columns(device, worlds);
        Self { config, worlds }
    }

    /// The counts of the scenario at position `index` of the set; the monitor gets a part for each
    /// simulation.
    ///
    /// # Errors
    /// As [`Worlds::of`] and [`imagine`].
    pub fn count(
        &mut self,
        index: usize,
        scenario: &Scenario,
        monitor: &dyn Monitor,
    ) -> Result<ScenarioCounts, EvalError> {
        let config = self.config;
        let mut behaviour = Behaviour::new(scenario, config.seconds);
        if config.spawning {
            behaviour = behaviour.with_newcomers();
        }
        let seed = config.seed.fork(index as u64);
        let mut counts = ScenarioCounts {
            log: StoredTally::of(&behaviour.log().tally),
            worlds: Vec::with_capacity(self.worlds.len()),
            notes: BTreeMap::new(),
        };
        for (column, worlds) in &mut self.worlds {
            let world = worlds.of(scenario)?;
            counts.note(&world.notes(scenario));
            let n = column.futures(config.futures);
            let simulate = column.decoding.frames(config.seconds.into());
            let part = monitor.part("simulating", frames(scenario, n, &simulate), "frames");
            let imagined = imagine(world, scenario, n, &simulate, seed, &*part)?;
            let tally = behaviour.tally(&imagined.rollouts);
            counts.worlds.push(StoredTally::of(&tally));
        }
        Ok(counts)
    }
}

#[cfg(test)]
mod tests {
    use gump_engine::SamplingConfig;

    use super::*;
    use crate::decoding::Decoding;
    use crate::worlds::WorldName;

    #[test]
    fn the_log_replayed_counts_as_the_log_and_reads_back_as_it_was_stored() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 250,0\nego vehicle 3: 10,0 velocity 10,0\n\
             agent vehicle 4: 30,0 velocity 10,0\nhistory 1 future 8 dt 0.1",
        )
        .unwrap();
        let columns = [WorldName::Log, WorldName::ConstantVelocity].map(|world| DecodedWorld {
            decoding: Decoding::of(SamplingConfig::default()).for_world(&world),
            world,
        });
        let config = BehaviourConfig {
            seconds: 8,
            futures: 4,
            spawning: false,
            seed: Seed(0),
        };
        let mut evaluation = BehaviourEvaluation::new(&Device::Cpu, &columns, config);
        let counts = evaluation.count(0, &scenario, &()).unwrap();
        assert!(!counts.log.cells.is_empty());
        assert_eq!(counts.worlds.len(), 2);
        assert_eq!(counts.worlds[0], counts.log);
        let text = toml::to_string(&counts).unwrap();
        assert_eq!(toml::from_str::<ScenarioCounts>(&text).unwrap(), counts);
        let entry = Entry {
            index: 0,
            id: scenario.id.clone(),
            scores: counts,
        };
        let tallies = ScenarioTallies::of(&[entry], 3).unwrap();
        assert_eq!(tallies.worlds[0][0].0, tallies.log[0].0);
        assert!(tallies.worlds[2][0].0.is_empty());
    }

    #[test]
    fn what_a_scene_lacks_is_stored_with_its_counts() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 250,0\nlight 8 red:\nlight 9 red:\n\
             ego vehicle 3: 10,0 velocity 10,0\nhistory 1 future 8 dt 0.1",
        )
        .unwrap();
        let columns = [WorldName::Log, WorldName::ConstantVelocity].map(|world| DecodedWorld {
            decoding: Decoding::of(SamplingConfig::default()).for_world(&world),
            world,
        });
        let config = BehaviourConfig {
            seconds: 8,
            futures: 1,
            spawning: false,
            seed: Seed(0),
        };
        let mut evaluation = BehaviourEvaluation::new(&Device::Cpu, &columns, config);
        let counts = evaluation.count(0, &scenario, &()).unwrap();
        assert_eq!(counts.notes().cases(Note::UnmappedLight), 2);
        let text = toml::to_string(&counts).unwrap();
        let read: ScenarioCounts = toml::from_str(&text).unwrap();
        assert_eq!(read.notes(), counts.notes());
        // Results of former versions have no notes.
        let former = text.split("[notes]").next().unwrap();
        let former: ScenarioCounts = toml::from_str(former).unwrap();
        assert!(former.notes().is_empty() && former.log == counts.log);
    }

    #[test]
    fn an_unknown_measure_is_named() {
        let stored = StoredTally {
            cells: vec![StoredCount {
                measure: "grace".into(),
                class: "vehicle".into(),
                seconds: 8,
                events: 1.0,
                of: 2.0,
            }],
        };
        let error = stored.tally().unwrap_err().to_string();
        assert!(error.ends_with("found grace of vehicle"), "{error}");
    }
}
