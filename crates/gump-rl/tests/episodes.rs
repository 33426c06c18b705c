//! Episodes in rule-based worlds, by hand.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::atomic::{AtomicBool, Ordering};

use gump_metrics::{Reward, Speed};
use gump_rollout::worlds::{ConstantVelocity, Idm, LogReplay};
use gump_rollout::{BoxError, RolloutError, Session, Start, WorldModel};
use gump_scene::{AgentId, AgentState, Frame, Scenario, Seed, fixture};

use gump_rl::{Action, End, Env, EnvConfig, Failure, Observation, RlError, Step};

const STREET: &str = "lane 1: 0,0 400,0 speed 15\nroute 1\nego vehicle 0: 10,0 velocity 10,0\n";
const COAST: Action = Action {
    acceleration: 0.0,
    curvature: 0.0,
};

fn scenes(others: &str) -> [Scenario; 1] {
    [fixture::scenario(&format!("{STREET}{others}")).unwrap()]
}

fn env<'w>(world: &'w dyn WorldModel, scenarios: &'w [Scenario], n_slots: usize) -> Env<'w> {
    let config = EnvConfig {
        n_slots,
        ..EnvConfig::default()
    };
    Env::new(world, scenarios, config).unwrap()
}

/// Drives all slots by one action until the first one ends; how many steps that took, and how.
fn until_end(env: &mut Env<'_>, action: Action) -> (usize, Vec<Step>) {
    env.reset(Seed(0)).unwrap();
    for n in 1..1000 {
        let steps = env.step(&vec![action; env.config().n_slots]).unwrap();
        if steps[0].end.is_some() {
            return (n, steps);
        }
    }
    panic!("no end");
}

#[test]
fn a_free_road_is_driven_to_the_horizon() {
    let scenarios = scenes("");
    let replay = LogReplay::new(&scenarios[0]);
    for world in [&ConstantVelocity as &dyn WorldModel, &replay] {
        let mut env = env(world, &scenarios, 3);
        let first = env.reset(Seed(0)).unwrap();
        let (n, steps) = until_end(&mut env, COAST);
        assert_eq!(n, 80);
        for (step, first) in steps.iter().zip(&first) {
            assert_eq!(step.end, Some(End::Truncated));
            // 1 m of progress in comfort.
            assert!((step.reward - 0.1).abs() < 1e-9);
            // The last observation of the old episode, the first of the new one.
            assert_eq!(step.restart.as_ref(), Some(first));
            assert_eq!(step.next_observation(), first);
        }
        // The new episode is in progress.
        let next = env.step(&[COAST; 3]).unwrap();
        assert!(next.iter().all(|step| step.end.is_none()));
        assert_eq!(env.episode(0).unwrap().steps(), 1);
    }
}

#[test]
fn a_collision_terminates() {
    let scenarios = scenes("agent vehicle 1: 34.85,0");
    let mut env = env(&ConstantVelocity, &scenarios, 1);
    let (n, steps) = until_end(&mut env, COAST);
    // 20.05 m of free road at 1 m per step.
    assert_eq!(n, 21);
    assert_eq!(steps[0].end, Some(End::Terminated(Failure::Collision)));
    assert!((steps[0].reward - (0.1 - 5.0)).abs() < 1e-9);
    // What ended is still described: the other's centre is 4.8 m less 0.95 m ahead.
    let gap = steps[0].observation.values()[25];
    assert!((gap - 3.85).abs() < 1e-4, "{gap}");
}

#[test]
fn leaving_the_road_terminates() {
    let scenarios = scenes("edge: -10,-3 400,-3\nedge: 400,3 -10,3");
    let mut env = env(&ConstantVelocity, &scenarios, 1);
    let turn = Action {
        curvature: 0.1,
        ..COAST
    };
    let (n, steps) = until_end(&mut env, turn);
    assert_eq!(steps[0].end, Some(End::Terminated(Failure::OffRoad)));
    assert!(n < 10, "{n}");
}

#[test]
fn the_end_of_the_route_truncates() {
    let text = "lane 1: 0,0 30,0\nroute 1\nego vehicle 0: 10,0 velocity 10,0";
    let scenarios = [fixture::scenario(text).unwrap()];
    let mut env = env(&ConstantVelocity, &scenarios, 1);
    let (n, steps) = until_end(&mut env, COAST);
    assert!((20..=21).contains(&n), "{n}");
    assert_eq!(steps[0].end, Some(End::Truncated));
}

/// Three roads, agents that choose at forks, starts drawn at random.
fn busy() -> Vec<Scenario> {
    let fork = "lane 1: 0,0 60,0 speed 12 next 2,3\n lane 2: 60,0 90,10 200,60\n
        lane 3: 60,0 300,0\n ego vehicle 0: 10,0 velocity 8,0\n";
    [
        "40,0 velocity 8,0",
        "30,0 velocity 5,0",
        "55,0 velocity 10,0",
    ]
    .map(|other| fixture::scenario(&format!("{fork} agent vehicle 1: {other}")).unwrap())
    .to_vec()
}

/// What all slots see over 120 steps, as `[step][slot]`, each slot driven by its own action.
fn history(n_slots: usize, seed: u64, action: impl Fn(usize) -> Action) -> Vec<Vec<Step>> {
    let (world, scenarios) = (Idm::default(), busy());
    let mut env = env(&world, &scenarios, n_slots);
    env.reset(Seed(seed)).unwrap();
    let actions: Vec<Action> = (0..n_slots).map(action).collect();
    (0..120).map(|_| env.step(&actions).unwrap()).collect()
}

#[test]
fn the_same_seed_gives_the_same_episodes() {
    assert_eq!(history(4, 1, |_| COAST), history(4, 1, |_| COAST));
    assert_ne!(history(4, 1, |_| COAST), history(4, 2, |_| COAST));
}

#[test]
fn a_slot_does_not_notice_its_neighbours() {
    let wild = Action {
        acceleration: 2.0,
        curvature: 0.0,
    };
    let calm = history(3, 5, |_| COAST);
    let mixed = history(4, 5, |slot| if slot == 0 { wild } else { COAST });
    let n_ends = |history: &[Vec<Step>], slot: usize| {
        let ended = history.iter().filter(|steps| steps[slot].end.is_some());
        ended.count()
    };
    // The wild slot is replaced more often, which the others must not feel.
    assert!(n_ends(&mixed, 0) > n_ends(&calm, 0));
    for (calm, mixed) in calm.iter().zip(&mixed) {
        assert_eq!(calm[1..], mixed[1..3]);
    }
}

#[test]
fn starts_are_drawn_afresh_for_every_episode() {
    let steps = history(1, 3, |_| Action {
        acceleration: 2.4,
        ..COAST
    });
    let restarts: Vec<&Observation> = steps.iter().filter_map(|s| s[0].restart.as_ref()).collect();
    assert!(restarts.windows(2).any(|pair| pair[0] != pair[1]));
}

#[test]
fn actions_beyond_the_limits_are_clipped_and_counted() {
    let scenarios = scenes("");
    let mut env = env(&ConstantVelocity, &scenarios, 2);
    env.reset(Seed(0)).unwrap();
    let beyond = Action {
        acceleration: 100.0,
        curvature: 0.0,
    };
    env.step(&[beyond, COAST]).unwrap();
    assert_eq!(env.clipped(), 1);
    let speed = |slot: usize| env.episode(slot).unwrap().last().ego_now().state.speed();
    assert!((speed(0) - 10.24).abs() < 1e-9 && speed(1) == 10.0);
    env.reset(Seed(0)).unwrap();
    assert_eq!(env.clipped(), 0);
}

#[test]
fn refused_actions_change_nothing() {
    let scenarios = scenes("");
    let (mut env, mut untouched) = (
        env(&ConstantVelocity, &scenarios, 2),
        env(&ConstantVelocity, &scenarios, 2),
    );
    assert!(matches!(env.step(&[COAST; 2]), Err(RlError::NotReset)));
    env.reset(Seed(0)).unwrap();
    untouched.reset(Seed(0)).unwrap();
    let error = env.step(&[COAST; 3]).unwrap_err();
    assert!(matches!(
        error,
        RlError::Count {
            expected: 2,
            found: 3,
            ..
        }
    ));
    let nan = Action {
        curvature: f64::NAN,
        ..COAST
    };
    let error = env.step(&[COAST, nan]).unwrap_err();
    assert!(matches!(error, RlError::NotFinite { slot: 1 }));
    let steps = env.step(&[COAST; 2]).unwrap();
    assert_eq!(steps, untouched.step(&[COAST; 2]).unwrap());
}

#[test]
fn parameters_out_of_range_are_refused() {
    let scenarios = scenes("");
    let check = |config: EnvConfig| {
        let found = Env::new(&ConstantVelocity, &scenarios, config);
        assert!(matches!(found.err(), Some(RlError::Parameter { .. })));
    };
    let config = EnvConfig::default;
    check(EnvConfig {
        n_slots: 0,
        ..config()
    });
    check(EnvConfig {
        horizon: f64::NAN,
        ..config()
    });
    let none = Env::new(&ConstantVelocity, &[], config());
    assert!(matches!(none.err(), Some(RlError::NoScenario)));
}

/// Constant velocity in steps of 0.5 s, which breaks when told to.
#[derive(Default)]
struct Slow {
    stride: usize,
    broken: AtomicBool,
    drops_ego: AtomicBool,
}

struct SlowSession<'a>(Box<dyn Session + 'a>, &'a Slow);

impl WorldModel for Slow {
    fn name(&self) -> &str {
        "slow"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        Ok(Box::new(SlowSession(ConstantVelocity.open(starts)?, self)))
    }
}

impl Session for SlowSession<'_> {
    fn dt(&self) -> f64 {
        self.0.dt() * self.1.stride as f64
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        if self.1.broken.load(Ordering::Relaxed) {
            return Err(RolloutError::Duration(0.0).into());
        }
        for _ in 1..self.1.stride {
            self.0.step(None)?;
        }
        let mut frames = self.0.step(ego)?;
        if self.1.drops_ego.load(Ordering::Relaxed) {
            frames.fill(Frame::default());
        }
        Ok(frames)
    }

    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
        self.0.replace(future, start)
    }
}

#[test]
fn a_step_is_a_step_of_the_world() {
    let scenarios = scenes("agent vehicle 1: 60,0 velocity 12,0");
    let world = Slow {
        stride: 5,
        ..Slow::default()
    };
    let mut env = env(&world, &scenarios, 2).with_reward(Reward::new().term(1.0, Speed));
    env.reset(Seed(0)).unwrap();
    // A second of history at the rate of the world.
    let start = env.episode(1).unwrap();
    assert_eq!((start.history().len(), start.dt()), (3, 0.5));
    let (n, steps) = until_end(&mut env, COAST);
    assert_eq!(n, 16);
    assert_eq!(
        (steps[1].end, steps[1].reward),
        (Some(End::Truncated), 10.0)
    );
    env.reset(Seed(0)).unwrap();
    env.step(&[COAST; 2]).unwrap();
    let frame = env.episode(0).unwrap().last().now();
    let x = |id: i64| frame.agent(AgentId(id)).unwrap().state.pose.position.x;
    assert!((x(0) - 15.0).abs() < 1e-9 && (x(1) - 66.0).abs() < 1e-9);
}

#[test]
fn failures_of_the_world_are_reported() {
    let scenarios = scenes("");
    let world = Slow {
        stride: 1,
        ..Slow::default()
    };
    let mut env_ = env(&world, &scenarios, 2);
    env_.reset(Seed(0)).unwrap();
    world.broken.store(true, Ordering::Relaxed);
    let error = env_.step(&[COAST; 2]).unwrap_err();
    assert!(matches!(error, RlError::World { ref world, .. } if world == "slow"));
    // Nobody knows what a session is worth after that.
    assert!(matches!(env_.step(&[COAST; 2]), Err(RlError::NotReset)));
    world.broken.store(false, Ordering::Relaxed);
    world.drops_ego.store(true, Ordering::Relaxed);
    env_.reset(Seed(0)).unwrap();
    let error = env_.step(&[COAST; 2]).unwrap_err();
    assert!(matches!(error, RlError::EgoVanished { slot: 0, .. }));

    let frozen = Slow::default();
    let error = env(&frozen, &scenarios, 2).reset(Seed(0)).unwrap_err();
    assert!(matches!(error, RlError::TimeStep { session: 0.0, .. }));
}
