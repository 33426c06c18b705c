//! Ways of decoding: the network alone, under rules, and as in the paper.
//!
//! Results have the network alone beside the network under rules, because rules that look at the
//! same edges and boxes as a score raise the score by themselves.

use gump_engine::SamplingConfig;
use gump_model::Device;
use gump_rollout::SimulateConfig;
use serde::{Deserialize, Serialize};

use crate::worlds::{WorldName, Worlds};

/// A way to make the futures of a world.
#[derive(Clone, Debug, PartialEq)]
pub struct Decoding {
    /// `ruled`, `raw` or `paper`; `-` for worlds that decode nothing.
    pub name: &'static str,
    /// Sampling of the network.
    pub sampling: SamplingConfig,
    /// Conversion of its frames to those of the scene, except for the length.
    frames: SimulateConfig,
}

impl Decoding {
    /// The name for worlds that decode nothing.
    pub const NONE: &'static str = "-";

    /// A decoding with its name: `raw` if no rule corrects it, else `ruled`.
    pub fn of(sampling: SamplingConfig) -> Self {
        Self {
            name: if sampling.has_rules() { "ruled" } else { "raw" },
            sampling,
            frames: SimulateConfig::default(),
        }
    }

    /// The paper's decoding, its interpolation included.
    pub fn paper(sampling: SamplingConfig) -> Self {
        Self {
            name: "paper",
            sampling,
            frames: SimulateConfig::compat(),
        }
    }

    /// The same decoding for a world; a rule-based world decodes nothing.
    pub fn for_world(self, world: &WorldName) -> Self {
        match world {
            WorldName::Model(_) => self,
            WorldName::Log | WorldName::Idm | WorldName::ConstantVelocity => Self {
                name: Self::NONE,
                frames: SimulateConfig::default(),
                ..self
            },
        }
    }

    /// The network alone, decoded the same otherwise.
    pub fn without_rules(&self) -> Self {
        Self::of(self.sampling.clone().without_rules())
    }

    /// The same way with another setting.
    pub fn with(&self, change: impl FnOnce(&mut SamplingConfig)) -> Self {
        let mut changed = self.clone();
        change(&mut changed.sampling);
        changed
    }

    /// Conversion of frames to those of the scene, for a number of seconds.
    pub fn frames(&self, seconds: f64) -> SimulateConfig {
        SimulateConfig {
            seconds,
            ..self.frames.clone()
        }
    }

    /// The name of a world beside others: with the decoding, unless that is the usual one.
    pub fn label(world: &str, name: &str) -> String {
        match name {
            Self::NONE | "ruled" => world.to_owned(),
            name => format!("{world} ({name})"),
        }
    }
}

/// A world and the way it decodes: one column of a comparison.
#[derive(Clone, Debug, PartialEq)]
pub struct DecodedWorld {
    /// The world.
    pub world: WorldName,
    /// The way it decodes.
    pub decoding: Decoding,
}

/// The name of a [`DecodedWorld`], as results are stored under it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DecodedWorldName {
    /// The name of the world.
    pub world: String,
    /// `ruled`, `raw` or `paper`; `-` for worlds that decode nothing.
    pub decoding: String,
}

impl DecodedWorld {
    /// Number of futures to simulate where `n` are requested: deterministic worlds have one.
    pub fn futures(&self, n: usize) -> usize {
        self.world.distinct_futures(n)
    }

    /// Its name in results.
    pub fn name(&self) -> DecodedWorldName {
        DecodedWorldName {
            world: self.world.to_string(),
            decoding: self.decoding.name.into(),
        }
    }
}

/// Every column with its world, which is not loaded yet.
pub(crate) fn columns<'a>(
    device: &Device,
    worlds: &'a [DecodedWorld],
) -> Vec<(&'a DecodedWorld, Worlds<'a>)> {
    let load = |world: &'a DecodedWorld| {
        let sampling = world.decoding.sampling.clone();
        (world, Worlds::new(device, &world.world, sampling))
    };
    worlds.iter().map(load).collect()
}

#[cfg(test)]
mod tests {
    use gump_rollout::Interpolation;

    use super::*;

    #[test]
    fn what_each_decoding_sets_is_pinned() {
        let ruled = Decoding::of(SamplingConfig::default());
        assert_eq!(ruled.name, "ruled");
        assert_eq!((ruled.sampling.redraws, ruled.sampling.limits), (12, true));
        assert_eq!(ruled.frames(8.0), SimulateConfig::default());
        let raw = ruled.without_rules();
        assert_eq!(raw.name, "raw");
        assert_eq!(raw.sampling, SamplingConfig::raw());
        assert_eq!(raw.frames(8.0), ruled.frames(8.0));
        let paper = Decoding::paper(SamplingConfig::paper());
        let expected = SimulateConfig {
            seconds: 3.0,
            interpolation: Interpolation::Linear,
            smoothing_window: 9,
            relative_elevation: true,
            made_scenes: false,
        };
        assert_eq!((paper.name, paper.frames(3.0)), ("paper", expected));
        let idm = paper.for_world(&WorldName::Idm);
        assert_eq!(
            (idm.name, idm.frames(8.0)),
            ("-", SimulateConfig::default())
        );
        assert_eq!(Decoding::label("w", "ruled"), "w");
        assert_eq!(Decoding::label("w", "raw"), "w (raw)");
    }

    #[test]
    fn a_world_without_chance_has_one_future_and_decodes_nothing() {
        let column = |world: WorldName| DecodedWorld {
            decoding: Decoding::of(SamplingConfig::default()).for_world(&world),
            world,
        };
        let (log, idm) = (column(WorldName::Log), column(WorldName::Idm));
        assert_eq!((log.futures(8), idm.futures(8)), (1, 8));
        assert_eq!(log.name().decoding, Decoding::NONE);
        assert_eq!(idm.name().world, "idm");
    }
}
