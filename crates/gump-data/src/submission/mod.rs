//! Files of the Waymo challenges: rollouts of the sim agents challenge (here), the archive of a
//! submission ([`ArchiveWriter`]), predictions of the motion challenge ([`read_predictions`]).
//!
//! Start with [`write_rollouts`] and [`read_rollouts`]; [`submission_problems`] checks the rules.

mod archive;
mod arrays;
mod motion;
mod shard;

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::path::Path;

use gump_geometry::{Pose, dvec2, wrap_angle};
use gump_scene::{AgentId, AgentState, Frame, Rollout, Scenario};
use prost::Message;

use crate::io::stream::{self, io_error};
use crate::{DataError, Problem, RecordLocation, write_atomically};
use gump_proto::{JointScene, ScenarioRollouts, SimAgentsChallengeSubmission, SimulatedTrajectory};

pub use archive::{
    ArchiveWriter, ExpectedScenarios, SubmissionCheck, check_archive, metadata_problems,
};
pub use motion::{
    N_POSITIONS, prediction_problems, predictions_from_proto, predictions_to_proto,
    read_predictions, write_predictions,
};

/// Number of futures that the challenge requires, per scenario.
pub const N_FUTURES: usize = 32;
/// Number of steps that the challenge requires, per future: 8 s at 10 Hz.
pub const N_STEPS: usize = 80;

/// Writes one scenario's futures as a binary `ScenarioRollouts` message and returns the number of
/// missing states that were filled in, see [`rollouts_to_proto`].
///
/// # Errors
/// Those of [`rollouts_to_proto`], and [`DataError::Io`].
pub fn write_rollouts(
    path: &Path,
    scenario_id: &str,
    rollouts: &[Rollout],
) -> Result<usize, DataError> {
    let (message, n_held) = rollouts_to_proto(scenario_id, rollouts)?;
    write_atomically(path, |file| {
        let bytes = message.encode_to_vec();
        file.write_all(&bytes)
            .map_err(|e| io_error("write", e, path))
    })?;
    Ok(n_held)
}

/// Converts futures to a message: every agent present at the start, every simulated step.
///
/// z is the agent's elevation. The challenge has no absent agents, so an agent that a world has
/// removed stays at its last position; the number of such states is returned with the message.
/// Agents that appear later are left out, as in the challenge.
///
/// # Errors
/// [`DataError::Unwritable`] if an agent's id exceeds 32 bits.
pub fn rollouts_to_proto(
    scenario_id: &str,
    rollouts: &[Rollout],
) -> Result<(ScenarioRollouts, usize), DataError> {
    let mut n_held = 0;
    let mut joint_scenes = Vec::with_capacity(rollouts.len());
    for rollout in rollouts {
        let agents = rollout.start().agents().iter();
        let trajectories = agents.map(|agent| {
            let object_id = i32::try_from(agent.id.0).map_err(|_| DataError::Unwritable {
                id: scenario_id.into(),
                problem: format!("agent id {} exceeds 32 bits", agent.id),
            })?;
            let (trajectory, held) = trajectory(rollout, agent.id, object_id);
            n_held += held;
            Ok(trajectory)
        });
        joint_scenes.push(JointScene {
            simulated_trajectories: trajectories.collect::<Result<_, DataError>>()?,
        });
    }
    let message = ScenarioRollouts {
        scenario_id: Some(scenario_id.into()),
        joint_scenes,
    };
    Ok((message, n_held))
}

fn trajectory(rollout: &Rollout, id: AgentId, object_id: i32) -> (SimulatedTrajectory, usize) {
    let mut trajectory = SimulatedTrajectory {
        object_id: Some(object_id),
        ..SimulatedTrajectory::default()
    };
    let (mut last, mut n_held) = (rollout.start().agent(id), 0);
    for frame in rollout.imagined() {
        let now = frame.agent(id);
        n_held += usize::from(now.is_none());
        last = now.or(last);
        if let Some(agent) = last {
            let pose = agent.state.pose;
            trajectory.center_x.push(pose.position.x as f32);
            trajectory.center_y.push(pose.position.y as f32);
            trajectory.center_z.push(agent.elevation as f32);
            trajectory.heading.push(pose.heading as f32);
        }
    }
    (trajectory, n_held)
}

/// Reads a file of rollouts, plain or gzip: one `ScenarioRollouts` message, one shard of a
/// submission, or arrays (`.npz`, `.npy` with the JSON beside it that describes its axes,
/// `.parquet` as [`crate::write_rollouts`] writes it). The kind is detected from the content.
///
/// In arrays an agent that is missing from some step on stays at its last position. Where they have
/// no heights, the columns of heights are empty.
///
/// # Errors
/// [`DataError::Missing`], [`DataError::Empty`], [`DataError::Io`], [`DataError::Proto`], and
/// [`DataError::Table`] for other arrays.
pub fn read_rollouts(path: &Path) -> Result<Vec<ScenarioRollouts>, DataError> {
    if let Some(rollouts) = arrays::read(path)? {
        return Ok(rollouts);
    }
    let mut bytes = Vec::new();
    let mut content = stream::open(path)?;
    content
        .read_to_end(&mut bytes)
        .map_err(|e| io_error("read", e, path))?;
    // The two messages disagree on the type of field 2, so one never decodes as the other
    // unless it is as good as empty.
    if let Ok(shard) = SimAgentsChallengeSubmission::decode(bytes.as_slice()) {
        return Ok(shard.scenario_rollouts);
    }
    let one = ScenarioRollouts::decode(bytes.as_slice()).map_err(|source| DataError::Proto {
        message: "waymo.open_dataset.ScenarioRollouts",
        source,
        place: RecordLocation {
            record: 0,
            offset: 0,
            path: path.into(),
        },
    })?;
    Ok(vec![one])
}

/// Decodes the bytes of a `ScenarioRollouts` message.
///
/// # Errors
/// [`Problem::Message`].
pub fn decode_rollouts(bytes: &[u8]) -> Result<ScenarioRollouts, Problem> {
    ScenarioRollouts::decode(bytes).map_err(|source| Problem::Message {
        message: "waymo.open_dataset.ScenarioRollouts",
        source,
    })
}

/// Encodes a `ScenarioRollouts` message; the inverse of [`decode_rollouts`].
pub fn encode_rollouts(message: &ScenarioRollouts) -> Vec<u8> {
    message.encode_to_vec()
}

/// A message in which agents without heights, as of [`read_rollouts`] from arrays, keep those that
/// they have at the present of `scenario`, as every world here simulates them.
pub fn with_heights<'a>(
    message: &'a ScenarioRollouts,
    scenario: &Scenario,
) -> Cow<'a, ScenarioRollouts> {
    let has_none = |t: &SimulatedTrajectory| t.center_z.is_empty() && !t.center_x.is_empty();
    let mut scenes = message.joint_scenes.iter();
    if !scenes.any(|scene| scene.simulated_trajectories.iter().any(has_none)) {
        return Cow::Borrowed(message);
    }
    let present = scenario.present();
    let mut filled = message.clone();
    for scene in &mut filled.joint_scenes {
        let bare = scene.simulated_trajectories.iter_mut();
        for trajectory in bare.filter(|trajectory| has_none(trajectory)) {
            let id = AgentId(trajectory.object_id().into());
            let height = present.now().agent(id).map_or(0.0, |agent| agent.elevation);
            trajectory.center_z = vec![height as f32; trajectory.center_x.len()];
        }
    }
    Cow::Owned(filled)
}

/// Converts a message to rollouts of `scenario`: its history, then one frame per step. Heights that
/// are missing are those of [`with_heights`].
///
/// Sizes and kinds are those at the present, velocities are differences of positions, headings
/// are wrapped to [-π, π), lights stay as they are at the present.
///
/// # Errors
/// [`Problem::OtherScenario`], or [`Problem::Future`] if one does not fit the scenario: agents that
/// are missing, unknown or duplicated, columns of different lengths, numbers that are not finite.
pub fn rollouts_from_proto(
    message: &ScenarioRollouts,
    scenario: &Scenario,
) -> Result<Vec<Rollout>, Problem> {
    if message.scenario_id() != scenario.id {
        return Err(Problem::OtherScenario {
            expected: scenario.id.as_str().into(),
            found: message.scenario_id().into(),
        });
    }
    let present = present_agents(scenario);
    let message = with_heights(message, scenario);
    let futures = message.joint_scenes.iter().enumerate();
    futures
        .map(|(k, scene)| {
            let problems = scene_problems(scene, &present);
            if let Some(problem) = problems.into_iter().next() {
                return Err(Problem::Future {
                    future: k,
                    problem: problem.into(),
                });
            }
            Ok(rollout(scene, scenario))
        })
        .collect()
}

/// A rollout of a scene without problems.
fn rollout(scene: &JointScene, scenario: &Scenario) -> Rollout {
    let present = scenario.present();
    let mut rollout = Rollout::begin(present);
    let columns = scene.simulated_trajectories.iter();
    let n_steps = columns.map(|t| t.center_x.len()).min().unwrap_or(0);
    for step in 0..n_steps {
        let last = rollout.last().now().clone();
        let agents = scene.simulated_trajectories.iter().filter_map(|t| {
            let before = last.agent(AgentId(t.object_id().into()))?;
            let position = dvec2(t.center_x[step].into(), t.center_y[step].into());
            let mut agent = before.with_state(AgentState {
                pose: Pose {
                    position,
                    heading: wrap_angle(t.heading[step].into()),
                },
                velocity: (position - before.state.pose.position) / scenario.dt,
            });
            agent.elevation = t.center_z[step].into();
            Some(agent)
        });
        rollout.push(Frame::new(agents.collect(), last.lights().to_vec()));
    }
    rollout
}

/// All violations of the challenge's rules in a message; empty if it may be submitted.
///
/// Source: the published submission checks of the Waymo sim agents challenge.
pub fn submission_problems(message: &ScenarioRollouts, scenario: &Scenario) -> Vec<String> {
    let mut problems = Vec::new();
    if message.scenario_id() != scenario.id {
        let found = message.scenario_id();
        problems.push(format!(
            "expected scenario id {}, found \"{found}\"",
            scenario.id
        ));
    }
    problems.extend(rollouts_problems(message, &present_agents(scenario)));
    problems
}

/// The agents that must be simulated: all that are present now.
fn present_agents(scenario: &Scenario) -> BTreeSet<AgentId> {
    let present = scenario.present().now().agents();
    present.iter().map(|agent| agent.id).collect()
}

/// Problems in the futures of a scenario with these agents in the present.
fn rollouts_problems(message: &ScenarioRollouts, present: &BTreeSet<AgentId>) -> Vec<String> {
    let mut problems = Vec::new();
    let n_futures = message.joint_scenes.len();
    if n_futures != N_FUTURES {
        problems.push(format!("expected {N_FUTURES} futures, found {n_futures}"));
    }
    for (k, scene) in message.joint_scenes.iter().enumerate() {
        let mut found = scene_problems(scene, present);
        for t in &scene.simulated_trajectories {
            let (id, n) = (t.object_id(), t.center_x.len());
            if n != N_STEPS {
                found.push(format!("expected {N_STEPS} steps of agent {id}, found {n}"));
            }
        }
        problems.extend(found.into_iter().map(|p| format!("future {k}: {p}")));
    }
    problems
}

fn scene_problems(scene: &JointScene, present: &BTreeSet<AgentId>) -> Vec<String> {
    let mut problems = Vec::new();
    let n_steps = scene
        .simulated_trajectories
        .first()
        .map_or(0, |t| t.center_x.len());
    let mut seen = BTreeSet::new();
    for t in &scene.simulated_trajectories {
        let id = AgentId(t.object_id().into());
        if !present.contains(&id) {
            problems.push(format!("agent {id} is not present in the scenario"));
        }
        if !seen.insert(id) {
            problems.push(format!("agent {id} occurs twice"));
        }
        let columns = [&t.center_x, &t.center_y, &t.center_z, &t.heading];
        if columns.iter().any(|column| column.len() != n_steps) {
            let n = columns.map(Vec::len);
            problems.push(format!(
                "agent {id} has columns of {n:?} steps, expected {n_steps}"
            ));
        }
        if columns
            .iter()
            .any(|column| !column.iter().all(|v| v.is_finite()))
        {
            problems.push(format!("agent {id} has a state that is not a number"));
        }
    }
    let missing = present.difference(&seen);
    problems.extend(missing.map(|id| format!("agent {id} is missing")));
    problems
}
