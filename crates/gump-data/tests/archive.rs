//! Archives for the sim agents challenge: packed, read back, and checked against the rules.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use std::io::Read as _;
use std::path::Path;

use flate2::read::GzDecoder;
use gump_data::submission::{
    ArchiveWriter, ExpectedScenarios, N_FUTURES, SubmissionCheck, check_archive, metadata_problems,
    rollouts_to_proto,
};
use gump_proto::{ScenarioRollouts, SimAgentsChallengeSubmission, SubmissionType};
use gump_scene::{Rollout, Scenario};
use prost::Message;

fn metadata() -> SimAgentsChallengeSubmission {
    SimAgentsChallengeSubmission {
        submission_type: Some(SubmissionType::SimAgentsSubmission.into()),
        account_name: Some("someone@example.org".into()),
        unique_method_name: Some("test".into()),
        uses_lidar_data: Some(false),
        uses_camera_data: Some(false),
        uses_public_model_pretraining: Some(false),
        num_model_parameters: Some("5M".into()),
        acknowledge_complies_with_closed_loop_requirement: Some(true),
        ..SimAgentsChallengeSubmission::default()
    }
}

/// Three scenarios of one scene.
fn scenarios() -> Vec<Scenario> {
    let named = |id: &str| Scenario {
        id: id.into(),
        ..common::crossing()
    };
    ["a", "b", "c"].map(named).into()
}

fn logged(scenario: &Scenario) -> ScenarioRollouts {
    let mut rollout = Rollout::begin(scenario.present());
    for frame in scenario.future() {
        rollout.push(frame.clone());
    }
    rollouts_to_proto(&scenario.id, &vec![rollout; N_FUTURES])
        .unwrap()
        .0
}

fn expected(scenarios: &[Scenario]) -> ExpectedScenarios {
    let mut expected = ExpectedScenarios::default();
    scenarios.iter().for_each(|scenario| expected.add(scenario));
    expected
}

fn pack(path: &Path, rollouts: &[ScenarioRollouts]) -> Vec<String> {
    // Room for one scenario a shard.
    let mut archive = ArchiveWriter::create(path, metadata()).with_shard_bytes(1);
    rollouts.iter().for_each(|r| archive.add(r).unwrap());
    archive.finish().unwrap()
}

#[test]
fn an_archive_holds_numbered_shards_that_decode_as_submissions() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("deep/submission.tar.gz");
    let scenarios = scenarios();
    let rollouts: Vec<_> = scenarios.iter().map(logged).collect();
    let names = pack(&path, &rollouts);
    assert_eq!(names[1], "submission.binproto-00001-of-00003");
    let file = std::fs::File::open(&path).unwrap();
    let mut archive = tar::Archive::new(GzDecoder::new(file));
    for (k, entry) in archive.entries().unwrap().enumerate() {
        let mut entry = entry.unwrap();
        assert_eq!(entry.path().unwrap().display().to_string(), names[k]);
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        let shard = SimAgentsChallengeSubmission::decode(bytes.as_slice()).unwrap();
        let of_shard = SimAgentsChallengeSubmission {
            scenario_rollouts: vec![rollouts[k].clone()],
            ..metadata()
        };
        assert!(shard == of_shard);
    }
    let found = check_archive(&path, &expected(&scenarios)).unwrap();
    assert_eq!(
        (found.scenarios, found.n_problems),
        (3, 0),
        "{:?}",
        found.problems
    );
    // Nothing but the archive is left, and packing again makes the same bytes.
    assert_eq!(
        std::fs::read_dir(path.parent().unwrap()).unwrap().count(),
        1
    );
    let again = folder.path().join("again.tar.gz");
    pack(&again, &rollouts);
    assert_eq!(std::fs::read(again).unwrap(), std::fs::read(path).unwrap());
}

#[test]
fn one_shard_takes_many_scenarios() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("submission.tar.gz");
    let scenarios = scenarios();
    let mut archive = ArchiveWriter::create(&path, metadata());
    for scenario in &scenarios {
        archive.add(&logged(scenario)).unwrap();
    }
    assert_eq!(
        archive.finish().unwrap(),
        ["submission.binproto-00000-of-00001"]
    );
    assert_eq!(
        check_archive(&path, &expected(&scenarios))
            .unwrap()
            .n_problems,
        0
    );
}

#[test]
fn a_writer_that_is_dropped_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut archive = ArchiveWriter::create(&folder.path().join("x.tar.gz"), metadata());
    archive.add(&logged(&scenarios()[0])).unwrap();
    drop(archive);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn every_broken_rule_is_named() {
    let scenarios = scenarios();
    let wanted = expected(&scenarios);
    let good: Vec<_> = scenarios.iter().map(logged).collect();
    let check = |damage: &dyn Fn(&mut Vec<ScenarioRollouts>), sentences: &[&str]| {
        let mut rollouts = good.clone();
        damage(&mut rollouts);
        let mut found = SubmissionCheck::default();
        for rollouts in &rollouts {
            found.add(rollouts, &wanted);
        }
        found.finish(&wanted);
        assert_eq!(found.problems, sentences);
        assert_eq!(found.n_problems, sentences.len());
    };
    check(&|_| {}, &[]);
    check(&|r| drop(r.remove(1)), &["scenario b is missing"]);
    check(&|r| r.push(r[0].clone()), &["scenario a occurs twice"]);
    check(
        &|r| r[2].scenario_id = Some("x".into()),
        &[
            "scenario \"x\" is not one of those expected",
            "scenario c is missing",
        ],
    );
    check(
        &|r| r[0].joint_scenes.truncate(31),
        &["scenario a: expected 32 futures, found 31"],
    );
    check(
        &|r| r[0].joint_scenes[5].simulated_trajectories[1].center_x[7] = f32::NAN,
        &["scenario a: future 5: agent 7 has a state that is not a number"],
    );
    check(
        &|r| drop(r[1].joint_scenes[0].simulated_trajectories.remove(0)),
        &["scenario b: future 0: agent 3 is missing"],
    );
    check(
        &|r| {
            let t = &mut r[1].joint_scenes[0].simulated_trajectories;
            t.push(t[0].clone());
        },
        &["scenario b: future 0: agent 3 occurs twice"],
    );
    check(
        &|r| {
            for t in &mut r[0].joint_scenes[31].simulated_trajectories {
                for column in [
                    &mut t.center_x,
                    &mut t.center_y,
                    &mut t.center_z,
                    &mut t.heading,
                ] {
                    column.truncate(79);
                }
            }
        },
        &[3, 7, 8, 9, 10]
            .map(|id| format!("scenario a: future 31: expected 80 steps of agent {id}, found 79"))
            .each_ref()
            .map(String::as_str),
    );
}

#[test]
fn problems_are_counted_beyond_those_that_are_told() {
    let wanted = ExpectedScenarios::default();
    let mut found = SubmissionCheck::default();
    for k in 0..1500 {
        let rollouts = ScenarioRollouts {
            scenario_id: Some(k.to_string()),
            joint_scenes: vec![],
        };
        assert!(!found.add(&rollouts, &wanted));
    }
    assert_eq!((found.n_problems, found.problems.len()), (1500, 1000));
}

#[test]
fn who_made_it_must_be_told() {
    assert_eq!(metadata_problems(&metadata()), [""; 0]);
    let check = |damage: &dyn Fn(&mut SimAgentsChallengeSubmission), expected: &str| {
        let mut metadata = metadata();
        damage(&mut metadata);
        let problems = metadata_problems(&metadata);
        assert_eq!(problems.len(), 1, "{problems:?}");
        assert!(problems[0].starts_with(expected), "{problems:?}");
    };
    check(&|m| m.submission_type = None, "submission_type");
    check(&|m| m.account_name = Some("me".into()), "account_name");
    check(&|m| m.unique_method_name = None, "unique_method_name");
    check(&|m| m.uses_lidar_data = None, "uses_lidar_data");
    check(&|m| m.uses_camera_data = None, "uses_camera_data");
    check(
        &|m| m.uses_public_model_pretraining = None,
        "uses_public_model_pretraining",
    );
    check(
        &|m| m.uses_public_model_pretraining = Some(true),
        "public_model_names",
    );
    check(
        &|m| m.num_model_parameters = Some("5".into()),
        "num_model_parameters",
    );
    check(
        &|m| m.acknowledge_complies_with_closed_loop_requirement = Some(false),
        "acknowledge_complies",
    );
}

#[test]
fn shards_must_agree_on_who_made_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.tar");
    let scenarios = scenarios();
    let mut tar = tar::Builder::new(std::fs::File::create(&path).unwrap());
    for (k, method) in ["one", "two"].into_iter().enumerate() {
        let shard = SimAgentsChallengeSubmission {
            scenario_rollouts: vec![logged(&scenarios[k])],
            unique_method_name: Some(method.into()),
            ..metadata()
        };
        let bytes = shard.encode_to_vec();
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        let name = format!("s.binproto-0000{k}-of-00002");
        tar.append_data(&mut header, name, bytes.as_slice())
            .unwrap();
    }
    tar.finish().unwrap();
    let found = check_archive(&path, &expected(&scenarios)).unwrap();
    let problem = "s.binproto-00001-of-00002 says other things of its makers than the first shard";
    assert_eq!(found.problems, [problem, "scenario c is missing"]);
}

#[test]
fn what_is_no_archive_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.tar.gz");
    std::fs::write(&path, vec![b'x'; 2000]).unwrap();
    let error = check_archive(&path, &ExpectedScenarios::default()).unwrap_err();
    assert!(
        error.to_string().contains("could not read the archive"),
        "{error}"
    );
}
