//! A recorded scenario as Python sees it.

use std::collections::BTreeSet;
use std::sync::{Arc, OnceLock};

use gump_scene::{AgentId, Frame};
use gump_wosac::realism::{Log, WosacError};
use numpy::{PyArray1, PyArrayDyn};
use pyo3::prelude::*;

use crate::arrays::{Numbers, array};
use crate::errors;
use crate::scenario_arrays as convert;

/// A scenario and its log as the realism metric reads it.
pub(crate) struct Scene {
    pub(crate) scenario: gump_scene::Scenario,
    /// For Waymo's messages, taken from the message; for other formats, computed from the scenario
    /// on first use.
    log: OnceLock<Result<Log, WosacError>>,
}

impl Scene {
    /// A scenario whose log is computed from it.
    pub(crate) fn of(scenario: gump_scene::Scenario) -> Self {
        Self::with_log(scenario, None)
    }

    /// A scenario with a separate log, if there is one.
    pub(crate) fn with_log(scenario: gump_scene::Scenario, log: Option<Log>) -> Self {
        let log = log.map_or_else(OnceLock::new, |log| OnceLock::from(Ok(log)));
        Self { scenario, log }
    }

    /// The log that the realism metric reads.
    ///
    /// Error: a scenario with another frame rate or length than the challenge's.
    pub(crate) fn log(&self) -> Result<&Log, WosacError> {
        let log = self.log.get_or_init(|| Log::of(&self.scenario));
        log.as_ref().map_err(Clone::clone)
    }

    /// Agents that are there now, ascending.
    pub(crate) fn present(&self) -> impl Iterator<Item = AgentId> {
        let agents = self.scenario.present().now().agents().iter();
        agents.map(|agent| agent.id)
    }
}

/// Recorded traffic: past, present and future, on its map.
///
/// Positions are box centres in the scenario's world frame, metres; headings radians
/// counter-clockwise from +x. Made by `gump.open`, `gump.find`, `gump.read`, `gump.generate`.
#[pyclass(frozen, module = "gump")]
pub(crate) struct Scenario {
    pub(crate) scene: Arc<Scene>,
}

impl Scenario {
    pub(crate) fn new(scene: Scene) -> Self {
        let scene = Arc::new(scene);
        Self { scene }
    }

    fn inner(&self) -> &gump_scene::Scenario {
        &self.scene.scenario
    }
}

#[pymethods]
impl Scenario {
    /// Name, unique within its dataset.
    #[getter]
    fn id(&self) -> &str {
        &self.inner().id
    }

    /// Seconds between frames.
    #[getter]
    fn dt(&self) -> f64 {
        self.inner().dt
    }

    /// Index of the present among the frames.
    #[getter]
    fn now(&self) -> usize {
        self.inner().now
    }

    /// Frames, past and future.
    fn __len__(&self) -> usize {
        self.inner().log.len()
    }

    /// The ego's id.
    #[getter]
    fn ego(&self) -> i64 {
        self.inner().ego.0
    }

    /// Ids of agents that a benchmark asks to predict, int64 `[N]`, ascending.
    #[getter]
    fn targets<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<i64>>> {
        ids(py, self.inner().targets.iter().copied())
    }

    /// Ids of agents marked as interacting, int64 `[N]`.
    #[getter]
    fn objects_of_interest<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<i64>>> {
        ids(py, self.inner().objects_of_interest.iter().copied())
    }

    /// Ids of the agents that are there now, int64 `[A]`, ascending: those that a world simulates
    /// and that rollouts must have, in the order of `World.simulate`.
    #[getter]
    fn simulated<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<i64>>> {
        ids(py, self.scene.present())
    }

    /// Kinds of situation, by nuPlan's names; empty if not known.
    #[getter]
    fn tags(&self) -> Vec<&'static str> {
        self.inner().tags.iter().map(|tag| tag.name()).collect()
    }

    /// Ids of the lanes that the ego's route leads along; empty if none is known.
    #[getter]
    fn route<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<i64>>> {
        let lanes = self.inner().route.iter().flat_map(|route| &route.lanes);
        let lanes: Vec<i64> = lanes.map(|lane| lane.0).collect();
        array(py, lanes.len(), lanes)
    }

    /// All agents over time, a `gump.Tracks`.
    #[getter]
    fn tracks<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        convert::tracks(py, self.inner())
    }

    /// Traffic lights over time, a `gump.Lights`.
    #[getter]
    fn lights<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        convert::lights(py, self.inner())
    }

    /// The road, a `gump.Map`.
    #[getter]
    fn map<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        convert::map(py, &self.inner().map)
    }

    /// The recorded future of the agents of `simulated`, float64 `[A, T, 4]`: x, y, z, heading of
    /// the frames after the present, NaN where an agent is absent.
    #[getter]
    fn future<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let ids: Vec<AgentId> = self.scene.present().collect();
        let frames = self.inner().future();
        let mut numbers = Vec::with_capacity(ids.len() * frames.len() * 4);
        for &id in &ids {
            for frame in frames {
                numbers.extend(frame.agent(id).map_or([f64::NAN; 4], convert::state));
            }
        }
        Ok(array(py, [ids.len(), frames.len(), 4], numbers)?.into_any())
    }

    /// The same scenario with only these agents, int64 `[A]`; other agents are removed from the
    /// targets too.
    fn only(&self, agent_id: &Bound<'_, PyArrayDyn<i64>>) -> PyResult<Self> {
        let ids = Numbers::new("agent_id", agent_id, &["A"])?;
        let kept: BTreeSet<AgentId> = ids.slice()?.iter().map(|&id| AgentId(id)).collect();
        let inner = self.inner();
        if !kept.contains(&inner.ego) {
            let (id, ego) = (&inner.id, inner.ego);
            return Err(errors::value(format!(
                "scenario {id}: expected agent_id to name the ego, {ego}, found it left out"
            )));
        }
        let frame = |frame: &Frame| {
            let agents = frame
                .agents()
                .iter()
                .filter(|agent| kept.contains(&agent.id));
            Frame::new(agents.copied().collect(), frame.lights().to_vec())
        };
        let is_kept = |id: &AgentId| kept.contains(id);
        let scenario = gump_scene::Scenario {
            log: inner.log.iter().map(frame).collect(),
            targets: inner.targets.iter().copied().filter(is_kept).collect(),
            ..inner.clone()
        };
        let log = self.scene.log().ok().map(|log| Log {
            tracks: log
                .tracks
                .iter()
                .filter(|t| is_kept(&t.id))
                .cloned()
                .collect(),
            targets: log.targets.iter().copied().filter(is_kept).collect(),
            ..log.clone()
        });
        Ok(Self::new(Scene::with_log(scenario, log)))
    }

    /// Writes it as a Waymo record (`.tfrecord`), which every reader of that format reads.
    fn save(&self, py: Python<'_>, path: std::path::PathBuf) -> PyResult<()> {
        py.detach(|| gump_data::womd::write_scenarios(&path, [self.inner()]))
            .map(drop)
            .map_err(|error| errors::data(&error))
    }

    fn __repr__(&self) -> String {
        let scenario = self.inner();
        format!(
            "<gump.Scenario {}: {} agents now, {} frames of {} s, the present is frame {}>",
            scenario.id,
            scenario.present().now().agents().len(),
            scenario.log.len(),
            scenario.dt,
            scenario.now
        )
    }
}

fn ids(py: Python<'_>, ids: impl Iterator<Item = AgentId>) -> PyResult<Bound<'_, PyArray1<i64>>> {
    let ids: Vec<i64> = ids.map(|id| id.0).collect();
    let ids = array(py, ids.len(), ids)?;
    Ok(ids.cast_into::<PyArray1<i64>>()?)
}
