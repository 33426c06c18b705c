//! The state of all agents and lights at one instant.

use std::sync::Arc;

use gump_geometry::DVec2;

use crate::{Agent, AgentId, LaneId};

/// Colour of a traffic light.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum LightState {
    /// Go.
    Green,
    /// Caution.
    Yellow,
    /// Stop.
    Red,
    /// Not observed.
    Unknown,
}

/// The signal that controls one lane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// The controlled lane.
    pub lane: LaneId,
    /// Its colour now.
    pub state: LightState,
    /// Point at which vehicles stop for it, world frame, metres; `None` if the format has none.
    pub stop_point: Option<DVec2>,
}

/// Agents sorted by id (each at most once) and lights sorted by lane.
///
/// A frame never changes once made; clones share its contents, so that the futures of a scene share
/// its history.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Frame {
    agents: Arc<[Agent]>,
    lights: Arc<[Light]>,
}

impl Frame {
    /// Sorts agents and lights; of several with one id the last wins.
    pub fn new(mut agents: Vec<Agent>, mut lights: Vec<Light>) -> Self {
        // Reverse, stable-sort, keep the first: the last given entry of each id survives.
        agents.reverse();
        agents.sort_by_key(|agent| agent.id);
        agents.dedup_by_key(|agent| agent.id);
        lights.reverse();
        lights.sort_by_key(|light| light.lane);
        lights.dedup_by_key(|light| light.lane);
        Self {
            agents: agents.into(),
            lights: lights.into(),
        }
    }

    /// Whether both are clones of one frame, which share their contents.
    ///
    /// Equal frames that were made separately are not.
    pub fn is_clone_of(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.agents, &other.agents) && Arc::ptr_eq(&self.lights, &other.lights)
    }

    /// All agents, sorted by id.
    pub fn agents(&self) -> &[Agent] {
        &self.agents
    }

    /// The agent with this id, if it is present.
    pub fn agent(&self, id: AgentId) -> Option<&Agent> {
        self.agents
            .binary_search_by_key(&id, |agent| agent.id)
            .ok()
            .map(|i| &self.agents[i])
    }

    /// All lights, sorted by lane.
    pub fn lights(&self) -> &[Light] {
        &self.lights
    }

    /// The light of this lane, if there is one.
    pub fn light(&self, lane: LaneId) -> Option<&Light> {
        self.lights
            .binary_search_by_key(&lane, |light| light.lane)
            .ok()
            .map(|i| &self.lights[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{AgentKind, AgentState};

    fn agent(id: i64, length: f64) -> Agent {
        Agent {
            id: AgentId(id),
            kind: AgentKind::Vehicle,
            length,
            width: 2.0,
            height: 1.5,
            elevation: 0.0,
            state: AgentState::default(),
        }
    }

    #[test]
    fn agents_are_sorted_and_the_last_of_an_id_wins() {
        let frame = Frame::new(vec![agent(3, 1.0), agent(1, 2.0), agent(3, 4.0)], vec![]);
        let ids: Vec<_> = frame.agents().iter().map(|a| a.id.0).collect();
        assert_eq!(ids, [1, 3]);
        assert_eq!(frame.agent(AgentId(3)).unwrap().length, 4.0);
        assert!(frame.agent(AgentId(2)).is_none());
    }
}
