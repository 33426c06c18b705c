//! The assignment of key ids to agents.
//!
//! An id belongs to one agent as long as any frame of the window contains it, and is not reused
//! while it does. Classes are not stored here; the grammar defines the canonical order within a
//! frame.

use std::collections::BTreeMap;

use gump_geometry::Pose;
use gump_scene::{AgentId, AgentKind, Frame, Rng};
use rand::seq::SliceRandom;

use crate::AGENT_KEYS;

/// A one-to-one map between agents and key ids; the ego is 0.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identities {
    keys: BTreeMap<AgentId, u16>,
    agents: BTreeMap<u16, AgentId>,
    /// Larger than every agent id seen, so that a newborn agent never gets the id of a recorded
    /// one.
    next_agent: i64,
}

impl Identities {
    /// Ids by rank, for inference: the same scene always has the same ids.
    ///
    /// Every moving agent of `frames` (oldest first) gets one: by class, then by distance from the
    /// centre at its last observation, then by agent id; the class is the first one observed. Of
    /// more than 320 agents the farthest get none.
    pub fn ranked(frames: &[&Frame], ego: AgentId, world_from_scene: Pose) -> Self {
        Self::with_ids(
            frames,
            ego,
            world_from_scene,
            AGENT_KEYS.map(|id| id as u16),
        )
    }

    /// Ids drawn at random from 1..=320 without replacement, for training: ranked ids would leave
    /// the high ones untrained. The agents with an id are those of [`Self::ranked`].
    pub fn shuffled(
        frames: &[&Frame],
        ego: AgentId,
        world_from_scene: Pose,
        rng: &mut Rng,
    ) -> Self {
        let mut ids: Vec<u16> = AGENT_KEYS.map(|id| id as u16).collect();
        ids.shuffle(rng);
        Self::with_ids(frames, ego, world_from_scene, ids)
    }

    /// The id of an agent.
    pub fn key(&self, agent: AgentId) -> Option<u16> {
        self.keys.get(&agent).copied()
    }

    /// The agent with an id.
    pub fn agent(&self, id: u16) -> Option<AgentId> {
        self.agents.get(&id).copied()
    }

    /// Gives an agent the lowest free id; `None` if all are used. An agent that has one keeps it.
    ///
    /// Ids given one after the other ascend, as the canonical order within a class requires.
    pub fn allocate(&mut self, agent: AgentId) -> Option<u16> {
        if let Some(id) = self.key(agent) {
            return Some(id);
        }
        let mut ids = AGENT_KEYS.map(|id| id as u16);
        let id = ids.find(|id| !self.agents.contains_key(id))?;
        self.insert(agent, id);
        Some(id)
    }

    /// A new agent id that no frame has had, with the lowest free key id; `None` if all are used.
    pub fn newborn(&mut self) -> Option<(u16, AgentId)> {
        self.newborn_after(0)
    }

    /// The same with the lowest free id above `id`, for a list in which ids ascend.
    pub fn newborn_after(&mut self, id: u16) -> Option<(u16, AgentId)> {
        let agent = AgentId(self.next_agent);
        let mut ids = AGENT_KEYS.map(|id| id as u16);
        let free = ids.find(|free| *free > id && !self.agents.contains_key(free))?;
        self.insert(agent, free);
        Some((free, agent))
    }

    /// Frees the ids for which `keep` is false. They must not occur in any frame that is still
    /// read.
    pub fn retain(&mut self, keep: impl Fn(u16) -> bool) {
        self.agents.retain(|id, _| *id == 0 || keep(*id));
        self.keys.retain(|_, id| *id == 0 || keep(*id));
    }

    /// (id, agent) in the order of ids, the ego first.
    pub fn iter(&self) -> impl Iterator<Item = (u16, AgentId)> + '_ {
        self.agents.iter().map(|(&id, &agent)| (id, agent))
    }

    fn with_ids(
        frames: &[&Frame],
        ego: AgentId,
        world_from_scene: Pose,
        ids: impl IntoIterator<Item = u16>,
    ) -> Self {
        // Static things count too: a newborn agent may not be taken for one of them either.
        let seen = frames.iter().flat_map(|frame| frame.agents());
        let highest = seen.map(|agent| agent.id.0).max();
        let mut identities = Self {
            keys: BTreeMap::new(),
            agents: BTreeMap::new(),
            next_agent: highest.map_or(0, |id| id.saturating_add(1)),
        };
        identities.insert(ego, 0);
        for (agent, id) in rank(frames, ego, world_from_scene).into_iter().zip(ids) {
            identities.insert(agent, id);
        }
        identities
    }

    fn insert(&mut self, agent: AgentId, id: u16) {
        self.keys.insert(agent, id);
        self.agents.insert(id, agent);
        self.next_agent = self.next_agent.max(agent.0.saturating_add(1));
    }
}

/// All moving agents but the ego, at most as many as there are ids, in the order of
/// [`Identities::ranked`].
fn rank(frames: &[&Frame], ego: AgentId, world_from_scene: Pose) -> Vec<AgentId> {
    let mut last_seen: BTreeMap<AgentId, (f64, AgentKind)> = BTreeMap::new();
    for agent in frames.iter().flat_map(|frame| frame.agents()) {
        if agent.id != ego && agent.kind.is_moving() {
            let distance = agent
                .state
                .pose
                .position
                .distance(world_from_scene.position);
            let entry = last_seen.entry(agent.id).or_insert((distance, agent.kind));
            entry.0 = distance;
        }
    }
    let mut ranked: Vec<_> = last_seen.into_iter().collect();
    // Both sorts are stable, so ties keep the order of agent ids.
    ranked.sort_by(|(_, a), (_, b)| a.0.total_cmp(&b.0));
    ranked.truncate(*AGENT_KEYS.end() as usize);
    ranked.sort_by_key(|(_, (_, kind))| *kind);
    ranked.into_iter().map(|(agent, _)| agent).collect()
}
