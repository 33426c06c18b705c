//! Gradient steps against hand-computed numbers and finite differences; runs that are resumed.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::BTreeMap;
use std::ops::ControlFlow;

use gump_scene::Seed;

use super::replay_buffer::{ReplayBuffer, Transition};
use super::test_envs::{Clock, Reach, Toy};
use super::{Batch, Learner, SacConfig, StepReport, Training};
use crate::Algorithm;
use crate::networks::Normalizer;
use crate::{Actor, RlError, VectorEnv};

fn config() -> SacConfig {
    SacConfig {
        steps: 60,
        segment: 20,
        batch: 10,
        hidden: vec![16, 16],
        initial_steps: 30,
        ..SacConfig::default()
    }
}

/// Three transitions of a learner, an end, a time-out and an ordinary one, and an expert's.
fn batch(n_imitated: usize) -> Batch {
    let n = 3 + n_imitated;
    Batch {
        observations: vec![0.4, -0.2, 0.1, 0.9, -0.7, 0.3, 0.2, 0.2][..2 * n].to_vec(),
        actions: vec![0.5, -0.6, 0.1, 0.3][..n].to_vec(),
        rewards: vec![-5.0, 1.0, 0.5, 0.7][..n].to_vec(),
        nexts: vec![0.3, 0.1, -0.4, 0.5, 0.8, -0.1, 0.0, 0.6][..2 * n].to_vec(),
        terminated: vec![true, false, false, false][..n].to_vec(),
        n_imitated,
    }
}

/// A learner whose networks give constants: actor (0, 0), critics 0, targets `values`.
fn constant(config: SacConfig, values: [f32; 2]) -> Learner {
    let mut learner = Learner::new(config, 2, 1, Seed(0));
    learner.actor.network.parameters_mut().fill(0.0);
    for (critic, value) in learner.critics.iter_mut().zip(values) {
        critic.online.parameters_mut().fill(0.0);
        critic.target.parameters_mut().fill(0.0);
        *critic.target.parameters_mut().last_mut().unwrap() = value;
    }
    learner
}

#[test]
fn a_critic_loss_by_hand() {
    let check = |values: [f32; 2], entropy_in_target: bool, expected: f64| {
        let config = SacConfig {
            discount: 0.9,
            entropy_in_target,
            initial_log_alpha: 0.5f64.ln(),
            ..config()
        };
        let report = constant(config, values).update(&batch(0), Seed(1));
        let error = (report.critic_loss - expected).abs();
        assert!(error < 1e-4, "{}, {expected}", report.critic_loss);
    };
    // Targets -5, 1 + 0.9 * 2 and 0.5 + 0.9 * 2, for two critics that say 0.
    let by_hand = 2.0 * (25.0 + 2.8 * 2.8 + 2.3 * 2.3) / 3.0;
    check([3.0, 2.0], false, by_hand);
    check([2.0, 3.0], false, by_hand);
    // The entropy of the drawn actions is worth half its nats.
    let noise = |row: usize| {
        let mut rng = Seed(1).fork(1).rng();
        let drawn: Vec<f64> = (0..3)
            .map(|_| gump_scene::standard_normal(&mut rng))
            .collect();
        drawn[row]
    };
    let log_density = |row: usize| {
        let u = noise(row);
        let normal = -0.5 * u * u - 0.5 * std::f64::consts::TAU.ln();
        normal - (1.0 - u.tanh().powi(2)).ln()
    };
    let target = |row: usize, reward: f64| reward + 0.9 * (2.0 - 0.5 * log_density(row));
    let by_hand = 2.0 * (25.0 + target(1, 1.0).powi(2) + target(2, 0.5).powi(2)) / 3.0;
    check([2.0, 3.0], true, by_hand);
}

#[test]
fn the_actor_trusts_the_lower_critic() {
    let mut learner = constant(
        SacConfig {
            actor_on_next: false,
            ..config()
        },
        [0.0, 0.0],
    );
    *learner.critics[0]
        .online
        .parameters_mut()
        .last_mut()
        .unwrap() = 4.0;
    *learner.critics[1]
        .online
        .parameters_mut()
        .last_mut()
        .unwrap() = -1.5;
    let report = learner.update(&batch(0), Seed(1));
    // alpha is 1: the loss is minus entropy minus value.
    assert!((report.actor_loss - (-report.entropy + 1.5)).abs() < 1e-6);
    assert_eq!(report.value, 4.0);
}

#[test]
fn entropy_above_its_target_lowers_the_temperature() {
    let check = |target_entropy: f64, falls: bool| {
        let config = SacConfig {
            target_entropy,
            ..config()
        };
        let mut learner = Learner::new(config, 2, 1, Seed(0));
        let before = learner.alpha();
        learner.update(&batch(0), Seed(1));
        assert_eq!(learner.alpha() < before, falls);
    };
    check(-1.6, true);
    check(2.0, false);
}

#[test]
fn targets_move_once_per_period() {
    let config = SacConfig {
        target_period: 2,
        ..config()
    };
    let mut learner = Learner::new(config, 2, 1, Seed(0));
    let mut before = learner.critics[0].target.clone();
    for moves in [false, true, false, true] {
        learner.update(&batch(0), Seed(1));
        let after = learner.critics[0].target.clone();
        assert_eq!(after != before, moves);
        before = after;
    }
}

/// Checks a gradient against finite differences of the loss, by one parameter in `every`. At a kink
/// of ReLU the two sides disagree and the gradient lies between them; the few with a large
/// disagreement are left out.
pub(super) fn check_gradient(found: &[f32], every: usize, loss: impl Fn(usize, f32) -> f64) {
    let h = 2e-3f32;
    let middle = loss(0, 0.0);
    let (mut checked, mut kinks) = (0, 0);
    for (i, &found) in found.iter().enumerate().step_by(every) {
        let (up, down) = (loss(i, h), loss(i, -h));
        let [right, left] = [up - middle, middle - down].map(|d| d / f64::from(h));
        if (right - left).abs() > 0.02 * (1.0 + right.abs()) {
            kinks += 1;
            continue;
        }
        let expected = (right + left) / 2.0;
        let error = (f64::from(found) - expected).abs();
        assert!(
            error < 5e-3 * (1.0 + expected.abs()) + (right - left).abs() / 2.0,
            "{i}: {found}, {expected}"
        );
        checked += 1;
    }
    assert!(kinks * 10 < checked, "{kinks} kinks, {checked} checked");
}

#[test]
fn gradients_of_all_losses_are_finite_differences() {
    for actor_on_next in [false, true] {
        let config = SacConfig {
            actor_on_next,
            imitation_weight: 0.7,
            initial_log_alpha: -1.0,
            head_gain: 1.0,
            ..config()
        };
        let learner = Learner::new(config, 2, 1, Seed(3));
        let after = |mut learner: Learner| {
            let report = learner.update(&batch(1), Seed(4));
            (learner, report)
        };
        let actor_loss = |i: usize, h: f32| {
            let mut moved = learner.clone();
            moved.actor.network.parameters_mut()[i] += h;
            let report = after(moved).1;
            report.actor_loss + 0.7 * report.imitation_loss
        };
        check_gradient(
            after(learner.clone()).0.actor_gradient_taken(),
            5,
            actor_loss,
        );
        for k in 0..2 {
            let critic_loss = |i: usize, h: f32| {
                let mut moved = learner.clone();
                moved.critics[k].online.parameters_mut()[i] += h;
                after(moved).1.critic_loss
            };
            let taken = after(learner.clone()).0.critics[k]
                .gradient_taken()
                .to_vec();
            check_gradient(&taken, 5, critic_loss);
        }
    }
}

#[test]
fn imitation_is_limited_to_a_multiple_of_the_rest() {
    let after = |imitation_weight: f64, imitation_limit: Option<f64>| {
        let config = SacConfig {
            imitation_weight,
            imitation_limit,
            ..config()
        };
        let mut learner = Learner::new(config, 2, 1, Seed(3));
        let report = learner.update(&batch(1), Seed(4));
        (learner.actor_gradient_taken().to_vec(), report)
    };
    let (free, report) = after(50.0, None);
    let ratio = report.imitation_gradient / report.reward_gradient;
    assert!(ratio > 2.0, "{ratio}");
    // A limit of half the ratio is the same as half the weight.
    let (limited, limited_report) = after(50.0, Some(ratio / 2.0));
    let (lighter, lighter_report) = after(25.0, None);
    assert_eq!(limited_report.imitation_gradient, report.imitation_gradient);
    assert!((lighter_report.imitation_gradient / report.imitation_gradient - 0.5).abs() < 1e-6);
    for (a, b) in limited.iter().zip(&lighter) {
        assert!((a - b).abs() < 1e-6 * (1.0 + b.abs()), "{a}, {b}");
    }
    assert_eq!(after(50.0, Some(2.0 * ratio)).0, free);
}

#[test]
fn a_batch_holds_its_share_of_experts() {
    let filled = |reward: f32| {
        let mut buffer = ReplayBuffer::new(4, 2, 1).unwrap();
        buffer.push(Transition {
            observation: (&[1.0, 2.0]).into(),
            action: &[0.1],
            reward,
            next: (&[3.0, 4.0]).into(),
            terminated: false,
        });
        buffer
    };
    let (own, expert) = (filled(0.0), filled(1.0));
    let mut batch = Batch::default();
    let (normalizer, mut rng) = (Normalizer::identity(2), Seed(0).rng());
    let n = SacConfig::default();
    let (n_own, n_imitated) = (n.batch - n.n_imitated(), n.n_imitated());
    batch
        .draw(
            (&own, n_own),
            (&expert, n_imitated),
            Some(&normalizer),
            &mut rng,
        )
        .unwrap();
    assert_eq!((batch.len(), batch.n_own()), (2048, 1638));
    assert_eq!(batch.rewards.iter().sum::<f32>(), 410.0);
    assert!(batch.rewards[n_own..].iter().all(|&r| r == 1.0));
}

fn experts() -> ReplayBuffer {
    let mut expert = ReplayBuffer::new(8, 2, 2).unwrap();
    for i in 0..8usize {
        let x = i as f32 / 8.0;
        expert.push(Transition {
            observation: (&[x, -x]).into(),
            action: &[-x, x],
            reward: x,
            next: (&[0.5 * x, -0.5 * x]).into(),
            terminated: i.is_multiple_of(2),
        });
    }
    expert
}

fn go_on(training: &mut Training, segments: usize) -> Vec<StepReport> {
    let mut env = Toy::new(Reach, 4);
    let mut reports = Vec::new();
    for _ in 0..segments {
        let keep = |report| {
            reports.push(report);
            ControlFlow::Continue(())
        };
        match training.algorithm() {
            Algorithm::Imitation => training.imitation_segment(keep).unwrap(),
            _ => training.segment(&mut env, keep).unwrap(),
        }
    }
    reports
}

#[test]
fn a_resumed_run_is_the_run() {
    let notes = BTreeMap::from([("world".to_owned(), "toy".to_owned())]);
    for algorithm in [Algorithm::Sac, Algorithm::Imitation] {
        // The buffer is written over: 30 random steps and four per gradient step.
        let config = SacConfig {
            replay_capacity: 100,
            ..config()
        };
        let mut whole = Training::new(algorithm, config, experts(), Seed(11)).unwrap();
        let mut first = whole.clone();
        let all = go_on(&mut whole, 3);
        assert!(whole.is_done());
        go_on(&mut first, 1);
        let bytes = first.to_bytes(&notes).unwrap();
        let (mut resumed, found) = Training::from_bytes(&bytes).unwrap();
        assert_eq!((found, resumed.steps()), (notes.clone(), 20));
        let rest = go_on(&mut resumed, 2);
        assert_eq!(rest, all[20..]);
        let [a, b] = [&whole, &resumed].map(|run| run.to_bytes(&notes).unwrap());
        assert!(a == b, "{algorithm:?}");
    }
}

/// The error that ends a run of segments of one step, each of which is stored.
fn how_it_ends(run: &mut Training, env: &mut dyn VectorEnv) -> RlError {
    for _ in 0..run.config().steps {
        let none = |_| ControlFlow::Continue(());
        let segment = match run.algorithm() {
            Algorithm::Imitation => run.imitation_segment(none),
            _ => run.segment(env, none),
        };
        if let Err(error) = segment.and_then(|()| run.to_bytes(&BTreeMap::new())) {
            return error;
        }
    }
    panic!("it should have diverged");
}

#[test]
fn a_run_whose_numbers_are_not_finite_ends_and_is_not_stored() {
    let check = |algorithm, change: fn(&mut Training), expected: &str, at: usize| {
        let config = SacConfig {
            segment: 1,
            ..config()
        };
        let mut run = Training::new(algorithm, config, experts(), Seed(1)).unwrap();
        change(&mut run);
        let error = how_it_ends(&mut run, &mut Toy::new(Reach, 4));
        assert!(
            matches!(error, RlError::Diverged { step, .. } if step == at),
            "{error}"
        );
        assert!(error.to_string().contains(expected), "{error}");
    };
    for algorithm in [Algorithm::Sac, Algorithm::Imitation] {
        // The loss of the only step is fine, its parameters are not.
        let too_fast: fn(&mut Training) = |run| run.learner.config.learning_rate = 1e38;
        check(algorithm, too_fast, "\"actor.parameters\"", 1);
        // An infinite moment freezes its parameter, and no loss ever shows it.
        let frozen: fn(&mut Training) = |run| run.learner.actor_optimizer.square[0] = f32::INFINITY;
        check(algorithm, frozen, "\"actor.adam.square\"", 1);
    }
    let hot: fn(&mut Training) = |run| run.learner.log_alpha = 1e3;
    check(Algorithm::Sac, hot, "a loss is not finite", 1);
    let lost: fn(&mut Training) = |run| {
        run.env_steps = 100;
        run.learner.actor.network.parameters_mut().fill(f32::NAN);
    };
    check(Algorithm::Sac, lost, "an action is not finite", 0);
}

#[test]
fn a_reward_that_is_not_finite_ends_a_run_before_it_is_stored() {
    for reward in [f64::NAN, f64::INFINITY] {
        let config = SacConfig {
            segment: 1,
            ..config()
        };
        let nothing = ReplayBuffer::new(1, 1, 1).unwrap();
        let mut run = Training::new(Algorithm::Sac, config, nothing, Seed(1)).unwrap();
        let broken = Clock {
            reward,
            terminates: false,
        };
        let error = how_it_ends(&mut run, &mut Toy::new(broken, 4));
        let expected = "learning diverged at gradient step 0: a reward is not finite";
        assert_eq!(error.to_string(), expected);
        assert!(run.replay.is_empty() && run.to_bytes(&BTreeMap::new()).is_ok());
    }
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| {
            let mut run = Training::new(Algorithm::Sac, config(), experts(), Seed(1)).unwrap();
            go_on(&mut run, 1);
            run.to_bytes(&BTreeMap::new()).unwrap()
        })
    };
    assert_eq!(run(1), run(2));
}

#[test]
fn a_policy_is_found_in_its_own_file_and_in_its_run() {
    let mut run = Training::new(Algorithm::Sac, config(), experts(), Seed(1)).unwrap();
    go_on(&mut run, 1);
    let notes = BTreeMap::from([("a".to_owned(), "b".to_owned())]);
    let alone = run.actor().to_bytes(&notes).unwrap();
    let whole = run.to_bytes(&notes).unwrap();
    for bytes in [&alone, &whole] {
        let (actor, found) = Actor::from_bytes(bytes).unwrap();
        assert_eq!((&actor, &found), (run.actor(), &notes));
    }
    assert!(
        Training::from_bytes(&alone)
            .unwrap_err()
            .to_string()
            .contains("no run")
    );
}

#[test]
fn damaged_files_are_refused() {
    let run = Training::new(Algorithm::Sac, config(), experts(), Seed(1)).unwrap();
    let bytes = run.to_bytes(&BTreeMap::new()).unwrap();
    for length in [0, 7, 100, bytes.len() - 1] {
        assert!(Training::from_bytes(&bytes[..length]).is_err());
    }
    let find = |text: &str| bytes.windows(text.len()).position(|w| w == text.as_bytes());
    let with = |old: &str, new: &str| {
        let mut bytes = bytes.clone();
        let at = find(old).unwrap();
        bytes[at..at + new.len()].copy_from_slice(new.as_bytes());
        Training::from_bytes(&bytes).unwrap_err().to_string()
    };
    assert!(with("gump-rl-1", "gump-rl-9").contains("expected gump-rl-1"));
    assert!(with("hidden = [16", "hidden = [99").contains("configuration"));
    assert!(with(r#"capacity\":8"#, r#"capacity\":3"#).contains("expert"));
}

#[test]
fn what_does_not_fit_is_refused() {
    let nothing = || ReplayBuffer::new(1, 2, 2).unwrap();
    let other = Training::new(Algorithm::Ppo, config(), experts(), Seed(0));
    assert!(matches!(other, Err(RlError::OtherAlgorithm { .. })));
    let empty = Training::new(Algorithm::Imitation, config(), nothing(), Seed(0));
    assert!(matches!(empty, Err(RlError::EmptyBuffer { .. })));
    let narrow = ReplayBuffer::new(1, 3, 2).unwrap();
    let mut training = Training::new(Algorithm::Sac, config(), narrow, Seed(0)).unwrap();
    let mut env = Toy::new(Reach, 2);
    assert_eq!(env.observation_len(), 2);
    let error = training
        .segment(&mut env, |_| ControlFlow::Continue(()))
        .unwrap_err();
    assert!(
        error.to_string().contains("2 numbers in its observations"),
        "{error}"
    );
}
