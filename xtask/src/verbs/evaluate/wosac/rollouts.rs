//! Where rollouts of a scenario come from: a world that imagines them, or files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use gump_data::ReadOptions;
use gump_data::submission::{read_rollouts, with_heights};
use gump_eval::worlds::{World, WorldName};
use gump_proto::ScenarioRollouts;
use gump_scene::Seed;
use gump_wosac::realism::{Mode, Rollouts};

use super::Recorded;
use crate::decoding::Decoding;
use crate::futures;
use crate::imagine::imagine;
use crate::run::Run;

/// Seconds that the challenge asks for.
const HORIZON_S: f64 = 8.0;

/// Rollouts of one scenario.
pub(crate) struct Found {
    pub(crate) rollouts: Rollouts,
    /// Of what a world imagined; nothing is known of a file's rollouts but their paths.
    pub(crate) digest: Option<String>,
}

/// Where rollouts come from.
pub(crate) enum Source {
    World {
        name: WorldName,
        decoding: Decoding,
        n_rollouts: usize,
        seed: Seed,
        /// The world, once it is built, unless it knows the log.
        built: Option<World>,
    },
    Files {
        folder: PathBuf,
        by_scenario: BTreeMap<String, PathBuf>,
        /// The file read last: scenarios of a shard follow each other.
        open: Option<(PathBuf, Vec<ScenarioRollouts>)>,
    },
}

impl Source {
    /// Imagines rollouts.
    pub(crate) fn world(
        name: WorldName,
        decoding: Decoding,
        n_rollouts: usize,
        seed: Seed,
    ) -> Self {
        Self::World {
            name,
            decoding,
            n_rollouts,
            seed,
            built: None,
        }
    }

    /// Reads rollouts from a file or a directory, one file in memory at a time.
    ///
    /// Error: a file that cannot be read, or two of one scenario.
    pub(crate) fn files(path: &Path) -> anyhow::Result<Self> {
        let mut files = Vec::new();
        if path.is_dir() {
            let entries = std::fs::read_dir(path)
                .with_context(|| format!("cannot list {}", path.display()))?;
            for entry in entries {
                let file = entry?.path();
                let name = file.file_name().unwrap_or_default().to_string_lossy();
                if file.is_file() && name.contains(".binproto") {
                    files.push(file);
                }
            }
            files.sort();
        } else {
            files.push(path.to_owned());
        }
        let mut by_scenario: BTreeMap<String, PathBuf> = BTreeMap::new();
        for file in files {
            for message in read_rollouts(&file)? {
                let id = message.scenario_id().to_owned();
                if let Some(other) = by_scenario.insert(id, file.clone()) {
                    anyhow::bail!(
                        "expected rollouts of scenario {} once, found them in {} and {}",
                        message.scenario_id(),
                        other.display(),
                        file.display()
                    );
                }
            }
        }
        anyhow::ensure!(
            !by_scenario.is_empty(),
            "expected rollouts in files named *.binproto*, found none: {}",
            path.display()
        );
        Ok(Self::Files {
            folder: path.to_owned(),
            by_scenario,
            open: None,
        })
    }

    /// How rollouts are made; files do not tell.
    pub(crate) fn decoding(&self) -> &'static str {
        match self {
            Self::World { decoding, .. } => decoding.name,
            Self::Files { .. } => Decoding::NONE,
        }
    }

    /// Which gaps of Waymo's messages matter.
    pub(crate) fn read_options(&self) -> ReadOptions {
        match self {
            Self::World { name, .. } => super::read_options(name),
            Self::Files { .. } => ReadOptions::STATED,
        }
    }

    /// Rollouts of one scenario.
    ///
    /// Error: what the world reports, or a scenario without rollouts.
    pub(crate) fn rollouts(
        &mut self,
        run: &Run,
        recorded: &Recorded,
        mode: Mode,
    ) -> anyhow::Result<Found> {
        let scenario = &recorded.scenario;
        match self {
            Self::World {
                name,
                decoding,
                n_rollouts,
                seed,
                built,
            } => {
                let sampling = &decoding.sampling;
                if built.is_none() || World::is_of_scenario(name, sampling) {
                    *built = Some(World::build(run.device(), name, scenario, sampling)?);
                }
                let world = built.as_ref().context("the world has just been built")?;
                // Worlds without chance imagine one future; it stands for all.
                let (n, copies) = match name {
                    WorldName::Log | WorldName::ConstantVelocity => (1, *n_rollouts),
                    WorldName::Idm | WorldName::Model(_) => (*n_rollouts, 1),
                };
                let seed = seed.fork(recorded.index as u64);
                let frames = decoding.frames(HORIZON_S);
                let imagined = imagine(run, world, scenario, n, &frames, seed)?;
                let rollouts = Rollouts::of(&scenario.id, &imagined.rollouts, mode)?;
                Ok(Found {
                    rollouts: rollouts.repeated(copies),
                    digest: Some(futures::digest(&imagined.rollouts)),
                })
            }
            Self::Files {
                folder,
                by_scenario,
                open,
            } => {
                let file = by_scenario.get(&scenario.id).with_context(|| {
                    format!("expected rollouts of it, found none: {}", folder.display())
                })?;
                if open.as_ref().is_none_or(|(path, _)| path != file) {
                    *open = Some((file.clone(), read_rollouts(file)?));
                }
                let messages = open.iter().flat_map(|(_, messages)| messages);
                let message = messages
                    .into_iter()
                    .find(|message| message.scenario_id() == scenario.id)
                    .with_context(|| format!("the file has changed: {}", file.display()))?;
                Ok(Found {
                    rollouts: Rollouts::of_message(&with_heights(message, scenario), mode),
                    digest: None,
                })
            }
        }
    }
}
