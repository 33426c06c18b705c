//! How futures are decoded.
//!
//! What lives here: the configuration. What does not: what is asked of the decoder (`request`), and
//! drawing a bin, which is `draw`'s business.

use gump_kernels::panels::Precision;
use serde::{Deserialize, Serialize};

/// How futures are decoded.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SamplingConfig {
    /// One object after another, or all objects of a frame at once.
    pub mode: Mode,
    /// What is kept between passes.
    pub cache: CacheMode,
    /// Divides the logits (paper, simulation: 1.1); above 1 is bolder. Without one draws are as the
    /// network was made for: at 0.5 by the sequence network, whose targets were smoothed, and at 1 by
    /// the relative one.
    pub temperature: Option<f64>,
    /// Bins that may be drawn per field (paper, simulation: 40).
    pub top_k: usize,
    /// Draws are among the likeliest bins that together have this probability. Without one they are
    /// as the network was made for: from all of `top_k` by the sequence network, without the least
    /// likely tail by the relative one.
    pub top_p: Option<f64>,
    /// Weight of a prediction made `i` frames ago is `decay^i` (paper: 1.2); 0 switches aggregation
    /// off.
    pub decay: f64,
    /// Frames of history in the window (paper: 3).
    pub history: usize,
    /// Where provisional states come from in partial-AR decoding.
    pub surrogate: Surrogate,
    /// Whether agents come and leave; else those who are there stay. A sequence network says itself
    /// who does (on a CPU), and what the lights show then.
    pub life: bool,
    /// What lights show, where the network does not say it.
    pub lights: LightSource,
    /// How fast that goes.
    pub pace: RateScale,
    /// How often an object that would run into another or off the road within 1.5 s is drawn again
    /// at most (paper: 0); in partial-AR decoding only.
    pub redraws: usize,
    /// Whether what cannot move by itself or turns too tightly is held back (paper: no).
    pub limits: bool,
    /// In which form the weights are multiplied (on a CPU; other devices compute as trained).
    pub precision: Precision,
}

impl Default for SamplingConfig {
    fn default() -> Self {
        Self {
            mode: Mode::PartialAr,
            cache: CacheMode::Window,
            temperature: None,
            top_k: 40,
            top_p: None,
            decay: 0.3,
            history: 3,
            surrogate: Surrogate::Chunk,
            life: false,
            lights: LightSource::Model,
            pace: RateScale::default(),
            redraws: 12,
            limits: true,
            precision: Precision::F32,
        }
    }
}

impl SamplingConfig {
    /// The network alone: what it says is what happens. Nothing is drawn again and nothing held
    /// back; temperature and averaging are the default's.
    pub fn raw() -> Self {
        Self::default().without_rules()
    }

    /// The decoding of the paper's Waymo evaluation: warmer draws, more weight for earlier
    /// predictions, no rules. Its frames are interpolated by `SimulateConfig::compat` of
    /// `gump-rollout`.
    ///
    /// Source: GUMP (ECCV 2024), section on simulation: temperature 1.1, the 40 likeliest bins,
    /// decay 1.2, three frames of history.
    pub fn paper() -> Self {
        Self {
            temperature: Some(1.1),
            top_k: 40,
            top_p: None,
            decay: 1.2,
            history: 3,
            surrogate: Surrogate::Chunk,
            ..Self::raw()
        }
    }

    /// The same decoding with neither redraws nor limits.
    #[must_use]
    pub fn without_rules(self) -> Self {
        Self {
            redraws: 0,
            limits: false,
            ..self
        }
    }

    /// Whether rules correct what the network says.
    pub fn has_rules(&self) -> bool {
        self.redraws > 0 || self.limits
    }
}

/// Factors on the odds that the network gives to what happens in a frame of living traffic; 1 is what
/// it says.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RateScale {
    /// That a further agent comes.
    pub arrivals: f64,
    /// That a light changes.
    pub light_changes: f64,
}

impl Default for RateScale {
    /// As the network says: that makes half a minute of made-up scenes with the shipped weights about
    /// as lively as the same scenes simulated by rules (docs/results/0012-generation.md).
    fn default() -> Self {
        Self {
            arrivals: 1.0,
            light_changes: 1.0,
        }
    }
}

/// What traffic lights show after the present.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LightSource {
    /// What signals of such junctions do, from what was seen of them.
    #[default]
    Model,
    /// What they show at the present.
    Hold,
    /// What was recorded: nothing that an actor could know.
    Log,
}

/// In which order the objects of a frame are decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// All at once against surrogates: one transformer pass per frame.
    PartialAr,
    /// One after another: one pass per object.
    FullAr,
}

/// What is kept between passes, and how far back the window reaches.
///
/// Keys and values are kept token by token as long as the token and all before it stand where they
/// stood, so every cache is exact: the result is that of reading the same window afresh.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CacheMode {
    /// Nothing: every pass sees the whole window.
    None,
    /// Keys and values of the window, which slides by one frame per frame; what slides changes its
    /// place, so this saves passes over the window within a frame, not between frames.
    Window,
    /// The window grows from frame to frame until it would be longer than a block, then falls back
    /// to its `history`; only what is new or changed is read. Sees more of the past than
    /// [`CacheMode::Window`], so its futures are others.
    Growing,
}

/// Where provisional states come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Surrogate {
    /// Chunks decoded for earlier frames.
    Chunk,
    /// The last state moved on.
    ConstantVelocity,
    /// The last state itself.
    Copy,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every field is spelled out, so that a new one asks what it is in these decodings.
    #[test]
    fn what_raw_and_paper_set_is_pinned() {
        let raw = SamplingConfig {
            mode: Mode::PartialAr,
            cache: CacheMode::Window,
            temperature: None,
            top_k: 40,
            top_p: None,
            decay: 0.3,
            history: 3,
            surrogate: Surrogate::Chunk,
            life: false,
            lights: LightSource::Model,
            pace: RateScale {
                arrivals: 1.0,
                light_changes: 1.0,
            },
            redraws: 0,
            limits: false,
            precision: Precision::F32,
        };
        assert_eq!(SamplingConfig::raw(), raw);
        let paper = SamplingConfig {
            temperature: Some(1.1),
            decay: 1.2,
            ..raw.clone()
        };
        assert_eq!(SamplingConfig::paper(), paper);
        assert!(!raw.has_rules() && !paper.has_rules());
        assert!(SamplingConfig::default().has_rules());
        assert_eq!(SamplingConfig::default().without_rules(), raw);
    }
}
