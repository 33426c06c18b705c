//! Problems that must be solved, to answers that are known.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::ops::ControlFlow;

use gump_scene::Seed;

use super::replay_buffer::{ReplayBuffer, Transition};
use super::test_envs::{
    Bandit, Clock, Identity, Pendulum, Problem, Reach, Regulator, SeenReach, Toy,
};
use super::{SacConfig, StepReport, Training};
use crate::Algorithm;
use crate::networks::Architecture;

/// Small networks and large steps, as small problems want them.
fn config(steps: usize) -> SacConfig {
    SacConfig {
        steps,
        segment: steps,
        batch: 64,
        hidden: vec![32, 32],
        learning_rate: 1e-3,
        final_learning_rate: 1e-3,
        initial_steps: 256,
        replay_capacity: 20_000,
        actor_on_next: false,
        normalize: false,
        ..SacConfig::default()
    }
}

fn learn<P: Problem>(
    problem: P,
    n: usize,
    config: SacConfig,
) -> (Training, Toy<P>, Vec<StepReport>) {
    let mut env = Toy::new(problem, n);
    let nothing = ReplayBuffer::new(1, P::form(), P::ACTION).unwrap();
    let mut training = Training::new(Algorithm::Sac, config, nothing, Seed(7)).unwrap();
    let mut reports = Vec::new();
    while !training.is_done() {
        let keep = |report| {
            reports.push(report);
            ControlFlow::Continue(())
        };
        training.segment(&mut env, keep).unwrap();
    }
    (training, env, reports)
}

#[test]
fn the_identity_is_learned() {
    let config = SacConfig {
        learn_alpha: false,
        initial_log_alpha: 1e-3f64.ln(),
        ..config(2000)
    };
    let (training, ..) = learn(Identity, 8, config);
    let seen: Vec<f32> = (-8..=8).map(|i| i as f32 / 10.0).collect();
    for (seen, done) in seen.iter().zip(training.actor().modes(&seen)) {
        assert!((seen - done).abs() < 0.08, "{seen}: {done}");
    }
}

#[test]
fn the_origin_is_reached() {
    let (training, mut env, reports) = learn(Reach, 8, config(2500));
    // The straight way costs about 0.2 + 0.4 + ... from a mean distance of 0.77; staying, 15.
    let best = env.play(Seed(1), |seen| {
        seen.iter().map(|x| (-5.0 * x).clamp(-1.0, 1.0)).collect()
    });
    let learned = env.play(Seed(1), |seen| training.actor().modes(seen));
    assert!(learned > best - 0.5, "{learned} of {best}");
    let ended: usize = reports.iter().map(|r| r.episodes.len()).sum();
    let steps: usize = reports
        .iter()
        .flat_map(|r| &r.episodes)
        .map(|e| e.steps)
        .sum();
    assert_eq!(steps, 20 * ended);
}

#[test]
fn a_bandit_is_played_by_boltzmann() {
    // exp(-(a - 0.3)^2 / 0.02) is a Gaussian of standard deviation 0.1.
    let config = SacConfig {
        learn_alpha: false,
        initial_log_alpha: 0.02f64.ln(),
        batch: 128,
        ..config(4000)
    };
    let (training, ..) = learn(Bandit, 8, config);
    let drawn = training.actor().sample(&[1.0; 4000], &mut Seed(2).rng());
    let mean = drawn.iter().sum::<f32>() / 4000.0;
    let std = (drawn.iter().map(|a| (a - mean).powi(2)).sum::<f32>() / 4000.0).sqrt();
    assert!((mean - 0.3).abs() < 0.02, "mean {mean}");
    assert!((std - 0.1).abs() < 0.015, "std {std}");
}

#[test]
fn being_cut_off_is_no_end() {
    let check = |terminates: bool, expected: f32| {
        let config = SacConfig {
            learn_alpha: false,
            initial_log_alpha: -20.0,
            discount: 0.9,
            tau: 0.05,
            ..config(3000)
        };
        let (training, ..) = learn(
            Clock {
                reward: 1.0,
                terminates,
            },
            8,
            config,
        );
        let start = [if terminates { 0.0 } else { 1.0 }];
        for critic in training.learner().critics() {
            let value = critic.values(&start, &[0.0])[0];
            assert!(
                (value - expected).abs() < 0.05 * expected,
                "{value}, not {expected}"
            );
        }
    };
    check(false, 10.0);
    check(true, 4.0951);
}

#[test]
fn without_reward_the_temperature_falls_and_the_policy_spreads() {
    let (training, _, reports) = learn(
        Clock {
            reward: 0.0,
            terminates: false,
        },
        8,
        config(1000),
    );
    let log_alpha = training.learner().alpha().ln();
    assert!((log_alpha + 1.0).abs() < 0.1, "{log_alpha}");
    let entropy = reports.last().unwrap().update.entropy;
    assert!(entropy > 0.6 && entropy < 2f64.ln() + 0.05, "{entropy}");
}

#[test]
fn a_peaked_reward_holds_the_entropy_at_its_target() {
    // The bandit's reward is flat compared with a temperature of 1, and peaked with one of 0.001.
    let config = SacConfig {
        initial_log_alpha: 1e-3f64.ln(),
        learning_rate: 3e-3,
        final_learning_rate: 1e-3,
        ..config(4000)
    };
    let target = config.target_entropy;
    let (_, _, reports) = learn(Bandit, 8, config);
    let last = &reports[3500..];
    let entropy = last.iter().map(|r| r.update.entropy).sum::<f64>() / last.len() as f64;
    assert!((entropy - target).abs() < 0.1, "{entropy}");
}

#[test]
fn a_regulator_is_learned_to_its_gain() {
    let config = SacConfig {
        learn_alpha: false,
        initial_log_alpha: 1e-3f64.ln(),
        discount: 0.9,
        tau: 0.02,
        batch: 128,
        final_learning_rate: 2e-4,
        ..config(4000)
    };
    let (training, ..) = learn(Regulator, 8, config);
    // The fixed point of P = 1 + 0.9 P r / (r + 0.9 P), r = 0.1, is P = 1.0908, K = 0.9076.
    let done = training.actor().modes(&[-0.4, -0.2, 0.2, 0.4]);
    let gain = (done[0] + done[1] - done[2] - done[3]) / 1.2;
    assert!((gain - 0.9076).abs() < 0.09, "{gain}");
}

/// Mean return over 20 starts after so many steps of one environment.
#[test]
fn the_origin_is_reached_by_sight() {
    let config = SacConfig {
        encoder: Some(Architecture::SmallConv),
        ..config(1500)
    };
    let (training, mut env, _) = learn(SeenReach, 8, config);
    // Staying costs 15; a pixel is as wide as a step, so that the last one cannot be seen.
    let learned = env.play(Seed(1), |seen| training.actor().modes(seen));
    assert!(learned > -4.0, "{learned}");
    let blind = vec![0.0; 8 * SeenReach::OBSERVATION];
    let blind = env.play(Seed(1), |_| training.actor().modes(&blind));
    assert!(blind < learned - 4.0, "{blind}, {learned}");
}

fn swing_up(steps: usize, seed: u64) -> f64 {
    let config = SacConfig {
        batch: 64,
        hidden: vec![64, 64],
        initial_steps: 1000,
        learning_rate: 1e-3,
        final_learning_rate: 1e-3,
        normalize: true,
        ..config(steps - 1000)
    };
    let nothing = ReplayBuffer::new(1, 3, 1).unwrap();
    let mut training = Training::new(Algorithm::Sac, config, nothing, Seed(seed)).unwrap();
    let mut env = Toy::new(Pendulum, 1);
    training
        .segment(&mut env, |_| ControlFlow::Continue(()))
        .unwrap();
    assert_eq!(training.env_steps(), steps as u64);
    Toy::new(Pendulum, 20).play(Seed(99), |seen| training.actor().modes(seen))
}

#[test]
fn a_pendulum_is_swung_up_within_10_000_steps() {
    // Random torques earn about -1200, published models of Stable-Baselines3's SAC -174 to -185.
    let random = Toy::new(Pendulum, 20).play(Seed(99), |_| vec![0.0; 20]);
    assert!(random < -900.0, "{random}");
    let returns: Vec<f64> = (0..3).map(|seed| swing_up(10_000, seed)).collect();
    let solved = returns.iter().filter(|&&r| r >= -250.0).count();
    assert!(solved >= 2, "{returns:?}");
}

#[test]
fn experts_are_imitated() {
    // An expert that does half of what it sees, with some noise.
    let mut expert = ReplayBuffer::new(500, 1, 1).unwrap();
    let mut rng = Seed(3).rng();
    for i in 0..500 {
        let seen = i as f32 / 250.0 - 1.0;
        let noise = 0.05 * gump_scene::standard_normal(&mut rng) as f32;
        expert.push(Transition {
            observation: (&[seen]).into(),
            action: &[(0.5 * seen + noise).clamp(-1.0, 1.0)],
            reward: 0.0,
            next: (&[seen]).into(),
            terminated: true,
        });
    }
    let config = SacConfig {
        normalize: true,
        ..config(2000)
    };
    let mut training = Training::new(Algorithm::Imitation, config, expert, Seed(5)).unwrap();
    let mut losses = Vec::new();
    let keep = |report: StepReport| {
        losses.push(report.update.imitation_loss);
        ControlFlow::Continue(())
    };
    training.imitation_segment(keep).unwrap();
    assert!(training.is_done());
    for seen in [-0.8f32, 0.0, 0.6] {
        let done = training.actor().modes(&[seen])[0];
        assert!((done - 0.5 * seen).abs() < 0.05, "{seen}: {done}");
    }
    // The entropy of noise of 0.05 is -1.58 nats, the least loss that there is.
    let last = losses[1900..].iter().sum::<f64>() / 100.0;
    assert!((-1.8..-1.3).contains(&last), "{last}");
}

#[test]
fn a_share_of_experts_pulls_towards_them() {
    // The bandit pays for 0.3; the expert insists on -0.5 and is heavier.
    let mut expert = ReplayBuffer::new(1, 1, 1).unwrap();
    expert.push(Transition {
        observation: (&[1.0]).into(),
        action: &[-0.5],
        reward: -0.64,
        next: (&[1.0]).into(),
        terminated: true,
    });
    let config = SacConfig {
        imitation_weight: 10.0,
        log_std_bounds: [-3.0, 2.0],
        ..config(1500)
    };
    let mut training = Training::new(Algorithm::Sac, config, expert, Seed(5)).unwrap();
    let mut env = Toy::new(Bandit, 8);
    training
        .segment(&mut env, |_| ControlFlow::Continue(()))
        .unwrap();
    let done = training.actor().modes(&[1.0])[0];
    assert!((done + 0.5).abs() < 0.1, "{done}");
}
