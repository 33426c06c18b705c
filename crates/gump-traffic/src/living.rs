//! A wrapper around a world that changes lights and adds and removes agents.

use std::sync::Arc;

use gump_geometry::Pose;
use gump_rollout::{
    BoxError, PredictiveSamples, ProbeConfig, Session, SessionStats, Start, WorldModel,
};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Frame, Light, MapGraph, Scenario, SceneState,
};
use rayon::prelude::*;

use crate::gates::{Arrivals, Flow};
use crate::notes::Notes;
use crate::signals::{SignalPlan, Signals};

/// Separates the random numbers of the surroundings from those of the world, which are far fewer.
const SIGNALS: u64 = 1 << 56;
const ARRIVALS: u64 = 1 << 57;

/// Source of the lights after the present.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub enum LightControl {
    /// The same as at the present.
    Hold,
    /// Phases of signals at such junctions: [`SignalPlan`].
    #[default]
    Signals,
    /// The recorded lights.
    Recorded(Arc<RecordedLights>),
}

/// The lights of a recording from its present on; the last state is held.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedLights {
    frames: Vec<Vec<Light>>,
    dt: f64,
}

impl RecordedLights {
    /// Those of a scenario.
    pub fn of(scenario: &Scenario) -> Self {
        let frames = scenario.log[scenario.now..].iter();
        Self {
            frames: frames.map(|frame| frame.lights().to_vec()).collect(),
            dt: scenario.dt,
        }
    }

    /// The lights of every frame from the present on.
    pub(crate) fn frames(&self) -> impl Iterator<Item = &[Light]> {
        self.frames.iter().map(Vec::as_slice)
    }

    /// The lights this many seconds after the present.
    fn at(&self, seconds: f64) -> &[Light] {
        let i = (seconds / self.dt).round() as usize;
        let last = self.frames.len().saturating_sub(1);
        self.frames.get(i.min(last)).map_or(&[], Vec::as_slice)
    }
}

/// Settings of lights and of arrivals and departures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LivingConfig {
    /// Source of the lights.
    pub lights: LightControl,
    /// Whether and where agents enter and leave.
    pub arrivals: Option<Arrivals>,
}

/// A world with changing lights and with agents that enter and leave; their motion is that of `W`.
///
/// Future `k` of a start draws its lights and arrivals from `seed.fork(k)` as well. A world that
/// controls its own lights, as the log does, keeps them.
#[derive(Clone, Debug)]
pub struct Living<W> {
    world: W,
    config: LivingConfig,
}

impl<W> Living<W> {
    /// Wraps `world`.
    pub fn new(world: W, config: LivingConfig) -> Self {
        Self { world, config }
    }

    /// The wrapped world, which moves the agents.
    pub fn world(&self) -> &W {
        &self.world
    }

    /// What a scene lacks for the lights, arrivals and departures of this world.
    pub fn notes(&self, scene: &SceneState<'_>) -> Notes {
        Notes::of(&self.config, scene)
    }

    /// The same surroundings around the world that `change` returns.
    pub fn map<V>(self, change: impl FnOnce(W) -> V) -> Living<V> {
        Living {
            world: change(self.world),
            config: self.config,
        }
    }
}

impl<W: WorldModel> WorldModel for Living<W> {
    fn name(&self) -> &str {
        self.world.name()
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let session = self.world.open(starts)?;
        let lives = starts
            .iter()
            .flat_map(|start| begin(&self.config, start))
            .collect();
        Ok(Box::new(LivingSession {
            session,
            config: &self.config,
            lives,
        }))
    }
}

/// Lights and arrivals of one future.
#[derive(Clone, Debug)]
struct Life {
    lights: Leads,
    /// Seconds since the present.
    time: f64,
    flow: Option<Flow>,
    map: Arc<MapGraph>,
    ego: AgentId,
    now: Frame,
}

/// The source of the lights.
#[derive(Clone, Debug)]
enum Leads {
    Nobody,
    Signals(Signals),
    Recording(Arc<RecordedLights>),
}

fn begin(config: &LivingConfig, start: &Start<'_>) -> Vec<Life> {
    let scene = start.scene;
    let plan = matches!(config.lights, LightControl::Signals).then(|| plan_of(scene));
    let plan = plan.filter(|plan| !plan.is_empty()).map(Arc::new);
    let life = |k: usize| {
        let seed = start.seed.fork(k as u64);
        let flow = |arrivals| Flow::begin(arrivals, scene, seed.fork(ARRIVALS));
        Life {
            lights: match (&config.lights, &plan) {
                (LightControl::Recorded(lights), _) => Leads::Recording(Arc::clone(lights)),
                (_, Some(plan)) => Leads::Signals(Signals::begin(plan, seed.fork(SIGNALS))),
                (_, None) => Leads::Nobody,
            },
            time: 0.0,
            flow: config.arrivals.as_ref().and_then(flow),
            map: Arc::clone(scene.map),
            ego: scene.ego,
            now: scene.now().clone(),
        }
    };
    (0..start.n_futures).map(life).collect()
}

fn plan_of(scene: SceneState<'_>) -> SignalPlan {
    SignalPlan::of(scene.map, scene.history, scene.dt)
}

/// The changes requested from the session before a frame.
struct Orders {
    lights: Option<Vec<Light>>,
    leave: Vec<AgentId>,
    come: Vec<Agent>,
}

impl Life {
    fn orders(&mut self, dt: f64) -> Orders {
        self.time += dt;
        let lights = match &mut self.lights {
            Leads::Nobody => None,
            Leads::Signals(signals) => {
                let drives =
                    |agent: &&Agent| matches!(agent.kind, AgentKind::Vehicle | AgentKind::Bicycle);
                let vehicles = self.now.agents().iter().filter(drives);
                let vehicles: Vec<Pose> = vehicles.map(|agent| agent.state.pose).collect();
                signals.advance(dt, Some(&vehicles));
                Some(signals.lights().to_vec())
            }
            Leads::Recording(lights) => Some(lights.at(self.time).to_vec()),
        };
        let (leave, come) = match &mut self.flow {
            Some(flow) => flow.step(&self.map, &self.now, self.ego, dt),
            None => (Vec::new(), Vec::new()),
        };
        Orders {
            lights,
            leave,
            come,
        }
    }
}

/// Futures in progress, with their lights and arrivals.
struct LivingSession<'a> {
    session: Box<dyn Session + 'a>,
    config: &'a LivingConfig,
    lives: Vec<Life>,
}

impl Session for LivingSession<'_> {
    fn dt(&self) -> f64 {
        self.session.dt()
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        let dt = self.session.dt();
        let orders: Vec<Orders> = self
            .lives
            .par_iter_mut()
            .map(|life| life.orders(dt))
            .collect();
        for (i, orders) in orders.into_iter().enumerate() {
            let is_asked = !orders.leave.is_empty() || !orders.come.is_empty();
            if is_asked && !self.session.exchange(i, &orders.leave, &orders.come) {
                self.lives[i].flow = None;
            }
            if let Some(lights) = orders.lights
                && !self.session.show(i, &lights)
            {
                self.lives[i].lights = Leads::Nobody;
            }
        }
        let frames = self.session.step(ego)?;
        for (life, frame) in self.lives.iter_mut().zip(&frames) {
            if life.flow.is_some() || matches!(life.lights, Leads::Signals(_)) {
                life.now = frame.clone();
            }
        }
        Ok(frames)
    }

    fn keep(&mut self, futures: &[usize]) -> bool {
        let kept = self.session.keep(futures);
        if kept {
            let mut at = 0..;
            self.lives
                .retain(|_| at.next().is_some_and(|i| futures.contains(&i)));
        }
        kept
    }

    fn show(&mut self, future: usize, lights: &[Light]) -> bool {
        let shown = self.session.show(future, lights);
        if shown {
            self.lives[future].lights = Leads::Nobody;
        }
        shown
    }

    fn exchange(&mut self, future: usize, leave: &[AgentId], come: &[Agent]) -> bool {
        self.session.exchange(future, leave, come)
    }

    fn take_for_made(&mut self) {
        self.session.take_for_made();
    }

    fn probe(&mut self, config: ProbeConfig) -> bool {
        self.session.probe(config)
    }

    fn take_predictive_samples(&mut self) -> Vec<PredictiveSamples> {
        self.session.take_predictive_samples()
    }

    fn stats(&self) -> SessionStats {
        self.session.stats()
    }

    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
        self.session.replace(future, start)?;
        let only = Start {
            n_futures: 1,
            ..start
        };
        self.lives[future] = begin(self.config, &only).swap_remove(0);
        Ok(())
    }
}
