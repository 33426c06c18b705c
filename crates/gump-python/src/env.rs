//! Environments in this process.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};

use gump_rl::{
    Autoreset, BicycleLimits, DrivingEnv, Dynamics, EnvConfig, ObservationSpec, PoseLimits,
    PreparedScenario, RasterView, RlError, Sampling, TrafficSource, VectorEnv, VectorView,
};
use gump_scene::Seed;
use numpy::PyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::arrays::{Numbers, array};
use crate::errors;
use crate::scenario::Scenario;
use crate::threads;
use crate::world::World;

/// Seconds that an action is held: a frame of the world model, as in the paper.
const STEP: f64 = 0.5;

/// A request to an environment.
enum Request {
    Reset {
        seeds: Option<Vec<u64>>,
        mask: Option<Vec<bool>>,
    },
    Step(Vec<f32>),
    Expert,
}

/// The answer to a [`Request`].
#[derive(Default)]
struct Answer {
    observations: Observations,
    rewards: Vec<f32>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    ended: Vec<Ended>,
    /// For [`Request::Expert`] alone.
    actions: Vec<f32>,
}

/// Numbers, or the zeros and ones of pictures.
enum Observations {
    Numbers(Vec<f32>),
    Pixels(Vec<u8>),
}

impl Default for Observations {
    fn default() -> Self {
        Self::Numbers(Vec::new())
    }
}

/// An episode that ended.
struct Ended {
    row: usize,
    scenario: usize,
    steps: usize,
    totals: gump_rl::Totals,
    last: Observations,
}

struct Ask {
    request: Request,
    answer: Sender<Result<Answer, RlError>>,
}

/// Many episodes of driving side by side; see `gump.VectorEnv`.
#[pyclass(frozen, module = "gump._native")]
pub(crate) struct Env {
    asks: Mutex<Option<Sender<Ask>>>,
    process: u32,
    n_envs: usize,
    n_scenarios: usize,
    action_len: usize,
    shape: Vec<usize>,
}

#[pymethods]
impl Env {
    #[new]
    #[allow(clippy::too_many_arguments, reason = "the choices of gump.VectorEnv")]
    fn new(
        py: Python<'_>,
        scenarios: Vec<PyRef<'_, Scenario>>,
        world: &World,
        num_envs: usize,
        autoreset: &str,
        observation: &str,
        dynamics: &str,
        horizon: f64,
        prioritized: bool,
        nearest: Option<usize>,
    ) -> PyResult<Self> {
        let mut config = EnvConfig {
            n_envs: num_envs,
            autoreset: match autoreset {
                "next_step" => Autoreset::NextStep,
                "same_step" => Autoreset::SameStep,
                "disabled" => Autoreset::Disabled,
                found => {
                    let expected = "next_step, same_step or disabled";
                    return Err(choice("autoreset_mode", expected, found));
                }
            },
            observation: match observation {
                "vector" => ObservationSpec::Vector(VectorView::default()),
                "raster" => ObservationSpec::Raster(RasterView::default()),
                found => return Err(choice("observation", "vector or raster", found)),
            },
            ..EnvConfig::default()
        };
        config.rules.dynamics = match dynamics {
            "bicycle" => Dynamics::Bicycle(BicycleLimits::default()),
            "next_pose" => Dynamics::NextPose(PoseLimits::default()),
            "trajectory" => Dynamics::Trajectory(PoseLimits::default()),
            found => {
                let expected = "bicycle, next_pose or trajectory";
                return Err(choice("dynamics", expected, found));
            }
        };
        config.rules.horizon = horizon;
        config.nearest = nearest;
        if prioritized {
            config.sampling = Sampling::prioritized();
        }
        let scenes: Vec<_> = scenarios.iter().map(|s| Arc::clone(&s.scene)).collect();
        let prepared = threads::work(py, || {
            PreparedScenario::prepare(scenes.iter().map(|scene| scene.scenario.clone()), STEP)
        })?;
        let prepared = prepared.map_err(errors::value)?;
        let n_scenarios = prepared.len();
        let model = world.kind.model();
        let (ready_sender, ready) = channel();
        let (asks, requests) = channel();
        threads::alone(move || {
            let traffic = match &model {
                Some(model) => TrafficSource::World(&**model),
                None => TrafficSource::Log,
            };
            match DrivingEnv::new(prepared, traffic, config) {
                Ok(env) => {
                    if ready_sender.send(Ok(env.action_len())).is_ok() {
                        serve(env, &requests);
                    }
                }
                // If this fails, nobody is waiting for the error.
                Err(error) => drop(ready_sender.send(Err(error))),
            }
        })?;
        let action_len = py.detach(move || ready.recv()).map_err(|_| gone())?;
        Ok(Self {
            asks: Mutex::new(Some(asks)),
            process: std::process::id(),
            n_envs: num_envs,
            n_scenarios,
            action_len: action_len.map_err(errors::value)?,
            shape: config.observation.shape(),
        })
    }

    /// Numbers in an action.
    #[getter]
    fn action_len(&self) -> usize {
        self.action_len
    }

    /// Scenarios that are driven through.
    #[getter]
    fn n_scenarios(&self) -> usize {
        self.n_scenarios
    }

    /// Axes of one observation.
    #[getter]
    fn observation_shape(&self) -> Vec<usize> {
        self.shape.clone()
    }

    /// Seconds that an action is held.
    #[getter]
    fn dt(&self) -> f64 {
        STEP
    }

    /// Starts episodes and returns the observations `[n, ...]`.
    fn reset<'py>(
        &self,
        py: Python<'py>,
        seeds: Option<Vec<u64>>,
        mask: Option<Vec<bool>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let answer = self.ask(py, Request::Reset { seeds, mask })?;
        self.observations(py, answer.observations, Some(self.n_envs))
    }

    /// One action per row, float32 `[n, action_len]`; observations, rewards, terminated, truncated,
    /// and the episodes that ended.
    #[allow(clippy::type_complexity, reason = "the five parts of a step")]
    fn step<'py>(
        &self,
        py: Python<'py>,
        actions: &Bound<'py, PyArrayDyn<f32>>,
    ) -> PyResult<(
        Bound<'py, PyAny>,
        Bound<'py, PyAny>,
        Bound<'py, PyAny>,
        Bound<'py, PyAny>,
        Bound<'py, PyList>,
    )> {
        let actions = Numbers::new("actions", actions, &["num_envs", "action_len"])?;
        actions.expect(0, self.n_envs, "one per environment")?;
        actions.expect(1, self.action_len, "numbers of an action")?;
        let answer = self.ask(py, Request::Step(actions.slice()?.to_vec()))?;
        let n = self.n_envs;
        let ended = PyList::empty(py);
        for episode in answer.ended {
            let dict = PyDict::new(py);
            dict.set_item("row", episode.row)?;
            dict.set_item("scenario", episode.scenario)?;
            dict.set_item("steps", episode.steps)?;
            dict.set_item("return", episode.totals.reward)?;
            dict.set_item("progress", episode.totals.progress)?;
            dict.set_item("collided", episode.totals.collided)?;
            dict.set_item("at_fault", episode.totals.at_fault)?;
            dict.set_item("off_road", episode.totals.off_road)?;
            dict.set_item("uncomfortable", episode.totals.uncomfortable)?;
            dict.set_item("last", self.observations(py, episode.last, None)?)?;
            ended.append(dict)?;
        }
        Ok((
            self.observations(py, answer.observations, Some(n))?,
            array(py, n, answer.rewards)?.into_any(),
            array(py, n, answer.terminated)?.into_any(),
            array(py, n, answer.truncated)?.into_any(),
            ended,
        ))
    }

    /// The actions that come nearest to what the log does next, float32 `[n, action_len]`.
    fn expert_actions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let answer = self.ask(py, Request::Expert)?;
        Ok(array(py, [self.n_envs, self.action_len], answer.actions)?.into_any())
    }

    /// Closes the environment; later calls raise `ValueError`.
    fn close(&self) {
        let mut asks = self.asks.lock().unwrap_or_else(PoisonError::into_inner);
        *asks = None;
    }
}

impl Env {
    fn ask(&self, py: Python<'_>, request: Request) -> PyResult<Answer> {
        if self.process != std::process::id() {
            let sentence =
                "expected the process that made the environment, found one forked from it";
            return Err(errors::runtime(sentence));
        }
        let asks = {
            let asks = self.asks.lock().unwrap_or_else(PoisonError::into_inner);
            asks.clone()
        };
        let asks = asks.ok_or_else(|| {
            errors::value("expected an environment that is open, found one that was closed")
        })?;
        let answer = py.detach(|| {
            let (answer, answered) = channel();
            asks.send(Ask { request, answer }).ok()?;
            answered.recv().ok()
        });
        answer.ok_or_else(gone)?.map_err(errors::value)
    }

    /// Observations of `n` rows, or of one alone.
    fn observations<'py>(
        &self,
        py: Python<'py>,
        observations: Observations,
        n: Option<usize>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let shape: Vec<usize> = n.into_iter().chain(self.shape.iter().copied()).collect();
        Ok(match observations {
            Observations::Numbers(numbers) => array(py, shape, numbers)?.into_any(),
            Observations::Pixels(pixels) => array(py, shape, pixels)?.into_any(),
        })
    }
}

fn choice(name: &str, expected: &str, found: &str) -> PyErr {
    errors::value(format!("{name}: expected {expected}, found {found}"))
}

fn gone() -> PyErr {
    errors::runtime("expected an environment in progress, found that it has failed")
}

fn serve(mut env: DrivingEnv<'_>, requests: &Receiver<Ask>) {
    while let Ok(ask) = requests.recv() {
        let answer = answer(&mut env, ask.request);
        if ask.answer.send(answer).is_err() {
            return;
        }
    }
}

fn answer(env: &mut DrivingEnv<'_>, request: Request) -> Result<Answer, RlError> {
    let n = env.n_envs();
    match request {
        Request::Reset { seeds, mask } => {
            let seeds: Option<Vec<Seed>> = seeds.map(|seeds| seeds.into_iter().map(Seed).collect());
            match (&seeds, mask) {
                (Some(seeds), None) => env.reset_with(seeds)?,
                (_, mask) => {
                    let mask = mask.unwrap_or_else(|| vec![true; n]);
                    env.reset_rows(&mask, seeds.as_deref())?;
                }
            }
            Ok(Answer {
                observations: whole(env),
                ..Answer::default()
            })
        }
        Request::Step(actions) => {
            env.step(&actions)?;
            let ended = env.finished().iter().map(|(row, outcome)| Ended {
                row: *row,
                scenario: outcome.start.scenario,
                steps: outcome.steps,
                totals: outcome.totals,
                last: last(env, *row),
            });
            Ok(Answer {
                ended: ended.collect(),
                observations: whole(env),
                rewards: env.rewards().to_vec(),
                terminated: env.terminated().to_vec(),
                truncated: env.truncated().to_vec(),
                actions: Vec::new(),
            })
        }
        Request::Expert => {
            let mut actions = vec![0.0; n * env.action_len()];
            env.expert_actions(&mut actions)?;
            Ok(Answer {
                actions,
                ..Answer::default()
            })
        }
    }
}

fn whole(env: &DrivingEnv<'_>) -> Observations {
    match env.packed_observations() {
        [] => Observations::Numbers(env.observations().to_vec()),
        packed => Observations::Pixels(pixels(packed)),
    }
}

/// Observations after the last step of a row's finished episode.
fn last(env: &DrivingEnv<'_>, row: usize) -> Observations {
    let part = |len: usize| row * len / env.n_envs()..(row + 1) * len / env.n_envs();
    match env.packed_final_observations() {
        [] => {
            let all = env.final_observations();
            Observations::Numbers(all[part(all.len())].to_vec())
        }
        packed => Observations::Pixels(pixels(&packed[part(packed.len())])),
    }
}

/// Bits, the lowest of a byte first, as zeros and ones.
fn pixels(packed: &[u8]) -> Vec<u8> {
    let bits = packed
        .iter()
        .flat_map(|byte| (0..8).map(move |bit| byte >> bit & 1));
    bits.collect()
}
