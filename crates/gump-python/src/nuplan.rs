//! nuPlan's closed loop and its scores, with our planners or planners in Python.

use std::sync::Arc;

use gump_eval::planners::{PlannerConfig, PlannerName, TimedDriver};
use gump_eval::recordings::{self, Case};
use gump_geometry::{Pose, dvec2};
use gump_nuplan::closed_loop::{
    DriveConfig, Driver, ImaginedTraffic, Others, PlannerInitialization, PlannerInput, Recording,
    Replayed, Step, Tracking, Traffic,
};
use gump_nuplan::metrics::{ClosedLoop, Sample, Scoring, SimulationHistory, score};
use gump_nuplan::reactive_agents::NuplanIdm;
use gump_nuplan::tracking::Trajectory;
use gump_planner::Explain;
use gump_planner::closed_loop::{Scored, drive_and_score};
use gump_rollout::worlds::Idm;
use gump_rollout::{BoxError, WorldModel};
use gump_scene::{EgoState, Frame, Scenario as Recorded, Seed, VehicleParameters};
use numpy::PyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{Numbers, array};
use crate::errors;
use crate::scenario::{Scenario, Scene};
use crate::scenario_arrays::state;
use crate::threads;
use crate::world::World;

/// Numbers of an ego's state beside its time: rear axle x, y, heading; velocity, acceleration in
/// the vehicle's frame; steering angle and rate; yaw rate and acceleration.
const EGO: usize = 11;

/// The scenario as a recording to drive through.
///
/// Error: a map without lanes, or no ego.
fn case(scene: &Scene) -> PyResult<Case> {
    recordings::of_boxes(scene.scenario.clone()).map_err(errors::value)
}

/// Drives through a scenario and scores the drive.
///
/// `planner` is a name, or an object with `initialize(dict)` and `plan(dict)`, which
/// `gump.nuplan` makes of whatever it was given.
#[pyfunction]
#[allow(
    clippy::too_many_arguments,
    reason = "the arguments of gump.nuplan.simulate"
)]
pub(crate) fn nuplan_simulate<'py>(
    py: Python<'py>,
    scenario: Bound<'py, Scenario>,
    planner: &Bound<'py, PyAny>,
    world: &World,
    imagination: Option<&World>,
    seconds: f64,
    perfect: bool,
    seed: u64,
) -> PyResult<Bound<'py, PyDict>> {
    let scene = Arc::clone(&scenario.get().scene);
    let case = case(&scene)?;
    let model = world.kind.model();
    let rules = world.name_is("idm");
    let inner: Box<dyn Traffic + Send + '_> = match &model {
        None => Box::new(Replayed),
        Some(_) if rules => Box::new(NuplanIdm::default()),
        Some(model) => Box::new(ImaginedTraffic::new(&**model, Seed(seed))),
    };
    let mut traffic = Pooled::new(inner)?;
    let config = DriveConfig {
        tracking: if perfect {
            Tracking::Perfect
        } else {
            Tracking::TwoStage
        },
        seconds,
        keep_plans: false,
    };
    let thinks_in = imagination.and_then(|world| world.kind.model());
    let thinks_in = thinks_in.unwrap_or_else(|| Arc::new(Idm::default()));
    let mut drive = |driver: &mut dyn Driver| {
        let mut driver = TimedDriver::new(driver, None);
        let scored = drive_and_score(
            &case.recording,
            &case.map,
            &mut traffic,
            &mut driver,
            &config,
        );
        scored.map(|scored| (scored, driver.milliseconds_per_step()))
    };
    let driven = match planner.extract::<String>() {
        Ok(name) => py.detach(|| {
            let mut driver = named(&name, &case, &*thinks_in, Seed(seed))?;
            drive(&mut *driver).map_err(errors::value)
        }),
        Err(_) => {
            let mut theirs = PythonDriver {
                bridge: planner.clone().unbind(),
                scenario: scenario.unbind(),
                raised: None,
            };
            let driven = py.detach(|| drive(&mut theirs));
            match theirs.raised {
                Some(raised) => Err(raised),
                None => driven.map_err(errors::value),
            }
        }
    };
    let (scored, milliseconds) = driven?;
    let dict = scores_dict(py, &scored.metrics)?;
    dict.set_item("milliseconds_per_step", milliseconds)?;
    add_drive(py, &scored, &scene.scenario, &dict)?;
    Ok(dict)
}

/// A planner of ours.
fn named<'w>(
    name: &str,
    case: &Case,
    world: &'w dyn WorldModel,
    seed: Seed,
) -> PyResult<Box<dyn Explain + 'w>> {
    // The proposals are many planners, of which none drives alone.
    let known = PlannerName::ALL.into_iter();
    let known = known.filter(|planner| *planner != PlannerName::Proposals);
    let Some(planner) = known.clone().find(|planner| planner.name() == name) else {
        let names: Vec<&str> = known.map(PlannerName::name).collect();
        return Err(errors::value(format!(
            "planner: expected {} or an object with initialize and compute_planner_trajectory, \
             found {name}",
            names.join(", ")
        )));
    };
    let built = planner.build(case, world, seed, &PlannerConfig::default());
    built.map_err(errors::value)
}

/// Traffic whose parallel work is done on our threads.
struct Pooled<'a> {
    inner: Box<dyn Traffic + Send + 'a>,
    pool: Arc<rayon::ThreadPool>,
    name: String,
}

impl<'a> Pooled<'a> {
    fn new(inner: Box<dyn Traffic + Send + 'a>) -> PyResult<Self> {
        Ok(Self {
            name: inner.name().to_owned(),
            pool: threads::pool()?,
            inner,
        })
    }
}

impl Traffic for Pooled<'_> {
    fn name(&self) -> &str {
        &self.name
    }

    fn begin(&mut self, recording: &Recording) -> Result<Others, BoxError> {
        let inner = &mut self.inner;
        self.pool.install(|| inner.begin(recording))
    }

    fn advance(&mut self, step: &Step<'_>) -> Result<Others, BoxError> {
        let inner = &mut self.inner;
        self.pool.install(|| inner.advance(step))
    }
}

/// A planner in Python, called with the interpreter's lock on the caller's thread.
struct PythonDriver {
    bridge: Py<PyAny>,
    scenario: Py<Scenario>,
    /// The exception that it raised, to be raised again in the caller.
    raised: Option<PyErr>,
}

impl PythonDriver {
    fn keep(&mut self, error: PyErr) -> BoxError {
        self.raised = Some(error);
        "the planner raised an exception".into()
    }
}

impl Driver for PythonDriver {
    fn name(&self) -> &str {
        "the planner"
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        let started = Python::attach(|py| {
            let dict = PyDict::new(py);
            dict.set_item("scenario", &self.scenario)?;
            let lanes = initialization.route.iter().flat_map(|route| &route.lanes);
            let lanes: Vec<i64> = lanes.map(|lane| lane.0).collect();
            dict.set_item("route_lane_ids", lanes)?;
            let blocks = initialization
                .route
                .iter()
                .flat_map(|route| &route.roadblocks);
            let blocks: Vec<i64> = blocks.map(|block| block.0).collect();
            dict.set_item("route_roadblock_ids", blocks)?;
            let goal = initialization
                .goal
                .map(|g| (g.position.x, g.position.y, g.heading));
            dict.set_item("mission_goal", goal)?;
            dict.set_item("vehicle", vehicle(py, &initialization.vehicle)?)?;
            self.bridge.call_method1(py, "initialize", (dict,))?;
            Ok(())
        });
        started.map_err(|error| self.keep(error))
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let planned = Python::attach(|py| {
            let dict = PyDict::new(py);
            dict.set_item("iteration", input.iteration)?;
            dict.set_item("time_us", input.ego.time_us)?;
            dict.set_item("ego", ego_row(input.ego).to_vec())?;
            // The states before the first iteration are sent once.
            let before = if input.iteration == 0 {
                let history = &input.scene.history[..input.scene.history.len() - 1];
                let frames = history.iter().map(|frame| observed(py, frame, input));
                let frames = frames.collect::<PyResult<Vec<_>>>()?;
                let past = input
                    .past
                    .iter()
                    .map(|ego| (ego.time_us, ego_row(ego).to_vec()));
                Some((past.collect::<Vec<_>>(), frames))
            } else {
                None
            };
            dict.set_item("before", before)?;
            dict.set_item("observed", observed(py, input.scene.now(), input)?)?;
            let plan = self.bridge.call_method1(py, "plan", (dict,))?;
            let plan = plan.bind(py).cast::<PyArrayDyn<f64>>()?;
            trajectory(plan, input.ego)
        });
        planned.map_err(|error| self.keep(error))
    }
}

fn vehicle<'py>(py: Python<'py>, vehicle: &VehicleParameters) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("width", vehicle.width)?;
    dict.set_item("front_length", vehicle.front_length)?;
    dict.set_item("rear_length", vehicle.rear_length)?;
    dict.set_item("wheel_base", vehicle.wheel_base)?;
    dict.set_item("height", vehicle.height)?;
    Ok(dict)
}

/// All agents but the ego, and the lights.
fn observed<'py>(
    py: Python<'py>,
    frame: &Frame,
    input: &PlannerInput<'_>,
) -> PyResult<Bound<'py, PyDict>> {
    let agents = frame.agents().iter();
    let others: Vec<_> = agents.filter(|a| a.id != input.scene.ego).collect();
    let dict = PyDict::new(py);
    let ids: Vec<i64> = others.iter().map(|agent| agent.id.0).collect();
    let kinds: Vec<&str> = others.iter().map(|agent| agent.kind.name()).collect();
    let n = others.len();
    let states = others.iter().flat_map(|agent| state(agent));
    let velocities = others.iter().flat_map(|a| a.state.velocity.to_array());
    let sizes = others.iter().flat_map(|a| [a.length, a.width, a.height]);
    dict.set_item("agent_id", array(py, n, ids)?)?;
    dict.set_item("kind", kinds)?;
    dict.set_item("states", array(py, [n, 4], states.collect())?)?;
    dict.set_item("velocity", array(py, [n, 2], velocities.collect())?)?;
    dict.set_item("size", array(py, [n, 3], sizes.collect())?)?;
    let lights = frame.lights().iter();
    let lights = lights.map(|light| (light.lane.0, light_name(light.state)));
    dict.set_item("lights", lights.collect::<Vec<_>>())?;
    Ok(dict)
}

fn light_name(state: gump_scene::LightState) -> &'static str {
    match state {
        gump_scene::LightState::Unknown => "unknown",
        gump_scene::LightState::Green => "green",
        gump_scene::LightState::Yellow => "yellow",
        gump_scene::LightState::Red => "red",
    }
}

/// The numbers of [`EGO`].
fn ego_row(ego: &EgoState) -> [f64; EGO] {
    [
        ego.rear_axle.position.x,
        ego.rear_axle.position.y,
        ego.rear_axle.heading,
        ego.velocity.x,
        ego.velocity.y,
        ego.acceleration.x,
        ego.acceleration.y,
        ego.steering_angle,
        ego.steering_rate,
        ego.yaw_rate,
        ego.yaw_acceleration,
    ]
}

fn ego_of(time_us: i64, row: &[f64; EGO]) -> EgoState {
    EgoState {
        time_us,
        rear_axle: Pose::new(row[0], row[1], row[2]),
        velocity: dvec2(row[3], row[4]),
        acceleration: dvec2(row[5], row[6]),
        steering_angle: row[7],
        steering_rate: row[8],
        yaw_rate: row[9],
        yaw_acceleration: row[10],
    }
}

/// A plan: rows of seconds from now and the numbers of [`EGO`]; the ego as it is comes first unless
/// the plan begins with now.
fn trajectory(plan: &Bound<'_, PyArrayDyn<f64>>, now: &EgoState) -> PyResult<Trajectory> {
    let plan = Numbers::new("the planner's trajectory", plan, &["N", "12"])?;
    plan.expect(1, 1 + EGO, "seconds from now and the ego's state")?;
    let rows = plan.slice()?.as_chunks::<{ 1 + EGO }>().0.iter();
    let states = rows.map(|row| {
        let [seconds, rest @ ..] = row;
        let time_us = now.time_us + (seconds * 1e6).round() as i64;
        ego_of(time_us, rest)
    });
    let mut states: Vec<EgoState> = states.collect();
    if states
        .first()
        .is_some_and(|first| first.time_us > now.time_us)
    {
        states.insert(0, *now);
    }
    Trajectory::new(states)
        .map_err(|error| errors::value(format!("the planner's trajectory: {error}")))
}

/// Scores a drive that was driven elsewhere, as nuPlan's closed-loop challenges do.
///
/// `time_us` int64 `[N]`, `ego` float64 `[N, 11]`; others as in `others` float64 `[A, N, 6]` (x, y,
/// z, heading, velocity; NaN where absent) with their ids, or as in the log.
#[pyfunction]
pub(crate) fn nuplan_score<'py>(
    py: Python<'py>,
    scenario: &Scenario,
    time_us: &Bound<'py, PyArrayDyn<i64>>,
    ego: &Bound<'py, PyArrayDyn<f64>>,
    agent_id: Option<&Bound<'py, PyArrayDyn<i64>>>,
    others: Option<&Bound<'py, PyArrayDyn<f64>>>,
) -> PyResult<Bound<'py, PyDict>> {
    let recording = case(&scenario.scene)?.recording;
    let times = Numbers::new("time_us", time_us, &["N"])?;
    let n = times.shape()[0];
    let ego = Numbers::new("ego", ego, &["N", "11"])?;
    ego.expect(0, n, "one per time_us")?;
    ego.expect(1, EGO, "the numbers of an ego's state")?;
    let rows = ego.slice()?.as_chunks::<EGO>().0.iter();
    let states: Vec<EgoState> = times
        .slice()?
        .iter()
        .zip(rows)
        .map(|(&time_us, row)| ego_of(time_us, row))
        .collect();
    let recorded = recording.scenario();
    let frames = match agent_id.zip(others) {
        None => {
            let frames = &recorded.log[recorded.now..];
            if n > frames.len() {
                let found = frames.len();
                return Err(errors::value(format!(
                    "scenario {}: expected {n} recorded frames from the present on, found {found}",
                    recorded.id
                )));
            }
            frames[..n].to_vec()
        }
        Some((ids, others)) => replayed(recorded, ids, others, n)?,
    };
    let found = py.detach(|| {
        let samples = states.into_iter().zip(frames).map(|(ego, frame)| Sample {
            ego,
            frame,
            plan: Vec::new(),
        });
        let samples: Vec<Sample> = samples.collect();
        let expert = recording.expert();
        score(&SimulationHistory {
            samples: &samples,
            expert: &expert[..(n + 1).min(expert.len())],
            map: &scenario.scene.scenario.map,
            ego: Some(recorded.ego),
            vehicle: *recording.vehicle(),
        })
    });
    scores_dict(py, &found.map_err(errors::value)?)
}

/// Frames of others that were simulated elsewhere: kinds, sizes and lights are those of the log.
fn replayed(
    recorded: &Recorded,
    ids: &Bound<'_, PyArrayDyn<i64>>,
    others: &Bound<'_, PyArrayDyn<f64>>,
    n: usize,
) -> PyResult<Vec<Frame>> {
    let ids = Numbers::new("agent_id", ids, &["A"])?;
    let others = Numbers::new("others", others, &["A", "N", "6"])?;
    others.expect(0, ids.shape()[0], "one per agent_id")?;
    others.expect(1, n, "one per time_us")?;
    others.expect(2, 6, "x, y, z, heading and velocity")?;
    let states = others.slice()?.as_chunks::<6>().0;
    let mut agents = vec![Vec::new(); n];
    for (i, &id) in ids.slice()?.iter().enumerate() {
        let id = gump_scene::AgentId(id);
        let known = recorded.log[recorded.now..]
            .iter()
            .find_map(|f| f.agent(id));
        let Some(known) = known else {
            return Err(errors::value(format!(
                "scenario {}: expected agent_id to name agents of its present or future, found {id}",
                recorded.id
            )));
        };
        for (step, &[x, y, z, heading, vx, vy]) in states[i * n..][..n].iter().enumerate() {
            if x.is_nan() {
                continue;
            }
            let mut agent = known.with_state(gump_scene::AgentState {
                pose: Pose::new(x, y, heading),
                velocity: dvec2(vx, vy),
            });
            agent.elevation = z;
            agents[step].push(agent);
        }
    }
    let lights = |step: usize| {
        let last = recorded.log.len() - 1;
        recorded.log[(recorded.now + step).min(last)]
            .lights()
            .to_vec()
    };
    let frames = agents.into_iter().enumerate();
    Ok(frames
        .map(|(step, agents)| Frame::new(agents, lights(step)))
        .collect())
}

/// The score and its parts, by nuPlan's names.
fn scores_dict<'py>(py: Python<'py>, metrics: &ClosedLoop) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("score", metrics.score(&Scoring::closed_loop()))?;
    let parts = PyDict::new(py);
    for (name, score) in metrics.scores() {
        parts.set_item(name, score)?;
    }
    dict.set_item("metrics", parts)?;
    Ok(dict)
}

/// Adds the states of the ego and of the other agents to `dict`.
fn add_drive(
    py: Python<'_>,
    scored: &Scored,
    recorded: &Recorded,
    dict: &Bound<'_, PyDict>,
) -> PyResult<()> {
    let ego = &scored.driven.ego;
    let times: Vec<i64> = ego.iter().map(|state| state.time_us).collect();
    let rows: Vec<f64> = ego.iter().flat_map(ego_row).collect();
    dict.set_item("time_us", array(py, ego.len(), times)?)?;
    dict.set_item("ego", array(py, [ego.len(), EGO], rows)?)?;
    let present = recorded.present();
    let ids: Vec<_> = present
        .now()
        .agents()
        .iter()
        .map(|agent| agent.id)
        .collect();
    let rollout = &scored.driven.rollout;
    let steps = rollout.steps() + 1;
    let mut states = Vec::with_capacity(ids.len() * steps * 6);
    for &id in &ids {
        for step in 0..steps {
            let agent = rollout.at(step).now().agent(id);
            states.extend(agent.map_or([f64::NAN; 4], state));
            states.extend(agent.map_or([f64::NAN; 2], |a| a.state.velocity.to_array()));
        }
    }
    let numbers: Vec<i64> = ids.iter().map(|id| id.0).collect();
    dict.set_item("agent_id", array(py, ids.len(), numbers)?)?;
    dict.set_item("others", array(py, [ids.len(), steps, 6], states)?)?;
    Ok(())
}

/// The plan of one of our planners for the present; float64 `[N, 12]`: seconds from now and the
/// ego's state.
#[pyfunction]
pub(crate) fn nuplan_plan<'py>(
    py: Python<'py>,
    scenario: &Scenario,
    planner: &str,
    imagination: Option<&World>,
    seed: u64,
) -> PyResult<Bound<'py, PyAny>> {
    let case = case(&scenario.scene)?;
    let recording = &case.recording;
    let thinks_in = imagination.and_then(|world| world.kind.model());
    let thinks_in = thinks_in.unwrap_or_else(|| Arc::new(Idm::default()));
    let ego = *recording.ego_at(0);
    let plan = py.detach(|| {
        let mut driver = named(planner, &case, &*thinks_in, Seed(seed))?;
        let started = driver.start(&recording.initialization());
        started.map_err(errors::value)?;
        let input = PlannerInput {
            iteration: 0,
            scene: recording.scenario().present(),
            ego: &ego,
            past: recording.past(),
        };
        driver.drive(&input).map_err(errors::value)
    })?;
    let rows = plan.states().iter().flat_map(|state| {
        let seconds = (state.time_us - ego.time_us) as f64 * 1e-6;
        std::iter::once(seconds).chain(ego_row(state))
    });
    let n = plan.states().len();
    Ok(array(py, [n, 1 + EGO], rows.collect())?.into_any())
}
