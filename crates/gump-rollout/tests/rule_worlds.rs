//! Log replay and constant velocity; what no world but the log may see.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use approx::assert_abs_diff_eq;
use gump_geometry::{Pose, dvec2};
use gump_rollout::worlds::{ConstantVelocity, Idm, LogReplay};
use gump_rollout::{SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{
    Agent, AgentId, AgentState, Frame, LightState, Scenario, SceneState, Seed, fixture,
};

fn scene() -> Scenario {
    let text = "ego vehicle 0: 0,0 velocity 5,0
                agent pedestrian 3: 20,4 velocity 0,-1
                history 1.0 future 2.0 dt 0.1";
    let mut scenario = fixture::scenario(text).unwrap();
    // The pedestrian stops a second from now and leaves the log another half second later.
    for i in 20..scenario.log.len() {
        let agents = scenario.log[i].agents().iter().copied();
        let agents = agents.filter(|agent| agent.id == AgentId(0) || i < 25);
        let agents = agents.map(|agent| match agent.id {
            AgentId(3) => agent.with_state(AgentState {
                pose: Pose::new(20.0, 3.0, 0.0),
                velocity: dvec2(0.0, 0.0),
            }),
            _ => agent,
        });
        scenario.log[i] = Frame::new(agents.collect(), vec![]);
    }
    scenario
}

fn start(scenario: &Scenario) -> Start<'_> {
    Start {
        scene: scenario.present(),
        n_futures: 2,
        seed: Seed(0),
    }
}

fn seconds(seconds: f64) -> SimulateConfig {
    SimulateConfig {
        seconds,
        relative_elevation: false,
        ..SimulateConfig::default()
    }
}

#[test]
fn replay_is_the_log() {
    let scenario = scene();
    let world = LogReplay::new(&scenario);
    assert_abs_diff_eq!(world.seconds_left(), 2.0, epsilon = 1e-12);
    for rollout in simulate(&world, &[start(&scenario)], None, &seconds(2.0)).unwrap() {
        assert_eq!(rollout.imagined(), scenario.future());
    }
}

#[test]
fn past_the_log_agents_keep_their_velocity() {
    let scenario = scene();
    let rollouts = simulate(
        &LogReplay::new(&scenario),
        &[start(&scenario)],
        None,
        &seconds(3.0),
    )
    .unwrap();
    let end = rollouts[0].last();
    assert_abs_diff_eq!(end.ego_now().state.pose.position.x, 15.0, epsilon = 1e-9);
    assert!(end.now().agent(AgentId(3)).is_none());
}

#[test]
fn replay_starts_anywhere_in_the_log_and_lets_the_ego_be_driven() {
    let scenario = scene();
    let world = LogReplay::new(&scenario);
    let late = Start {
        scene: scenario.at(15),
        ..start(&scenario)
    };
    let mut session = world.open(&[late]).unwrap();
    let driven = AgentState {
        pose: Pose::new(-7.0, 1.0, 0.2),
        velocity: dvec2(1.0, 0.0),
    };
    let first = session.step(Some(&[driven; 2])).unwrap().remove(0);
    assert_eq!(first.agent(AgentId(0)).unwrap().state, driven);
    assert_eq!(first.agent(AgentId(3)), scenario.log[16].agent(AgentId(3)));
    // A scene whose ego has left the log is still recognised by the others.
    let history = [first];
    let again = Start {
        scene: SceneState {
            history: &history,
            ..scenario.present()
        },
        ..start(&scenario)
    };
    let next = world.open(&[again]).unwrap().step(None).unwrap().remove(1);
    assert_eq!(next.agent(AgentId(3)), scenario.log[17].agent(AgentId(3)));
}

#[test]
fn replay_refuses_a_foreign_scene() {
    let other = fixture::scenario("ego vehicle 99: 1000,0").unwrap();
    let world = LogReplay::new(&scene());
    let error = world.open(&[start(&other)]).err().unwrap();
    assert_eq!(
        error.to_string(),
        "the scene shows no moment of the replayed log \"fixture\""
    );
}

#[test]
fn constant_velocity_moves_everyone_straight() {
    let scenario = scene();
    let rollouts = simulate(&ConstantVelocity, &[start(&scenario)], None, &seconds(8.0)).unwrap();
    let end = rollouts[1].last();
    assert_abs_diff_eq!(end.ego_now().state.pose.position.x, 40.0, epsilon = 1e-9);
    let walker = end.now().agent(AgentId(3)).unwrap();
    assert_abs_diff_eq!(walker.state.pose.position.y, -4.0, epsilon = 1e-9);
}

#[test]
fn constant_velocity_does_not_look_ahead() {
    let scenario = scene();
    let mut blind = scenario.clone();
    blind.log.truncate(blind.now + 1);
    let run = |s: &Scenario| simulate(&ConstantVelocity, &[start(s)], None, &seconds(8.0)).unwrap();
    assert_eq!(run(&scenario)[0].imagined(), run(&blind)[0].imagined());
}

#[test]
fn a_slot_can_be_replaced() {
    let scenario = scene();
    let mut session = ConstantVelocity.open(&[start(&scenario)]).unwrap();
    session.step(None).unwrap();
    session.replace(1, start(&scenario)).unwrap();
    let frames = session.step(None).unwrap();
    let x = |i: usize| frames[i].agent(AgentId(0)).unwrap().state.pose.position.x;
    assert_abs_diff_eq!(x(0), 1.0, epsilon = 1e-9);
    assert_abs_diff_eq!(x(1), 0.5, epsilon = 1e-9);
    assert!(session.replace(2, start(&scenario)).is_err());
}

/// A fork, and a log that goes on as `way` says: the ego takes that lane, which its route shows as
/// readers infer it; on the third lane a light turns red and an agent appears. Equal up to now.
fn recording(way: i64) -> Scenario {
    let text = format!(
        "lane 1: 0,0 50,0 next 2,3
         lane 2: 50,0 100,40
         lane 3: 50,0 100,-40
         route 1,{way}
         light 1 green: 48,0
         ego vehicle 0: 10,0 velocity 10,0
         agent vehicle 1: 30,0 velocity 9,0"
    );
    let mut scenario = fixture::scenario(&text).unwrap();
    let now = scenario.now;
    for frame in scenario.log[now + 1..].iter_mut().filter(|_| way == 3) {
        // A single look at these states would show everywhere.
        let nowhere = AgentState {
            pose: Pose::new(f64::NAN, 0.0, 0.0),
            velocity: dvec2(f64::NAN, 1.0),
        };
        let agents = frame.agents().iter();
        let mut agents: Vec<Agent> = agents.map(|agent| agent.with_state(nowhere)).collect();
        agents.push(Agent {
            id: AgentId(9),
            ..agents[0]
        });
        let mut lights = frame.lights().to_vec();
        lights[0].state = LightState::Red;
        *frame = Frame::new(agents, lights);
    }
    scenario
}

#[test]
fn what_comes_after_the_present_is_not_seen_but_for_the_route_that_can_be_hidden() {
    let [left, right] = [2, 3].map(recording);
    let idm = Idm::default();
    for world in [&idm as &dyn WorldModel, &ConstantVelocity] {
        let futures = |scene: SceneState<'_>| {
            let start = Start {
                scene,
                n_futures: 8,
                seed: Seed(5),
            };
            let rollouts = simulate(world, &[start], None, &seconds(8.0)).unwrap();
            let frames = rollouts.iter().map(|rollout| rollout.imagined().to_vec());
            frames.collect::<Vec<_>>()
        };
        let [a, b] = [&left, &right].map(|scenario| futures(scenario.present().unguided()));
        assert_eq!(a, b, "{}", world.name());
        // The test can fail: a guided ego takes the way of its log.
        let [a, b] = [&left, &right].map(|scenario| futures(scenario.present()));
        assert_eq!(a != b, world.name() == idm.name(), "{}", world.name());
    }
}
