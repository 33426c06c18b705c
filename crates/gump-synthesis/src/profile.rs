//! What made-up scenes are to be like.

use std::fmt;

use gump_scene::{Scenario, Seed};

use crate::tracker::{Tracker, track};
use crate::{SynthesisConfig, recorded, synthesize};

/// Draws of a scene before giving up: half of them succeed in the worst of families.
const ATTEMPTS: u64 = 64;

/// What made-up scenes are to be like.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Profile {
    /// Tidy traffic on tidy roads, every agent seen all the time: [`synthesize`].
    #[default]
    Plain,
    /// Like recordings of a vehicle with sensors in a town: rows of parked vehicles, car parks,
    /// driveways, side roads without signs, people in groups and off the crosswalks, drivers of
    /// every temper, limits and lights that nobody noted; and a tracker that sees what can be seen
    /// from the ego, with its noise. Fitted to `configs/targets/waymo-like.toml`.
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

    /// How many of what, how long and how far, for [`Self::synthesize`].
    pub fn config(self) -> SynthesisConfig {
        match self {
            Self::Plain => SynthesisConfig::standard(),
            Self::RecordedLike => recorded::config(),
        }
    }

    /// Makes up one scenario; the same profile, config and seed always give the same one.
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

    /// The same scenario as [`Self::synthesize`] makes up, as it was and not as a tracker saw it:
    /// everybody is there, in their true places.
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
