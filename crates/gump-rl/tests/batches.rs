//! Episodes in a batch do not affect each other.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use common::{Transition, busy, config, env, part, roam, street, wander};
use gump_rl::{
    Autoreset, DrivingEnv, EnvConfig, ObservationSpec, PreparedScenario, RasterView, RlError,
    Sampling, TrafficSource, VectorEnv, expand,
};
use gump_rollout::worlds::{ConstantVelocity, Idm, LogReplay};
use gump_rollout::{BoxError, RolloutError, Session, Start, WorldModel};
use gump_scene::{AgentState, Frame, Seed};

fn with_mode<'w>(
    prepared: &Arc<[PreparedScenario]>,
    traffic: TrafficSource<'w>,
    mode: Autoreset,
) -> DrivingEnv<'w> {
    let config = EnvConfig {
        autoreset: mode,
        ..config(4)
    };
    DrivingEnv::new(Arc::clone(prepared), traffic, config).unwrap()
}

/// Each row acts by its own count of transitions, so that waiting rows act no differently.
fn transitions(env: &mut DrivingEnv<'_>, n: usize) -> Vec<Vec<Transition>> {
    env.reset(Seed(5)).unwrap();
    let rows = env.n_envs();
    let mut history: Vec<Vec<Transition>> = vec![Vec::new(); rows];
    let mode = env.config().autoreset;
    while history.iter().any(|history| history.len() < n) {
        let before = env.observations().to_vec();
        let actions: Vec<Vec<f32>> = (0..rows)
            .map(|row| wander(row, history[row].len() as u64, 2))
            .collect();
        env.step(&actions.concat()).unwrap();
        for row in 0..rows {
            if env.restarted()[row] && mode == Autoreset::NextStep {
                assert_eq!(env.rewards()[row], 0.0);
                assert!(!env.terminated()[row] && !env.truncated()[row]);
                continue;
            }
            history[row].push(Transition {
                before: part(&before, row, rows),
                action: actions[row].clone(),
                reward: env.rewards()[row],
                after: part(env.final_observations(), row, rows),
                terminated: env.terminated()[row],
                truncated: env.truncated()[row],
            });
        }
        if mode == Autoreset::Disabled {
            let over = |row: &usize| env.episode(*row).unwrap().1.end.is_some();
            let mask: Vec<bool> = (0..rows).map(|row| over(&row)).collect();
            let untouched: Vec<f32> = part(env.observations(), 0, rows);
            env.reset_rows(&mask, None).unwrap();
            if !mask[0] {
                assert_eq!(part(env.observations(), 0, rows), untouched);
            }
        }
    }
    for history in &mut history {
        history.truncate(n);
    }
    history
}

#[test]
fn transitions_are_the_same_in_all_autoreset_modes() {
    let prepared = busy(6);
    let idm = Idm::default();
    for traffic in [TrafficSource::Log, TrafficSource::World(&idm)] {
        let of = |mode| transitions(&mut with_mode(&prepared, traffic, mode), 40);
        let same_step = of(Autoreset::SameStep);
        assert_eq!(same_step, of(Autoreset::NextStep));
        assert_eq!(same_step, of(Autoreset::Disabled));
        let all = || same_step.iter().flatten();
        assert!(all().any(|t| t.terminated) && all().any(|t| t.truncated));
        assert!(all().all(|t| !(t.terminated && t.truncated)));
    }
}

#[test]
fn the_same_seed_gives_the_same_episodes() {
    let prepared = busy(6);
    let idm = Idm::default();
    for traffic in [TrafficSource::Log, TrafficSource::World(&idm)] {
        let of = |seed| roam(&mut env(&prepared, traffic, 3), Seed(seed), 30);
        assert_eq!(of(1), of(1));
        assert_ne!(of(1), of(2));
    }
}

#[test]
fn a_row_does_not_notice_its_neighbours() {
    let prepared = busy(6);
    let idm = Idm::default();
    for traffic in [TrafficSource::Log, TrafficSource::World(&idm)] {
        let few = roam(&mut env(&prepared, traffic, 2), Seed(1), 40);
        let many = roam(&mut env(&prepared, traffic, 5), Seed(1), 40);
        assert_eq!(few[..], many[..2]);
    }
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let prepared = busy(6);
    let idm = Idm::default();
    let raster = ObservationSpec::Raster(RasterView::default());
    for traffic in [TrafficSource::Log, TrafficSource::World(&idm)] {
        for observation in [ObservationSpec::default(), raster] {
            let with_threads = |n: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(n);
                let run = || {
                    let config = EnvConfig {
                        observation,
                        sampling: Sampling::prioritized(),
                        ..config(20)
                    };
                    let mut env = DrivingEnv::new(prepared.clone(), traffic, config).unwrap();
                    roam(&mut env, Seed(2), 12)
                };
                pool.build().unwrap().install(run)
            };
            assert!(with_threads(1) == with_threads(4));
        }
    }
}

#[test]
fn agents_far_away_follow_the_log() {
    let prepared = busy(6);
    let idm = Idm::default();
    let of = |nearest| {
        let config = EnvConfig {
            nearest,
            ..config(3)
        };
        let mut env =
            DrivingEnv::new(prepared.clone(), TrafficSource::World(&idm), config).unwrap();
        roam(&mut env, Seed(1), 40)
    };
    let all = of(None);
    assert_eq!(all, of(Some(1000)));
    assert_ne!(all, of(Some(2)));
    assert_eq!(of(Some(2)), of(Some(2)));
}

/// Replaying the log needs no session; a session that replays it gives the same motion.
#[test]
fn the_log_is_the_world_that_replays_it() {
    for one in busy(4).iter() {
        let prepared = PreparedScenario::prepare([one.scenario().clone()], one.dt()).unwrap();
        let replay = LogReplay::new(one.scenario());
        let fast = roam(&mut env(&prepared, TrafficSource::Log, 2), Seed(1), 30);
        let slow = roam(
            &mut env(&prepared, TrafficSource::World(&replay), 2),
            Seed(1),
            30,
        );
        assert_eq!(fast, slow);
    }
}

#[test]
fn an_episode_can_be_driven_again() {
    let prepared = busy(6);
    let idm = Idm::default();
    let mut original = env(&prepared, TrafficSource::World(&idm), 3);
    original.reset(Seed(8)).unwrap();
    // The second episode of row 1, with the actions it took.
    let mut actions = Vec::new();
    let mut n_ended = 0;
    let outcome = (0..)
        .find_map(|step| {
            let all: Vec<Vec<f32>> = (0..3).map(|row| wander(row, step, 2)).collect();
            actions.push(all[1].clone());
            original.step(&all.concat()).unwrap();
            let ended = original.finished().iter().find(|(row, _)| *row == 1)?.1;
            n_ended += 1;
            if n_ended == 1 {
                actions.clear();
            }
            (n_ended == 2).then_some(ended)
        })
        .unwrap();
    let mut again = env(&prepared, TrafficSource::World(&idm), 1);
    again.reset_to(&[outcome.start]).unwrap();
    for action in &actions {
        assert!(again.finished().is_empty());
        again.step(action).unwrap();
    }
    assert_eq!(again.finished(), [(0, outcome)]);
}

#[test]
fn rasters_are_what_their_bits_say() {
    let config = EnvConfig {
        observation: ObservationSpec::Raster(RasterView::default()),
        ..config(4)
    };
    let mut env = DrivingEnv::new(busy(3), TrafficSource::Log, config).unwrap();
    roam(&mut env, Seed(1), 17);
    let check = |packed: &[u8], numbers: &[f32]| {
        let mut expected = vec![f32::NAN; numbers.len()];
        expand(packed, &mut expected);
        assert_eq!(numbers, expected);
        assert!(numbers.contains(&0.0) && numbers.contains(&1.0));
    };
    check(env.packed_observations(), env.observations());
    check(env.packed_final_observations(), env.final_observations());
    assert_eq!(env.packed_observations().len(), 4 * 4096);
}

#[test]
fn refused_actions_change_nothing() {
    let prepared = street("");
    let (mut env, mut untouched) = (
        with_mode(&prepared, TrafficSource::Log, Autoreset::Disabled),
        with_mode(&prepared, TrafficSource::Log, Autoreset::Disabled),
    );
    assert!(matches!(env.step(&[0.0; 8]), Err(RlError::NotReset)));
    assert!(matches!(
        env.reset_rows(&[true; 4], None),
        Err(RlError::NotReset)
    ));
    env.reset(Seed(0)).unwrap();
    untouched.reset(Seed(0)).unwrap();
    let mut refuse = |actions: &[f32]| env.step(actions).unwrap_err();
    assert!(matches!(
        refuse(&[0.0; 7]),
        RlError::Count {
            expected: 8,
            found: 7,
            ..
        }
    ));
    let mut bad = [0.0; 8];
    bad[5] = f32::INFINITY;
    assert!(matches!(refuse(&bad), RlError::NotFinite { row: 2 }));
    bad[5] = 1.01;
    assert!(matches!(
        refuse(&bad),
        RlError::OutOfRange {
            row: 2,
            dimension: 1,
            ..
        }
    ));
    env.step(&[0.0; 8]).unwrap();
    untouched.step(&[0.0; 8]).unwrap();
    assert_eq!(env.observations(), untouched.observations());
}

#[test]
fn a_finished_row_is_not_stepped() {
    let mut env = with_mode(&street(""), TrafficSource::Log, Autoreset::Disabled);
    env.reset(Seed(0)).unwrap();
    for _ in 0..16 {
        env.step(&[0.0; 8]).unwrap();
    }
    assert_eq!(env.finished().len(), 4);
    env.reset_rows(&[true, false, true, true], None).unwrap();
    assert_eq!(env.restarted(), [true, false, true, true]);
    let error = env.step(&[0.0; 8]).unwrap_err();
    assert!(matches!(error, RlError::Finished { row: 1 }));
    env.reset_rows(&[false, true, false, false], Some(&[Seed(1); 4]))
        .unwrap();
    env.step(&[0.0; 8]).unwrap();
    let error = env.reset_rows(&[true; 3], None).unwrap_err();
    assert!(matches!(error, RlError::Count { found: 3, .. }));
}

/// Constant velocity; fails on request.
#[derive(Default)]
struct Fragile {
    broken: AtomicBool,
    drops_ego: AtomicBool,
    dt: Option<f64>,
}

struct FragileSession<'a>(Box<dyn Session + 'a>, &'a Fragile);

impl WorldModel for Fragile {
    fn name(&self) -> &str {
        "fragile"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let session = ConstantVelocity.open(starts)?;
        Ok(Box::new(FragileSession(session, self)))
    }
}

impl Session for FragileSession<'_> {
    fn dt(&self) -> f64 {
        self.1.dt.unwrap_or(self.0.dt())
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        if self.1.broken.load(Ordering::Relaxed) {
            return Err(RolloutError::Duration(0.0).into());
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
fn failures_of_the_world_are_reported() {
    let prepared = street("");
    let world = Fragile::default();
    let mut fragile = env(&prepared, TrafficSource::World(&world), 2);
    fragile.reset(Seed(0)).unwrap();
    world.broken.store(true, Ordering::Relaxed);
    let error = fragile.step(&[0.0; 4]).unwrap_err();
    assert!(matches!(error, RlError::World { ref world, .. } if world == "fragile"));
    // The state of the session is unknown after that.
    assert!(matches!(fragile.step(&[0.0; 4]), Err(RlError::NotReset)));
    world.broken.store(false, Ordering::Relaxed);
    world.drops_ego.store(true, Ordering::Relaxed);
    fragile.reset(Seed(0)).unwrap();
    let error = fragile.step(&[0.0; 4]).unwrap_err();
    assert!(matches!(error, RlError::EgoVanished { row: 0, .. }));

    let odd = Fragile {
        dt: Some(0.3),
        ..Fragile::default()
    };
    let error = env(&prepared, TrafficSource::World(&odd), 2).reset(Seed(0));
    assert!(matches!(error, Err(RlError::TimeStep { frames: 0.3, .. })));
}
