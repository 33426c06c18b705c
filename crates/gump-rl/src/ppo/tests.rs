//! Advantages by hand, gradients against finite differences, problems with known answers, and runs
//! that are resumed.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::BTreeMap;
use std::ops::ControlFlow;

use gump_scene::Seed;

use super::learner::{PpoLearner, Rows};
use super::round::{Lessons, Round, log_densities};
use super::*;
use crate::networks::{Mlp, Pass};
use crate::sac::test_envs::{Identity, Problem, Reach, Regulator, Toy};
use crate::sac::{ReplayBuffer, SacConfig, Transition};
use crate::{Actor, RlError};

fn config(rounds: usize) -> PpoConfig {
    PpoConfig {
        rounds,
        unroll: 16,
        batch: 64,
        hidden: vec![32, 32],
        learning_rate: 3e-3,
        discount: 0.9,
        critic_rounds: 2,
        segment: 4,
        ..PpoConfig::default()
    }
}

fn nothing<P: Problem>() -> ReplayBuffer {
    ReplayBuffer::new(1, P::form(), P::ACTION).unwrap()
}

fn learn<P: Problem>(problem: P, n: usize, config: PpoConfig) -> (PpoTraining, Toy<P>) {
    let mut env = Toy::new(problem, n);
    let mut training = PpoTraining::new(config, nothing::<P>(), Seed(3)).unwrap();
    while !training.is_done() {
        training
            .segment(&mut env, |_| ControlFlow::Continue(()))
            .unwrap();
    }
    (training, env)
}

/// A critic that says the one number that it observes.
fn echo() -> Mlp {
    Mlp::from_parameters(&[1, 1], vec![1.0, 0.0]).unwrap()
}

#[test]
fn advantages_by_hand() {
    // Two environments, three steps: the first goes on, the second is truncated after the first
    // step and terminates with the second.
    let round = Round {
        observations: vec![1.0, 2.0, 1.5, 4.0, 3.0, 0.5],
        actions: Vec::new(),
        log_densities: Vec::new(),
        rewards: vec![0.5, 1.0, 0.0, -2.0, 0.25, 0.0],
        nexts: vec![1.5, 9.0, 3.0, 9.0, 2.0, 1.0],
        terminated: vec![false, false, false, true, false, false],
        ended: vec![false, true, false, true, false, false],
    };
    let (discount, lambda) = (0.8, 0.5);
    let lessons = round.lessons(&echo(), 2, (discount, lambda));
    let decay = discount * lambda;
    let third = 0.25 + discount * 2.0 - 3.0;
    let second = 0.0 + discount * 3.0 - 1.5 + decay * third;
    let first = 0.5 + discount * 1.5 - 1.0 + decay * second;
    // The truncated one goes on as from where it acted last, the terminated one from nothing.
    let truncated = 1.0 + discount * 2.0 - 2.0;
    let terminated = -2.0 - 4.0;
    let last = 0.0 + discount * 1.0 - 0.5;
    let by_hand = [first, truncated, second, terminated, third, last];
    let values = [1.0, 2.0, 1.5, 4.0, 3.0, 0.5];
    for ((found, value), by_hand) in lessons.returns.iter().zip(values).zip(by_hand) {
        assert!((found - value - by_hand).abs() < 1e-6);
    }
    let mean = by_hand.iter().sum::<f64>() / 6.0;
    let sum: f64 = lessons.advantages.iter().sum();
    let squares: f64 = lessons.advantages.iter().map(|a| a * a).sum();
    assert!(sum.abs() < 1e-9 && (squares - 6.0).abs() < 1e-9);
    let variance = by_hand.iter().map(|a| (a - mean).powi(2)).sum::<f64>() / 6.0;
    for (found, by_hand) in lessons.advantages.iter().zip(by_hand) {
        assert!((found - (by_hand - mean) / variance.sqrt()).abs() < 1e-6);
    }
}

/// Of the actor's loss; the step of plain gradient descent shows its gradient.
#[test]
fn the_gradient_is_that_of_the_clipped_objective() {
    let config = PpoConfig {
        hidden: vec![8],
        entropy: 0.05,
        clip: 1e9,
        ..config(1)
    };
    let of_sac = SacConfig {
        hidden: config.hidden.clone(),
        log_std_bounds: config.log_std_bounds,
        ..SacConfig::default()
    };
    let actor = Actor::new(&of_sac, 2, 1, Seed(5));
    let observations = vec![0.3, -0.7, 1.1, 0.2, -0.4, 0.9, 0.6, 0.6];
    let actions = vec![0.2, -0.5, 0.7, 0.1];
    let densities = |actor: &Actor, observations: &[f32], actions: &[f32]| {
        let mut pass = Pass::default();
        actor.network.forward(observations, &mut pass);
        let outputs = pass.output().to_vec();
        (log_densities(actor, &outputs, actions), outputs)
    };
    let (now, _) = densities(&actor, &observations, &actions);
    // Ratios of 1.3, 0.7, 1 and 1.1: the first counts only with a disadvantage.
    let before = [1.3f64, 0.7, 1.0, 1.1].map(f64::ln);
    let round = Round {
        observations,
        actions,
        log_densities: now
            .iter()
            .zip(before)
            .map(|(d, change)| d - change)
            .collect(),
        rewards: vec![0.0; 4],
        nexts: Vec::new(),
        terminated: Vec::new(),
        ended: Vec::new(),
    };
    let lessons = Lessons {
        advantages: vec![0.8, 0.4, -1.2, -0.3],
        returns: vec![0.0; 4],
    };
    let expert = (vec![0.1f32, 0.5, -0.9, 0.4], vec![0.3f32, -0.2]);
    let loss = |actor: &Actor| {
        let (new, outputs) = densities(actor, &round.observations, &round.actions);
        let mut loss = 0.0;
        for i in 0..4 {
            let ratio = (new[i] - round.log_densities[i]).exp();
            let a = lessons.advantages[i];
            loss -= (ratio * a).min(ratio.clamp(0.8, 1.2) * a) / 4.0;
            let log_std = f64::from(outputs[2 * i + 1]);
            loss -= 0.05 * log_std / 4.0;
        }
        let (shown, _) = densities(actor, &expert.0, &expert.1);
        loss - 0.3 * shown.iter().sum::<f64>() / 2.0
    };
    let mut learner = PpoLearner::new(actor.clone(), echo());
    let indices = [0, 1, 2, 3];
    let rows = Rows {
        round: &round,
        lessons: &lessons,
        indices: &indices,
        expert: (&expert.0, &expert.1),
        imitation_weight: 0.3,
    };
    let mut update = PpoUpdate::default();
    let gradient = learner.actor_gradient(&rows, &config, &mut update).to_vec();
    assert_eq!(update.clipped, 0.25);
    // By the outputs, the gradient of imitation is proportional to its weight, that of rewards is
    // not affected by it.
    let mut doubled = PpoUpdate::default();
    let twice = Rows {
        imitation_weight: 0.6,
        ..rows
    };
    learner.actor_gradient(&twice, &config, &mut doubled);
    let ratio = doubled.imitation_gradient / update.imitation_gradient;
    assert!((ratio - 2.0).abs() < 1e-5, "{ratio}");
    assert!(update.reward_gradient > 0.0);
    assert_eq!(doubled.reward_gradient, update.reward_gradient);
    let h = 1e-3f32;
    for (k, found) in gradient.iter().enumerate() {
        let at = |by: f32| {
            let mut actor = actor.clone();
            actor.network.parameters_mut()[k] += by;
            loss(&actor)
        };
        let expected = (at(h) - at(-h)) / f64::from(2.0 * h);
        let error = (f64::from(*found) - expected).abs();
        assert!(
            error < 2e-3 * (1.0 + expected.abs()),
            "{k}: {found} {expected}"
        );
    }
}

#[test]
fn known_answers_are_found() {
    let (training, _) = learn(Identity, 32, config(60));
    let seen: Vec<f32> = (-8..=8).map(|i| i as f32 / 10.0).collect();
    let modes = training.actor().modes(&seen);
    let worst = seen.iter().zip(&modes).map(|(x, y)| (x - y).abs());
    let worst = worst.fold(0.0, f32::max);
    assert!(worst < 0.15, "{worst}");
    for (name, untrained, trained) in [
        {
            let (training, mut env) = learn(Reach, 32, config(80));
            let random = env.play(Seed(1), |_| vec![0.0; 32 * Reach::ACTION]);
            let learned = env.play(Seed(1), |seen| training.actor().modes(seen));
            ("reach", random, learned)
        },
        {
            let (training, mut env) = learn(Regulator, 32, config(80));
            let random = env.play(Seed(1), |_| vec![0.0; 32 * Regulator::ACTION]);
            let learned = env.play(Seed(1), |seen| training.actor().modes(seen));
            ("regulator", random, learned)
        },
    ] {
        assert!(trained > untrained, "{name}: {untrained} {trained}");
    }
}

/// Experts that act against the rewards are left behind, unless imitation is all that counts.
#[test]
fn rewards_correct_what_was_imitated() {
    let mut experts = ReplayBuffer::new(400, Identity::form(), Identity::ACTION).unwrap();
    for i in 0..400 {
        let x = (i % 17) as f32 / 10.0 - 0.8;
        experts.push(Transition {
            observation: [x][..].into(),
            action: &[0.5 * x],
            reward: 0.0,
            next: [x][..].into(),
            terminated: true,
        });
    }
    let gain = |rounds, imitation_weight| {
        let config = PpoConfig {
            imitation_steps: 600,
            imitation_weight,
            ..config(rounds)
        };
        let mut env = Toy::new(Identity, 32);
        let mut training = PpoTraining::new(config, experts.clone(), Seed(3)).unwrap();
        while !training.is_done() {
            training
                .segment(&mut env, |_| ControlFlow::Continue(()))
                .unwrap();
        }
        training.actor().modes(&[0.6])[0]
    };
    let (imitated, rewarded, held) = (gain(0, 0.0), gain(60, 0.0), gain(60, 30.0));
    assert!((imitated - 0.3).abs() < 0.1, "{imitated}");
    assert!((rewarded - 0.6).abs() < 0.15, "{rewarded}");
    assert!((held - 0.3).abs() < 0.1, "{held}");
}

#[test]
fn a_resumed_run_is_the_same_run() {
    let run = |stops: &[usize]| {
        let mut training = PpoTraining::new(config(12), nothing::<Reach>(), Seed(9)).unwrap();
        let mut reports = Vec::new();
        while !training.is_done() {
            let mut env = Toy::new(Reach, 4);
            let keep = |report| {
                reports.push(report);
                ControlFlow::Continue(())
            };
            training.segment(&mut env, keep).unwrap();
            if stops.contains(&training.rounds()) {
                let bytes = training.to_bytes(&BTreeMap::new()).unwrap();
                training = PpoTraining::from_bytes(&bytes).unwrap().0;
            }
        }
        (training.to_bytes(&BTreeMap::new()).unwrap(), reports)
    };
    let (whole, reports) = run(&[]);
    assert_eq!(reports.len(), 12);
    assert_eq!((whole, reports), run(&[4, 8]));
}

#[test]
fn another_run_goes_on_with_the_policy() {
    let (first, mut env) = learn(Reach, 8, config(8));
    let next = |config| PpoTraining::continuing(config, &first, nothing::<Reach>(), Seed(1));
    let mut on = next(config(4)).unwrap();
    let seen = [0.2f32; 64];
    let seen = &seen[..first.actor().observation_len()];
    assert_eq!(on.actor().modes(seen), first.actor().modes(seen));
    on.segment(&mut env, |_| ControlFlow::Continue(())).unwrap();
    assert_ne!(on.actor().modes(seen), first.actor().modes(seen));
    let wider = PpoConfig {
        hidden: vec![64, 64],
        ..config(4)
    };
    assert!(matches!(
        next(wider),
        Err(RlError::Parameter { name: "hidden", .. })
    ));
}

#[test]
fn observations_are_scaled_once() {
    let scale = |training: &PpoTraining| training.actor().normalizer().unwrap().clone();
    let (first, mut env) = learn(Reach, 8, config(4));
    assert!(!scale(&first).is_identity());
    let mut on = PpoTraining::continuing(config(4), &first, nothing::<Reach>(), Seed(1)).unwrap();
    on.segment(&mut env, |_| ControlFlow::Continue(())).unwrap();
    assert_eq!(scale(&on), scale(&first));
    // Experts that are not imitated before the first round.
    let mut experts = ReplayBuffer::new(1, Reach::form(), Reach::ACTION).unwrap();
    let seen = vec![0.5; Reach::form().len()];
    experts.push(Transition {
        observation: seen[..].into(),
        action: &[0.1; Reach::ACTION],
        reward: 0.0,
        next: seen[..].into(),
        terminated: true,
    });
    let without = PpoConfig {
        imitation_steps: 0,
        ..config(4)
    };
    let mut training = PpoTraining::new(without, experts, Seed(1)).unwrap();
    training
        .segment(&mut env, |_| ControlFlow::Continue(()))
        .unwrap();
    assert!(!scale(&training).is_identity());
}

#[test]
fn imitation_fades_if_asked_to() {
    let weight = |imitation_anneals, round| {
        let config = PpoConfig {
            imitation_weight: 0.2,
            imitation_anneals,
            ..config(10)
        };
        config.imitation_weight_of(round)
    };
    assert_eq!([0, 5, 10].map(|round| weight(false, round)), [0.2; 3]);
    assert_eq!([0, 5, 10].map(|round| weight(true, round)), [0.2, 0.1, 0.0]);
}

#[test]
fn numbers_out_of_range_are_named() {
    let check = |change: fn(&mut PpoConfig), expected: &str| {
        let mut config = PpoConfig::default();
        change(&mut config);
        let error = config.check().unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    };
    assert!(PpoConfig::default().check().is_ok());
    check(|c| c.batch = 0, "batch");
    check(|c| c.hidden = vec![], "hidden");
    check(|c| c.lambda = 1.5, "lambda is 1.5");
    check(|c| c.ratio = f64::NAN, "ratio");
    check(|c| c.imitation_weight = -1.0, "imitation_weight");
    check(|c| c.log_std_bounds = [1.0, -1.0], "log_std_bounds");
}
