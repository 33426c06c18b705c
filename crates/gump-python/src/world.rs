//! Worlds by name, their simulations, and sessions that advance step by step.

use std::fmt::Display;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};

use gump_engine::{LightSource, Mode, Precision, Routes, SamplingConfig, TransformerWorld};
use gump_eval::worlds::{self, WorldName};
use gump_geometry::{Pose, dvec2};
use gump_model::Device;
use gump_rollout::worlds::LogReplay;
use gump_rollout::{SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{AgentId, AgentState, Frame, Rollout, Seed};
use numpy::PyArrayDyn;
use pyo3::prelude::*;

use crate::arrays::{Numbers, array};
use crate::scenario::{Scenario, Scene};
use crate::scenario_arrays::state;
use crate::{errors, threads};

/// The model of a world.
#[derive(Clone)]
pub(crate) enum Kind {
    /// The log, which is another world in every scenario.
    Log,
    /// A network of sequences, which also generates scenes.
    Transformer(Arc<TransformerWorld>),
    /// Rules, or a network of another kind.
    Other(Arc<dyn WorldModel>),
}

/// A world: simulates the future of traffic.
#[pyclass(frozen, module = "gump._native")]
pub(crate) struct World {
    name: String,
    pub(crate) kind: Kind,
    /// Whether it cannot simulate on a map without lanes.
    follows_lanes: bool,
    /// Conversion of its frames to those of the scene.
    frames: SimulateConfig,
}

/// Sampling of a network, where it is not the default; see `gump.World`.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct Sampling {
    mode: String,
    temperature: Option<f64>,
    top_k: Option<usize>,
    top_p: Option<f64>,
    decay: Option<f64>,
    redraws: Option<usize>,
    limits: bool,
    raw: bool,
    paper: bool,
    spawn: bool,
    lights: String,
    routes: String,
    precision: String,
}

impl Sampling {
    /// Error: a number out of its range, or ways of decoding that contradict each other.
    fn resolve(&self) -> PyResult<SamplingConfig> {
        let base = match (self.raw, self.paper) {
            (true, true) => {
                return Err(errors::value("expected raw or paper, found both"));
            }
            (_, true) => SamplingConfig::paper(),
            (true, _) => SamplingConfig::raw(),
            _ => SamplingConfig::default(),
        };
        let config = SamplingConfig {
            mode: one_of(&Mode::ALL, "mode", &self.mode)?,
            precision: one_of(&Precision::ALL, "precision", &self.precision)?,
            spawn: self.spawn,
            // Recorded lights would need a world per scenario.
            lights: one_of(
                &[LightSource::Model, LightSource::Hold],
                "lights",
                &self.lights,
            )?,
            routes: one_of(&Routes::ALL, "routes", &self.routes)?,
            temperature: self.temperature.or(base.temperature),
            top_k: self.top_k.unwrap_or(base.top_k),
            top_p: self.top_p.or(base.top_p),
            decay: self.decay.unwrap_or(base.decay),
            redraws: self.redraws.unwrap_or(base.redraws),
            limits: base.limits && self.limits,
            ..base
        };
        let absurd = |t: &f64| !(*t > 0.0 && t.is_finite());
        let wrong = if let Some(t) = config.temperature.filter(absurd) {
            ("temperature", "a number above 0", t)
        } else if config.top_k == 0 {
            ("top_k", "at least 1", 0.0)
        } else if let Some(p) = config.top_p.filter(|p| !(*p > 0.0 && *p <= 1.0)) {
            ("top_p", "a number above 0 and at most 1", p)
        } else if !(config.decay >= 0.0 && config.decay.is_finite()) {
            ("decay", "0 or more", config.decay)
        } else {
            return Ok(config);
        };
        let (name, expected, found) = wrong;
        Err(errors::value(format!(
            "{name}: expected {expected}, found {found}"
        )))
    }
}

/// The value of an argument that takes one of some names.
fn one_of<T>(known: &[T], argument: &str, found: &str) -> PyResult<T>
where
    T: Display + FromStr + PartialEq,
{
    let value = found.parse().ok().filter(|value| known.contains(value));
    value.ok_or_else(|| {
        let mut names = known.iter().map(ToString::to_string);
        let last = names.next_back().unwrap_or_default();
        let others: Vec<String> = names.collect();
        unknown(argument, &format!("{} or {last}", others.join(", ")), found)
    })
}

fn unknown(name: &str, expected: &str, found: &str) -> PyErr {
    errors::value(format!("{name}: expected {expected}, found {found}"))
}

#[pymethods]
impl World {
    #[new]
    fn new(
        py: Python<'_>,
        name: &str,
        weights: Option<PathBuf>,
        sampling: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let sampling: Sampling = sampling.extract()?;
        let config = sampling.resolve()?;
        let world = world_name(name, weights)?;
        let is_learned = matches!(world, WorldName::Model(_));
        let (kind, follows_lanes) = match &world {
            WorldName::Log => (Kind::Log, false),
            world => build(py, world, &config)?,
        };
        Ok(Self {
            name: name.into(),
            kind,
            follows_lanes,
            frames: if sampling.paper && is_learned {
                SimulateConfig::compat()
            } else {
                SimulateConfig::default()
            },
        })
    }

    /// Its name, as it was given.
    #[getter]
    fn name(&self) -> &str {
        &self.name
    }

    /// Simulates `futures` futures after the present; float64 `[R, A, T, 4]`.
    fn simulate<'py>(
        &self,
        py: Python<'py>,
        scenario: &Scenario,
        futures: usize,
        seconds: f64,
        seed: u64,
        hold: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let scene = &scenario.scene;
        let config = SimulateConfig {
            seconds,
            ..self.frames.clone()
        };
        check_futures(futures)?;
        let world = self.model(scene)?;
        let ids: Vec<AgentId> = scene.present().collect();
        let imagined = threads::work(py, || {
            let starts = [start(scene, futures, Seed(seed))];
            let rollouts = simulate(&*world, &starts, None, &config)?;
            let steps = rollouts.first().map_or(0, Rollout::steps);
            Ok::<_, gump_rollout::BoxError>((steps, numbers(&rollouts, &ids, hold)))
        })?;
        let (steps, numbers) = imagined.map_err(refusal)?;
        Ok(array(py, [futures, ids.len(), steps, 4], numbers)?.into_any())
    }

    /// Opens a session that advances step by step.
    fn start(
        &self,
        py: Python<'_>,
        scenario: &Scenario,
        futures: usize,
        seed: u64,
    ) -> PyResult<Session> {
        check_futures(futures)?;
        let world = self.model(&scenario.scene)?;
        Session::open(py, world, Arc::clone(&scenario.scene), futures, Seed(seed))
    }
}

impl World {
    /// Whether it was given this name.
    pub(crate) fn name_is(&self, name: &str) -> bool {
        self.name == name
    }

    /// The world of a scenario.
    ///
    /// Error: a map without lanes for a world that follows them.
    pub(crate) fn model(&self, scene: &Scene) -> PyResult<Arc<dyn WorldModel>> {
        let scenario = &scene.scenario;
        if self.follows_lanes && scenario.map.lanes().is_empty() {
            return Err(errors::value(format!(
                "scenario {}: expected a map with lanes to drive on, found none",
                scenario.id
            )));
        }
        Ok(match &self.kind {
            Kind::Log => Arc::new(LogReplay::new(scenario)),
            kind => kind
                .model()
                .expect("every world but the log is one for all scenarios"),
        })
    }
}

impl Kind {
    /// The model for all scenarios; `None` for the log.
    pub(crate) fn model(&self) -> Option<Arc<dyn WorldModel>> {
        match self {
            Self::Log => None,
            Self::Transformer(world) => Some(Arc::<TransformerWorld>::clone(world)),
            Self::Other(world) => Some(Arc::clone(world)),
        }
    }
}

/// The world that a name and its weights stand for.
///
/// Error: no such world.
fn world_name(name: &str, weights: Option<PathBuf>) -> PyResult<WorldName> {
    if let Some(path) = weights {
        return Ok(WorldName::Model(path));
    }
    match name.parse() {
        // Weights are found by the caller, which also knows the shipped ones.
        Err(_) | Ok(WorldName::Model(_)) => {
            let expected = "log, idm, constant-velocity, model or model:WEIGHTS";
            Err(unknown("world", expected, name))
        }
        Ok(world) => Ok(world),
    }
}

/// A world for all scenarios, and whether it cannot simulate on a map without lanes.
///
/// Error: weights that are missing or damaged.
fn build(py: Python<'_>, name: &WorldName, config: &SamplingConfig) -> PyResult<(Kind, bool)> {
    if let WorldName::Model(path) = name
        && !path.exists()
    {
        return Err(pyo3::exceptions::PyFileNotFoundError::new_err(format!(
            "expected weights, found no file: {}",
            path.display()
        )));
    }
    let built = threads::work(py, || {
        let world = worlds::World::without_log(&Device::Cpu, name, config);
        world.map_err(|error| error.to_string())
    })?;
    let world = built.map_err(errors::DataError::new_err)?;
    let follows_lanes = world.follows_lanes();
    let kind = match world {
        worlds::World::Learned(world) => Kind::Transformer(Arc::from(world)),
        world => Kind::Other(world.into_model()),
    };
    Ok((kind, follows_lanes))
}

fn check_futures(futures: usize) -> PyResult<()> {
    if futures == 0 {
        return Err(errors::value("futures: expected at least 1, found 0"));
    }
    Ok(())
}

/// The present without the route, which is derived from the future to be simulated.
fn start(scene: &Scene, n_futures: usize, seed: Seed) -> Start<'_> {
    Start {
        scene: scene.scenario.present().unguided(),
        n_futures,
        seed,
    }
}

/// The error for arguments that a world refuses.
fn refusal(error: gump_rollout::BoxError) -> PyErr {
    errors::value(error)
}

/// States `[R, A, T, 4]`; an agent that a world removes stays where it was last, or is NaN.
fn numbers(rollouts: &[Rollout], ids: &[AgentId], hold: bool) -> Vec<f64> {
    let mut numbers = Vec::new();
    for rollout in rollouts {
        for &id in ids {
            let mut last = rollout.start().agent(id).map_or([f64::NAN; 4], state);
            for frame in rollout.imagined() {
                let now = frame.agent(id).map(state);
                match now {
                    Some(now) => last = now,
                    None if hold => {}
                    None => last = [f64::NAN; 4],
                }
                numbers.extend(last);
            }
        }
    }
    numbers
}

/// A request to advance a session; with the ego's next states, if it is driven.
struct Ask {
    ego: Option<Vec<AgentState>>,
    answer: Sender<Result<Vec<Frame>, String>>,
}

/// Futures in progress, a step of the world at a time.
#[pyclass(frozen, module = "gump._native")]
pub(crate) struct Session {
    asks: Mutex<Option<Sender<Ask>>>,
    process: u32,
    ids: Vec<AgentId>,
    futures: usize,
    dt: f64,
}

impl Session {
    fn open(
        py: Python<'_>,
        world: Arc<dyn WorldModel>,
        scene: Arc<Scene>,
        futures: usize,
        seed: Seed,
    ) -> PyResult<Self> {
        let ids = scene.present().collect();
        let (ready_sender, ready) = channel();
        let (asks, requests) = channel();
        threads::alone(move || serve(&*world, &scene, futures, seed, &ready_sender, &requests))?;
        let dt = py.detach(move || ready.recv()).map_err(|_| gone())?;
        Ok(Self {
            asks: Mutex::new(Some(asks)),
            process: std::process::id(),
            ids,
            futures,
            dt: dt.map_err(errors::value)?,
        })
    }
}

/// Opens a session, sends its time step, and advances it at each request.
fn serve(
    world: &dyn WorldModel,
    scene: &Scene,
    futures: usize,
    seed: Seed,
    ready_sender: &Sender<Result<f64, String>>,
    requests: &Receiver<Ask>,
) {
    let mut session = match world.open(&[start(scene, futures, seed)]) {
        Ok(session) => session,
        Err(error) => {
            // If this fails, nobody is waiting for the error.
            drop(ready_sender.send(Err(error.to_string())));
            return;
        }
    };
    if ready_sender.send(Ok(session.dt())).is_err() {
        return;
    }
    while let Ok(ask) = requests.recv() {
        let frames = session.step(ask.ego.as_deref());
        if ask
            .answer
            .send(frames.map_err(|error| error.to_string()))
            .is_err()
        {
            return;
        }
    }
}

fn gone() -> PyErr {
    errors::runtime("expected a session in progress, found that it has failed")
}

#[pymethods]
impl Session {
    /// Seconds that a step takes.
    #[getter]
    fn dt(&self) -> f64 {
        self.dt
    }

    /// Ids of the agents in the order of the states, int64 `[A]`.
    #[getter]
    fn agent_id<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let ids: Vec<i64> = self.ids.iter().map(|id| id.0).collect();
        Ok(array(py, ids.len(), ids)?.into_any())
    }

    /// Simulates the next frame; float64 `[R, A, 6]`: x, y, z, heading and velocity, NaN where an
    /// agent is absent. `ego` is float64 `[R, 5]`: its next x, y, heading and velocity.
    fn step<'py>(
        &self,
        py: Python<'py>,
        ego: Option<&Bound<'py, PyArrayDyn<f64>>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let ego = ego.map(|ego| self.ego(ego)).transpose()?;
        if self.process != std::process::id() {
            let sentence =
                "expected the process that started the session, found one forked from it";
            return Err(errors::runtime(sentence));
        }
        let asks = {
            let asks = self.asks.lock().unwrap_or_else(PoisonError::into_inner);
            asks.clone()
        };
        let asks = asks.ok_or_else(|| {
            errors::value("expected a session that is open, found one that was closed")
        })?;
        let frames = py.detach(|| {
            let (answer, answered) = channel();
            asks.send(Ask { ego, answer }).ok()?;
            answered.recv().ok()
        });
        let frames = frames.ok_or_else(gone)?.map_err(errors::value)?;
        let mut numbers = Vec::with_capacity(frames.len() * self.ids.len() * 6);
        for frame in &frames {
            for &id in &self.ids {
                let agent = frame.agent(id);
                numbers.extend(agent.map_or([f64::NAN; 4], state));
                numbers.extend(agent.map_or([f64::NAN; 2], |a| a.state.velocity.to_array()));
            }
        }
        Ok(array(py, [frames.len(), self.ids.len(), 6], numbers)?.into_any())
    }

    /// Closes the session; `step` raises `ValueError` from then on.
    fn close(&self) {
        let mut asks = self.asks.lock().unwrap_or_else(PoisonError::into_inner);
        *asks = None;
    }
}

impl Session {
    fn ego(&self, ego: &Bound<'_, PyArrayDyn<f64>>) -> PyResult<Vec<AgentState>> {
        let ego = Numbers::new("ego", ego, &["R", "5"])?;
        ego.expect(0, self.futures, "one per future")?;
        ego.expect(1, 5, "x, y, heading and velocity")?;
        let states = ego.slice()?.as_chunks::<5>().0.iter();
        let state = |&[x, y, heading, vx, vy]: &[f64; 5]| AgentState {
            pose: Pose::new(x, y, heading),
            velocity: dvec2(vx, vy),
        };
        let states: Vec<AgentState> = states.map(state).collect();
        match states.iter().position(|state| !state.is_finite()) {
            Some(row) => Err(errors::value(format!(
                "ego: expected numbers, found one that is none in row {row}"
            ))),
            None => Ok(states),
        }
    }
}
