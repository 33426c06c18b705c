//! Recorded traffic, including its future.

use std::sync::Arc;

use crate::{AgentId, Frame, MapGraph, Route, ScenarioTag, SceneState};

/// Recorded traffic. Only readers, log-based metrics and oracles hold one.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// Name, unique within its dataset.
    pub id: String,
    /// The map.
    pub map: Arc<MapGraph>,
    /// The ego's route, if known or derived, usually from the log including its future.
    pub route: Option<Arc<Route>>,
    /// One frame every `dt` seconds, past and future.
    pub log: Vec<Frame>,
    /// Seconds between frames, > 0.
    pub dt: f64,
    /// Index of the present in `log`.
    pub now: usize,
    /// The ego.
    pub ego: AgentId,
    /// Agents that a benchmark requires to be predicted, sorted; the ego need not be among them.
    pub targets: Vec<AgentId>,
    /// Agents marked as interacting, in the order given.
    pub objects_of_interest: Vec<AgentId>,
    /// The scenario tags that apply, sorted; empty if not known.
    pub tags: Vec<ScenarioTag>,
}

/// Why a recording is not a valid scenario.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ScenarioError {
    /// The log has no present.
    #[error("the present is frame {now} but the log has {frames} frames")]
    NoPresent {
        /// Index of the present.
        now: usize,
        /// Frames in the log.
        frames: usize,
    },
    /// The ego is not in the present frame.
    #[error("the ego (agent {0}) is absent in the present frame")]
    NoEgo(AgentId),
    /// The time step is not a positive number.
    #[error("the time step is {0} s, expected a positive number")]
    TimeStep(f64),
    /// A state is NaN or infinite.
    #[error("agent {agent} has a state that is not a number in frame {frame}")]
    NotFinite {
        /// The agent.
        agent: AgentId,
        /// Index into the log.
        frame: usize,
    },
    /// A box without extent.
    #[error(
        "agent {agent} has size {length} x {width} m in frame {frame}, expected positive numbers"
    )]
    Size {
        /// The agent.
        agent: AgentId,
        /// Index into the log.
        frame: usize,
        /// Its length, metres.
        length: f64,
        /// Its width, metres.
        width: f64,
    },
}

impl Scenario {
    /// Checks the invariants that all users of a scenario rely on.
    ///
    /// # Errors
    /// The first violation as a [`ScenarioError`].
    pub fn validate(&self) -> Result<(), ScenarioError> {
        if !(self.dt > 0.0 && self.dt.is_finite()) {
            return Err(ScenarioError::TimeStep(self.dt));
        }
        let Some(present) = self.log.get(self.now) else {
            return Err(ScenarioError::NoPresent {
                now: self.now,
                frames: self.log.len(),
            });
        };
        if present.agent(self.ego).is_none() {
            return Err(ScenarioError::NoEgo(self.ego));
        }
        for (frame, content) in self.log.iter().enumerate() {
            for a in content.agents() {
                if !a.state.is_finite() || !a.elevation.is_finite() {
                    return Err(ScenarioError::NotFinite { agent: a.id, frame });
                }
                let is_size = |extent: f64| extent > 0.0 && extent.is_finite();
                if !(is_size(a.length) && is_size(a.width)) {
                    let (length, width) = (a.length, a.width);
                    return Err(ScenarioError::Size {
                        agent: a.id,
                        frame,
                        length,
                        width,
                    });
                }
            }
        }
        Ok(())
    }

    /// The present scene without the future. The route is kept, although it reveals where the ego
    /// goes; [`SceneState::unguided`] removes it.
    pub fn present(&self) -> SceneState<'_> {
        self.at(self.now)
    }

    /// The scene as of frame `index` of the log, which must contain the ego.
    pub fn at(&self, index: usize) -> SceneState<'_> {
        SceneState {
            map: &self.map,
            route: self.route.as_ref(),
            history: &self.log[..=index],
            ego: self.ego,
            dt: self.dt,
        }
    }

    /// Logged frames after the present.
    pub fn future(&self) -> &[Frame] {
        &self.log[self.now + 1..]
    }
}
