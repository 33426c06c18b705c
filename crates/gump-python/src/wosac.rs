//! Realism of rollouts that come as arrays or as messages.

use std::sync::{Arc, OnceLock};

use gump_data::submission::decode_rollouts;
use gump_scene::{AgentId, AgentKind};
use gump_wosac::realism::{
    AgentRealism, Attribution, Component, Config, Log, Mode, N_FUTURE, N_STEPS, Reference,
    Rollouts, Scores, Trajectory, WosacError, Year,
};
use numpy::PyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use rayon::prelude::*;

use crate::arrays::{Numbers, array};
use crate::errors;
use crate::scenario::{Scenario, Scene};
use crate::threads;

/// The settings of a year, read once, or custom settings: TOML, which has more than one line.
fn config(year: &str) -> PyResult<Arc<Config>> {
    static CONFIGS: [OnceLock<Arc<Config>>; Year::ALL.len()] = [const { OnceLock::new() }; 5];
    if year.contains('\n') {
        let config = Config::parse(year).map_err(|why| {
            let why = why.to_string().trim().replace('\n', " ");
            errors::value(format!("settings: {why}"))
        })?;
        return Ok(Arc::new(config));
    }
    match Year::ALL.iter().position(|y| y.name() == year) {
        Some(i) => {
            let config = CONFIGS[i].get_or_init(|| Arc::new(Config::of(Year::ALL[i])));
            Ok(Arc::clone(config))
        }
        None => {
            let names = Year::ALL.map(Year::name).join(", ");
            Err(errors::value(format!(
                "year: expected one of {names}, found {year}"
            )))
        }
    }
}

/// Results requested beside the scores.
#[derive(Clone, Copy)]
struct Wanted {
    leave_one_out: bool,
    per_agent: bool,
    explain: bool,
}

const SCORES_ALONE: Wanted = Wanted {
    leave_one_out: false,
    per_agent: false,
    explain: false,
};

/// Results of one scenario.
struct Found {
    scores: Scores,
    leave_one_out: Option<Vec<f64>>,
    per_agent: Option<Vec<AgentRealism>>,
    attributions: Option<Vec<Attribution>>,
}

fn evaluate(
    log: &Log,
    rollouts: &Rollouts,
    config: &Config,
    wanted: Wanted,
) -> Result<Found, WosacError> {
    let reference = Reference::new(log, config)?;
    let evaluation = reference.evaluate(rollouts)?;
    let leave_one_out = wanted.leave_one_out.then(|| evaluation.leave_one_out());
    Ok(Found {
        leave_one_out: leave_one_out.flatten().map(|worth| worth.metametric),
        per_agent: wanted.per_agent.then(|| evaluation.realism()),
        attributions: wanted.explain.then(|| evaluation.explain()),
        scores: evaluation.scores,
    })
}

impl Found {
    /// The results as the keyword arguments of `gump.wosac.Scores`.
    fn to_dict<'py>(&self, py: Python<'py>, scenario: &str) -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        let scores = &self.scores;
        dict.set_item("scenario_id", scenario)?;
        dict.set_item("metametric", scores.metametric)?;
        dict.set_item("average_displacement_error", scores.ade)?;
        dict.set_item("min_average_displacement_error", scores.min_ade)?;
        for (component, likelihood) in &scores.components {
            dict.set_item(field(*component), likelihood)?;
        }
        dict.set_item("simulated_collision_rate", scores.collision_rate)?;
        dict.set_item("simulated_offroad_rate", scores.offroad_rate)?;
        if let Some(rate) = scores.traffic_light_violation_rate {
            dict.set_item("simulated_traffic_light_violation_rate", rate)?;
        }
        dict.set_item("kinematic_metrics", scores.kinematic)?;
        dict.set_item("interactive_metrics", scores.interactive)?;
        dict.set_item("map_based_metrics", scores.map_based)?;
        if let Some(without) = &self.leave_one_out {
            dict.set_item("leave_one_out", array(py, without.len(), without.clone())?)?;
        }
        if let Some(agents) = &self.per_agent {
            dict.set_item("per_agent", per_agent(py, agents)?)?;
        }
        if let Some(attributions) = &self.attributions {
            let list = PyList::empty(py);
            for attribution in attributions {
                list.append(attribution_dict(py, attribution)?)?;
            }
            dict.set_item("explanation", list)?;
        }
        Ok(dict)
    }
}

/// Waymo's name of a component's likelihood.
fn field(component: Component) -> String {
    let indication = match component {
        Component::Collision | Component::Offroad => "_indication",
        _ => "",
    };
    format!("{}{indication}_likelihood", component.name())
}

fn per_agent<'py>(py: Python<'py>, agents: &[AgentRealism]) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    let n_steps = agents.first().map_or(0, |agent| agent.steps.len());
    let ids: Vec<i64> = agents.iter().map(|agent| agent.agent.0).collect();
    let realism: Vec<f64> = agents.iter().map(|agent| agent.realism).collect();
    let steps = agents.iter().flat_map(|agent| &agent.steps);
    let steps: Vec<f64> = steps.map(|step| step.unwrap_or(f64::NAN)).collect();
    dict.set_item("agent_id", array(py, ids.len(), ids)?)?;
    dict.set_item("realism", array(py, realism.len(), realism)?)?;
    dict.set_item("steps", array(py, [agents.len(), n_steps], steps)?)?;
    Ok(dict)
}

fn attribution_dict<'py>(
    py: Python<'py>,
    attribution: &Attribution,
) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("component", attribution.component.name())?;
    dict.set_item("agent_id", attribution.agent.0)?;
    dict.set_item("kind", attribution.kind.name())?;
    dict.set_item("cost", attribution.cost)?;
    dict.set_item("likelihood", attribution.likelihood)?;
    dict.set_item("step", attribution.step)?;
    dict.set_item("logged", attribution.logged)?;
    dict.set_item("imagined", attribution.imagined)?;
    Ok(dict)
}

/// Rollouts as arrays: states `[R, A, T, 4]`, and for scenario generation sizes `[R, A, T, 3]` and
/// the kind of every agent.
struct Arrays<'a> {
    ids: &'a [i64],
    states: &'a [f32],
    n_rollouts: usize,
    shapes: Option<(&'a [f32], &'a [AgentKind])>,
}

impl Arrays<'_> {
    fn rollouts(&self, scenario: &str, n_steps: usize) -> Rollouts {
        let n_agents = self.ids.len();
        let future = |rollout: usize| {
            let agent = |(i, &id): (usize, &i64)| {
                let row = rollout * n_agents + i;
                let states = &self.states[row * n_steps * 4..][..n_steps * 4];
                let drive = trajectory(id, states.as_chunks().0.iter().copied());
                match self.shapes {
                    None => drive,
                    Some((sizes, kinds)) => {
                        let sizes = &sizes[row * n_steps * 3..][..n_steps * 3];
                        drive.with_box(kinds[i], sizes.as_chunks().0.to_vec())
                    }
                }
            };
            self.ids.iter().enumerate().map(agent).collect()
        };
        let futures = (0..self.n_rollouts).into_par_iter().map(future);
        Rollouts::new(scenario, futures.collect())
    }
}

/// One agent's x, y, z and heading.
fn trajectory(id: i64, states: impl ExactSizeIterator<Item = [f32; 4]>) -> Trajectory {
    let n = states.len();
    let columns = || Vec::with_capacity(n);
    let (mut xs, mut ys, mut zs, mut headings) = (columns(), columns(), columns(), columns());
    for [x, y, z, heading] in states {
        xs.push(x);
        ys.push(y);
        zs.push(z);
        headings.push(heading);
    }
    Trajectory::new(AgentId(id), xs, ys, zs, headings)
}

fn n_steps(mode: Mode) -> (usize, &'static str) {
    match mode {
        Mode::SimAgents => (N_FUTURE, "steps of 0.1 s after the present"),
        Mode::Generation => (N_STEPS, "steps of 0.1 s, the past included"),
    }
}

/// The ids and states of one scenario, their shapes checked.
struct Borrowed<'py> {
    ids: Numbers<'py, i64>,
    states: Numbers<'py, f32>,
    sizes: Option<Numbers<'py, f32>>,
    kinds: Vec<AgentKind>,
}

impl<'py> Borrowed<'py> {
    fn new(
        ids: &Bound<'py, PyArrayDyn<i64>>,
        states: &Bound<'py, PyArrayDyn<f32>>,
        shapes: Option<(&Bound<'py, PyArrayDyn<f32>>, Vec<String>)>,
        mode: Mode,
    ) -> PyResult<Self> {
        let ids = Numbers::new("agent_id", ids, &["A"])?;
        let n = ids.shape()[0];
        let (steps, what) = n_steps(mode);
        let states = Numbers::new("states", states, &["R", "A", "T", "4"])?;
        states.expect(1, n, "one agent per agent_id")?;
        states.expect(2, steps, what)?;
        states.expect(3, 4, "x, y, z, heading")?;
        let (sizes, kinds) = match (mode, shapes) {
            (Mode::SimAgents, _) => (None, Vec::new()),
            (Mode::Generation, None) => {
                let sentence = "sizes, kinds: expected both, since scenario generation makes them \
                                up, found none";
                return Err(errors::value(sentence));
            }
            (Mode::Generation, Some((sizes, kinds))) => {
                let sizes = Numbers::new("sizes", sizes, &["R", "A", "T", "3"])?;
                for axis in 0..3 {
                    sizes.expect(axis, states.shape()[axis], "as of states")?;
                }
                sizes.expect(3, 3, "length, width, height")?;
                if kinds.len() != n {
                    let found = kinds.len();
                    return Err(errors::value(format!(
                        "kinds: expected {n}, one per agent_id, found {found}"
                    )));
                }
                let kinds = kinds.iter().map(|name| kind(name));
                (Some(sizes), kinds.collect::<PyResult<Vec<_>>>()?)
            }
        };
        Ok(Self {
            ids,
            states,
            sizes,
            kinds,
        })
    }

    fn arrays(&self) -> PyResult<Arrays<'_>> {
        let sizes = self.sizes.as_ref().map(Numbers::slice).transpose()?;
        Ok(Arrays {
            ids: self.ids.slice()?,
            states: self.states.slice()?,
            n_rollouts: self.states.shape()[0],
            shapes: sizes.map(|sizes| (sizes, self.kinds.as_slice())),
        })
    }
}

fn kind(name: &str) -> PyResult<AgentKind> {
    let kinds = AgentKind::MOVING.into_iter().chain(AgentKind::STATIC);
    let mut kinds = kinds.filter(|kind| kind.name() == name);
    kinds.next().ok_or_else(|| {
        errors::value(format!(
            "kinds: expected vehicle, pedestrian, bicycle or other, found {name}"
        ))
    })
}

/// Leaving out one rollout requires at least two.
fn check_leave_one_out(n_rollouts: usize) -> PyResult<()> {
    if n_rollouts < 2 {
        return Err(errors::value(format!(
            "leave_one_out: expected at least 2 rollouts, found {n_rollouts}"
        )));
    }
    Ok(())
}

/// Scores one scenario; `states` float32 `[R, A, T, 4]`.
#[pyfunction]
#[pyo3(signature = (scenario, agent_id, states, year, leave_one_out, per_agent, explain, sizes=None, kinds=None))]
#[allow(
    clippy::too_many_arguments,
    reason = "the arguments of gump.wosac.score"
)]
pub(crate) fn wosac_score<'py>(
    py: Python<'py>,
    scenario: &Scenario,
    agent_id: &Bound<'py, PyArrayDyn<i64>>,
    states: &Bound<'py, PyArrayDyn<f32>>,
    year: &str,
    leave_one_out: bool,
    per_agent: bool,
    explain: bool,
    sizes: Option<&Bound<'py, PyArrayDyn<f32>>>,
    kinds: Option<Vec<String>>,
) -> PyResult<Bound<'py, PyDict>> {
    let config = config(year)?;
    let borrowed = Borrowed::new(agent_id, states, sizes.zip(kinds), config.mode)?;
    let arrays = borrowed.arrays()?;
    if leave_one_out {
        check_leave_one_out(arrays.n_rollouts)?;
    }
    let wanted = Wanted {
        leave_one_out,
        per_agent,
        explain,
    };
    let scene = &scenario.scene;
    let found = threads::work(py, || {
        let rollouts = arrays.rollouts(&scene.scenario.id, n_steps(config.mode).0);
        evaluate(scene.log()?, &rollouts, &config, wanted)
    })?;
    found
        .map_err(errors::value)?
        .to_dict(py, &scene.scenario.id)
}

/// Scores many scenarios over threads; a list each of ids `[A]` and states `[R, A, T, 4]`.
#[pyfunction]
pub(crate) fn wosac_score_many<'py>(
    py: Python<'py>,
    scenarios: Vec<PyRef<'py, Scenario>>,
    agent_id: Vec<Bound<'py, PyArrayDyn<i64>>>,
    states: Vec<Bound<'py, PyArrayDyn<f32>>>,
    year: &str,
) -> PyResult<Vec<Bound<'py, PyDict>>> {
    let config = config(year)?;
    let n = scenarios.len();
    for (name, found) in [("agent_id", agent_id.len()), ("states", states.len())] {
        if found != n {
            return Err(errors::value(format!(
                "{name}: expected {n}, one per scenario, found {found}"
            )));
        }
    }
    let pairs = agent_id.iter().zip(&states);
    let borrowed = pairs.map(|(ids, states)| Borrowed::new(ids, states, None, config.mode));
    let borrowed = borrowed.collect::<PyResult<Vec<_>>>()?;
    let arrays = borrowed.iter().map(Borrowed::arrays);
    let arrays = arrays.collect::<PyResult<Vec<_>>>()?;
    let scenes: Vec<Arc<Scene>> = scenarios.iter().map(|s| Arc::clone(&s.scene)).collect();
    let found = threads::work(py, || {
        let pairs = scenes.par_iter().zip(&arrays);
        let each = pairs.map(|(scene, arrays)| {
            let rollouts = arrays.rollouts(&scene.scenario.id, n_steps(config.mode).0);
            evaluate(scene.log()?, &rollouts, &config, SCORES_ALONE)
        });
        each.collect::<Vec<Result<Found, WosacError>>>()
    })?;
    tell_all(py, found, &scenes)
}

fn tell_all<'py>(
    py: Python<'py>,
    found: Vec<Result<Found, WosacError>>,
    scenes: &[Arc<Scene>],
) -> PyResult<Vec<Bound<'py, PyDict>>> {
    let pairs = found.into_iter().zip(scenes);
    let dicts = pairs.map(|(found, scene)| {
        let found = found.map_err(errors::value)?;
        found.to_dict(py, &scene.scenario.id)
    });
    dicts.collect()
}

/// Scores a batch in CAT-K's layout: positions `[A, R, T, 2]`, heights and headings `[A, R, T]`,
/// agents of all scenarios one after another; `agent_batch` says whose they are.
#[pyfunction]
#[allow(clippy::too_many_arguments, reason = "the parts of CAT-K's batches")]
pub(crate) fn wosac_score_catk<'py>(
    py: Python<'py>,
    scenarios: Vec<PyRef<'py, Scenario>>,
    agent_id: &Bound<'py, PyArrayDyn<i64>>,
    agent_batch: &Bound<'py, PyArrayDyn<i64>>,
    position: &Bound<'py, PyArrayDyn<f32>>,
    z: &Bound<'py, PyArrayDyn<f32>>,
    heading: &Bound<'py, PyArrayDyn<f32>>,
    year: &str,
) -> PyResult<Vec<Bound<'py, PyDict>>> {
    let config = config(year)?;
    if config.mode == Mode::Generation {
        let sentence = format!("year: expected one of simulated agents, found {year}");
        return Err(errors::value(sentence));
    }
    let ids = Numbers::new("agent_id", agent_id, &["A"])?;
    let n = ids.shape()[0];
    let batch = Numbers::new("agent_batch", agent_batch, &["A"])?;
    batch.expect(0, n, "one per agent_id")?;
    let position = Numbers::new("position", position, &["A", "R", "T", "2"])?;
    position.expect(0, n, "one per agent_id")?;
    position.expect(2, N_FUTURE, "steps of 0.1 s after the present")?;
    position.expect(3, 2, "x, y")?;
    let n_rollouts = position.shape()[1];
    let z = Numbers::new("z", z, &["A", "R", "T"])?;
    let heading = Numbers::new("heading", heading, &["A", "R", "T"])?;
    for axis in 0..3 {
        z.expect(axis, position.shape()[axis], "as of position")?;
        heading.expect(axis, position.shape()[axis], "as of position")?;
    }
    let (ids, batch) = (ids.slice()?, batch.slice()?);
    let mut members: Vec<Vec<usize>> = vec![Vec::new(); scenarios.len()];
    for (agent, &scenario) in batch.iter().enumerate() {
        let own = usize::try_from(scenario).ok();
        match own.and_then(|scenario| members.get_mut(scenario)) {
            Some(own) => own.push(agent),
            None => {
                let n = scenarios.len();
                return Err(errors::value(format!(
                    "agent_batch: expected indices of the {n} scenarios, found {scenario}"
                )));
            }
        }
    }
    let (position, z, heading) = (position.slice()?, z.slice()?, heading.slice()?);
    let drive = |agent: usize, rollout: usize| {
        let row = (agent * n_rollouts + rollout) * N_FUTURE;
        let states =
            (row..row + N_FUTURE).map(|i| [position[2 * i], position[2 * i + 1], z[i], heading[i]]);
        trajectory(ids[agent], states)
    };
    let scenes: Vec<Arc<Scene>> = scenarios.iter().map(|s| Arc::clone(&s.scene)).collect();
    let found = threads::work(py, || {
        let each = scenes.par_iter().zip(&members).map(|(scene, agents)| {
            let future = |rollout| agents.iter().map(|&a| drive(a, rollout)).collect();
            let futures = (0..n_rollouts).into_par_iter().map(future);
            let rollouts = Rollouts::new(scene.scenario.id.clone(), futures.collect());
            evaluate(scene.log()?, &rollouts, &config, SCORES_ALONE)
        });
        each.collect::<Vec<_>>()
    })?;
    tell_all(py, found, &scenes)
}

/// Scores a serialized `ScenarioRollouts` message.
#[pyfunction]
pub(crate) fn wosac_score_message<'py>(
    py: Python<'py>,
    scenario: &Scenario,
    message: &[u8],
    year: &str,
    leave_one_out: bool,
    per_agent: bool,
    explain: bool,
) -> PyResult<Bound<'py, PyDict>> {
    let config = config(year)?;
    let scene = &scenario.scene;
    let message = decode_rollouts(message).map_err(errors::data_problem)?;
    if leave_one_out {
        check_leave_one_out(message.joint_scenes.len())?;
    }
    let wanted = Wanted {
        leave_one_out,
        per_agent,
        explain,
    };
    let found = threads::work(py, || {
        let rollouts = Rollouts::of_message(&message, config.mode);
        evaluate(scene.log()?, &rollouts, &config, wanted)
    })?;
    found
        .map_err(errors::value)?
        .to_dict(py, &scene.scenario.id)
}

/// Weights of a year's components, by Waymo's names of their likelihoods.
#[pyfunction]
pub(crate) fn wosac_weights<'py>(py: Python<'py>, year: &str) -> PyResult<Bound<'py, PyDict>> {
    let (config, dict) = (config(year)?, PyDict::new(py));
    for component in Component::ALL {
        if let Some(feature) = config.feature(component) {
            dict.set_item(field(component), f64::from(feature.weight))?;
        }
    }
    Ok(dict)
}
