//! Futures survive the trip through Waymo's message, and the challenge's rules are enforced.

mod common;

use gump_data::submission::{
    N_FUTURES, N_STEPS, read_rollouts, rollouts_from_proto, rollouts_to_proto, submission_problems,
    write_rollouts,
};
use gump_data::{Problem, open};
use gump_scene::{AgentId, Frame, Rollout, Scenario};
use tempfile::TempDir;

/// The log as an imagined future, shifted sideways by `k` centimetres.
fn future(scenario: &Scenario, k: usize) -> Rollout {
    let mut rollout = Rollout::begin(scenario.present());
    for frame in scenario.future() {
        let agents = frame.agents().iter().map(|agent| {
            let mut agent = *agent;
            agent.state.pose.position.y += k as f64 / 100.0;
            agent.elevation = 2.5;
            agent
        });
        rollout.push(Frame::new(agents.collect(), frame.lights().to_vec()));
    }
    rollout
}

#[test]
fn agents_without_heights_keep_those_of_the_present() {
    let scenario = common::crossing();
    let (mut message, _) = rollouts_to_proto(&scenario.id, &[future(&scenario, 1)]).unwrap();
    for trajectory in &mut message.joint_scenes[0].simulated_trajectories {
        trajectory.center_z.clear();
    }
    let read = rollouts_from_proto(&message, &scenario).unwrap();
    let present = scenario.present();
    for agent in read[0].imagined().iter().flat_map(Frame::agents) {
        let before = present.now().agent(agent.id).unwrap();
        assert!((agent.elevation - before.elevation).abs() < 1e-6);
    }
}

#[test]
fn thirty_two_futures_come_back() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("some.binproto");
    let scenario = common::crossing();
    let rollouts: Vec<_> = (0..N_FUTURES).map(|k| future(&scenario, k)).collect();
    assert_eq!(write_rollouts(&path, &scenario.id, &rollouts).unwrap(), 0);
    let messages = read_rollouts(&path).unwrap();
    assert_eq!(messages.len(), 1);
    assert_eq!(submission_problems(&messages[0], &scenario), [""; 0]);
    let read = rollouts_from_proto(&messages[0], &scenario).unwrap();
    assert_eq!(read.len(), N_FUTURES);
    for (original, read) in rollouts.iter().zip(&read) {
        assert_eq!(read.steps(), N_STEPS);
        for (a, b) in original.imagined().iter().zip(read.imagined()) {
            for (a, b) in a.agents().iter().zip(b.agents()) {
                assert_eq!((a.id, a.length, b.elevation), (b.id, b.length, 2.5));
                let offset = a.state.pose.position - b.state.pose.position;
                assert!(offset.length() < 1e-5);
            }
        }
        let ego = |r: &Rollout| r.imagined()[5].agent(r.ego()).unwrap().state.velocity;
        assert!((ego(original) - ego(read)).length() < 1e-3);
    }
}

#[test]
fn who_leaves_stays_where_it_was_last() {
    let scenario = common::crossing();
    let full = future(&scenario, 0);
    let mut rollout = Rollout::begin(scenario.present());
    for (step, frame) in full.imagined().iter().enumerate() {
        let agents = frame.agents().iter().copied();
        let stay = agents.filter(|agent| step < 30 || agent.id != AgentId(7));
        rollout.push(Frame::new(stay.collect(), Vec::new()));
    }
    let (message, n_held) = rollouts_to_proto("x", &[rollout]).unwrap();
    assert_eq!(n_held, N_STEPS - 30);
    let trajectories = &message.joint_scenes[0].simulated_trajectories;
    let gone = trajectories.iter().find(|t| t.object_id() == 7).unwrap();
    assert_eq!(gone.center_y.len(), N_STEPS);
    assert_eq!(gone.center_y[79], gone.center_y[29]);
    assert_ne!(gone.center_y[29], gone.center_y[28]);
}

#[test]
fn every_broken_rule_is_named() {
    let scenario = common::crossing();
    let rollouts: Vec<_> = (0..N_FUTURES).map(|k| future(&scenario, k)).collect();
    let (message, _) = rollouts_to_proto(&scenario.id, &rollouts).unwrap();
    let check = |damage: &dyn Fn(&mut gump_proto::ScenarioRollouts), expected: &str| {
        let mut message = message.clone();
        damage(&mut message);
        let problems = submission_problems(&message, &scenario);
        assert!(problems.iter().any(|p| p == expected), "{problems:?}");
    };
    check(
        &|m| m.scenario_id = Some("y".into()),
        "expected scenario id fixture, found \"y\"",
    );
    check(
        &|m| m.joint_scenes.truncate(31),
        "expected 32 futures, found 31",
    );
    check(
        &|m| m.joint_scenes[3].simulated_trajectories[0].object_id = Some(99),
        "future 3: agent 99 is not present in the scenario",
    );
    check(
        &|m| m.joint_scenes[3].simulated_trajectories[0].object_id = Some(7),
        "future 3: agent 7 occurs twice",
    );
    check(
        &|m| drop(m.joint_scenes[0].simulated_trajectories.remove(4)),
        "future 0: agent 10 is missing",
    );
    check(
        &|m| m.joint_scenes[1].simulated_trajectories[2].heading[7] = f32::NAN,
        "future 1: agent 8 has a state that is not a number",
    );
    check(
        &|m| {
            m.joint_scenes[1].simulated_trajectories[2]
                .heading
                .truncate(79);
        },
        "future 1: agent 8 has columns of [80, 80, 80, 79] steps, expected 80",
    );
}

#[test]
fn real_submissions_read_as_rollouts_of_their_scenario() {
    let Some(path) = common::shared("data/waymo/scenario_a.tfrecord") else {
        return;
    };
    let scenario = open(&path).unwrap().next().unwrap().unwrap().scenario;
    let files = [
        ("golden/wosac/inputs_real/test_submission.binproto.gz", 32),
        (
            "golden/wosac/inputs/rollouts_637f20cafde22ff8_noise_part0.binproto",
            16,
        ),
        (
            "golden/wosac/inputs/rollouts_637f20cafde22ff8_cv_1scene.binproto",
            1,
        ),
    ];
    for (name, n_futures) in files {
        let Some(path) = common::shared(name) else {
            continue;
        };
        let messages = read_rollouts(&path).unwrap();
        assert_eq!(messages.len(), 1);
        let rollouts = rollouts_from_proto(&messages[0], &scenario).unwrap();
        assert_eq!(rollouts.len(), n_futures);
        assert!(rollouts.iter().all(|r| r.steps() == N_STEPS));
        assert_eq!(rollouts[0].last().now().agents().len(), 50);
        let expected = if n_futures == N_FUTURES { 0 } else { 1 };
        assert_eq!(submission_problems(&messages[0], &scenario).len(), expected);
    }
    let other = common::crossing();
    let Some(path) = common::shared(files[2].0) else {
        return;
    };
    let error = rollouts_from_proto(&read_rollouts(&path).unwrap()[0], &other).unwrap_err();
    assert!(matches!(error, Problem::OtherScenario { .. }));
}
