//! Episodes by hand, and against the metrics they are made of.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use common::{DT, STREET, busy, config, env, street, until_end, wander};
use gump_metrics::{Collision, Metric, OffRoad, Reward};
use gump_rl::{
    BicycleLimits, DrivingEnv, Dynamics, End, EnvConfig, EpisodeState, Episodes, EvaluatedPolicy,
    Failure, PoseLimits, PreparedScenario, RlError, Rules, TrafficSource, VectorEnv, evaluate,
    recorded_drive,
};
use gump_rollout::worlds::{ConstantVelocity, Idm};
use gump_scene::{AgentId, AgentState, Frame, LightState, Rollout, SceneState, Seed, fixture};

const COAST: [f32; 2] = [0.0, 0.0];

#[test]
fn a_free_road_is_driven_to_the_horizon() {
    let prepared = street("agent vehicle 1: 60,9");
    let idm = Idm::default();
    for traffic in [TrafficSource::Log, TrafficSource::World(&idm)] {
        let mut env = env(&prepared, traffic, 3);
        env.reset(Seed(0)).unwrap();
        let first = env.observations().to_vec();
        let (n, outcome) = until_end(&mut env, &COAST);
        assert_eq!((n, outcome.end), (16, End::Truncated));
        assert_eq!(env.truncated(), [true; 3]);
        assert_eq!(env.terminated(), [false; 3]);
        // 5 m of progress per step in comfort.
        assert!((outcome.totals.progress - 80.0).abs() < 1e-9);
        assert!((env.rewards()[0] - 0.5).abs() < 1e-6 && outcome.is_safe());
        assert!(!outcome.totals.uncomfortable);
        // The first observation of the new episode; the last one of the old differs.
        assert_eq!(env.observations(), first);
        assert_ne!(env.final_observations(), first);
        env.step(&COAST.repeat(3)).unwrap();
        assert!(env.finished().is_empty() && !env.restarted()[0]);
        assert_eq!(env.episode(0).unwrap().1.steps, 1);
        assert_eq!(env.observations(), env.final_observations());
    }
}

#[test]
fn a_recorded_drive_is_that_of_the_evaluation() {
    let prepared = street("agent vehicle 1: 34.85,0");
    let coast = EvaluatedPolicy::Constant(&COAST);
    let (idm, seed) = (Idm::default(), Seed(3));
    for traffic in [TrafficSource::Log, TrafficSource::World(&idm)] {
        let episodes = Episodes::all(prepared.len(), 1, seed);
        let result = evaluate(&prepared, traffic, &config(4), coast, &episodes).unwrap()[0];
        let drive = recorded_drive(&prepared, traffic, &config(4), coast, (0, seed)).unwrap();
        // Five frames of the scenario's in a step.
        assert_eq!(drive.steps(), 5 * result.steps);
        assert_eq!(drive.dt(), prepared[0].scenario().dt);
        let x = |k: usize| drive.at(k).ego_now().state.pose.position.x;
        for k in 1..=drive.steps() {
            assert!((x(k) - x(k - 1) - 1.0).abs() < 1e-6, "{k}");
            assert_eq!(drive.at(k).now().agents().len(), 2);
        }
        assert!((x(drive.steps()) - x(0) - result.progress).abs() < 1e-6);
        let touches = |k: usize| Collision.at(&drive.at(k), drive.at(k).ego_now()) == Some(1.0);
        let n = (0..=drive.steps()).filter(|&k| touches(k)).count();
        assert_eq!(n > 0, result.collided);
    }
}

#[test]
fn a_collision_terminates() {
    let prepared = street("agent vehicle 1: 34.85,0");
    for traffic in [TrafficSource::Log, TrafficSource::World(&ConstantVelocity)] {
        let (n, outcome) = until_end(&mut env(&prepared, traffic, 1), &COAST);
        // 20.05 m of free road at 5 m per step.
        assert_eq!((n, outcome.end), (5, End::Terminated(Failure::Collision)));
        assert!((outcome.totals.reward - (2.5 - 5.0)).abs() < 1e-9);
        assert!(outcome.totals.collided && !outcome.totals.off_road && !outcome.is_safe());
    }
}

/// Both boxes are clear of each other after 2.5 and after 3 s; the car passes in between.
#[test]
fn a_collision_within_a_step_terminates() {
    let prepared = street("agent vehicle 1: 37.5,-55.5 heading 1.5708 velocity 0,20");
    for traffic in [TrafficSource::Log, TrafficSource::World(&ConstantVelocity)] {
        let (n, outcome) = until_end(&mut env(&prepared, traffic, 1), &COAST);
        assert_eq!((n, outcome.end), (6, End::Terminated(Failure::Collision)));
    }
}

#[test]
fn leaving_the_road_terminates() {
    let prepared = street("edge: -10,-3 400,-3\nedge: 400,3 -10,3");
    let (n, outcome) = until_end(&mut env(&prepared, TrafficSource::Log, 1), &[0.0, 1.0]);
    assert_eq!(outcome.end, End::Terminated(Failure::OffRoad));
    assert!(n < 5 && outcome.totals.off_road, "{n}");
}

/// A car waits at a light, which turns green after a second of the log.
#[test]
fn lights_change_in_every_world_as_they_were_recorded() {
    let text =
        format!("{STREET}lane 2: 0,9 400,9\nlight 2 red: 60,9\nagent vehicle 1: 55,9 heading 0");
    let mut scenario = fixture::scenario(&text).unwrap();
    let green = scenario.now + 10;
    for frame in &mut scenario.log[green..] {
        let mut lights = frame.lights().to_vec();
        lights[0].state = LightState::Green;
        *frame = Frame::new(frame.agents().to_vec(), lights);
    }
    let prepared = PreparedScenario::prepare([scenario], DT).unwrap();
    let idm = Idm::default();
    // Lights after each step, and whether the front of the car, at first 2.6 m before the line, has
    // passed it in the end.
    let drive = |traffic, live_lights, nearest| {
        let config = EnvConfig {
            live_lights,
            nearest,
            autoreset: gump_rl::Autoreset::Disabled,
            ..config(1)
        };
        let mut env = DrivingEnv::new(prepared.clone(), traffic, config).unwrap();
        env.reset(Seed(0)).unwrap();
        let mut colours = Vec::new();
        for _ in 0..8 {
            env.step(&COAST).unwrap();
            colours.push(env.frame(0).unwrap().lights()[0].state);
        }
        let frame = env.frame(0).unwrap();
        let place = frame.agent(AgentId(1)).unwrap().state.pose.position;
        (colours, place.x + 2.4 > 60.0)
    };
    let (red, green) = (LightState::Red, LightState::Green);
    let recorded = [red, green, green, green, green, green, green, green];
    let (of_log, _) = drive(TrafficSource::Log, true, None);
    assert_eq!(of_log, recorded);
    for nearest in [None, Some(1)] {
        let (of_idm, passed) = drive(TrafficSource::World(&idm), true, nearest);
        assert!(of_idm == recorded && passed, "{of_idm:?}");
        let (held, passed) = drive(TrafficSource::World(&idm), false, nearest);
        assert!(held == [red; 8] && !passed, "{held:?}");
    }
}

#[test]
fn the_end_of_the_route_and_of_the_log_truncate() {
    let text = "lane 1: 0,0 30,0\nroute 1\nego vehicle 0: 10,0 velocity 10,0";
    let short = fixture::scenario(text).unwrap();
    let prepared = PreparedScenario::prepare([short], DT).unwrap();
    let (n, outcome) = until_end(&mut env(&prepared, TrafficSource::Log, 1), &COAST);
    assert_eq!((n, outcome.end), (4, End::Truncated));
    let prepared = street("history 1.0 future 3.0 dt 0.1");
    let steps = |traffic| until_end(&mut env(&prepared, traffic, 1), &COAST).0;
    assert_eq!(steps(TrafficSource::Log), 6);
    assert_eq!(steps(TrafficSource::World(&ConstantVelocity)), 16);
}

/// Every step earns what the reward of the metrics says about the same frames; collisions count at
/// any tenth of a second, road edges at the end and about every two metres before it.
#[test]
fn rewards_are_those_of_the_metrics() {
    let rules = Rules::default();
    let reward = Reward::driving_step();
    let (mut failures, mut n) = (0, 0);
    for (i, prepared) in busy(24).iter().enumerate() {
        let scene = prepared.scenario().present();
        let history: Vec<Frame> = scene.strided_history(5, 9).into_iter().cloned().collect();
        let start = SceneState {
            history: &history,
            dt: DT,
            ..scene
        };
        let mut rollout = Rollout::begin(start);
        let mut state = rules.reset(prepared);
        while state.end.is_none() {
            let action = wander(i, state.steps as u64, 2);
            let next = rules.step(prepared, &state, &action).unwrap();
            let [before, frame] = [state.steps, next.steps].map(|step| prepared.logged(step));
            let others = frame.agents().iter().filter(|agent| agent.id != scene.ego);
            // Both failures by the metrics at a moment of the step.
            let failed = |k: usize| {
                let share = k as f64 / 5.0;
                let ego = rules
                    .dynamics
                    .advance(&state.ego.state, &action, DT, DT * share);
                let moved = others.clone().map(|agent| {
                    let from = before.agent(agent.id).unwrap_or(agent).state.pose;
                    let pose = from.interpolate(agent.state.pose, share);
                    agent.with_state(AgentState {
                        pose,
                        ..agent.state
                    })
                });
                let agents = moved.chain([next.ego.with_state(ego)]).collect();
                let mut then = rollout.clone();
                then.push(Frame::new(agents, frame.lights().to_vec()));
                let now = then.last();
                let metric = |metric: &dyn Metric| metric.at(&now, now.ego_now()) > Some(0.0);
                [metric(&Collision), metric(&OffRoad)]
            };
            let moments: Vec<[bool; 2]> = (1..=5).map(failed).collect();
            let agents = others.clone().copied().chain([next.ego]).collect();
            rollout.push(Frame::new(agents, frame.lights().to_vec()));
            let now = rollout.last();
            let mut expected = reward.at(&now, now.ego_now()).total;
            let position = |state: &EpisodeState| state.ego.state.pose.position;
            let moved = position(&next).distance(position(&state));
            let stride = [5, 5, 3, 2, 2, 1][(moved / 2.0).ceil().min(5.0) as usize];
            let collided = moments.iter().any(|m| m[0]);
            let off_road = moments.iter().rev().step_by(stride).any(|m| m[1]);
            for (within, at_end) in [(collided, moments[4][0]), (off_road, moments[4][1])] {
                if within && !at_end {
                    expected -= 5.0;
                }
            }
            assert!(
                (next.reward - expected).abs() < 1e-9,
                "{} but {expected}",
                next.reward
            );
            state = next;
            n += 1;
        }
        failures += usize::from(state.end != Some(End::Truncated));
    }
    // Some of everything has been compared.
    assert!(n > 60 && failures > 2, "{n} steps, {failures} failures");
}

/// Metres between the driven ego and its log, at most, and the share of safe episodes, when all
/// rows do what the log did.
fn follow_the_log(dynamics: Dynamics) -> (f64, f64) {
    let prepared = busy(24);
    let config = EnvConfig {
        n_envs: prepared.len(),
        rules: Rules {
            dynamics,
            ..Rules::default()
        },
        sampling: gump_rl::Sampling::InOrder,
        autoreset: gump_rl::Autoreset::Disabled,
        ..EnvConfig::default()
    };
    let mut env = DrivingEnv::new(prepared, TrafficSource::Log, config).unwrap();
    env.reset(Seed(0)).unwrap();
    let mut actions = vec![0.0; env.n_envs() * env.action_len()];
    let (mut worst, mut safe) = (0.0f64, 0);
    while env.finished().is_empty() {
        env.expert_actions(&mut actions).unwrap();
        env.step(&actions).unwrap();
        for row in 0..env.n_envs() {
            let (start, state) = env.episode(row).unwrap();
            let logged = env.prepared()[start.scenario].logged_ego(state.steps);
            let logged = logged.unwrap().pose.position;
            worst = worst.max(logged.distance(state.ego.state.pose.position));
        }
        let done: Vec<bool> = (0..env.n_envs())
            .map(|row| env.episode(row).unwrap().1.end.is_some())
            .collect();
        safe += env.finished().iter().filter(|(_, o)| o.is_safe()).count();
        if done.iter().all(|done| *done) {
            break;
        }
        assert!(!done.contains(&true), "an expert failed early");
    }
    (worst, safe as f64 / env.n_envs() as f64)
}

#[test]
fn the_experts_actions_reproduce_the_log() {
    let poses = PoseLimits::default();
    for dynamics in [Dynamics::NextPose(poses), Dynamics::Trajectory(poses)] {
        let (worst, safe) = follow_the_log(dynamics);
        assert!(worst < 1e-3, "{worst} m");
        assert_eq!(safe, 1.0);
    }
    let (worst, safe) = follow_the_log(Dynamics::Bicycle(BicycleLimits::default()));
    assert!(worst < 0.3, "{worst} m");
    assert_eq!(safe, 1.0);
}

#[test]
fn a_copied_state_has_the_same_successor() {
    let prepared = busy(1);
    let rules = Rules::default();
    let start = rules.reset(&prepared[0]);
    let one = rules.step(&prepared[0], &start, &[0.5, 0.1]).unwrap();
    let again = rules
        .step(&prepared[0], &start.clone(), &[0.5, 0.1])
        .unwrap();
    assert_eq!(one, again);
    let other = rules.step(&prepared[0], &start, &[0.5, -0.1]).unwrap();
    assert_ne!(one, other);
}

#[test]
fn what_is_no_action_is_refused() {
    let prepared = street("");
    let rules = Rules::default();
    let start = rules.reset(&prepared[0]);
    let refuse = |action: &[f32]| rules.step(&prepared[0], &start, action).unwrap_err();
    assert!(matches!(refuse(&[0.0]), RlError::Count { found: 1, .. }));
    assert!(matches!(
        refuse(&[0.0, f32::NAN]),
        RlError::NotFinite { row: 0 }
    ));
    let beyond = refuse(&[0.0, -1.5]);
    assert!(matches!(beyond, RlError::OutOfRange { dimension: 1, .. }));
    assert_eq!(
        beyond.to_string(),
        "number 1 of the action of row 0 is -1.5, expected -1 to 1"
    );
    let mut ended = start;
    ended.end = Some(End::Truncated);
    let error = rules.step(&prepared[0], &ended, &COAST).unwrap_err();
    assert!(matches!(error, RlError::Finished { row: 0 }));
}

#[test]
fn parameters_out_of_range_are_refused() {
    let prepared = street("");
    let check = |change: &dyn Fn(&mut EnvConfig)| {
        let mut config = config(2);
        change(&mut config);
        let found = DrivingEnv::new(prepared.clone(), TrafficSource::Log, config);
        assert!(matches!(found.err(), Some(RlError::Parameter { .. })));
    };
    check(&|c| c.n_envs = 0);
    check(&|c| c.rules.horizon = f64::NAN);
    check(&|c| {
        c.rules.dynamics = Dynamics::Bicycle(BicycleLimits {
            max_speed: 0.0,
            ..BicycleLimits::default()
        });
    });
    check(&|c| {
        c.observation = gump_rl::ObservationSpec::Raster(gump_rl::RasterView {
            side_px: 20,
            metres_per_px: 1.0,
        });
    });
    check(&|c| {
        c.sampling = gump_rl::Sampling::Prioritized {
            floor: 0.0,
            forget: 0.1,
        };
    });
    let nothing = DrivingEnv::new([].into(), TrafficSource::Log, config(2));
    assert!(matches!(nothing.err(), Some(RlError::NoScenario)));
    let none = fixture::scenario(STREET).unwrap();
    assert!(PreparedScenario::new(none, 0.03).is_err());
}
