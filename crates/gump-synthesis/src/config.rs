//! How large, how long and how busy made-up scenes are.

use std::ops::RangeInclusive;

use crate::RoadFamily;

/// What [`crate::synthesize`] is asked for; everything else is drawn from the seed.
#[derive(Clone, Debug, PartialEq)]
pub struct SynthesisConfig {
    /// Logged seconds before the present.
    pub history_s: f64,
    /// Logged seconds after the present.
    pub future_s: f64,
    /// Seconds between frames, also the step of the traffic simulation; at most 0.2.
    pub dt: f64,
    /// Simulated seconds before the first logged frame, so that queues have formed.
    pub warmup_s: f64,
    /// Multiplies the numbers of agents drawn from the ranges below; 1 leaves them.
    pub density: f64,
    /// Distance from the centre of the scene to where its roads end, metres.
    pub extent_m: f64,
    /// Vehicles a scene aims at, parked ones included.
    pub vehicles: RangeInclusive<usize>,
    /// People on foot a scene aims at.
    pub pedestrians: RangeInclusive<usize>,
    /// Bicycles a scene aims at.
    pub bicycles: RangeInclusive<usize>,
    /// The kind of road; `None` draws one of [`RoadFamily::ALL`] per scene.
    pub family: Option<RoadFamily>,
}

impl SynthesisConfig {
    /// Nine seconds at 10 Hz with the present at one second, as the Waymo Open Motion Dataset has
    /// them, and 10 to 50 vehicles within about 100 m.
    pub fn standard() -> Self {
        Self {
            history_s: 1.0,
            future_s: 8.0,
            dt: 0.1,
            warmup_s: 25.0,
            density: 1.0,
            extent_m: 120.0,
            vehicles: 12..=60,
            pedestrians: 0..=14,
            bicycles: 0..=5,
            family: None,
        }
    }

    /// What a version of the generator asked for, field by field: it stays as it is when
    /// [`Self::standard`] moves on. `None` for a version that does not exist.
    pub fn of_version(version: u32) -> Option<Self> {
        (version == 1).then_some(Self {
            history_s: 1.0,
            future_s: 8.0,
            dt: 0.1,
            warmup_s: 25.0,
            density: 1.0,
            extent_m: 120.0,
            vehicles: 12..=60,
            pedestrians: 0..=14,
            bicycles: 0..=5,
            family: None,
        })
    }

    /// Index of the present in the log.
    pub fn now(&self) -> usize {
        (self.history_s / self.dt).round() as usize
    }

    /// Number of frames in the log.
    pub fn n_frames(&self) -> usize {
        self.now() + (self.future_s / self.dt).round() as usize + 1
    }
}
