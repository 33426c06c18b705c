//! Predictions survive the trip through Waymo's message, and the challenge's rules are enforced.
//!
//! The files under `golden` were written by the official messages for made-up scenarios.

mod common;

use std::path::{Path, PathBuf};

use gump_data::DataError;
use gump_data::submission::{
    N_POSITIONS, prediction_problems, predictions_from_proto, predictions_to_proto,
    read_predictions, write_predictions,
};
use gump_geometry::{DVec2, dvec2};
use gump_proto::motion::{ChallengeScenarioPredictions, MotionChallengeSubmission, PredictionKind};
use gump_scene::{AgentId, PredictedMode, Prediction, Scenario};

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/golden")
        .join(name)
}

#[test]
fn official_messages_become_predictions_and_the_same_messages_again() {
    for (name, n_predictions, n_agents) in [
        ("motion_noise8.binproto", [12, 7], 1),
        ("motion_joint8.binproto", [1, 1], 2),
    ] {
        let submission = read_predictions(&golden(name)).unwrap();
        assert_eq!(submission.account_name(), "test");
        assert_eq!(submission.scenario_predictions.len(), 2);
        for (message, n) in submission.scenario_predictions.iter().zip(n_predictions) {
            let predictions = predictions_from_proto(message).unwrap();
            assert_eq!(predictions.len(), n, "{name}");
            for prediction in &predictions {
                assert_eq!(prediction.agents.len(), n_agents);
                assert_eq!(prediction.modes.len(), 8);
                let mut paths = prediction.modes.iter().flat_map(|mode| &mode.paths);
                assert!(paths.all(|path| path.len() == N_POSITIONS));
            }
            let again = predictions_to_proto(message.scenario_id(), &predictions).unwrap();
            assert!(again == *message, "{name}");
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("again.binproto");
        write_predictions(&path, &submission).unwrap();
        assert_eq!(
            std::fs::read(&path).unwrap(),
            std::fs::read(golden(name)).unwrap()
        );
    }
}

fn straight(x: f64) -> Vec<DVec2> {
    (0..N_POSITIONS).map(|k| dvec2(x, k as f64)).collect()
}

/// A prediction of every target, one by one.
fn single(scenario: &Scenario) -> Vec<Prediction> {
    let of_agent = |&agent: &AgentId| Prediction {
        agents: vec![agent],
        modes: vec![PredictedMode {
            confidence: 0.5,
            paths: vec![straight(1.0)],
        }],
    };
    scenario.targets.iter().map(of_agent).collect()
}

fn scenario() -> Scenario {
    let mut scenario = common::crossing();
    scenario.targets = vec![AgentId(3), AgentId(7)];
    scenario
}

#[test]
fn every_broken_rule_is_named() {
    let scenario = scenario();
    let check = |damage: &dyn Fn(&mut Vec<Prediction>), expected: &[&str]| {
        let mut predictions = single(&scenario);
        damage(&mut predictions);
        let message = predictions_to_proto(&scenario.id, &predictions).unwrap();
        assert_eq!(prediction_problems(&message, &scenario), expected);
    };
    check(&|_| {}, &[]);
    check(&|p| drop(p.remove(1)), &["agent 7 is missing"]);
    check(
        &|p| p[0].agents[0] = AgentId(8),
        &["agent 8 is not to be predicted", "agent 3 is missing"],
    );
    check(
        &|p| p[0].agents[0] = AgentId(7),
        &["agent 7 occurs twice", "agent 3 is missing"],
    );
    check(&|p| p[1].modes.clear(), &["agent 7 has no mode"]);
    check(
        &|p| p[0].modes[0].paths[0].truncate(15),
        &["expected 16 positions in mode 0 of agent 3, found 15"],
    );
    check(
        &|p| p[0].modes[0].paths[0][2].x = f64::NAN,
        &["mode 0 of agent 3 has a position that is not a number"],
    );
    check(
        &|p| p[0].modes[0].confidence = f64::NAN,
        &["mode 0 of agent 3 has a confidence that is not a number"],
    );
    let message = predictions_to_proto("other", &single(&scenario)).unwrap();
    assert_eq!(
        prediction_problems(&message, &scenario),
        ["expected scenario id fixture, found \"other\""]
    );
    let nothing = ChallengeScenarioPredictions::default();
    assert_eq!(prediction_problems(&nothing, &scenario).len(), 2);
}

fn joint() -> Prediction {
    let mode = |x: f64| PredictedMode {
        confidence: x,
        paths: vec![straight(x), straight(-x)],
    };
    Prediction {
        agents: vec![AgentId(3), AgentId(7)],
        modes: vec![mode(1.0), mode(2.0)],
    }
}

#[test]
fn joint_paths_are_found_by_their_agents() {
    let scenario = scenario();
    let mut message = predictions_to_proto(&scenario.id, &[joint()]).unwrap();
    assert!(prediction_problems(&message, &scenario).is_empty());
    let Some(PredictionKind::JointPrediction(found)) = &mut message.prediction_set else {
        panic!("expected a joint prediction");
    };
    found.joint_trajectories[1].trajectories.reverse();
    assert_eq!(predictions_from_proto(&message).unwrap(), [joint()]);
}

#[test]
fn inconsistent_messages_are_refused() {
    let check = |damage: &dyn Fn(&mut ChallengeScenarioPredictions), expected: &str| {
        let mut message = predictions_to_proto("x", &[joint()]).unwrap();
        damage(&mut message);
        let error = predictions_from_proto(&message).unwrap_err();
        assert_eq!(error.to_string(), expected);
    };
    let modes = |m: &mut ChallengeScenarioPredictions| match m.prediction_set.take() {
        Some(PredictionKind::JointPrediction(joint)) => joint,
        _ => panic!("expected a joint prediction"),
    };
    let damaged =
        |m: &mut ChallengeScenarioPredictions,
         damage: &dyn Fn(&mut gump_proto::motion::ScoredJointTrajectory)| {
            let mut joint = modes(m);
            damage(&mut joint.joint_trajectories[1]);
            m.prediction_set = Some(PredictionKind::JointPrediction(joint));
        };
    check(
        &|m| m.prediction_set = None,
        "expected single or joint predictions, found none",
    );
    let other = "mode 1 is of other agents than mode 0, or of one agent twice";
    check(
        &|m| damaged(m, &|mode| mode.trajectories.truncate(1)),
        other,
    );
    check(
        &|m| damaged(m, &|mode| mode.trajectories[0].object_id = Some(7)),
        other,
    );
    check(
        &|m| damaged(m, &|mode| mode.trajectories[0].trajectory = None),
        "mode 1 of agent 3 has no trajectory",
    );
    check(
        &|m| {
            damaged(m, &|mode| {
                let trajectory = mode.trajectories[1].trajectory.as_mut().unwrap();
                trajectory.center_y.truncate(9);
            });
        },
        "mode 1 of agent 7 has 16 numbers center_x and 9 center_y",
    );
}

#[test]
fn what_a_message_cannot_hold_is_refused() {
    let check = |predictions: &[Prediction], expected: &str| {
        let error = predictions_to_proto("x", predictions).unwrap_err();
        assert!(matches!(error, DataError::Unwritable { .. }));
        assert!(error.to_string().contains(expected), "{error}");
    };
    check(&[joint(), joint()], "found 2 mixed");
    let mut large = joint();
    large.agents[0] = AgentId(1 << 40);
    check(&[large], "exceeds 32 bits");
}

#[test]
fn a_file_that_is_no_submission_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.binproto");
    std::fs::write(&path, b"not a message").unwrap();
    let error = read_predictions(&path).unwrap_err();
    assert!(
        error.to_string().contains("MotionChallengeSubmission"),
        "{error}"
    );
    write_predictions(&path, &MotionChallengeSubmission::default()).unwrap();
    assert!(matches!(
        read_predictions(&path),
        Err(DataError::Empty { .. })
    ));
}
