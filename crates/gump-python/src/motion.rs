//! Motion prediction, measured as the Waymo challenge does.

use std::sync::{Mutex, PoisonError};

use gump_geometry::dvec2;
use gump_scene::{AgentId, PredictedMode, Prediction};
use gump_wosac::motion::{MotionConfig, MotionTally, PredictionScore, evaluate_predictions};
use numpy::PyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::arrays::Numbers;
use crate::errors;
use crate::scenario::Scenario;

/// Measurements of the predictions of many scenarios.
#[pyclass(frozen, module = "gump.motion")]
pub(crate) struct Tally {
    config: MotionConfig,
    tally: Mutex<MotionTally>,
}

#[pymethods]
impl Tally {
    #[new]
    fn new() -> Self {
        Self {
            config: MotionConfig::challenge(),
            tally: Mutex::default(),
        }
    }

    /// Measures the predictions of one scenario, keeps what was measured and returns it.
    ///
    /// `paths` is float64 `[A, K, 16, 2]`, `confidence` `[A, K]`; of agents predicted together
    /// `confidence` is `[1, K]`.
    fn add<'py>(
        &self,
        py: Python<'py>,
        scenario: &Scenario,
        agent_id: &Bound<'py, PyArrayDyn<i64>>,
        paths: &Bound<'py, PyArrayDyn<f64>>,
        confidence: &Bound<'py, PyArrayDyn<f64>>,
        joint: bool,
    ) -> PyResult<Bound<'py, PyList>> {
        let predictions = predictions(agent_id, paths, confidence, self.config.n_steps, joint)?;
        let scenario = &scenario.scene.scenario;
        let scores = py.detach(|| {
            let scores = evaluate_predictions(scenario, &predictions, &self.config)?;
            let mut tally = self.tally.lock().unwrap_or_else(PoisonError::into_inner);
            scores.iter().for_each(|score| tally.add(score));
            Ok::<_, gump_wosac::motion::MotionError>(scores)
        });
        let list = PyList::empty(py);
        for score in &scores.map_err(errors::value)? {
            list.append(self.score_dict(py, score)?)?;
        }
        Ok(list)
    }

    /// Adds the measurements of another tally; the order of additions changes nothing.
    fn merge(&self, other: &Self) {
        let theirs = {
            let theirs = other.tally.lock().unwrap_or_else(PoisonError::into_inner);
            theirs.clone()
        };
        let mut own = self.tally.lock().unwrap_or_else(PoisonError::into_inner);
        own.merge(&theirs);
    }

    /// The table: a dictionary per kind of agent and horizon, then the means; the last is what a
    /// leaderboard ranks.
    fn rows<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let rows = {
            let tally = self.tally.lock().unwrap_or_else(PoisonError::into_inner);
            tally.rows(&self.config)
        };
        let list = PyList::empty(py);
        for row in rows {
            let line = PyDict::new(py);
            line.set_item("kind", row.kind.map(|kind| kind.name()))?;
            line.set_item("seconds", row.seconds)?;
            line.set_item("predictions", row.predictions)?;
            for (name, number) in row.numbers() {
                line.set_item(name, number)?;
            }
            list.append(line)?;
        }
        Ok(list)
    }
}

impl Tally {
    fn score_dict<'py>(
        &self,
        py: Python<'py>,
        score: &PredictionScore,
    ) -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        let ids: Vec<i64> = score.agents.iter().map(|agent| agent.0).collect();
        dict.set_item("agent_id", ids)?;
        dict.set_item("kind", score.kind.name())?;
        dict.set_item("shape", score.shape.map(|shape| shape.name()))?;
        let horizons = PyList::empty(py);
        for (horizon, found) in self.config.horizons.iter().zip(&score.horizons) {
            let line = PyDict::new(py);
            line.set_item("seconds", self.config.seconds(horizon))?;
            line.set_item("min_ade", found.min_ade)?;
            line.set_item("min_fde", found.min_fde)?;
            line.set_item("missed", found.missed())?;
            line.set_item("overlaps", found.overlaps)?;
            horizons.append(line)?;
        }
        dict.set_item("horizons", horizons)?;
        Ok(dict)
    }
}

fn predictions(
    agent_id: &Bound<'_, PyArrayDyn<i64>>,
    paths: &Bound<'_, PyArrayDyn<f64>>,
    confidence: &Bound<'_, PyArrayDyn<f64>>,
    n_steps: usize,
    joint: bool,
) -> PyResult<Vec<Prediction>> {
    let ids = Numbers::new("agent_id", agent_id, &["A"])?;
    let n = ids.shape()[0];
    let paths = Numbers::new("paths", paths, &["A", "K", "T", "2"])?;
    paths.expect(0, n, "one per agent_id")?;
    paths.expect(2, n_steps, "positions every half second")?;
    paths.expect(3, 2, "x, y")?;
    let n_modes = paths.shape()[1];
    let confidence = Numbers::new("confidence", confidence, &["A", "K"])?;
    let (groups, why) = if joint {
        (1, "one row for agents predicted together")
    } else {
        (n, "one per agent_id")
    };
    confidence.expect(0, groups, why)?;
    confidence.expect(1, n_modes, "one per mode of paths")?;
    let (ids, paths, confidence) = (ids.slice()?, paths.slice()?, confidence.slice()?);
    let path = |agent: usize, mode: usize| {
        let start = (agent * n_modes + mode) * n_steps * 2;
        let points = paths[start..][..n_steps * 2].as_chunks::<2>().0.iter();
        points.map(|&[x, y]| dvec2(x, y)).collect()
    };
    let group = |row: usize| {
        let members = if joint { 0..n } else { row..row + 1 };
        let mode = |mode: usize| PredictedMode {
            confidence: confidence[row * n_modes + mode],
            paths: members.clone().map(|agent| path(agent, mode)).collect(),
        };
        Prediction {
            agents: members.clone().map(|agent| AgentId(ids[agent])).collect(),
            modes: (0..n_modes).map(mode).collect(),
        }
    };
    Ok((0..groups).map(group).collect())
}
