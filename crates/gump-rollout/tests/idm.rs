//! Reactive traffic on small roads.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use approx::assert_abs_diff_eq;
use gump_geometry::{Pose, angle_difference, dvec2};
use gump_rollout::worlds::{Idm, IdmConfig, idm_acceleration, idm_euler_step};
use gump_rollout::{RolloutError, SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{
    Agent, AgentId, AgentState, Frame, LaneKind, MapGraph, Rollout, Scenario, Seed, fixture,
};

const STREET: &str = "lane 1: 0,0 150,0 300,0 speed 15\n";

fn scene(text: &str) -> Scenario {
    fixture::scenario(text).unwrap()
}

fn run_futures(scenario: &Scenario, n_futures: usize, seconds: f64) -> Vec<Rollout> {
    let start = Start {
        scene: scenario.present(),
        n_futures,
        seed: Seed(5),
    };
    let config = SimulateConfig {
        seconds,
        ..SimulateConfig::default()
    };
    simulate(&Idm::default(), &[start], None, &config).unwrap()
}

fn run(text: &str, seconds: f64) -> Rollout {
    run_futures(&scene(text), 1, seconds).remove(0)
}

fn agent(frame: &Frame, id: i64) -> &Agent {
    frame.agent(AgentId(id)).unwrap()
}

fn end(rollout: &Rollout, id: i64) -> AgentState {
    agent(rollout.last().now(), id).state
}

/// Fails if agents 0 and 1 ever overlap; the gap between their centres along x at the end.
fn gap_without_collision(rollout: &Rollout) -> f64 {
    for frame in rollout.imagined() {
        let (a, b) = (
            agent(frame, 0).oriented_box(),
            agent(frame, 1).oriented_box(),
        );
        assert!(!a.overlaps(&b));
    }
    end(rollout, 1).pose.position.x - end(rollout, 0).pose.position.x
}

#[test]
fn a_free_vehicle_reaches_the_speed_limit_or_keeps_its_own_speed() {
    let limited = run(&format!("{STREET}ego vehicle 0: 10,0 velocity 5,0"), 20.0);
    assert!((13.0..=15.0).contains(&end(&limited, 0).speed()));
    let fast = run("lane 1: 0,0 300,0\nego vehicle 0: 10,0 velocity 15,0", 8.0);
    assert_abs_diff_eq!(end(&fast, 0).speed(), 15.0, epsilon = 1e-9);
}

#[test]
fn without_a_limit_the_kind_of_lane_says_how_fast() {
    let speed = |kind: LaneKind| {
        let mut scene = scene("lane 1: 0,0 3000,0\nego vehicle 0: 10,0 velocity 3,0");
        let mut parts = scene.map.parts().clone();
        parts.lanes[0].kind = kind;
        scene.map = Arc::new(MapGraph::new(parts).unwrap());
        let rollout = run_futures(&scene, 1, 60.0).remove(0);
        end(&rollout, 0).speed()
    };
    assert_abs_diff_eq!(speed(LaneKind::SurfaceStreet), 13.4, epsilon = 0.2);
    assert!((24.0..29.2).contains(&speed(LaneKind::Freeway)));
    assert_abs_diff_eq!(speed(LaneKind::Undefined), 10.0, epsilon = 0.2);
}

#[test]
fn it_stops_behind_what_stands_in_its_way() {
    for blocker in [
        "vehicle 1: 80,0",
        "other 1: 80,0.5",
        "pedestrian 1: 80,-0.7",
    ] {
        let text = format!("{STREET}ego vehicle 0: 10,0 velocity 12,0\nagent {blocker} heading 0");
        // A standing vehicle in the lane would drive off: park it across.
        let text = text.replace("80,0 heading 0", "80,0 heading 1.5");
        let rollout = run(&text, 20.0);
        let gap = gap_without_collision(&rollout);
        assert!(end(&rollout, 0).speed() < 0.1, "{blocker}");
        assert!((3.0..9.0).contains(&gap), "{blocker}: {gap}");
    }
}

#[test]
fn it_passes_what_stands_beside_its_way() {
    let text =
        format!("{STREET}ego vehicle 0: 10,0 velocity 12,0\nagent vehicle 1: 80,3 heading 0");
    let rollout = run(&text, 10.0);
    assert!(gap_without_collision(&rollout) < -30.0);
    assert_eq!(end(&rollout, 1).pose, Pose::new(80.0, 3.0, 0.0));
}

#[test]
fn it_settles_at_the_desired_gap_behind_a_slow_vehicle() {
    let text = "lane 1: 0,0 400,0 speed 15\nego vehicle 0: 10,0 velocity 12,0\n\
                agent bicycle 1: 60,0 velocity 5,0";
    let rollout = run(text, 40.0);
    let gap = gap_without_collision(&rollout) - 2.4 - 0.9;
    let state = end(&rollout, 0);
    assert_abs_diff_eq!(state.speed(), 5.0, epsilon = 0.05);
    // At equal speeds (s*/gap)² = 1 - (v/v0)⁴.
    let expected = (1.0 + 5.0 * 1.5) / (1.0 - (5.0f64 / 15.0).powi(4)).sqrt();
    assert_abs_diff_eq!(gap, expected, epsilon = 0.2);
}

#[test]
fn it_stops_at_red_and_drives_at_green() {
    let check = |state: &str, start: &str| {
        let text = format!("{STREET}light 1 {state}: 80,1\nego vehicle 0: {start}");
        end(&run(&text, 15.0), 0)
    };
    let red = check("red", "10,0 velocity 12,0");
    assert!(red.speed() < 0.1 && (74.0..77.6).contains(&red.pose.position.x));
    assert!(check("green", "10,0 velocity 12,0").pose.position.x > 150.0);
    assert!(check("unknown", "10,0 velocity 12,0").pose.position.x > 150.0);
    // A vehicle that stands at a light waits unless the light is seen to be green.
    assert!(check("unknown", "76,0").pose.position.x < 77.6);
    assert_eq!(check("red", "79,0").pose.position.x, 79.0);
    assert!(check("green", "76,0").pose.position.x > 120.0);
    // Past the line it leaves the crossing; at yellow it stops only if it can.
    assert!(check("red", "85,0 velocity 3,0").pose.position.x > 120.0);
    assert!(check("yellow", "65,0 velocity 12,0").pose.position.x > 150.0);
    assert!(check("yellow", "10,0 velocity 12,0").pose.position.x < 77.6);
}

#[test]
fn others_react_to_the_driven_ego_within_the_frame() {
    let scenario = scene(&format!(
        "{STREET}ego vehicle 0: 60,0 velocity 10,0\nagent vehicle 1: 40,0 velocity 10,0"
    ));
    let start = Start {
        scene: scenario.present(),
        n_futures: 1,
        seed: Seed(0),
    };
    let speed_after = |x: f64| {
        let driven = AgentState {
            pose: Pose::new(x, 0.0, 0.0),
            velocity: dvec2(0.0, 0.0),
        };
        let frame = Idm::default()
            .open(&[start])
            .unwrap()
            .step(Some(&[driven]))
            .unwrap()
            .remove(0);
        assert_eq!(agent(&frame, 0).state, driven);
        agent(&frame, 1).state.speed()
    };
    assert!(speed_after(48.0) < speed_after(140.0) - 0.5);
    // Handed back, the ego drives on by itself.
    let world = Idm::default();
    let mut session = world.open(&[start]).unwrap();
    session
        .step(Some(&[scenario.present().ego_now().state]))
        .unwrap();
    let mut x = 60.0;
    for _ in 0..50 {
        let frame = session.step(None).unwrap().remove(0);
        assert!((agent(&frame, 0).state.pose.position.x - x).abs() < 2.0);
        x = agent(&frame, 0).state.pose.position.x;
    }
    assert!(x > 95.0);
}

const FORK: &str = "lane 1: 0,0 50,0 next 2,3\nlane 2: 50,0 100,40\nlane 3: 50,0 100,-40\n";

#[test]
fn forks_are_drawn_from_the_seed_and_the_ego_follows_its_route() {
    let scenario = scene(&format!(
        "{FORK}route 1,3\nego vehicle 0: 10,0 velocity 10,0\nagent vehicle 1: 30,0 velocity 10,0"
    ));
    let rollouts = run_futures(&scenario, 40, 8.0);
    let left = |id: i64| {
        rollouts
            .iter()
            .filter(|r| end(r, id).pose.position.y > 5.0)
            .count()
    };
    assert!((8..=32).contains(&left(1)), "{} of 40 went left", left(1));
    assert_eq!(left(0), 0);
    assert!(rollouts.iter().all(|r| end(r, 0).pose.position.y < -5.0));
    // Future k depends on its seed alone, not on how many there are.
    let fewer = run_futures(&scenario, 7, 8.0);
    for (a, b) in fewer.iter().zip(&rollouts) {
        assert_eq!(a.imagined(), b.imagined());
    }
}

#[test]
fn nothing_jumps_and_offsets_fade() {
    let scenario = scene(
        "lane 1: 0,0 60,0 90,10 110,30 120,60 120,200\n\
         ego vehicle 0: 10,1.2 heading -0.1 velocity 8,-0.8\n\
         agent vehicle 1: 40,-0.9 heading 0.2 velocity 0,0",
    );
    let rollout = run_futures(&scenario, 1, 20.0).remove(0);
    let mut last = rollout.start().clone();
    for frame in rollout.imagined() {
        for id in [0, 1] {
            let (a, b) = (agent(&last, id).state, agent(frame, id).state);
            let step = a.pose.position.distance(b.pose.position);
            let driven = (a.speed() + b.speed()) / 2.0 * 0.1;
            assert!(
                (step - driven).abs() < 0.15 * driven + 2e-3,
                "{step} for {driven}"
            );
            assert!(angle_difference(a.pose.heading, b.pose.heading).abs() < 0.12);
        }
        last = frame.clone();
    }
    let lane = scenario.map.lanes()[0]
        .centerline
        .project(end(&rollout, 0).pose.position);
    assert!(lane.distance < 0.1, "still {} m off", lane.distance);
}

#[test]
fn curves_are_taken_slowly() {
    let rollout = run(
        "lane 1: 0,0 80,0 84,0.8 87,2.5 89.3,5.8 90,10 90,150\nego vehicle 0: 10,0 velocity 12,0",
        16.0,
    );
    let fastest = rollout
        .imagined()
        .iter()
        .map(|frame| agent(frame, 0).state)
        .filter(|state| {
            let p = state.pose.position;
            p.x > 84.0 && p.y < 7.0
        });
    let fastest = fastest.map(|state| state.speed()).fold(0.0, f64::max);
    assert!(
        (2.0..8.0).contains(&fastest),
        "{fastest} m/s in a curve of 10 m"
    );
    assert!(end(&rollout, 0).pose.position.y > 20.0);
}

#[test]
fn those_off_the_lanes_park_brake_or_walk() {
    let rollout = run(
        &format!(
            "{STREET}ego vehicle 0: 10,0 velocity 12,0\nagent vehicle 1: 80,30\n\
             agent vehicle 2: 20,40 velocity 0,6\nagent pedestrian 3: 30,8 velocity 1,0\n\
             agent bicycle 4: 30,-9 velocity 4,0"
        ),
        8.0,
    );
    assert_eq!(end(&rollout, 1).pose, Pose::new(80.0, 30.0, 0.0));
    assert_abs_diff_eq!(end(&rollout, 2).pose.position.y, 46.0, epsilon = 0.05);
    assert_eq!(end(&rollout, 2).speed(), 0.0);
    assert_abs_diff_eq!(end(&rollout, 3).pose.position.x, 38.0, epsilon = 1e-9);
    assert_abs_diff_eq!(end(&rollout, 4).pose.position.x, 62.0, epsilon = 1e-9);
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let scenario = scene(&format!(
        "{FORK}ego vehicle 0: 10,0 velocity 10,0\nagent vehicle 1: 30,0 velocity 9,0\n\
         agent vehicle 2: 20,0.4 velocity 9,0"
    ));
    let with = |n: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(n)
            .build()
            .unwrap();
        pool.install(|| run_futures(&scenario, 9, 8.0))
    };
    for (a, b) in with(1).iter().zip(&with(4)) {
        assert_eq!(a.imagined(), b.imagined());
    }
}

#[test]
fn parameters_are_checked() {
    let config = IdmConfig {
        headway: 0.0,
        ..IdmConfig::default()
    };
    let name = "headway";
    let expected = RolloutError::Parameter { name, value: 0.0 };
    assert_eq!(Idm::new(config).unwrap_err(), expected);
}

fn golden() -> serde_json::Value {
    serde_json::from_str(include_str!("data/idm.json")).unwrap()
}

fn numbers(value: &serde_json::Value) -> Vec<f64> {
    let list = value.as_array().unwrap().iter();
    list.map(|v| v.as_f64().unwrap()).collect()
}

fn law(params: &[f64]) -> IdmConfig {
    IdmConfig {
        target_velocity: params[0],
        min_gap: params[1],
        headway: params[2],
        max_acceleration: params[3],
        max_deceleration: params[4],
        ..IdmConfig::default()
    }
}

fn check_step(config: &IdmConfig, state: (f64, f64), lead: &[f64], dt: f64, expected: &[f64]) {
    let (gap, target) = (lead[0] - state.0 - lead[2], config.target_velocity);
    let found = idm_euler_step(config, state, target, gap, lead[1], dt);
    assert_abs_diff_eq!(found.0, expected[0], epsilon = 1e-9);
    assert_abs_diff_eq!(found.1, expected[1], epsilon = 1e-9);
}

#[test]
fn the_law_agrees_with_the_reference() {
    let steps = golden()["steps"].as_array().unwrap().clone();
    assert_eq!(steps.len(), 40);
    for step in steps {
        let params = numbers(&step["params"]);
        let config = law(&params);
        let (agent, lead) = (numbers(&step["agent"]), numbers(&step["lead"]));
        let gap = lead[0] - agent[0] - lead[2];
        let found = idm_acceleration(&config, agent[1], params[0], gap, lead[1]);
        let expected = numbers(&step["model"])[1];
        assert_abs_diff_eq!(found, expected, epsilon = 1e-6 * expected.abs().max(1.0));
        let dt = step["dt"].as_f64().unwrap();
        let state = (agent[0], agent[1]);
        check_step(&config, state, &lead, dt, &numbers(&step["euler"]));
    }
}

#[test]
fn following_for_fifteen_seconds_agrees_with_the_reference() {
    let golden = &golden()["follow_rollout"];
    let number = |key: &str| golden[key].as_f64().unwrap();
    let config = law(&numbers(&golden["params"]));
    let (mut state, mut lead) = ((0.0, number("v0")), number("lead_gap0"));
    let dt = number("dt");
    for row in golden["out"].as_array().unwrap() {
        let gap = lead - state.0;
        let target = config.target_velocity;
        state = idm_euler_step(&config, state, target, gap, number("lead_v"), dt);
        lead += number("lead_v") * dt;
        let expected = numbers(row);
        assert_abs_diff_eq!(state.0, expected[0], epsilon = 1e-6);
        assert_abs_diff_eq!(state.1, expected[1], epsilon = 1e-6);
    }
}

#[test]
fn the_planners_exponent_agrees_with_the_reference() {
    for batch in golden()["batch_idm_pdm"].as_array().unwrap() {
        let limit = batch["speed_limit"].as_f64().unwrap_or(15.0);
        for i in 0..5 {
            let config = IdmConfig {
                target_velocity: limit * 0.2 * (i + 1) as f64,
                min_gap: 1.0,
                headway: 1.5,
                max_acceleration: 1.5,
                max_deceleration: 3.0,
                exponent: 10.0,
                ..IdmConfig::default()
            };
            let row = |key: &str| numbers(&batch[key][i]);
            let state = (row("prev")[0], row("prev")[1]);
            check_step(&config, state, &row("lead"), 0.1, &row("out"));
            check_step(&config, state, &[0.0; 3], 0.1, &row("zero_lead_out"));
        }
    }
}

#[test]
fn moving_and_turning_the_world_moves_nothing_else() {
    let world_from_home = Pose::new(1000.0, -500.0, 0.7);
    let at = |frame: Pose| {
        let p = |x: f64, y: f64| {
            let point = frame * dvec2(x, y);
            format!("{:.9},{:.9}", point.x, point.y)
        };
        let v = |x: f64, y: f64| {
            let velocity = frame.rotate(dvec2(x, y));
            format!("{:.9},{:.9}", velocity.x, velocity.y)
        };
        let heading = |h: f64| h + frame.heading;
        let lanes = [
            format!("lane 1: {} {} next 2,3", p(0.0, 0.0), p(50.0, 0.0)),
            format!(
                "lane 2: {} {} {}",
                p(50.0, 0.0),
                p(70.0, 10.0),
                p(80.0, 90.0)
            ),
            format!("lane 3: {} {}", p(50.0, 0.0), p(150.0, -40.0)),
            format!("light 3 red: {}", p(60.0, -4.0)),
        ];
        let agents = [
            format!(
                "ego vehicle 0: {} heading {} velocity {}",
                p(5.0, 0.5),
                heading(0.1),
                v(8.0, 0.0)
            ),
            format!(
                "agent vehicle 1: {} heading {}",
                p(30.0, -0.3),
                heading(0.0)
            ),
            format!(
                "agent pedestrian 2: {} velocity {}",
                p(70.0, 6.0),
                v(0.1, 0.5)
            ),
        ];
        scene(&[lanes.join("\n"), agents.join("\n")].join("\n"))
    };
    let home = run_futures(&at(Pose::IDENTITY), 6, 10.0);
    let moved = run_futures(&at(world_from_home), 6, 10.0);
    for (a, b) in home.iter().zip(&moved) {
        for id in 0..3 {
            let (a, b) = (end(a, id).pose, end(b, id).pose);
            let back = world_from_home.inverse() * b;
            assert!(
                back.position.distance(a.position) < 1e-3,
                "{back:?} is not {a:?}"
            );
            assert!(angle_difference(back.heading, a.heading).abs() < 1e-3);
        }
    }
}
