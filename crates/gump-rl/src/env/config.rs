//! Configuration of an environment.

use serde::{Deserialize, Serialize};
use std::fmt;

use gump_rollout::WorldModel;

use super::Sampling;
use crate::{ObservationSpec, RlError, Rules};

/// Number of episodes, observations and actions.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EnvConfig {
    /// Number of parallel episodes, > 0.
    pub n_envs: usize,
    /// Rules of an episode.
    pub rules: Rules,
    /// Observations.
    pub observation: ObservationSpec,
    /// The moment at which a row whose episode ended gets its next one.
    pub autoreset: Autoreset,
    /// Rule by which episodes choose their scenarios.
    pub sampling: Sampling,
    /// Agents that a world simulates in each episode, those that come nearest to the ego in the
    /// log; all others follow the log, unseen by those simulated, and stand where it ends. `None`
    /// simulates all. For training: a step of a learned world costs as much as it has agents.
    /// [`crate::evaluate`] always simulates all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nearest: Option<usize>,
    /// Whether a world that accepts lights is shown the recorded ones of each moment, those of the
    /// log's last frame past its end. If not, lights are the world's: bare worlds keep those of the
    /// present. The log always has its own.
    pub live_lights: bool,
}

impl Default for EnvConfig {
    /// 128 environments as in the paper.
    fn default() -> Self {
        Self {
            n_envs: 128,
            rules: Rules::default(),
            observation: ObservationSpec::default(),
            autoreset: Autoreset::default(),
            sampling: Sampling::default(),
            nearest: None,
            live_lights: true,
        }
    }
}

/// The moment at which a row whose episode ended gets its next one.
///
/// Source: the modes and names of Gymnasium 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Autoreset {
    /// In the step that ends it; the result of that step is in the final observations.
    #[default]
    SameStep,
    /// In the following step, which ignores the row's action, has a reward of 0 and ends nothing.
    NextStep,
    /// On request; stepping a row that ended is an error.
    Disabled,
}

/// The source of the other agents' motion.
#[derive(Clone, Copy)]
#[non_exhaustive]
pub enum TrafficSource<'w> {
    /// The log: agents follow their recording, whatever the ego does. An episode is truncated where
    /// the log ends.
    Log,
    /// A world, which may react to the ego.
    World(&'w dyn WorldModel),
}

impl TrafficSource<'_> {
    /// A short name for tables and reports.
    pub fn name(&self) -> &str {
        match self {
            Self::Log => "log",
            Self::World(world) => world.name(),
        }
    }
}

impl fmt::Debug for TrafficSource<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl EnvConfig {
    /// Refuses parameters out of range.
    pub(super) fn check(&self) -> Result<(), RlError> {
        let refuse = |(name, value, expected)| {
            Err(RlError::Parameter {
                name,
                value,
                expected,
            })
        };
        if self.n_envs == 0 {
            return refuse(("n_envs", 0.0, "at least one episode"));
        }
        let horizon = self.rules.horizon;
        if !(horizon > 0.0 && horizon.is_finite()) {
            return refuse(("horizon", horizon, "a positive number"));
        }
        if let Some(wrong) = self.rules.dynamics.check().or(self.sampling.check()) {
            return refuse(wrong);
        }
        self.observation.check()
    }
}
