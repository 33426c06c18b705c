//! `rl`: policies that learn to drive, and how well they drive.

pub(crate) mod evaluate;
pub(crate) mod serve;
pub(crate) mod table;
pub(crate) mod train;

pub(crate) mod columns;
mod curves;
mod learner;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use anyhow::Context as _;
use gump_engine::{LightSource, SamplingConfig};
use gump_eval::benchmarks::ScenarioSetName;
use gump_eval::datasets::{self, Manifest, Part, Split};
use gump_eval::worlds::{World, WorldName};
use gump_model::Device;
use gump_rl::networks::Architecture;
use gump_rl::ppo::PpoConfig;
use gump_rl::sac::SacConfig;
use gump_rl::{Algorithm, Autoreset, EnvConfig, PreparedScenario, TrafficSource};
use serde::{Deserialize, Serialize};
use toml::Table;

use crate::cli::WrongArguments;
use crate::run::Run;
use crate::{benchmark, config};

/// Seconds that an action is held: a frame of the world model, as in the paper.
const STEP: f64 = 0.5;

#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Train a driving policy, by soft actor-critic or proximal policy optimization in a world or by
    /// imitation of the log.
    Train(train::Args),
    /// Evaluate policies in closed loop and print the paper's columns.
    Evaluate(evaluate::Args),
    /// Serve environments to Python and others over a Unix socket, until Ctrl-C.
    Serve(serve::Args),
    /// Train and evaluate all policies of the paper's table, resuming where it stopped.
    Table(table::Args),
}

/// Settings of reinforcement learning in a config file.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    /// Environment: episodes, observations and rewards.
    env: EnvConfig,
    /// Hyperparameters of soft actor-critic, and of imitation alone.
    sac: SacConfig,
    /// Hyperparameters of proximal policy optimization.
    ppo: PpoConfig,
}

impl Settings {
    /// Reads the tables of a config file, or the defaults without one.
    ///
    /// Error: [`WrongArguments`] for a key that does not exist or does not fit.
    fn read(path: Option<&Path>) -> anyhow::Result<Self> {
        let Some(path) = path else {
            return Ok(Self::default());
        };
        let tables = config::tables(path)?;
        config::check_keys(path, &tables, &known_keys()?)?;
        let wrong = |error: &dyn std::fmt::Display| {
            let message = error.to_string().trim().replace('\n', " ");
            WrongArguments(format!("{}: {message}", path.display()))
        };
        let settings: Self =
            toml::from_str(&tables.to_string()).map_err(|error| wrong(&error.message()))?;
        settings.sac.check().map_err(|error| wrong(&error))?;
        settings.ppo.check().map_err(|error| wrong(&error))?;
        let fits = settings.sac.check_form(settings.env.observation.form());
        fits.map_err(|error| wrong(&format!("sac.encoder: {error}")))?;
        if settings.env.autoreset != Autoreset::SameStep {
            return Err(wrong(&"env.autoreset: learners expect \"same-step\"").into());
        }
        Ok(settings)
    }
}

impl Settings {
    /// Sets the steps of runs of an algorithm, if any are given.
    fn set_steps(&mut self, algorithm: Algorithm, steps: Option<usize>) {
        let own = match algorithm {
            Algorithm::Ppo => &mut self.ppo.rounds,
            _ => &mut self.sac.steps,
        };
        *own = steps.unwrap_or(*own);
    }

    /// The first eight hexadecimal digits of the checksum of everything here that a policy of this
    /// algorithm depends on.
    fn digest(&self, algorithm: Algorithm) -> anyhow::Result<String> {
        let learner = match algorithm {
            Algorithm::Ppo => toml::to_string(&self.ppo)?,
            _ => toml::to_string(&self.sac)?,
        };
        let text = format!("{learner}\n{}", toml::to_string(&self.env)?);
        Ok(evaluate::sha256(text.as_bytes())[..8].to_owned())
    }
}

/// The known keys, from which a near miss is suggested; those of the environment are checked as
/// they are read.
fn known_keys() -> anyhow::Result<Table> {
    let sac = SacConfig {
        encoder: Some(Architecture::SmallConv),
        huber: Some(1.0),
        clip: Some(1.0),
        imitation_limit: Some(1.0),
        ..SacConfig::default()
    };
    let mut known = Table::new();
    known.insert("sac".into(), Table::try_from(sac)?.into());
    let ppo = PpoConfig::default();
    known.insert("ppo".into(), Table::try_from(ppo)?.into());
    known.insert("env".into(), true.into());
    Ok(known)
}

/// A world to drive in; the log needs no world model, since the environment replays it.
enum RlWorld {
    Log,
    Imagined(World),
}

impl RlWorld {
    /// Loads what the world needs.
    ///
    /// Error: weights that cannot be read or do not fit, and [`WrongArguments`] for lights that the
    /// environment would replace.
    fn load(
        device: &Device,
        name: &WorldName,
        sampling: &SamplingConfig,
        live_lights: bool,
    ) -> anyhow::Result<Self> {
        Ok(match name {
            WorldName::Log => Self::Log,
            _ if live_lights && sampling.lights == LightSource::Hold => {
                let wrong = "--lights hold: env.live_lights shows the recorded ones, expected \
                             live_lights = false under [env] in --config";
                return Err(WrongArguments(wrong.into()).into());
            }
            _ => Self::Imagined(World::without_log(device, name, sampling)?),
        })
    }

    fn traffic(&self) -> TrafficSource<'_> {
        match self {
            Self::Log => TrafficSource::Log,
            Self::Imagined(world) => TrafficSource::World(world.model()),
        }
    }
}

/// Scenarios that are ready to be driven.
struct PreparedSet {
    /// Name of their set in results.
    name: String,
    scenarios: Arc<[PreparedScenario]>,
}

impl PreparedSet {
    /// The scenarios of a name, at most `limit`. Of a folder with a manifest those of the split
    /// `purpose`, likewise of a list with several splits where the name has none; otherwise all.
    /// Warns if something is to learn from scenes of a frozen set.
    ///
    /// Error: nothing there to read, scenes that differ from their list, or a scenario that cannot
    /// be driven.
    fn read(
        run: &mut Run,
        name: &ScenarioSetName,
        purpose: Split,
        limit: Option<usize>,
    ) -> anyhow::Result<Self> {
        let set = benchmark::find_for(run, name, Some(purpose))?;
        let scenarios = run.phase("read", |run| {
            let progress = run.progress("reading", 0, "scenarios");
            let parts: Vec<Part> = match &set.paths[..] {
                [path] if Manifest::of(path)?.is_some() => datasets::parts(path, purpose)?,
                paths => paths.iter().map(|path| Part::whole(path)).collect(),
            };
            let mut scenarios = datasets::read(&parts, &progress)?;
            scenarios.truncate(limit.unwrap_or(usize::MAX));
            anyhow::ensure!(!scenarios.is_empty(), "no scenario in {name}");
            Ok(scenarios)
        })?;
        if purpose == Split::Train {
            let ids = scenarios.iter().map(|scenario| scenario.id.as_str());
            benchmark::warn_of_frozen(run, ids, "what who learns from them scores")?;
        }
        Ok(Self {
            name: set.name,
            scenarios: PreparedScenario::prepare(scenarios, STEP)?,
        })
    }
}

/// Metadata of a stored policy.
#[derive(Clone, Debug)]
struct Notes {
    algorithm: String,
    train_world: String,
    /// The scenarios it learned on, as the command named them; none as of version 0.1.
    scenes: Option<String>,
    /// [`Self::kind`] of the run whose policy it began with.
    from: Option<String>,
    /// [`Settings::digest`]; none as of version 0.1.
    settings: Option<String>,
    env: EnvConfig,
}

impl Notes {
    /// What policies have in common that differ in their seeds only.
    fn kind(&self) -> String {
        let mut kind = format!("{} in {}", self.algorithm, self.train_world);
        if let Some(settings) = &self.settings {
            kind.push_str(&format!(", settings {settings}"));
        }
        if let Some(from) = &self.from {
            kind.push_str(&format!(", from {from}"));
        }
        kind
    }

    fn to_map(&self) -> anyhow::Result<BTreeMap<String, String>> {
        let mut notes = BTreeMap::from([
            ("algorithm".to_owned(), self.algorithm.clone()),
            ("train_world".to_owned(), self.train_world.clone()),
            ("env".to_owned(), toml::to_string(&self.env)?),
        ]);
        for (key, note) in [
            ("scenes", &self.scenes),
            ("from", &self.from),
            ("settings", &self.settings),
        ] {
            notes.extend(note.clone().map(|note| (key.to_owned(), note)));
        }
        Ok(notes)
    }

    /// Error: an entry that is missing or invalid.
    fn from_map(notes: &BTreeMap<String, String>) -> anyhow::Result<Self> {
        let get = |key: &str| {
            let note = notes.get(key).cloned();
            note.with_context(|| format!("its notes have no \"{key}\""))
        };
        let env = get("env")?;
        Ok(Self {
            algorithm: get("algorithm")?,
            train_world: get("train_world")?,
            scenes: notes.get("scenes").cloned(),
            from: notes.get("from").cloned(),
            settings: notes.get("settings").cloned(),
            env: toml::from_str(&env)
                .map_err(|error| anyhow::anyhow!("its environment: {}", error.message()))?,
        })
    }
}

/// Writes a file whole or not at all.
fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    use std::io::Write as _;
    gump_data::write_atomically(path, |file| {
        file.write_all(bytes)
            .with_context(|| format!("cannot write {}", path.display()))
    })
}

fn read(path: &Path) -> anyhow::Result<Vec<u8>> {
    std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::machine::repository;

    #[test]
    fn the_shipped_configurations_are_understood() {
        for name in ["rl-ppo", "rl-ppo-refine"] {
            let path = repository().join(format!("configs/{name}.toml"));
            let settings = Settings::read(Some(&path)).unwrap();
            assert_ne!(settings.ppo, PpoConfig::default());
        }
        for name in ["rl-tiny", "rl-raster"] {
            let path = repository().join(format!("configs/{name}.toml"));
            let Settings { env, sac, .. } = Settings::read(Some(&path)).unwrap();
            assert_ne!(sac, SacConfig::default());
            assert_eq!(sac.encoder.is_some(), env.observation.packed_len() > 0);
        }
    }

    #[test]
    fn settings_have_a_digest_per_algorithm() {
        let mut settings = Settings::default();
        let of = |settings: &Settings, algorithm| settings.digest(algorithm).unwrap();
        let [sac, ppo] = [Algorithm::Sac, Algorithm::Ppo].map(|a| of(&settings, a));
        assert_ne!(sac, ppo);
        settings.ppo.discount = 0.5;
        assert_eq!(of(&settings, Algorithm::Sac), sac);
        assert_ne!(of(&settings, Algorithm::Ppo), ppo);
        settings.env.rules.reward.collision = -7.0;
        assert_ne!(of(&settings, Algorithm::Sac), sac);
    }

    #[test]
    fn wrong_keys_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.toml");
        let check = |text: &str, expected: &str| {
            std::fs::write(&path, text).unwrap();
            let error = Settings::read(Some(&path)).unwrap_err();
            assert!(error.is::<WrongArguments>());
            assert!(error.to_string().contains(expected), "{error}");
        };
        check("[sac]\nbach = 3", "batch");
        check("[sac]\nbatch = 0", "batch");
        check("[env]\nn_env = 3", "n_envs");
        check("[env]\nautoreset = \"disabled\"", "same-step");
        check("[env.rules.reward]\nprogres = 3", "progress");
        check("[sac]\nencoder = \"small-conv\"", "sac.encoder");
        check("[sac]\nencoder = \"resnet50\"", "resnet18");
    }

    #[test]
    fn notes_come_back() {
        let notes = Notes {
            algorithm: "sac".into(),
            train_world: "model:a.safetensors".into(),
            scenes: Some("a.tfrecord".into()),
            from: Some("ppo in log, settings 0a1b2c3d".into()),
            settings: Some("00112233".into()),
            env: EnvConfig::default(),
        };
        let found = Notes::from_map(&notes.to_map().unwrap()).unwrap();
        assert_eq!(found.env, notes.env);
        assert_eq!(found.train_world, notes.train_world);
        assert_eq!(found.scenes, notes.scenes);
        assert_eq!(found.from, notes.from);
        assert_eq!(found.settings, notes.settings);
        let mut old = notes.to_map().unwrap();
        old.remove("from");
        old.remove("settings");
        let found = Notes::from_map(&old).unwrap();
        assert_eq!(found.kind(), "sac in model:a.safetensors");
        assert!(Notes::from_map(&BTreeMap::new()).is_err());
    }
}
