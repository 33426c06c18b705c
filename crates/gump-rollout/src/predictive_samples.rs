//! Predictive samples: the distributions of agents' next states, represented by draws.

use gump_scene::{AgentId, AgentState};

/// Settings of predictive samples; by default none are recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProbeConfig {
    /// Number of futures of a session to record, the first ones.
    pub futures: usize,
    /// Draws per agent and step.
    pub draws: usize,
}

/// The possible states of one agent one step of its session later.
///
/// They are drawn from the distribution that the agent's state is drawn from, before rules correct
/// it: draws that overlap other agents are included.
#[derive(Clone, Debug, PartialEq)]
pub struct PredictiveSamples {
    /// Index of the future in the session.
    pub future: usize,
    /// Number of steps of the session before it: 0 is sampled from the start.
    pub step: usize,
    /// Length of a step, seconds: the time from the frame it is sampled from to the draws.
    pub step_s: f64,
    /// The agent.
    pub agent: AgentId,
    /// States, world frame, all equally likely.
    pub draws: Vec<AgentState>,
}

impl PredictiveSamples {
    /// Time of the frame it is sampled from, seconds after the start.
    pub fn from_s(&self) -> f64 {
        self.step as f64 * self.step_s
    }
}
