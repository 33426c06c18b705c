//! Size, duration and density of synthetic scenes.

use std::ops::RangeInclusive;

use crate::RoadFamily;

/// Configuration of [`crate::synthesize`]; everything else is drawn from the seed.
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
    /// Target number of vehicles, including parked ones.
    pub vehicles: RangeInclusive<usize>,
    /// Target number of pedestrians.
    pub pedestrians: RangeInclusive<usize>,
    /// Target number of bicycles.
    pub bicycles: RangeInclusive<usize>,
    /// The kind of road; `None` draws one of [`RoadFamily::ALL`] per scene.
    pub family: Option<RoadFamily>,
    /// Whether vehicles have the headings of bodies that are steered at the front ([`crate::steer`]), or
    /// head along the paths of their centres.
    pub steered: bool,
}

impl SynthesisConfig {
    /// Nine seconds at 10 Hz with the present at one second, as in the Waymo Open Motion Dataset,
    /// and 10 to 50 vehicles within about 100 m; numbers are chosen by hand.
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
            steered: true,
        }
    }

    /// The configuration of a version of the generator, field by field: it does not change when
    /// [`Self::standard`] does. `None` for a version that does not exist.
    pub fn of_version(version: u32) -> Option<Self> {
        (1..=2).contains(&version).then_some(Self {
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
            steered: version > 1,
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
