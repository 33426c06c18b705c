//! Profiles: the style of synthetic scenes.

use std::fmt;

use gump_scene::{Scenario, Seed};

use crate::tracker::{Tracker, track};
use crate::{SynthesisConfig, recorded, synthesize};

/// Maximum number of draws of a scene: in the worst of families half of them succeed.
const ATTEMPTS: u64 = 64;

/// The style of synthetic scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Profile {
    /// Idealised traffic on regular roads, with every agent observed all the time: [`synthesize`].
    #[default]
    Plain,
    /// The statistics of recordings by a vehicle with sensors in a town: rows of parked vehicles,
    /// car parks, driveways, side roads without signs, pedestrians in groups and off the
    /// crosswalks, all driving styles, limits and lights that are not recorded; and a tracker with
    /// limited view and noise on the ego. Fitted to `configs/targets/waymo-like.toml`.
    RecordedLike,
}

impl Profile {
    /// Every profile.
    pub const ALL: [Self; 2] = [Self::Plain, Self::RecordedLike];

    /// The name for flags and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::RecordedLike => "recorded-like",
        }
    }

    /// The profile with this name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|profile| profile.name() == name)
    }

    /// The standard configuration, for [`Self::synthesize`].
    pub fn config(self) -> SynthesisConfig {
        match self {
            Self::Plain => SynthesisConfig::standard(),
            Self::RecordedLike => recorded::config(),
        }
    }

    /// Generates one scenario; the same profile, config and seed always give the same one.
    ///
    /// # Panics
    /// If the extent leaves no room for a vehicle to drive through for the logged time.
    pub fn synthesize(self, config: &SynthesisConfig, seed: Seed) -> Scenario {
        let mut scenario = self.synthesize_clean(config, seed);
        if self == Self::RecordedLike {
            track(
                &mut scenario,
                &Tracker::recorded_like(),
                seed.fork(u64::MAX),
            );
        }
        scenario
    }

    /// The scenario of [`Self::synthesize`] without the tracker: all agents are present, with their
    /// true states.
    ///
    /// # Panics
    /// If the extent leaves no room for a vehicle to drive through for the logged time.
    pub fn synthesize_clean(self, config: &SynthesisConfig, seed: Seed) -> Scenario {
        match self {
            Self::Plain => synthesize(config, seed),
            Self::RecordedLike => {
                let drawn = || recorded::draw_family(&mut seed.rng());
                let family = config.family.unwrap_or_else(drawn);
                (0..ATTEMPTS)
                    .find_map(|attempt| recorded::draw_scenario(config, family, seed, attempt))
                    .expect("the extent leaves room for a vehicle to drive through")
            }
        }
    }
}

impl fmt::Display for Profile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
