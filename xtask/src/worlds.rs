//! Worlds by name: `log`, `idm`, `constant-velocity` and `model:WEIGHTS`.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use gump_model::relative::{self, RelativeSampling, RelativeWorld};
use gump_model::world::TransformerWorld;
use gump_model::{CacheMode, Device, Mode, Outlook, Precision, SamplingConfig, Watch, checkpoint};
use gump_rollout::WorldModel;
use gump_rollout::worlds::{ConstantVelocity, Idm, LogReplay};
use gump_scene::Scenario;
use serde::{Serialize, Serializer};

use crate::cli::WrongArguments;

/// Which world imagines.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum WorldName {
    /// What really happened: an oracle.
    Log,
    /// Rule-driven traffic that reacts.
    Idm,
    /// Everyone goes straight on.
    ConstantVelocity,
    /// A trained network.
    Model(PathBuf),
}

impl FromStr for WorldName {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "log" => Ok(Self::Log),
            "idm" => Ok(Self::Idm),
            "constant-velocity" => Ok(Self::ConstantVelocity),
            _ => match name.strip_prefix("model:") {
                Some(path) if !path.is_empty() => Ok(Self::Model(path.into())),
                _ => Err("expected log, idm, constant-velocity or model:WEIGHTS".into()),
            },
        }
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

/// A world that is ready to imagine.
pub(crate) enum World {
    /// One that follows rules.
    Rule(Box<dyn WorldModel>),
    /// A trained network.
    Learned(Box<TransformerWorld>),
}

impl World {
    /// Builds the world, a network on `device`; only `log` looks at more than the present of the
    /// scenario.
    ///
    /// Error: weights that cannot be read or do not fit.
    pub(crate) fn build(
        device: &Device,
        name: &WorldName,
        scenario: &Scenario,
        sampling: &SamplingConfig,
    ) -> anyhow::Result<Self> {
        match name {
            WorldName::Log => Ok(Self::Rule(Box::new(LogReplay::new(scenario)))),
            _ => Self::without_log(device, name, sampling),
        }
    }

    /// Builds a world that looks at no log.
    ///
    /// Error: the world `log`, and as [`World::build`].
    pub(crate) fn without_log(
        device: &Device,
        name: &WorldName,
        sampling: &SamplingConfig,
    ) -> anyhow::Result<Self> {
        Ok(match name {
            WorldName::Log => anyhow::bail!("the world log needs a scenario to replay"),
            WorldName::Idm => Self::Rule(Box::new(Idm::default())),
            WorldName::ConstantVelocity => Self::Rule(Box::new(ConstantVelocity)),
            WorldName::Model(path) if relative::is_relative(path)? => {
                let network = relative::load(path, device)?;
                let sampling = RelativeSampling {
                    temperature: sampling.temperature,
                    precision: sampling.precision,
                    ..RelativeSampling::default()
                };
                Self::Rule(Box::new(RelativeWorld::new(&network, sampling)?))
            }
            WorldName::Model(path) => {
                let network = checkpoint::load(path, device)?;
                Self::Learned(Box::new(TransformerWorld::new(network, sampling.clone())))
            }
        })
    }

    /// What imagines.
    pub(crate) fn model(&self) -> &dyn WorldModel {
        match self {
            Self::Rule(world) => &**world,
            Self::Learned(world) => &**world,
        }
    }

    /// The same world, which keeps what its agents might have done; rules have nothing to keep.
    pub(crate) fn watching(self, watch: Watch) -> Self {
        match self {
            Self::Learned(world) => Self::Learned(Box::new(world.watching(watch))),
            rule => rule,
        }
    }

    /// What was watched; `None` of a world that follows rules.
    pub(crate) fn take_outlooks(&self) -> Option<Vec<Outlook>> {
        match self {
            Self::Rule(_) => None,
            Self::Learned(world) => Some(world.take_outlooks()),
        }
    }

    /// Transformer passes made so far; rules make none.
    pub(crate) fn passes(&self) -> u64 {
        match self {
            Self::Rule(_) => 0,
            Self::Learned(world) => world.passes(),
        }
    }
}

/// One world for many scenarios: loaded once, but for the log, which is another world in every
/// scenario.
pub(crate) struct Worlds<'a> {
    device: Device,
    name: &'a WorldName,
    sampling: SamplingConfig,
    loaded: Option<World>,
}

impl<'a> Worlds<'a> {
    /// Names a world; nothing is loaded yet.
    pub(crate) fn new(device: &Device, name: &'a WorldName, sampling: SamplingConfig) -> Self {
        Self {
            device: device.clone(),
            name,
            sampling,
            loaded: None,
        }
    }

    /// The world for a scenario.
    ///
    /// Error: as [`World::build`].
    pub(crate) fn of(&mut self, scenario: &Scenario) -> anyhow::Result<&World> {
        let world = match self.loaded.take() {
            Some(world) if *self.name != WorldName::Log => world,
            _ => World::build(&self.device, self.name, scenario, &self.sampling)?,
        };
        Ok(self.loaded.insert(world))
    }
}

/// How a learned world decodes.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct Sampling {
    /// Decode all agents of a frame at once, or one after another
    #[arg(long, value_enum, default_value_t = ModeName::PartialAr)]
    mode: ModeName,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) draw: Draw,
}

/// How a learned world decodes, whatever the order.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct Draw {
    /// What is kept between the passes of a frame
    #[arg(long, value_enum, default_value_t = CacheName::Window)]
    cache: CacheName,
    /// In which form the weights are multiplied
    #[arg(long, value_enum, default_value_t = PrecisionName::F32)]
    precision: PrecisionName,
    /// Divides the logits; above 1 is bolder [default: 0.5]
    #[arg(long, value_name = "X")]
    temperature: Option<f64>,
    /// Bins that may be drawn per field [default: 40]
    #[arg(long, value_name = "N")]
    top_k: Option<usize>,
    /// Weight decay^age of earlier predictions of a moment, 0 for none [default: 0.3]
    #[arg(long, value_name = "X")]
    decay: Option<f64>,
    /// Draws again at most that often what would run into something or off the road, 0 for never [default: 12]
    #[arg(long, value_name = "N")]
    redraws: Option<usize>,
    /// Vehicles and bicycles may turn on the spot and slip sideways as the model says
    #[arg(long)]
    no_limits: bool,
    /// Agents come and leave and lights change as the model says
    #[arg(long)]
    life: bool,
}

#[derive(Clone, Copy, Debug, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum ModeName {
    PartialAr,
    FullAr,
}

#[derive(Clone, Copy, Debug, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum CacheName {
    /// Every pass reads the whole window
    None,
    /// The window slides; within a frame nothing is read twice
    Window,
    /// The window grows as far as it fits; between frames nothing is read twice either
    Growing,
}

#[derive(Clone, Copy, Debug, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum PrecisionName {
    F32,
    Bf16,
    Int8,
}

impl PrecisionName {
    /// The model's form of the name.
    pub(crate) fn resolve(self) -> Precision {
        match self {
            Self::F32 => Precision::F32,
            Self::Bf16 => Precision::Bf16,
            Self::Int8 => Precision::Int8,
        }
    }
}

impl Sampling {
    /// The model's form of the flags.
    ///
    /// Error: [`WrongArguments`] for a number out of its range.
    pub(crate) fn resolve(&self) -> anyhow::Result<SamplingConfig> {
        self.draw.resolve(match self.mode {
            ModeName::PartialAr => Mode::PartialAr,
            ModeName::FullAr => Mode::FullAr,
        })
    }
}

impl Draw {
    /// The model's form of the flags.
    ///
    /// Error: [`WrongArguments`] for a number out of its range.
    pub(crate) fn resolve(&self, mode: Mode) -> anyhow::Result<SamplingConfig> {
        let default = SamplingConfig::default();
        let config = SamplingConfig {
            mode,
            cache: match self.cache {
                CacheName::None => CacheMode::None,
                CacheName::Window => CacheMode::Window,
                CacheName::Growing => CacheMode::Growing,
            },
            precision: self.precision.resolve(),
            life: self.life,
            temperature: self.temperature.unwrap_or(default.temperature),
            top_k: self.top_k.unwrap_or(default.top_k),
            decay: self.decay.unwrap_or(default.decay),
            redraws: self.redraws.unwrap_or(default.redraws),
            limits: !self.no_limits,
            ..default
        };
        let wrong = if !(config.temperature > 0.0 && config.temperature.is_finite()) {
            format!(
                "--temperature: expected a number above 0, found {}",
                config.temperature
            )
        } else if config.top_k == 0 {
            "--top-k: expected at least 1, found 0".into()
        } else if !(config.decay >= 0.0 && config.decay.is_finite()) {
            format!("--decay: expected 0 or more, found {}", config.decay)
        } else {
            return Ok(config);
        };
        Err(WrongArguments(wrong).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_read_as_they_are_written() {
        for name in ["log", "idm", "constant-velocity", "model:a/b.safetensors"] {
            assert_eq!(name.parse::<WorldName>().unwrap().to_string(), name);
        }
        for name in ["", "model:", "model", "IDM"] {
            assert!(name.parse::<WorldName>().is_err(), "{name}");
        }
    }
}
