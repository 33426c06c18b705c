//! Predictions from files: as such, or as futures that are condensed to modes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use gump_data::submission::{
    predictions_from_proto, read_predictions, read_rollouts, rollouts_from_proto,
};
use gump_data::{DataError, Problem};
use gump_proto::ScenarioRollouts;
use gump_proto::motion::{ChallengeScenarioPredictions, MotionChallengeSubmission, PredictionKind};
use gump_scene::{Prediction, Scenario};
use gump_wosac::motion::{MotionConfig, forecast};

use crate::{ErrorContext, EvalError, RolloutFileError, rollout_files};

/// Predictions in files, by scenario.
pub(super) struct Predictions {
    path: PathBuf,
    by_scenario: BTreeMap<String, Message>,
}

enum Message {
    Predictions(ChallengeScenarioPredictions),
    Rollouts(ScenarioRollouts),
}

impl Predictions {
    /// Reads a file or all files of a folder.
    ///
    /// Error: a file of another kind, or a scenario that occurs twice.
    pub(super) fn read(path: &Path) -> Result<Self, EvalError> {
        let mut by_scenario = BTreeMap::new();
        for file in rollout_files::files(path)? {
            for (id, message) in messages(&file)? {
                if by_scenario.insert(id.clone(), message).is_some() {
                    return Err(RolloutFileError::RepeatedPredictions {
                        scenario: id,
                        path: file,
                    }
                    .into());
                }
            }
        }
        Ok(Self {
            path: path.to_owned(),
            by_scenario,
        })
    }

    /// The predictions of a scenario.
    pub(super) fn of(
        &self,
        scenario: &Scenario,
        config: &MotionConfig,
    ) -> Result<Vec<Prediction>, EvalError> {
        let id = &scenario.id;
        let wrong = |problem: Problem| RolloutFileError::Unusable {
            scenario: id.clone(),
            path: self.path.clone(),
            problem,
        };
        match self.by_scenario.get(id) {
            Some(Message::Predictions(message)) => {
                Ok(predictions_from_proto(message).map_err(wrong)?)
            }
            Some(Message::Rollouts(message)) => {
                let rollouts = rollouts_from_proto(message, scenario);
                let rollouts = rollouts.map_err(wrong)?;
                Ok(forecast(scenario, &rollouts, config)?)
            }
            None => Err(RolloutFileError::NoPredictions {
                scenario: id.clone(),
                path: self.path.clone(),
            }
            .into()),
        }
    }

    /// Refuses predictions of scenarios that are not among `ids`.
    pub(super) fn check_all_known(&self, ids: &BTreeSet<String>) -> Result<(), EvalError> {
        match self.by_scenario.keys().find(|id| !ids.contains(*id)) {
            Some(id) => Err(RolloutFileError::UnknownScenario {
                scenario: id.clone(),
                path: self.path.clone(),
            }
            .into()),
            None => Ok(()),
        }
    }
}

fn messages(file: &Path) -> Result<Vec<(String, Message)>, EvalError> {
    match read_predictions(file) {
        Ok(submission) if holds_predictions(&submission) => {
            let messages = submission.scenario_predictions.into_iter();
            return Ok(messages
                .map(|m| (m.scenario_id().to_owned(), Message::Predictions(m)))
                .collect());
        }
        Ok(_) | Err(DataError::Proto { .. }) => {}
        Err(error) => return Err(error.into()),
    }
    let rollouts = read_rollouts(file)
        .map_err(|error| EvalError::from(error).at(ErrorContext::Predictions))?;
    Ok(rollouts
        .into_iter()
        .map(|m| (m.scenario_id().to_owned(), Message::Rollouts(m)))
        .collect())
}

/// Whether the message really holds predictions: messages do not state their type, and rollouts may
/// decode as predictions without paths.
fn holds_predictions(submission: &MotionChallengeSubmission) -> bool {
    let holds = |message: &ChallengeScenarioPredictions| match &message.prediction_set {
        Some(PredictionKind::SinglePredictions(set)) => {
            let mut modes = set.predictions.iter().flat_map(|p| &p.trajectories);
            modes.all(|mode| mode.trajectory.is_some())
        }
        Some(PredictionKind::JointPrediction(_)) => true,
        None => false,
    };
    let mut messages = submission.scenario_predictions.iter();
    !submission.scenario_predictions.is_empty() && messages.all(holds)
}
