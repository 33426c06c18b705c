//! Many episodes side by side in one session of a world.
//!
//! `observation` says what is seen, `action` what can be done.

use gump_metrics::{Collision, Metric, OffRoad, Reward};
use gump_rollout::{BoxError, Session, Start, WorldModel, dynamics};
use gump_scene::{AgentState, Frame, Rollout, Scenario, SceneState, Seed};
use rand::Rng as _;

use crate::{Action, ActionLimits, Observation, ObservationSpec, RlError, observe};

/// How many episodes, how long, and what is seen and done in them.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvConfig {
    /// Episodes side by side, > 0.
    pub n_slots: usize,
    /// Seconds until an episode is truncated, > 0; rounded to whole steps of the world.
    pub horizon: f64,
    /// What the ego can do.
    pub limits: ActionLimits,
    /// What is seen.
    pub observation: ObservationSpec,
}

impl Default for EnvConfig {
    /// 128 environments as in the paper; 8 s, the future of a Waymo scenario.
    fn default() -> Self {
        Self {
            n_slots: 128,
            horizon: 8.0,
            limits: ActionLimits::default(),
            observation: ObservationSpec::default(),
        }
    }
}

/// What a step led to in one slot.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// What is seen after the step, in the same episode also where that ended.
    pub observation: Observation,
    /// What the step earned.
    pub reward: f64,
    /// How the episode ended, if it did.
    pub end: Option<End>,
    /// The first observation of the episode that took the slot, if this one ended.
    pub restart: Option<Observation>,
}

/// How an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// By failure: nothing comes after.
    Terminated(Failure),
    /// Cut off at the horizon or at the end of the route: more would have come.
    Truncated,
}

/// What went wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Failure {
    /// The ego's box overlapped another.
    Collision,
    /// A corner of the ego's box left the road.
    OffRoad,
}

/// Episodes of driving in any world.
///
/// The ego is driven by actions through the kinematic bicycle, everyone else by the world, in one
/// batched call per step; a step is a step of the world. When an episode ends its slot starts the
/// next one at once, in the same session, and no other slot notices. Episode `e` of slot `i`
/// depends on `seed.fork(i).fork(e)` and its actions alone.
///
/// A collision or leaving the road terminates, in this order; an episode that starts in a collision
/// ends with its first step. The horizon and the end of the route truncate.
pub struct Env<'w> {
    world: &'w dyn WorldModel,
    scenarios: &'w [Scenario],
    config: EnvConfig,
    reward: Reward,
    seed: Seed,
    session: Option<Box<dyn Session + 'w>>,
    slots: Vec<Slot>,
    n_clipped: u64,
}

struct Slot {
    /// How many episodes it has started.
    n_episodes: u64,
    rollout: Rollout,
}

impl Step {
    /// What to act on next: the new episode where the old one ended.
    pub fn next_observation(&self) -> &Observation {
        self.restart.as_ref().unwrap_or(&self.observation)
    }
}

impl<'w> Env<'w> {
    /// An environment that draws its episodes' starts from `scenarios`, uniformly, and pays
    /// [`Reward::driving_step`]. It has no episodes before the first [`Env::reset`].
    ///
    /// # Errors
    /// [`RlError::NoScenario`], and [`RlError::Parameter`] for parameters out of range.
    pub fn new(
        world: &'w dyn WorldModel,
        scenarios: &'w [Scenario],
        config: EnvConfig,
    ) -> Result<Self, RlError> {
        if scenarios.is_empty() {
            return Err(RlError::NoScenario);
        }
        for (name, value) in [
            ("n_slots", config.n_slots as f64),
            ("horizon", config.horizon),
            ("route_spacing", config.observation.route_spacing),
            ("-min_acceleration", -config.limits.min_acceleration),
            ("max_acceleration", config.limits.max_acceleration),
            ("max_curvature", config.limits.max_curvature),
        ] {
            if !(value > 0.0 && value.is_finite()) {
                let expected = "a positive number";
                return Err(RlError::Parameter {
                    name,
                    value,
                    expected,
                });
            }
        }
        Ok(Self {
            world,
            scenarios,
            config,
            reward: Reward::driving_step(),
            seed: Seed(0),
            session: None,
            slots: Vec::new(),
            n_clipped: 0,
        })
    }

    /// The same environment paying another reward.
    #[must_use]
    pub fn with_reward(self, reward: Reward) -> Self {
        Self { reward, ..self }
    }

    /// Starts fresh episodes in all slots and forgets the counts; what is seen in them, by slot.
    ///
    /// # Errors
    /// What the world reports, and [`RlError::TimeStep`] where it does not fit the scenarios.
    pub fn reset(&mut self, seed: Seed) -> Result<Vec<Observation>, RlError> {
        (self.seed, self.n_clipped) = (seed, 0);
        self.session = None;
        self.slots.clear();
        let starts: Vec<Start<'_>> = (0..self.config.n_slots)
            .map(|slot| self.start(slot, 0))
            .collect();
        let session = self.world.open(&starts).map_err(|e| self.world_error(e))?;
        let slots: Result<_, _> = starts
            .iter()
            .map(|start| {
                Ok(Slot {
                    n_episodes: 1,
                    rollout: begin(start.scene, session.dt())?,
                })
            })
            .collect();
        self.slots = slots?;
        self.session = Some(session);
        let observe = |slot: &Slot| observe(&self.config.observation, &slot.rollout.last());
        Ok(self.slots.iter().map(observe).collect())
    }

    /// Applies one action per slot and lets everyone else answer.
    ///
    /// Actions outside the limits are clipped and counted, see [`Env::clipped`].
    ///
    /// # Errors
    /// [`RlError::NotReset`], [`RlError::Count`] and [`RlError::NotFinite`] leave the episodes as
    /// they are. After any other error the environment must be reset.
    pub fn step(&mut self, actions: &[Action]) -> Result<Vec<Step>, RlError> {
        let egos = self.drive(actions)?;
        // Put back only if all goes well: a session that failed halfway is of no use.
        let mut session = self.session.take().ok_or(RlError::NotReset)?;
        let frames = session.step(Some(&egos)).map_err(|e| self.world_error(e))?;
        self.push(frames)?;
        let mut steps = Vec::with_capacity(self.slots.len());
        for slot in 0..self.slots.len() {
            let mut step = self.judge(&self.slots[slot].rollout, session.dt());
            if step.end.is_some() {
                step.restart = Some(self.restart(slot, &mut *session)?);
            }
            steps.push(step);
        }
        self.session = Some(session);
        Ok(steps)
    }

    /// The episode in progress in a slot; `None` if there is no such slot or no episode yet.
    pub fn episode(&self, slot: usize) -> Option<&Rollout> {
        self.slots.get(slot).map(|slot| &slot.rollout)
    }

    /// Number of actions since the last reset that were outside the limits.
    pub fn clipped(&self) -> u64 {
        self.n_clipped
    }

    /// The configuration.
    pub fn config(&self) -> &EnvConfig {
        &self.config
    }

    /// The egos' next states; nothing has changed if this fails.
    fn drive(&mut self, actions: &[Action]) -> Result<Vec<AgentState>, RlError> {
        let dt = self.session.as_ref().ok_or(RlError::NotReset)?.dt();
        check_count("the policy", self.slots.len(), actions.len())?;
        if let Some(slot) = actions.iter().position(|action| !action.is_finite()) {
            return Err(RlError::NotFinite { slot });
        }
        let limits = self.config.limits;
        let clipped: Vec<Action> = actions.iter().map(|a| limits.clip(*a)).collect();
        let states: Result<_, _> = self
            .slots
            .iter()
            .zip(&clipped)
            .map(|(slot, action)| {
                let now = slot.rollout.last().ego_now().state;
                dynamics::advance(&now, &action.command(), dt)
            })
            .collect();
        let states = states.map_err(|e| self.world_error(e.into()))?;
        let beyond = actions.iter().zip(&clipped).filter(|(a, b)| a != b);
        self.n_clipped += beyond.count() as u64;
        Ok(states)
    }

    fn push(&mut self, frames: Vec<Frame>) -> Result<(), RlError> {
        check_count("the world", self.slots.len(), frames.len())?;
        for (slot, (place, frame)) in self.slots.iter_mut().zip(frames).enumerate() {
            let ego = place.rollout.ego();
            if frame.agent(ego).is_none() {
                return Err(RlError::EgoVanished { ego, slot });
            }
            place.rollout.push(frame);
        }
        Ok(())
    }

    fn judge(&self, rollout: &Rollout, dt: f64) -> Step {
        let scene = rollout.last();
        let ego = scene.ego_now();
        let happened = |metric: &dyn Metric| metric.at(&scene, ego).is_some_and(|v| v > 0.0);
        let n_steps = (self.config.horizon / dt).round().max(1.0) as usize;
        let end = if happened(&Collision) {
            Some(End::Terminated(Failure::Collision))
        } else if happened(&OffRoad) {
            Some(End::Terminated(Failure::OffRoad))
        } else if rollout.steps() >= n_steps || is_at_end_of_route(&scene) {
            Some(End::Truncated)
        } else {
            None
        };
        Step {
            observation: observe(&self.config.observation, &scene),
            reward: self.reward.at(&scene, ego).total,
            end,
            restart: None,
        }
    }

    fn restart(
        &mut self,
        slot: usize,
        session: &mut (dyn Session + 'w),
    ) -> Result<Observation, RlError> {
        let start = self.start(slot, self.slots[slot].n_episodes);
        session
            .replace(slot, start)
            .map_err(|e| self.world_error(e))?;
        let rollout = begin(start.scene, session.dt())?;
        let observation = observe(&self.config.observation, &rollout.last());
        self.slots[slot] = Slot {
            n_episodes: self.slots[slot].n_episodes + 1,
            rollout,
        };
        Ok(observation)
    }

    /// Where an episode starts.
    fn start(&self, slot: usize, episode: u64) -> Start<'w> {
        let seed = self.seed.fork(slot as u64).fork(episode);
        let drawn = seed.fork(0).rng().random_range(0..self.scenarios.len());
        Start {
            scene: self.scenarios[drawn].present(),
            n_futures: 1,
            seed: seed.fork(1),
        }
    }

    fn world_error(&self, source: BoxError) -> RlError {
        RlError::World {
            world: self.world.name().to_owned(),
            source,
        }
    }
}

/// The past of a scene at the time step of the world.
fn begin(scene: SceneState<'_>, dt: f64) -> Result<Rollout, RlError> {
    let stride = (dt / scene.dt).round();
    if stride < 1.0 || (dt / scene.dt - stride).abs() > 1e-6 {
        return Err(RlError::TimeStep {
            session: dt,
            scene: scene.dt,
        });
    }
    let thinned: Vec<Frame> = scene
        .strided_history(stride as usize, usize::MAX)
        .into_iter()
        .cloned()
        .collect();
    Ok(Rollout::begin(SceneState {
        history: &thinned,
        dt,
        ..scene
    }))
}

fn is_at_end_of_route(scene: &SceneState<'_>) -> bool {
    scene.route.is_some_and(|route| {
        let position = scene.ego_now().state.pose.position;
        route.path.project(position).arc_length >= route.path.length()
    })
}

fn check_count(who: &'static str, expected: usize, found: usize) -> Result<(), RlError> {
    if expected == found {
        Ok(())
    } else {
        Err(RlError::Count {
            who,
            expected,
            found,
        })
    }
}
