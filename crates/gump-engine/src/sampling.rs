//! Configuration of decoding.
//!
//! Requests to the decoder are in `request`, drawing of bins is in `draw`.

use std::fmt;
use std::str::FromStr;

use gump_kernels::panels::Precision;
use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

/// Configuration of decoding.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SamplingConfig {
    /// The order in which the objects of a frame are decoded.
    pub mode: Mode,
    /// Caching between passes.
    pub cache: CacheMode,
    /// Divides the logits (paper, simulation: 1.1); above 1 gives more varied draws. The default
    /// depends on the network: 0.5 for the sequence network, whose targets were smoothed, and 1 for
    /// the relative one.
    pub temperature: Option<f64>,
    /// Number of bins that may be drawn per field (paper, simulation: 40).
    pub top_k: usize,
    /// Nucleus: draws are among the most likely bins that together have this probability. The
    /// default depends on the network: all of `top_k` for the sequence network, without the least
    /// likely tail for the relative one.
    pub top_p: Option<f64>,
    /// Weight of a prediction made `i` frames ago is `decay^i` (paper: 1.2); 0 switches temporal
    /// averaging off.
    pub decay: f64,
    /// Frames of history in the window (paper: 3).
    pub history: usize,
    /// The source of provisional states in partial-AR decoding.
    pub surrogate: Surrogate,
    /// Whether agents enter and leave; otherwise the set of agents is fixed. A sequence network
    /// decides this itself (on a CPU), as well as the states of lights.
    #[serde(rename = "life", alias = "spawn")]
    pub spawn: bool,
    /// Source of the lights, where the network does not decide them.
    pub lights: LightSource,
    /// Factors on the rates of arrivals and of changes of lights.
    #[serde(rename = "pace", alias = "spawn_rates")]
    pub spawn_rates: RateScale,
    /// Maximum number of redraws of an object that would overlap another or leave the road within
    /// 1.5 s (paper: 0); in partial-AR decoding only.
    pub redraws: usize,
    /// Whether redraws also keep agents clear of an agent that is driven from outside. Without it
    /// only the network makes them react to it.
    pub yields_to_driven: bool,
    /// Whether kinematic limits apply to vehicles and bicycles (paper: no).
    pub limits: bool,
    /// When the vehicles of a relative network are given routes, which they keep; the sequence network
    /// has none.
    pub routes: Routes,
    /// The form in which the weights are multiplied (on a CPU; other devices compute as trained).
    pub precision: Precision,
}

impl Default for SamplingConfig {
    /// `decay` is from result 11 and `redraws` from result 13: more than 12 gain little. `top_k` and
    /// `history` are the paper's.
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
            spawn: false,
            lights: LightSource::Model,
            spawn_rates: RateScale::default(),
            redraws: 12,
            yields_to_driven: true,
            limits: true,
            routes: Routes::default(),
            precision: Precision::F32,
        }
    }
}

impl SamplingConfig {
    /// The network alone: no redraws and no limits; temperature and averaging are the default's.
    pub fn raw() -> Self {
        Self::default().without_rules()
    }

    /// The decoding of the paper's Waymo evaluation: higher temperature, more weight for earlier
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

    /// The same decoding without redraws and limits.
    #[must_use]
    pub fn without_rules(self) -> Self {
        Self {
            redraws: 0,
            limits: false,
            ..self
        }
    }

    /// Whether rules correct the network's draws.
    pub fn has_rules(&self) -> bool {
        self.redraws > 0 || self.limits
    }
}

/// Factors on the network's odds of events in a frame with spawning; 1 leaves them unchanged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RateScale {
    /// Arrival of a further agent.
    pub arrivals: f64,
    /// Change of a light.
    pub light_changes: f64,
}

impl Default for RateScale {
    /// No change: half a minute of synthetic scenes with the shipped weights then has about as many
    /// events as the same scenes simulated by rules (docs/results/0012-generation.md).
    fn default() -> Self {
        Self {
            arrivals: 1.0,
            light_changes: 1.0,
        }
    }
}

/// Source of traffic lights after the present.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum LightSource {
    /// Signal phases, estimated from the observed states.
    #[default]
    Model,
    /// The same as at the present.
    Hold,
    /// The recorded states, which no agent could know.
    Log,
}

impl LightSource {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 3] = [Self::Model, Self::Hold, Self::Log];
}

impl fmt::Display for LightSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for LightSource {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// When vehicles are given routes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Routes {
    /// Never: the network decides every half second where to go.
    Never,
    /// After nine seconds: until then the network knows better than the frequencies of turns.
    #[default]
    Late,
    /// From the second step on.
    Always,
}

impl Routes {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 3] = [Self::Never, Self::Late, Self::Always];
}

impl fmt::Display for Routes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Routes {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// The order in which the objects of a frame are decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Mode {
    /// All at once against surrogates: one transformer pass per frame.
    PartialAr,
    /// One after another: one pass per object.
    FullAr,
}

impl Mode {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 2] = [Self::PartialAr, Self::FullAr];
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Mode {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// Caching between passes, and the length of the window.
///
/// Keys and values are cached token by token as long as the token and all tokens before it are
/// unchanged, so every cache is exact: the result is that of computing the same window anew.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum CacheMode {
    /// Nothing: every pass sees the whole window.
    None,
    /// Keys and values of the window, which slides by one frame per frame. Tokens that slide change
    /// their position, so this saves passes over the window within a frame, not between frames.
    Window,
    /// The window grows from frame to frame until it would be longer than a block, then falls back
    /// to its `history`; only new or changed tokens are computed. It covers more of the past than
    /// [`CacheMode::Window`], so its futures differ.
    Growing,
}

impl CacheMode {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 3] = [Self::None, Self::Window, Self::Growing];
}

impl fmt::Display for CacheMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for CacheMode {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// The source of provisional states.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Surrogate {
    /// Chunks decoded for earlier frames.
    Chunk,
    /// The last state, extrapolated.
    ConstantVelocity,
    /// The last state itself.
    Copy,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_read_as_they_are_written() {
        assert_eq!(
            Mode::ALL.map(|mode| mode.to_string()),
            ["partial-ar", "full-ar"]
        );
        assert_eq!("partial-ar".parse(), Ok(Mode::PartialAr));
        let error = "best".parse::<LightSource>().unwrap_err().to_string();
        assert!(error.contains("`model`, `hold`, `log`"), "{error}");
    }

    /// Every field is spelled out, so that a new one has to be decided for these decodings.
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
            spawn: false,
            lights: LightSource::Model,
            spawn_rates: RateScale {
                arrivals: 1.0,
                light_changes: 1.0,
            },
            redraws: 0,
            yields_to_driven: true,
            limits: false,
            routes: Routes::Late,
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
