//! Predictions from files: as such, or as futures that are condensed to modes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::Context as _;
use gump_data::submission::{
    predictions_from_proto, read_predictions, read_rollouts, rollouts_from_proto,
};
use gump_eval::rollout_files;
use gump_proto::ScenarioRollouts;
use gump_proto::motion::{ChallengeScenarioPredictions, MotionChallengeSubmission, PredictionKind};
use gump_scene::{Prediction, Scenario};
use gump_wosac::motion::{MotionConfig, forecast};

/// What is predicted, by scenario.
pub(super) struct Predictions(BTreeMap<String, Message>);

enum Message {
    Predictions(ChallengeScenarioPredictions),
    Rollouts(ScenarioRollouts),
}

impl Predictions {
    /// Reads a file or all files of a folder.
    ///
    /// Error: a file of another kind, or a scenario that occurs twice.
    pub(super) fn read(path: &Path) -> anyhow::Result<Self> {
        let mut by_scenario = BTreeMap::new();
        for file in rollout_files::files(path)? {
            for (id, message) in messages(&file)? {
                let twice = by_scenario.insert(id.clone(), message).is_some();
                anyhow::ensure!(
                    !twice,
                    "expected scenario {id} once, found it twice: {}",
                    file.display()
                );
            }
        }
        Ok(Self(by_scenario))
    }

    /// The predictions of a scenario.
    pub(super) fn of(
        &self,
        scenario: &Scenario,
        config: &MotionConfig,
        path: &Path,
    ) -> anyhow::Result<Vec<Prediction>> {
        let id = &scenario.id;
        let place = || format!("scenario {id} of {}", path.display());
        match self.0.get(id) {
            Some(Message::Predictions(message)) => {
                predictions_from_proto(message).with_context(place)
            }
            Some(Message::Rollouts(message)) => {
                let rollouts = rollouts_from_proto(message, scenario).with_context(place)?;
                Ok(forecast(scenario, &rollouts, config)?)
            }
            None => anyhow::bail!(
                "expected predictions of scenario {id}, found none: {}",
                path.display()
            ),
        }
    }

    /// Refuses predictions of scenarios that are not among `ids`.
    pub(super) fn check_all_known(
        &self,
        ids: &BTreeSet<String>,
        path: &Path,
    ) -> anyhow::Result<()> {
        let unknown = self.0.keys().find(|id| !ids.contains(*id));
        match unknown {
            Some(id) => anyhow::bail!(
                "found predictions of \"{id}\", which is not among the scenarios: {}",
                path.display()
            ),
            None => Ok(()),
        }
    }
}

fn messages(file: &Path) -> anyhow::Result<Vec<(String, Message)>> {
    match read_predictions(file) {
        Ok(submission) if holds_predictions(&submission) => {
            let messages = submission.scenario_predictions.into_iter();
            return Ok(messages
                .map(|m| (m.scenario_id().to_owned(), Message::Predictions(m)))
                .collect());
        }
        Ok(_) | Err(gump_data::DataError::Proto { .. }) => {}
        Err(error) => return Err(error.into()),
    }
    let rollouts = read_rollouts(file).context(
        "expected a MotionChallengeSubmission, a ScenarioRollouts or a SimAgentsChallengeSubmission",
    )?;
    Ok(rollouts
        .into_iter()
        .map(|m| (m.scenario_id().to_owned(), Message::Rollouts(m)))
        .collect())
}

/// True if this is what it was decoded as: messages do not say their type, and rollouts may decode
/// as predictions without paths.
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
