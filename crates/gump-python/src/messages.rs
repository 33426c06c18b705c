//! Waymo's `ScenarioRollouts` as arrays and back.

use std::path::PathBuf;

use gump_data::submission::{decode_rollouts, encode_rollouts, read_rollouts};
use gump_proto::{JointScene, ScenarioRollouts, SimulatedTrajectory};
use numpy::PyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::arrays::{Numbers, array};
use crate::errors;

/// A scenario's id, int64 `[A]` and float32 `[R, A, T, 4]`.
type RolloutArrays<'py> = (String, Bound<'py, PyAny>, Bound<'py, PyAny>);

/// The arrays of a serialized message; agents in the order of the first rollout.
#[pyfunction]
pub(crate) fn rollouts_from_message<'py>(
    py: Python<'py>,
    message: &[u8],
) -> PyResult<RolloutArrays<'py>> {
    let message = decode_rollouts(message).map_err(errors::data_problem)?;
    arrays_of(py, &message)
}

/// The arrays of every scenario in a file of messages, of a submission or of arrays.
#[pyfunction]
pub(crate) fn rollouts_from_file<'py>(
    py: Python<'py>,
    path: PathBuf,
) -> PyResult<Vec<RolloutArrays<'py>>> {
    let messages = py.detach(|| read_rollouts(&path));
    let messages = messages.map_err(|error| errors::data(&error))?;
    messages
        .iter()
        .map(|message| arrays_of(py, message))
        .collect()
}

/// Heights that are not stated are NaN.
fn arrays_of<'py>(py: Python<'py>, message: &ScenarioRollouts) -> PyResult<RolloutArrays<'py>> {
    let first = message.joint_scenes.first();
    let first = first.map_or(&[][..], |scene| &scene.simulated_trajectories);
    let ids: Vec<i32> = first.iter().map(SimulatedTrajectory::object_id).collect();
    let steps = first.first().map_or(0, |agent| agent.center_x.len());
    let mut states = Vec::with_capacity(message.joint_scenes.len() * ids.len() * steps * 4);
    for (r, scene) in message.joint_scenes.iter().enumerate() {
        let agents = &scene.simulated_trajectories;
        if agents.len() != ids.len() {
            let (expected, found) = (ids.len(), agents.len());
            return Err(errors::DataError::new_err(format!(
                "rollout {r}: expected the {expected} agents of the first rollout, found {found}"
            )));
        }
        for id in &ids {
            let Some(agent) = agents.iter().find(|agent| agent.object_id() == *id) else {
                return Err(errors::DataError::new_err(format!(
                    "rollout {r}: expected agent {id}, which the first rollout has, found none"
                )));
            };
            let columns = [
                &agent.center_x,
                &agent.center_y,
                &agent.center_z,
                &agent.heading,
            ];
            let is_short = |column: &&&Vec<f32>| {
                let is_open = std::ptr::eq(**column, &agent.center_z) && column.is_empty();
                column.len() != steps && !is_open
            };
            if let Some(column) = columns.iter().find(is_short) {
                let found = column.len();
                return Err(errors::DataError::new_err(format!(
                    "rollout {r}: expected {steps} steps of agent {id}, found {found}"
                )));
            }
            let at = |column: &Vec<f32>, step: usize| column.get(step).copied();
            states.extend(
                (0..steps)
                    .flat_map(|step| columns.map(|column| at(column, step).unwrap_or(f32::NAN))),
            );
        }
    }
    let shape = [message.joint_scenes.len(), ids.len(), steps, 4];
    let numbers: Vec<i64> = ids.iter().map(|id| i64::from(*id)).collect();
    Ok((
        message.scenario_id().to_owned(),
        array(py, ids.len(), numbers)?.into_any(),
        array(py, shape, states)?.into_any(),
    ))
}

/// A serialized message of ids `[A]` and states `[R, A, T, 4]`.
#[pyfunction]
pub(crate) fn rollouts_to_message<'py>(
    py: Python<'py>,
    scenario_id: String,
    agent_id: &Bound<'py, PyArrayDyn<i64>>,
    states: &Bound<'py, PyArrayDyn<f32>>,
) -> PyResult<Bound<'py, PyBytes>> {
    let ids = Numbers::new("agent_id", agent_id, &["A"])?;
    let states = Numbers::new("states", states, &["R", "A", "T", "4"])?;
    let n = ids.shape()[0];
    states.expect(1, n, "one per agent_id")?;
    states.expect(3, 4, "x, y, z, heading")?;
    let (n_rollouts, steps) = (states.shape()[0], states.shape()[2]);
    let numbers = states.slice()?.as_chunks::<4>().0;
    let mut joint_scenes = Vec::with_capacity(n_rollouts);
    for r in 0..n_rollouts {
        let mut simulated_trajectories = Vec::with_capacity(n);
        for (a, &id) in ids.slice()?.iter().enumerate() {
            let id = i32::try_from(id).map_err(|_| {
                errors::value(format!("agent_id: expected ids of 32 bits, found {id}"))
            })?;
            let rows = &numbers[(r * n + a) * steps..][..steps];
            let column = |i: usize| rows.iter().map(|row| row[i]).collect();
            simulated_trajectories.push(SimulatedTrajectory {
                object_id: Some(id),
                center_x: column(0),
                center_y: column(1),
                center_z: column(2),
                heading: column(3),
                ..SimulatedTrajectory::default()
            });
        }
        joint_scenes.push(JointScene {
            simulated_trajectories,
        });
    }
    let message = ScenarioRollouts {
        scenario_id: Some(scenario_id),
        joint_scenes,
    };
    Ok(PyBytes::new(py, &encode_rollouts(&message)))
}
