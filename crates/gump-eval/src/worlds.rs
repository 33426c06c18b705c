//! Worlds by name: `log`, `idm`, `constant-velocity` and `model:WEIGHTS`.

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use gump_data::ReadOptions;
use gump_engine::relative::{RelativeSampling, RelativeWorld};
use gump_engine::{LightSource, SamplingConfig, TransformerWorld};
use gump_model::{Device, checkpoint, relative};
use gump_rollout::WorldModel;
use gump_rollout::worlds::{ConstantVelocity, Idm, LogReplay};
use gump_scene::Scenario;
use gump_traffic::{Arrivals, LightControl, Living, LivingConfig, Notes, RecordedLights};
use serde::{Serialize, Serializer};

use crate::{ArgumentError, EvalError};

/// A world by name.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum WorldName {
    /// The recording: an oracle.
    Log,
    /// Rule-driven traffic that reacts.
    Idm,
    /// Constant velocity.
    ConstantVelocity,
    /// A trained network.
    Model(PathBuf),
}

impl FromStr for WorldName {
    type Err = EvalError;

    /// Reads `log`, `idm`, `constant-velocity` or `model:WEIGHTS`; a path of weights alone is that
    /// model.
    ///
    /// # Errors
    /// [`ArgumentError::NoSuchWorld`].
    fn from_str(name: &str) -> Result<Self, EvalError> {
        match name {
            "log" => Ok(Self::Log),
            "idm" => Ok(Self::Idm),
            "constant-velocity" => Ok(Self::ConstantVelocity),
            _ => match name.strip_prefix("model:") {
                Some(path) if !path.is_empty() => Ok(Self::Model(path.into())),
                // No other world has such a name, so the meaning is clear.
                None if name.ends_with(WEIGHTS) => Ok(Self::Model(name.into())),
                _ => Err(no_such_world(name).into()),
            },
        }
    }
}

impl WorldName {
    /// Number of distinct futures among `n`: deterministic worlds have one.
    pub fn distinct_futures(&self, n: usize) -> usize {
        match self {
            Self::Log | Self::ConstantVelocity => n.min(1),
            Self::Idm | Self::Model(_) => n,
        }
    }

    /// Options for reading Waymo's messages: the gaps that matter to the world.
    pub fn read_options(&self) -> ReadOptions {
        match self {
            Self::Log | Self::ConstantVelocity => ReadOptions::STATED,
            Self::Idm | Self::Model(_) => ReadOptions::ALL,
        }
    }
}

/// Extension of files of weights.
const WEIGHTS: &str = ".safetensors";

/// A file of weights, given by its path or by the name of a world.
///
/// # Errors
/// [`ArgumentError::NoWeights`].
pub fn weights(name: &str) -> Result<PathBuf, EvalError> {
    match name.parse() {
        Ok(WorldName::Model(path)) => Ok(path),
        Ok(found) => Err(ArgumentError::NoWeights { found }.into()),
        Err(_) => Ok(name.into()),
    }
}

/// Why a name is not a world.
fn no_such_world(name: &str) -> ArgumentError {
    let is_path = name.contains(['/', '\\', '.']) || Path::new(name).exists();
    ArgumentError::NoSuchWorld {
        found: name.into(),
        is_path: is_path && !name.starts_with("model:"),
    }
}

impl fmt::Display for WorldName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Log => f.write_str("log"),
            Self::Idm => f.write_str("idm"),
            Self::ConstantVelocity => f.write_str("constant-velocity"),
            Self::Model(path) => write!(f, "model:{}", path.display()),
        }
    }
}

impl Serialize for WorldName {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// A world that is ready to simulate.
#[non_exhaustive]
pub enum World {
    /// A rule-based world with its own lights and agents: the log.
    Rule(Box<dyn WorldModel>),
    /// A rule-based world with signals, arrivals and departures.
    Living(Box<Living<Box<dyn WorldModel>>>),
    /// A trained network of sequences.
    Learned(Box<TransformerWorld>),
    /// A trained network with relative attention.
    Relative(Box<Living<RelativeWorld>>),
}

impl World {
    /// Builds the world, with its network on `device`; only `log` uses more than the present of the
    /// scenario.
    ///
    /// # Errors
    /// Weights that cannot be read or do not fit.
    pub fn build(
        device: &Device,
        name: &WorldName,
        scenario: &Scenario,
        sampling: &SamplingConfig,
    ) -> Result<Self, EvalError> {
        match name {
            WorldName::Log => Ok(Self::Rule(Box::new(LogReplay::new(scenario)))),
            _ => {
                let recorded = || LightControl::Recorded(Arc::new(RecordedLights::of(scenario)));
                Self::with_lights(device, name, sampling, recorded)
            }
        }
    }

    /// Builds a world that does not use the log.
    ///
    /// # Errors
    /// The world `log`, lights as recorded, and as [`World::build`].
    pub fn without_log(
        device: &Device,
        name: &WorldName,
        sampling: &SamplingConfig,
    ) -> Result<Self, EvalError> {
        if sampling.lights == LightSource::Log {
            return Err(ArgumentError::RecordedLightsWithoutScenario.into());
        }
        Self::with_lights(device, name, sampling, || LightControl::Hold)
    }

    fn with_lights(
        device: &Device,
        name: &WorldName,
        sampling: &SamplingConfig,
        recorded: impl Fn() -> LightControl,
    ) -> Result<Self, EvalError> {
        let living = LivingConfig {
            lights: match sampling.lights {
                LightSource::Model => LightControl::Signals,
                LightSource::Hold => LightControl::Hold,
                LightSource::Log => recorded(),
                found => return Err(ArgumentError::UnsupportedLights { found }.into()),
            },
            arrivals: sampling.spawn.then(Arrivals::default),
        };
        let with_life =
            |world: Box<dyn WorldModel>, living| Self::Living(Box::new(Living::new(world, living)));
        Ok(match name {
            WorldName::Log => return Err(ArgumentError::LogWithoutScenario.into()),
            WorldName::Idm => with_life(Box::<Idm>::default(), living),
            WorldName::ConstantVelocity => with_life(Box::new(ConstantVelocity), living),
            WorldName::Model(path) if relative::is_relative(path)? => {
                let network = relative::load(path, device)?;
                let world = RelativeWorld::new(&network, RelativeSampling::from(sampling))?;
                Self::Relative(Box::new(Living::new(world, living)))
            }
            WorldName::Model(path) => {
                let network = checkpoint::load(path, device)?;
                Self::Learned(Box::new(TransformerWorld::new(network, sampling.clone())))
            }
        })
    }

    /// Whether a world of this name has to be built for every scenario.
    pub fn is_of_scenario(name: &WorldName, sampling: &SamplingConfig) -> bool {
        *name == WorldName::Log || sampling.lights == LightSource::Log
    }

    /// The world model.
    pub fn model(&self) -> &dyn WorldModel {
        match self {
            Self::Rule(world) => &**world,
            Self::Living(world) => &**world,
            Self::Learned(world) => &**world,
            Self::Relative(world) => &**world,
        }
    }

    /// The world model, to be shared.
    #[must_use]
    pub fn into_model(self) -> Arc<dyn WorldModel> {
        match self {
            Self::Rule(world) => world.into(),
            Self::Living(world) => Arc::<Living<Box<dyn WorldModel>>>::from(world),
            Self::Learned(world) => Arc::<TransformerWorld>::from(world),
            Self::Relative(world) => Arc::<Living<RelativeWorld>>::from(world),
        }
    }

    /// Whether the world cannot simulate on a map without lanes.
    pub fn follows_lanes(&self) -> bool {
        match self {
            Self::Rule(_) => false,
            Self::Living(world) => world.name() == "idm",
            Self::Learned(_) | Self::Relative(_) => true,
        }
    }

    /// What the present of a scenario lacks for signals, arrivals and departures; nothing for worlds
    /// that have their own.
    pub fn notes(&self, scenario: &Scenario) -> Notes {
        match self {
            Self::Rule(_) | Self::Learned(_) => Notes::default(),
            Self::Living(world) => world.notes(&scenario.present()),
            Self::Relative(world) => world.notes(&scenario.present()),
        }
    }
}

/// One world for many scenarios: loaded once, except for the parts that depend on the scenario,
/// which are the log and recorded lights.
pub struct Worlds<'a> {
    device: Device,
    name: &'a WorldName,
    sampling: SamplingConfig,
    loaded: Option<World>,
}

impl<'a> Worlds<'a> {
    /// Stores the name of a world; nothing is loaded yet.
    pub fn new(device: &Device, name: &'a WorldName, sampling: SamplingConfig) -> Self {
        Self {
            device: device.clone(),
            name,
            sampling,
            loaded: None,
        }
    }

    /// The world for a scenario.
    ///
    /// # Errors
    /// As [`World::build`].
    pub fn of(&mut self, scenario: &Scenario) -> Result<&World, EvalError> {
        let world = match self.loaded.take() {
            Some(world) if !World::is_of_scenario(self.name, &self.sampling) => world,
            _ => World::build(&self.device, self.name, scenario, &self.sampling)?,
        };
        Ok(self.loaded.insert(world))
    }
}

#[cfg(test)]
mod tests {
    use gump_traffic::Note;

    use super::*;

    #[test]
    fn worlds_note_what_a_scene_lacks() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -60,0 60,0\nlight 9 red:\nego vehicle 0: 0,0 velocity 8,0",
        )
        .unwrap();
        let cases = |name: &str, lights: LightSource| {
            let sampling = SamplingConfig {
                lights,
                ..SamplingConfig::default()
            };
            let name = name.parse().unwrap();
            let world = World::build(&Device::Cpu, &name, &scenario, &sampling).unwrap();
            world.notes(&scenario).cases(Note::UnmappedLight)
        };
        assert_eq!(cases("idm", LightSource::Model), 1);
        assert_eq!(cases("constant-velocity", LightSource::Model), 1);
        // Lights that stay, or that the log has, need no lane.
        assert_eq!(cases("idm", LightSource::Hold), 0);
        assert_eq!(cases("log", LightSource::Model), 0);
    }

    #[test]
    fn names_read_as_they_are_written() {
        for name in ["log", "idm", "constant-velocity", "model:a/b.safetensors"] {
            assert_eq!(name.parse::<WorldName>().unwrap().to_string(), name);
        }
        for name in ["", "model:", "model", "IDM"] {
            assert!(name.parse::<WorldName>().is_err(), "{name}");
        }
        let bare: WorldName = "a/b.safetensors".parse().unwrap();
        assert_eq!(bare.to_string(), "model:a/b.safetensors");
        for bare in ["model", "model:"] {
            let error = bare.parse::<WorldName>().unwrap_err().to_string();
            let shipped = "model:datasets/weights/gump-relative.safetensors";
            assert!(error.ends_with(shipped), "{error}");
        }
        let other = "a/b.bin".parse::<WorldName>().unwrap_err().to_string();
        assert!(
            other.ends_with("for weights in a file: model:a/b.bin"),
            "{other}"
        );
    }
}
