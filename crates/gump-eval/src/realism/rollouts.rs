//! Sources of rollouts of a scenario: a world that simulates them, or files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use gump_data::ReadOptions;
use gump_data::submission::{read_rollouts, with_heights};
use gump_model::Device;
use gump_proto::ScenarioRollouts;
use gump_scene::{Scenario, Seed};
use gump_wosac::realism::{Mode, Rollouts};

use super::Recorded;
use crate::decoding::Decoding;
use crate::imagine::{frames, imagine};
use crate::worlds::{World, WorldName};
use crate::{EvalError, Monitor, RolloutFileError, digest};

/// Seconds that the challenge requires.
const HORIZON_S: f64 = 8.0;

/// Rollouts of one scenario.
pub struct FoundRollouts {
    /// [`Decoding::name`] of a world, [`Decoding::NONE`] of files.
    pub decoding: &'static str,
    /// As the metric takes them.
    pub rollouts: Rollouts,
    /// Digest of simulated rollouts; `None` for those of a file, of which only the paths are known.
    pub digest: Option<String>,
}

/// A source of rollouts: a world that simulates them, or files.
pub struct RolloutSource(Kind);

enum Kind {
    World {
        name: WorldName,
        decoding: Decoding,
        n_rollouts: usize,
        seed: Seed,
        /// The world, once it is built, unless it knows the log.
        built: Option<Box<World>>,
    },
    Files {
        folder: PathBuf,
        by_scenario: BTreeMap<String, PathBuf>,
        /// The file read last: scenarios of a shard follow each other.
        open: Option<(PathBuf, Vec<ScenarioRollouts>)>,
    },
}

impl RolloutSource {
    /// Imagines `n_rollouts` of each scenario; those of scenario `i` come from `seed.fork(i)`.
    pub fn world(name: WorldName, decoding: Decoding, n_rollouts: usize, seed: Seed) -> Self {
        Self(Kind::World {
            name,
            decoding,
            n_rollouts,
            seed,
            built: None,
        })
    }

    /// Reads rollouts from a file or a directory, one file in memory at a time.
    ///
    /// # Errors
    /// A file that cannot be read, or two of one scenario.
    pub fn files(path: &Path) -> Result<Self, EvalError> {
        let mut by_scenario: BTreeMap<String, PathBuf> = BTreeMap::new();
        for file in binproto_files(path)? {
            for message in read_rollouts(&file)? {
                let id = message.scenario_id().to_owned();
                if let Some(other) = by_scenario.insert(id, file.clone()) {
                    return Err(RolloutFileError::RepeatedRollouts {
                        scenario: message.scenario_id().into(),
                        first: other,
                        second: file,
                    }
                    .into());
                }
            }
        }
        if by_scenario.is_empty() {
            let path = path.to_owned();
            return Err(RolloutFileError::NoFiles { path }.into());
        }
        Ok(Self(Kind::Files {
            folder: path.to_owned(),
            by_scenario,
            open: None,
        }))
    }

    /// Options for reading Waymo's messages: which gaps are filled.
    pub fn read_options(&self) -> ReadOptions {
        match &self.0 {
            Kind::World { name, .. } => name.read_options(),
            Kind::Files { .. } => ReadOptions::STATED,
        }
    }

    /// Frames that the monitor of [`rollouts`](Self::rollouts) counts; `None` for files.
    pub fn frames(&self, scenario: &Scenario) -> Option<u64> {
        match &self.0 {
            Kind::World {
                name,
                decoding,
                n_rollouts,
                ..
            } => {
                let n = name.distinct_futures(*n_rollouts);
                Some(frames(scenario, n, &decoding.frames(HORIZON_S)))
            }
            Kind::Files { .. } => None,
        }
    }

    /// Rollouts of one scenario.
    ///
    /// # Errors
    /// An error of the world, a scenario without rollouts, or [`EvalError::Stopped`].
    pub fn rollouts(
        &mut self,
        device: &Device,
        recorded: &Recorded,
        mode: Mode,
        monitor: &dyn Monitor,
    ) -> Result<FoundRollouts, EvalError> {
        let scenario = &recorded.scenario;
        match &mut self.0 {
            Kind::World {
                name,
                decoding,
                n_rollouts,
                seed,
                built,
            } => {
                let sampling = &decoding.sampling;
                if World::is_of_scenario(name, sampling) {
                    *built = None;
                }
                let world = match built {
                    Some(world) => world,
                    None => {
                        let world = World::build(device, name, scenario, sampling)?;
                        built.insert(Box::new(world))
                    }
                };
                // Where there is one future, it stands for all.
                let n = name.distinct_futures(*n_rollouts);
                let seed = seed.fork(recorded.index as u64);
                let frames = decoding.frames(HORIZON_S);
                let imagined = imagine(world, scenario, n, &frames, seed, monitor)?;
                let rollouts = Rollouts::of(&scenario.id, &imagined.rollouts, mode)?;
                Ok(FoundRollouts {
                    decoding: decoding.name,
                    rollouts: rollouts.repeated(n_rollouts.checked_div(n).unwrap_or(0)),
                    digest: Some(digest::of_rollouts(&imagined.rollouts)),
                })
            }
            Kind::Files {
                folder,
                by_scenario,
                open,
            } => {
                let missing = || RolloutFileError::NoRollouts {
                    scenario: scenario.id.clone(),
                    path: folder.clone(),
                };
                let file = by_scenario.get(&scenario.id).ok_or_else(missing)?;
                if open.as_ref().is_none_or(|(path, _)| path != file) {
                    *open = Some((file.clone(), read_rollouts(file)?));
                }
                let mut messages = open.iter().flat_map(|(_, messages)| messages);
                let message = messages
                    .find(|message| message.scenario_id() == scenario.id)
                    .ok_or_else(|| {
                        let path = file.clone();
                        RolloutFileError::Changed { path }
                    })?;
                Ok(FoundRollouts {
                    decoding: Decoding::NONE,
                    rollouts: Rollouts::of_message(&with_heights(message, scenario), mode),
                    digest: None,
                })
            }
        }
    }
}

/// The file, or those of a folder, unfinished ones too: reading them says what they lack.
fn binproto_files(path: &Path) -> Result<Vec<PathBuf>, EvalError> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let cannot = |cause| EvalError::io("list", path, cause);
    let mut files = Vec::new();
    for entry in std::fs::read_dir(path).map_err(cannot)? {
        let file = entry.map_err(cannot)?.path();
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        if file.is_file() && name.contains(".binproto") {
            files.push(file);
        }
    }
    files.sort();
    Ok(files)
}
