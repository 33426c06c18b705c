//! One future of reactive traffic: all agents see the same instant, then all move.

use std::sync::Arc;

use gump_scene::{Agent, AgentId, AgentKind, AgentState, Frame, Light, Rollout, Seed};
use rayon::prelude::*;

use super::IdmConfig;
use super::driver::{Ground, MotionModel, Situation};
use super::obstacles::Obstacle;
use super::road::Road;
use crate::Start;
use crate::worlds::independent::Future;

/// Opens all futures of a start; computes once what does not depend on chance.
pub(super) fn open<'a>(
    config: &'a IdmConfig,
    road: &Arc<Road>,
    start: &Start<'_>,
) -> Vec<IdmFuture<'a>> {
    let scene = start.scene;
    let now = scene.now();
    let ground = Ground {
        config,
        road,
        lights: now.lights(),
    };
    let situations: Vec<Situation> = now
        .agents()
        .par_iter()
        .map(|agent| match agent.kind {
            AgentKind::Vehicle if agent.id == scene.ego => Situation::of_ego(agent, scene, ground),
            AgentKind::Vehicle => Situation::of(agent, scene, road),
            _ => Situation::Fixed(MotionModel::Coast),
        })
        .collect();
    // The ego can be handed back to the world later; it then looks at its route afresh.
    let origin = Arc::new(Rollout::begin(gump_scene::SceneState {
        history: &scene.history[scene.history.len() - 1..],
        ..scene
    }));
    (0..start.n_futures)
        .into_par_iter()
        .map(|k| {
            let seed = start.seed.fork(k as u64);
            let motions = now
                .agents()
                .iter()
                .zip(&situations)
                .map(|(agent, situation)| {
                    situation.decide(agent, ground, agent_seed(seed, agent.id, 0))
                });
            IdmFuture {
                config,
                road: Arc::clone(road),
                origin: Arc::clone(&origin),
                dt: scene.dt,
                ego: scene.ego,
                motions: motions.collect(),
                frame: now.clone(),
                obstacles: Vec::new(),
                next_lights: None,
                seed,
                n_handovers: 0,
            }
        })
        .collect()
}

/// Every agent draws from its own stream, so its draws do not depend on which other agents are
/// present.
fn agent_seed(seed: Seed, id: AgentId, handover: u64) -> Seed {
    seed.fork(id.0 as u64).fork(handover)
}

pub(super) struct IdmFuture<'a> {
    config: &'a IdmConfig,
    road: Arc<Road>,
    origin: Arc<Rollout>,
    dt: f64,
    ego: AgentId,
    /// One for each agent of the frame, in its order.
    motions: Vec<MotionModel>,
    frame: Frame,
    obstacles: Vec<Obstacle>,
    /// The lights of the next frame, if they were set.
    next_lights: Option<Vec<Light>>,
    seed: Seed,
    n_handovers: u64,
}

impl IdmFuture<'_> {
    /// Applies the states of externally driven agents.
    fn hand_over(&mut self, driven: bool) {
        let agents = self.frame.agents();
        let Ok(i) = agents.binary_search_by_key(&self.ego, |agent| agent.id) else {
            return;
        };
        match (driven, &self.motions[i]) {
            (true, _) => self.motions[i] = MotionModel::Driven,
            (false, MotionModel::Driven) => {
                let agent = &agents[i];
                let ground = Ground {
                    config: self.config,
                    road: &self.road,
                    lights: self.frame.lights(),
                };
                self.n_handovers += 1;
                let seed = agent_seed(self.seed, agent.id, self.n_handovers);
                self.motions[i] = if agent.kind == AgentKind::Vehicle {
                    let mut scene = self.origin.at(0);
                    let history = std::slice::from_ref(&self.frame);
                    scene.history = history;
                    Situation::of_ego(agent, scene, ground).decide(agent, ground, seed)
                } else {
                    MotionModel::Coast
                };
            }
            (false, _) => {}
        }
    }
}

impl IdmFuture<'_> {
    /// The motion of an agent that has just entered.
    fn motion_of(&self, agent: &Agent) -> MotionModel {
        if agent.kind != AgentKind::Vehicle {
            return MotionModel::Coast;
        }
        let ground = Ground {
            config: self.config,
            road: &self.road,
            lights: self.frame.lights(),
        };
        let now = Frame::new(vec![*agent], Vec::new());
        let mut scene = self.origin.at(0);
        scene.history = std::slice::from_ref(&now);
        let seed = agent_seed(self.seed, agent.id, 0);
        Situation::of(agent, scene, &self.road).decide(agent, ground, seed)
    }
}

impl Future for IdmFuture<'_> {
    fn show(&mut self, lights: &[Light]) -> bool {
        self.next_lights = Some(lights.to_vec());
        true
    }

    fn exchange(&mut self, leave: &[AgentId], come: &[Agent]) -> bool {
        let agents = self.frame.agents().iter().copied();
        let motions = std::mem::take(&mut self.motions);
        let stay = agents.zip(motions);
        let stay = stay.filter(|(agent, _)| agent.id == self.ego || !leave.contains(&agent.id));
        let new = come.iter().map(|agent| (*agent, self.motion_of(agent)));
        let mut all: Vec<(Agent, MotionModel)> = stay.chain(new).collect();
        all.sort_by_key(|(agent, _)| agent.id);
        let (agents, motions) = all.into_iter().unzip();
        self.motions = motions;
        self.frame = Frame::new(agents, self.frame.lights().to_vec());
        true
    }

    fn step(&mut self, ego: Option<AgentState>) -> Frame {
        self.hand_over(ego.is_some());
        let ground = Ground {
            config: self.config,
            road: &self.road,
            lights: self.frame.lights(),
        };
        // Others see the ego where it will be: its next state is already decided.
        let seen = |agent: &Agent| match ego {
            Some(state) if agent.id == self.ego => agent.with_state(state),
            _ => *agent,
        };
        self.obstacles.clear();
        self.obstacles.extend(
            self.frame
                .agents()
                .iter()
                .map(|agent| Obstacle::new(&seen(agent))),
        );
        let mut agents = Vec::with_capacity(self.motions.len());
        for (i, (agent, motion)) in self
            .frame
            .agents()
            .iter()
            .zip(&mut self.motions)
            .enumerate()
        {
            agents.push(match ego {
                Some(state) if agent.id == self.ego => agent.with_state(state),
                _ => agent.with_state(motion.step(agent, &self.obstacles, i, ground, self.dt)),
            });
        }
        let lights = match self.next_lights.take() {
            Some(lights) => {
                self.motions
                    .iter_mut()
                    .for_each(|motion| motion.show(&lights));
                lights
            }
            None => self.frame.lights().to_vec(),
        };
        self.frame = Frame::new(agents, lights);
        self.frame.clone()
    }
}
