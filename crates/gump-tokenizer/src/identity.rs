//! Which agent has which key.

use std::collections::BTreeMap;

use gump_geometry::Pose;
use gump_scene::{AgentId, AgentKind, Frame, Rng};
use rand::Rng as _;

use crate::{AGENT_KEYS, class_index};

/// A one-to-one map between agents and key ids, never reused within a window.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Identities {
    keys: BTreeMap<AgentId, u16>,
    agents: BTreeMap<u16, AgentId>,
}

impl Identities {
    /// Ids by rank, as inference uses them: 0 for the ego, then by class and by distance from the
    /// centre where the agent was last seen. Of more than 320 agents the farthest have none.
    pub fn ranked(frames: &[&Frame], ego: AgentId, world_from_scene: Pose) -> Self {
        let mut identities = Self::of_ego(ego);
        for agent in ranked(frames, ego, world_from_scene) {
            identities.insert(agent, identities.agents.len() as u16);
        }
        identities
    }

    /// Ids drawn without replacement, as training uses them, so that every id is learned.
    pub fn shuffled(
        frames: &[&Frame],
        ego: AgentId,
        world_from_scene: Pose,
        rng: &mut Rng,
    ) -> Self {
        let mut ids: Vec<u16> = AGENT_KEYS.map(|id| id as u16).collect();
        for i in (1..ids.len()).rev() {
            ids.swap(i, rng.random_range(0..=i));
        }
        let mut identities = Self::of_ego(ego);
        for (agent, id) in ranked(frames, ego, world_from_scene).into_iter().zip(ids) {
            identities.insert(agent, id);
        }
        identities
    }

    /// The id of an agent.
    pub fn key(&self, agent: AgentId) -> Option<u16> {
        self.keys.get(&agent).copied()
    }

    /// The agent of an id.
    pub fn agent(&self, id: u16) -> Option<AgentId> {
        self.agents.get(&id).copied()
    }

    /// Gives a newborn agent the lowest id above all in use, or the lowest that is free; `None` if
    /// all are taken. An agent that has an id keeps it.
    pub fn allocate(&mut self, agent: AgentId) -> Option<u16> {
        if let Some(id) = self.key(agent) {
            return Some(id);
        }
        let last = *AGENT_KEYS.end() as u16;
        let above = self.agents.keys().next_back().map_or(1, |id| id + 1);
        let id = if above <= last {
            above
        } else {
            (1..=last).find(|id| !self.agents.contains_key(id))?
        };
        self.insert(agent, id);
        Some(id)
    }

    /// (id, agent) in the order of ids.
    pub fn iter(&self) -> impl Iterator<Item = (u16, AgentId)> + '_ {
        self.agents.iter().map(|(&id, &agent)| (id, agent))
    }

    fn of_ego(ego: AgentId) -> Self {
        let mut identities = Self::default();
        identities.insert(ego, 0);
        identities
    }

    fn insert(&mut self, agent: AgentId, id: u16) {
        self.keys.insert(agent, id);
        self.agents.insert(id, agent);
    }
}

/// All moving agents of the window but the ego, at most 320, the nearest; by class, then distance.
fn ranked(frames: &[&Frame], ego: AgentId, world_from_scene: Pose) -> Vec<AgentId> {
    let mut seen: BTreeMap<AgentId, (f64, AgentKind)> = BTreeMap::new();
    for agent in frames.iter().flat_map(|frame| frame.agents()) {
        if agent.id != ego && agent.kind != AgentKind::Other {
            let distance = agent
                .state
                .pose
                .position
                .distance(world_from_scene.position);
            seen.insert(agent.id, (distance, agent.kind));
        }
    }
    let mut all: Vec<(AgentId, f64, AgentKind)> =
        seen.into_iter().map(|(id, (d, k))| (id, d, k)).collect();
    all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    all.truncate(*AGENT_KEYS.end() as usize);
    all.sort_by_key(|(_, _, kind)| class_index(*kind));
    all.into_iter().map(|(id, ..)| id).collect()
}
