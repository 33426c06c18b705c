//! The engine against scripted worlds: resampling, policies, errors.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use approx::assert_abs_diff_eq;
use gump_geometry::{Pose, angle_difference, dvec2};
use gump_rollout::worlds::ConstantVelocity;
use gump_rollout::{
    BoxError, Command, Interpolation, Policy, Session, SimulateConfig, Start, WorldModel, simulate,
};
use gump_scene::{
    Agent, AgentId, AgentState, Frame, Light, LightState, Rollout, Scenario, SceneState, Seed,
    fixture,
};
use std::f64::consts::PI;

/// The script of a world: the frame of knot `k`, given the present.
type Script = fn(&Frame, usize) -> Frame;

/// A world that steps by 0.5 s and follows a script; a driven ego is at the given state.
struct Scripted(Script);

impl WorldModel for Scripted {
    fn name(&self) -> &str {
        "scripted"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let futures = starts.iter().flat_map(|start| {
            std::iter::repeat_n(
                (start.scene.now().clone(), start.scene.ego),
                start.n_futures,
            )
        });
        Ok(Box::new(ScriptedSession {
            script: self.0,
            futures: futures.collect(),
            knot: 0,
        }))
    }
}

struct ScriptedSession {
    script: Script,
    futures: Vec<(Frame, AgentId)>,
    knot: usize,
}

impl Session for ScriptedSession {
    fn dt(&self) -> f64 {
        0.5
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        self.knot += 1;
        let frames = self.futures.iter().enumerate().map(|(i, (present, id))| {
            let frame = (self.script)(present, self.knot);
            let agents = frame.agents().iter().map(|agent| match ego {
                Some(ego) if agent.id == *id => agent.with_state(ego[i]),
                _ => *agent,
            });
            Frame::new(agents.collect(), frame.lights().to_vec())
        });
        Ok(frames.collect())
    }

    fn replace(&mut self, _: usize, _: Start<'_>) -> Result<(), BoxError> {
        Err("a script cannot be replaced".into())
    }
}

fn scene(text: &str) -> Scenario {
    fixture::scenario(text).unwrap()
}

fn run(scenario: &Scenario, script: Script, config: &SimulateConfig) -> Rollout {
    let start = Start {
        scene: scenario.present(),
        n_futures: 1,
        seed: Seed(0),
    };
    simulate(&Scripted(script), &[start], None, config)
        .unwrap()
        .remove(0)
}

fn hermite() -> SimulateConfig {
    SimulateConfig::default()
}

fn linear() -> SimulateConfig {
    SimulateConfig {
        interpolation: Interpolation::Linear,
        ..SimulateConfig::default()
    }
}

/// All agents of a frame moved to the place and heading that `path` gives.
fn moved(present: &Frame, path: impl Fn(Pose) -> Pose) -> Frame {
    let agents = present.agents().iter().map(|agent| {
        let mut state = agent.state;
        state.pose = path(state.pose);
        agent.with_state(state)
    });
    Frame::new(agents.collect(), present.lights().to_vec())
}

/// The track of agent 0 over the imagined frames.
fn track(rollout: &Rollout) -> Vec<Agent> {
    let agents = rollout.imagined().iter();
    agents
        .map(|frame| *frame.agent(AgentId(0)).unwrap())
        .collect()
}

fn winding(present: &Frame, k: usize) -> Frame {
    let t = k as f64 * 0.5;
    moved(present, |p| {
        let turn = (0.7 * t).sin();
        Pose::new(p.position.x + 6.0 * t, p.position.y + 3.0 * turn, turn)
    })
}

#[test]
fn eight_seconds_are_eighty_frames_that_pass_through_the_knots() {
    let scenario = scene("ego vehicle 0: 5,1 velocity 6,0");
    for config in [hermite(), linear()] {
        let rollout = run(&scenario, winding, &config);
        assert_eq!((rollout.steps(), rollout.dt()), (80, 0.1));
        for (k, agent) in track(&rollout).iter().skip(4).step_by(5).enumerate() {
            let knot = winding(scenario.present().now(), k + 1);
            assert_eq!(agent.state.pose, knot.agents()[0].state.pose);
        }
    }
}

#[test]
fn straight_motion_at_constant_velocity_is_exact() {
    let scenario = scene("ego vehicle 0: 5,1 velocity 6,-2");
    let straight: Script = |present, k| {
        moved(present, |p| Pose {
            position: p.position + dvec2(6.0, -2.0) * (0.5 * k as f64),
            ..p
        })
    };
    for config in [hermite(), linear(), SimulateConfig::compat()] {
        for (i, agent) in track(&run(&scenario, straight, &config)).iter().enumerate() {
            let t = 0.1 * (i + 1) as f64;
            assert_abs_diff_eq!(agent.state.pose.position.x, 5.0 + 6.0 * t, epsilon = 1e-9);
            assert_abs_diff_eq!(agent.state.pose.position.y, 1.0 - 2.0 * t, epsilon = 1e-9);
            assert_abs_diff_eq!(agent.state.velocity.x, 6.0, epsilon = 1e-8);
            assert_abs_diff_eq!(agent.state.velocity.y, -2.0, epsilon = 1e-8);
        }
    }
}

#[test]
fn velocities_are_differences_of_positions() {
    let scenario = scene("ego vehicle 0: 5,1 velocity 6,0");
    let rollout = run(&scenario, winding, &hermite());
    let mut before = *rollout.start().agent(AgentId(0)).unwrap();
    for agent in track(&rollout) {
        let step = agent.state.pose.position - before.state.pose.position;
        assert_abs_diff_eq!(agent.state.velocity.x, step.x / 0.1, epsilon = 1e-9);
        assert_abs_diff_eq!(agent.state.velocity.y, step.y / 0.1, epsilon = 1e-9);
        before = agent;
    }
}

#[test]
fn headings_turn_the_short_way() {
    let scenario = scene("ego vehicle 0: 0,0 heading 3.0");
    let across_the_cut: Script = |present, k| {
        moved(present, |p| Pose {
            heading: if k % 2 == 1 { -3.0 } else { 3.0 },
            ..p
        })
    };
    for config in [hermite(), linear()] {
        for agent in track(&run(&scenario, across_the_cut, &config)) {
            assert!(angle_difference(agent.state.pose.heading, PI).abs() <= PI - 3.0 + 1e-9);
        }
    }
}

#[test]
fn hermite_is_smoother_than_linear_and_never_overshoots_a_stop() {
    let scenario = scene("ego vehicle 0: 0,0 velocity 8,0");
    let braking: Script = |present, k| {
        let x = [0.0, 3.5, 6.0, 7.5, 8.0];
        let reached = x[k.min(4)];
        moved(present, |p| Pose::new(p.position.x + reached, 0.0, 0.0))
    };
    let jerk = |config: &SimulateConfig| {
        let speeds: Vec<f64> = track(&run(&scenario, braking, config))
            .iter()
            .map(|agent| agent.state.velocity.x)
            .collect();
        let changes = speeds.windows(2).map(|pair| (pair[1] - pair[0]).abs());
        changes.fold(0.0, f64::max)
    };
    assert!(jerk(&hermite()) < 0.5 * jerk(&linear()));
    for pair in track(&run(&scenario, braking, &hermite())).windows(2) {
        let (a, b) = (pair[0].state.pose.position.x, pair[1].state.pose.position.x);
        assert!(a <= b + 1e-12 && b <= 8.0 + 1e-12, "moved from {a} to {b}");
    }
}

#[test]
fn smoothing_preserves_lines_and_damps_noise() {
    let smooth = SimulateConfig {
        smoothing_window: 9,
        ..hermite()
    };
    let scenario = scene("ego vehicle 0: 0,0 velocity 4,0");
    let shaky: Script = |present, k| {
        let shake = if k % 2 == 1 { 0.3 } else { -0.3 };
        moved(present, |p| {
            Pose::new(p.position.x + 2.0 * k as f64, shake, shake)
        })
    };
    let spread = |config: &SimulateConfig| {
        let agents = track(&run(&scenario, shaky, config));
        let middle = agents[10..70].iter().map(|a| a.state.pose);
        middle.fold((0.0f64, 0.0f64), |(y, heading), pose| {
            (
                y.max(pose.position.y.abs()),
                heading.max(pose.heading.abs()),
            )
        })
    };
    let ((y, heading), (raw_y, raw_heading)) = (spread(&smooth), spread(&hermite()));
    assert!(y < 0.5 * raw_y && heading < 0.5 * raw_heading);
    // Constant and linear signals were checked with `compat` above; a constant heading off zero
    // would be bent if only its sine were smoothed.
    let turned = scene("ego vehicle 0: 0,0 heading 2.5 velocity 4,0");
    let level: Script = |present, k| {
        moved(present, |p| {
            Pose::new(p.position.x + 2.0 * k as f64, 0.0, 2.5)
        })
    };
    for agent in track(&run(&turned, level, &smooth)) {
        assert_abs_diff_eq!(agent.state.pose.heading, 2.5, epsilon = 1e-12);
    }
}

#[test]
fn agents_vanish_after_their_last_knot_and_appear_at_their_first() {
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 4,0
         agent vehicle 1: 20,0 velocity 4,0",
    );
    let coming_and_going: Script = |present, k| {
        let ids: &[i64] = match k {
            1 => &[0, 1],
            2 => &[0],
            3 => &[0, 7],
            _ => &[0, 1, 7],
        };
        let template = present.agents()[0];
        let agents = ids.iter().map(|&id| Agent {
            id: AgentId(id),
            length: 4.0 + id as f64,
            ..template
        });
        Frame::new(agents.collect(), vec![])
    };
    let rollout = run(&scenario, coming_and_going, &hermite());
    let present = |id: i64| -> Vec<usize> {
        let has = |i: &usize| rollout.imagined()[*i - 1].agent(AgentId(id)).is_some();
        (1..=80).filter(has).collect()
    };
    assert_eq!(present(0).len(), 80);
    assert_eq!(
        present(1),
        [1, 2, 3, 4, 5]
            .into_iter()
            .chain(20..=80)
            .collect::<Vec<_>>()
    );
    assert_eq!(present(7), (15..=80).collect::<Vec<_>>());
    // The logged extent wins over the world's, a newborn has the world's.
    assert_eq!(rollout.imagined()[2].agent(AgentId(1)).unwrap().length, 4.8);
    assert_eq!(rollout.last().now().agent(AgentId(7)).unwrap().length, 11.0);
}

#[test]
fn lights_hold_until_the_next_knot() {
    let scenario = scene("lane 1: 0,0 50,0\nlight 1 red: 40,0\nego vehicle 0: 0,0");
    let alternating: Script = |present, k| {
        let state = if k % 2 == 1 {
            LightState::Green
        } else {
            LightState::Red
        };
        let light = Light {
            state,
            ..present.lights()[0]
        };
        Frame::new(present.agents().to_vec(), vec![light])
    };
    let rollout = run(&scenario, alternating, &hermite());
    let colours: String = rollout.imagined()[..12]
        .iter()
        .map(|frame| {
            if frame.lights()[0].state == LightState::Red {
                'r'
            } else {
                'g'
            }
        })
        .collect();
    assert_eq!(colours, "rrrrgggggrrr");
}

#[test]
fn agents_keep_their_height_over_the_road() {
    let mut scenario = scene("ego vehicle 0: 0,0 velocity 10,0");
    // A ramp of 10 %: 200 points along x, z = x / 10.
    let xs: Vec<f64> = (-50..150).map(f64::from).collect();
    let mut parts = gump_scene::MapParts::default();
    parts.road_lines.push(gump_scene::RoadLine {
        id: 1,
        kind: gump_scene::RoadLineKind::Unknown,
        line: gump_geometry::Polyline::new(xs.iter().map(|&x| dvec2(x, 0.0)).collect()).unwrap(),
        elevation: xs.iter().map(|x| x / 10.0).collect(),
    });
    scenario.map = std::sync::Arc::new(gump_scene::MapGraph::new(parts).unwrap());
    let lifted = scenario.log.iter().map(|frame| {
        let agents = frame.agents().iter().map(|a| Agent {
            elevation: 0.8,
            ..*a
        });
        Frame::new(agents.collect(), vec![])
    });
    scenario.log = lifted.collect();
    let start = || Start {
        scene: scenario.present(),
        n_futures: 1,
        seed: Seed(0),
    };
    let rollouts = simulate(&ConstantVelocity, &[start()], None, &hermite()).unwrap();
    assert_abs_diff_eq!(rollouts[0].last().ego_now().elevation, 8.8, epsilon = 0.11);
    let flat = SimulateConfig {
        relative_elevation: false,
        ..hermite()
    };
    let rollouts = simulate(&ConstantVelocity, &[start()], None, &flat).unwrap();
    assert_eq!(rollouts[0].last().ego_now().elevation, 0.8);
}

/// Drives with one command forever and checks the scenes it gets.
struct Constant(Command);

impl Policy for Constant {
    fn name(&self) -> &str {
        "constant"
    }

    fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError> {
        for scene in scenes {
            assert_eq!(scene.dt, 0.5);
            // 1 s of history at 0.5 s and whatever was imagined since.
            assert!(scene.history.len() >= 3);
        }
        Ok(vec![self.0.clone(); scenes.len()])
    }
}

#[test]
fn the_policy_drives_the_ego_and_nobody_else() {
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 5,0
         agent vehicle 1: 20,4 velocity 4,0",
    );
    let still: Script = |present, _| present.clone();
    let mut policy = Constant(Command::Drive {
        acceleration: 1.0,
        curvature: 0.0,
    });
    let start = Start {
        scene: scenario.present(),
        n_futures: 3,
        seed: Seed(0),
    };
    let rollouts = simulate(&Scripted(still), &[start], Some(&mut policy), &hermite()).unwrap();
    assert_eq!(rollouts.len(), 3);
    for rollout in rollouts {
        let end = rollout.last();
        assert_abs_diff_eq!(end.ego_now().state.pose.position.x, 72.0, epsilon = 1e-9);
        assert_eq!(
            end.now().agent(AgentId(1)).unwrap().state.pose,
            Pose::new(20.0, 4.0, 0.0)
        );
    }
}

#[test]
fn a_policy_that_answers_wrongly_is_an_error() {
    struct Silent;
    impl Policy for Silent {
        fn name(&self) -> &str {
            "silent"
        }
        fn act(&mut self, _: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError> {
            Ok(vec![])
        }
    }
    let scenario = scene("ego vehicle 0: 0,0");
    let start = || Start {
        scene: scenario.present(),
        n_futures: 2,
        seed: Seed(0),
    };
    let message = |result: Result<Vec<Rollout>, BoxError>| result.unwrap_err().to_string();
    let silent = simulate(&ConstantVelocity, &[start()], Some(&mut Silent), &hermite());
    assert_eq!(message(silent), "the policy gave 0 answers for 2 futures");
    let never = SimulateConfig {
        seconds: f64::NAN,
        ..hermite()
    };
    let result = simulate(&ConstantVelocity, &[start()], None, &never);
    assert_eq!(
        message(result),
        "asked to simulate NaN s, expected a positive number of seconds"
    );
    let odd = scene("ego vehicle 0: 0,0\nhistory 0.9 future 0.9 dt 0.3");
    let start = Start {
        scene: odd.present(),
        n_futures: 1,
        seed: Seed(0),
    };
    let result = simulate(
        &Scripted(|present, _| present.clone()),
        &[start],
        None,
        &hermite(),
    );
    assert_eq!(
        message(result),
        "the world steps by 0.5 s, which is not a multiple of the scene's 0.3 s"
    );
}
