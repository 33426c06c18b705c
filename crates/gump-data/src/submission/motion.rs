//! Predictions in the messages of the Waymo motion prediction challenge.
//!
//! Start with [`read_predictions`] and [`predictions_from_proto`]; `gump_wosac::motion` scores
//! them.

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::path::Path;

use gump_geometry::{DVec2, dvec2};
use gump_scene::{AgentId, PredictedMode, Prediction, Scenario};
use prost::Message;

use crate::io::stream::{self, io_error};
use crate::{DataError, Problem, RecordLocation, write_atomically};
use gump_proto::motion::{
    ChallengeScenarioPredictions, JointPrediction, MotionChallengeSubmission, ObjectTrajectory,
    PredictionKind, PredictionSet, ScoredJointTrajectory, ScoredTrajectory, SingleObjectPrediction,
    Trajectory,
};

/// Number of positions that the challenge requires, per path: 8 s at 2 Hz.
pub const N_POSITIONS: usize = 16;
/// Agents of an interaction prediction.
const N_INTERACTING: usize = 2;

/// Reads a `MotionChallengeSubmission` message, plain or gzip.
///
/// # Errors
/// [`DataError::Missing`], [`DataError::Empty`], [`DataError::Io`], [`DataError::Proto`].
pub fn read_predictions(path: &Path) -> Result<MotionChallengeSubmission, DataError> {
    let mut bytes = Vec::new();
    stream::open(path)?
        .read_to_end(&mut bytes)
        .map_err(|e| io_error("read", e, path))?;
    MotionChallengeSubmission::decode(bytes.as_slice()).map_err(|source| DataError::Proto {
        message: "waymo.open_dataset.MotionChallengeSubmission",
        source,
        place: RecordLocation {
            record: 0,
            offset: 0,
            path: path.into(),
        },
    })
}

/// Writes a `MotionChallengeSubmission` message.
///
/// # Errors
/// [`DataError::Io`].
pub fn write_predictions(
    path: &Path,
    submission: &MotionChallengeSubmission,
) -> Result<(), DataError> {
    write_atomically(path, |file| {
        file.write_all(&submission.encode_to_vec())
            .map_err(|e| io_error("write", e, path))
    })
}

/// Converts the message of one scenario to predictions: one per object, or a single joint one.
///
/// The paths of a joint prediction are put into the order of its first mode. Consistency with a
/// scenario is not checked here, see [`prediction_problems`].
///
/// # Errors
/// [`Problem::NoPredictions`], [`Problem::MixedAgents`], [`Problem::NoTrajectory`],
/// [`Problem::UnequalPositions`].
pub fn predictions_from_proto(
    message: &ChallengeScenarioPredictions,
) -> Result<Vec<Prediction>, Problem> {
    match &message.prediction_set {
        Some(PredictionKind::SinglePredictions(set)) => {
            set.predictions.iter().map(single_prediction).collect()
        }
        Some(PredictionKind::JointPrediction(joint)) => Ok(vec![joint_prediction(joint)?]),
        None => Err(Problem::NoPredictions),
    }
}

fn single_prediction(message: &SingleObjectPrediction) -> Result<Prediction, Problem> {
    let id = AgentId(message.object_id().into());
    let mode = |(m, scored): (usize, &ScoredTrajectory)| -> Result<PredictedMode, Problem> {
        Ok(PredictedMode {
            confidence: scored.confidence().into(),
            paths: vec![path(scored.trajectory.as_ref(), id, m)?],
        })
    };
    let modes = message.trajectories.iter().enumerate().map(mode);
    Ok(Prediction {
        agents: vec![id],
        modes: modes.collect::<Result<_, _>>()?,
    })
}

fn joint_prediction(message: &JointPrediction) -> Result<Prediction, Problem> {
    let id = |t: &ObjectTrajectory| AgentId(t.object_id().into());
    let first = message.joint_trajectories.first();
    let agents: Vec<AgentId> = first.map_or(Vec::new(), |mode| {
        mode.trajectories.iter().map(id).collect()
    });
    let mode = |(m, joint): (usize, &ScoredJointTrajectory)| {
        let own: BTreeSet<AgentId> = joint.trajectories.iter().map(id).collect();
        let same = own.len() == joint.trajectories.len()
            && own.len() == agents.len()
            && agents.iter().all(|agent| own.contains(agent));
        if !same {
            return Err(Problem::MixedAgents { mode: m });
        }
        let of_agent = |agent: &AgentId| {
            let found = joint.trajectories.iter().find(|t| id(t) == *agent);
            path(found.and_then(|t| t.trajectory.as_ref()), *agent, m)
        };
        Ok(PredictedMode {
            confidence: joint.confidence().into(),
            paths: agents.iter().map(of_agent).collect::<Result<_, _>>()?,
        })
    };
    let modes = message.joint_trajectories.iter().enumerate().map(mode);
    let modes = modes.collect::<Result<_, _>>()?;
    Ok(Prediction { agents, modes })
}

fn path(
    trajectory: Option<&Trajectory>,
    agent: AgentId,
    mode: usize,
) -> Result<Vec<DVec2>, Problem> {
    let Some(trajectory) = trajectory else {
        return Err(Problem::NoTrajectory { mode, agent });
    };
    let (x, y) = (&trajectory.center_x, &trajectory.center_y);
    if x.len() != y.len() {
        let (x, y) = (x.len(), y.len());
        return Err(Problem::UnequalPositions { mode, agent, x, y });
    }
    let point = |(&x, &y): (&f32, &f32)| dvec2(x.into(), y.into());
    Ok(x.iter().zip(y).map(point).collect())
}

/// Converts the predictions of one scenario to a message: a joint one if one prediction is of
/// several agents.
///
/// # Errors
/// [`DataError::Unwritable`] if an agent's id exceeds 32 bits, or a joint prediction is not the
/// only one.
pub fn predictions_to_proto(
    scenario_id: &str,
    predictions: &[Prediction],
) -> Result<ChallengeScenarioPredictions, DataError> {
    let unwritable = |problem: String| DataError::Unwritable {
        id: scenario_id.into(),
        problem,
    };
    let object_id = |agent: AgentId| {
        i32::try_from(agent.0).map_err(|_| unwritable(format!("agent id {agent} exceeds 32 bits")))
    };
    let kind = match predictions {
        [joint] if joint.agents.len() > 1 => {
            let ids: Vec<i32> = joint
                .agents
                .iter()
                .copied()
                .map(object_id)
                .collect::<Result<_, _>>()?;
            PredictionKind::JointPrediction(joint_to_proto(joint, &ids))
        }
        single if single.iter().all(|prediction| prediction.agents.len() == 1) => {
            let one = |prediction: &Prediction| {
                let id = object_id(prediction.agents[0])?;
                Ok(single_to_proto(prediction, id))
            };
            let predictions = single.iter().map(one).collect::<Result<_, DataError>>()?;
            PredictionKind::SinglePredictions(PredictionSet { predictions })
        }
        several => {
            let n = several.len();
            let problem = format!("expected one joint prediction or single ones, found {n} mixed");
            return Err(unwritable(problem));
        }
    };
    Ok(ChallengeScenarioPredictions {
        scenario_id: Some(scenario_id.into()),
        prediction_set: Some(kind),
    })
}

fn single_to_proto(prediction: &Prediction, id: i32) -> SingleObjectPrediction {
    let scored = |mode: &PredictedMode| ScoredTrajectory {
        trajectory: mode.paths.first().map(|path| trajectory(path)),
        confidence: Some(mode.confidence as f32),
    };
    SingleObjectPrediction {
        object_id: Some(id),
        trajectories: prediction.modes.iter().map(scored).collect(),
    }
}

fn joint_to_proto(prediction: &Prediction, ids: &[i32]) -> JointPrediction {
    let scored = |mode: &PredictedMode| {
        let of_object = |(&id, path): (&i32, &Vec<DVec2>)| ObjectTrajectory {
            object_id: Some(id),
            trajectory: Some(trajectory(path)),
        };
        ScoredJointTrajectory {
            trajectories: ids.iter().zip(&mode.paths).map(of_object).collect(),
            confidence: Some(mode.confidence as f32),
        }
    };
    JointPrediction {
        joint_trajectories: prediction.modes.iter().map(scored).collect(),
    }
}

fn trajectory(path: &[DVec2]) -> Trajectory {
    Trajectory {
        center_x: path.iter().map(|p| p.x as f32).collect(),
        center_y: path.iter().map(|p| p.y as f32).collect(),
    }
}

/// All violations of the challenge's rules in a message; empty if it may be submitted.
///
/// Source: the published validation of the Waymo motion prediction challenge.
pub fn prediction_problems(
    message: &ChallengeScenarioPredictions,
    scenario: &Scenario,
) -> Vec<String> {
    let mut problems = Vec::new();
    if message.scenario_id() != scenario.id {
        let (expected, found) = (&scenario.id, message.scenario_id());
        problems.push(format!(
            "expected scenario id {expected}, found \"{found}\""
        ));
    }
    let predictions = match predictions_from_proto(message) {
        Ok(predictions) => predictions,
        Err(problem) => {
            problems.push(problem.to_string());
            return problems;
        }
    };
    let mut seen = BTreeSet::new();
    for prediction in &predictions {
        for agent in &prediction.agents {
            if !scenario.targets.contains(agent) {
                problems.push(format!("agent {agent} is not to be predicted"));
            }
            if !seen.insert(*agent) {
                problems.push(format!("agent {agent} occurs twice"));
            }
        }
        mode_problems(prediction, &mut problems);
    }
    if let Some(PredictionKind::JointPrediction(_)) = message.prediction_set
        && seen.len() != N_INTERACTING
    {
        let n = seen.len();
        problems.push(format!(
            "expected {N_INTERACTING} agents in a joint prediction, found {n}"
        ));
    }
    let missing = scenario.targets.iter().filter(|id| !seen.contains(id));
    problems.extend(missing.map(|id| format!("agent {id} is missing")));
    problems
}

fn mode_problems(prediction: &Prediction, problems: &mut Vec<String>) {
    let named = |agent: Option<&AgentId>| agent.map_or("nobody".into(), ToString::to_string);
    if prediction.modes.is_empty() {
        let agent = named(prediction.agents.first());
        problems.push(format!("agent {agent} has no mode"));
    }
    for (m, mode) in prediction.modes.iter().enumerate() {
        if !mode.confidence.is_finite() {
            let agent = named(prediction.agents.first());
            problems.push(format!(
                "mode {m} of agent {agent} has a confidence that is not a number"
            ));
        }
        for (agent, path) in prediction.agents.iter().zip(&mode.paths) {
            if path.len() != N_POSITIONS {
                let n = path.len();
                problems.push(format!(
                    "expected {N_POSITIONS} positions in mode {m} of agent {agent}, found {n}"
                ));
            }
            if !path.iter().all(|position| position.is_finite()) {
                problems.push(format!(
                    "mode {m} of agent {agent} has a position that is not a number"
                ));
            }
        }
    }
}
