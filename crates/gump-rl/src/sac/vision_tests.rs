//! Learners on pictures: which loss trains which encoder, and runs that are resumed.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::BTreeMap;
use std::ops::ControlFlow;

use gump_scene::Seed;
use rand::Rng as _;

use super::replay_buffer::{ReplayBuffer, Transition};
use super::test_envs::{Problem as _, Reach, SeenReach, Toy};
use super::tests::check_gradient;
use super::{Batch, Learner, SacConfig, Training, UpdateReport};
use crate::Algorithm;
use crate::networks::{Architecture, Picture};
use crate::{Actor, RlError};

/// One in this many of the 60,000 parameters is checked.
const EVERY: usize = 211;

const PICTURE: Picture = Picture { layers: 2, side: 8 };

fn config(separate_encoders: bool) -> SacConfig {
    SacConfig {
        steps: 6,
        segment: 3,
        batch: 6,
        hidden: vec![16],
        initial_steps: 8,
        replay_capacity: 12,
        encoder: Some(Architecture::SmallConv),
        separate_encoders,
        imitation_weight: 0.7,
        initial_log_alpha: -1.0,
        head_gain: 1.0,
        ..SacConfig::default()
    }
}

/// Four transitions of random pictures, the last an expert's.
fn batch() -> Batch {
    let mut rng = Seed(2).rng();
    let mut pictures = || {
        let pixel = || f32::from(u8::from(rng.random_range(0.0..1.0) < 0.4));
        std::iter::repeat_with(pixel)
            .take(4 * PICTURE.len())
            .collect()
    };
    Batch {
        observations: pictures(),
        actions: vec![0.5, -0.6, 0.1, 0.3],
        rewards: vec![-5.0, 1.0, 0.5, 0.7],
        nexts: pictures(),
        terminated: vec![true, false, false, false],
        n_imitated: 1,
    }
}

fn updated(mut learner: Learner) -> (Learner, UpdateReport) {
    let report = learner.update(&batch(), Seed(4));
    (learner, report)
}

fn actor_loss(report: &UpdateReport) -> f64 {
    report.actor_loss + 0.7 * report.imitation_loss
}

#[test]
fn the_critics_train_the_encoder_that_all_share() {
    let learner = Learner::new(config(false), PICTURE, 1, Seed(3));
    let (after, _) = updated(learner.clone());
    let [taken, none] = after.vision.as_ref().unwrap().gradients_taken();
    assert_eq!(none, [0.0; 0]);
    // The targets depend on it too, by the actions drawn, but no gradient goes there: a learner
    // that only sees ends has none.
    let mut ends = batch();
    ends.terminated.fill(true);
    let mut ended = learner.clone();
    ended.update(&ends, Seed(4));
    let of_ends = ended.vision.as_ref().unwrap().gradients_taken()[0].to_vec();
    check_gradient(&of_ends, EVERY, |i, h| {
        let mut moved = learner.clone();
        moved.actor.encoder_mut().unwrap().parameters_mut()[i] += h;
        moved.update(&ends, Seed(4)).critic_loss
    });
    assert!(taken.iter().any(|g| *g != 0.0));
}

#[test]
fn separate_encoders_learn_from_their_own_loss() {
    let learner = Learner::new(config(true), PICTURE, 1, Seed(3));
    let (after, _) = updated(learner.clone());
    let [of_actor, of_critics] = after.vision.as_ref().unwrap().gradients_taken();
    check_gradient(of_actor, EVERY, |i, h| {
        let mut moved = learner.clone();
        moved.actor.encoder_mut().unwrap().parameters_mut()[i] += h;
        actor_loss(&updated(moved).1)
    });
    check_gradient(of_critics, EVERY, |i, h| {
        let mut moved = learner.clone();
        let vision = moved.vision.as_mut().unwrap();
        vision.separate.as_mut().unwrap().0.parameters_mut()[i] += h;
        updated(moved).1.critic_loss
    });
}

#[test]
fn imitation_trains_the_actors_encoder() {
    let learner = Learner::new(config(false), PICTURE, 1, Seed(3));
    let mut after = learner.clone();
    after.imitate(&batch());
    check_gradient(
        after.vision.as_ref().unwrap().gradients_taken()[0],
        EVERY,
        |i, h| {
            let mut moved = learner.clone();
            moved.actor.encoder_mut().unwrap().parameters_mut()[i] += h;
            moved.imitate(&batch()).imitation_loss
        },
    );
}

#[test]
fn the_target_sees_with_a_slow_copy() {
    for separate in [false, true] {
        let learner = Learner::new(config(separate), PICTURE, 1, Seed(3));
        let (after, _) = updated(learner.clone());
        let online = |learner: &Learner| {
            let vision = learner.vision.as_ref().unwrap();
            let own = vision.separate.as_ref().map(|(own, _)| own);
            own.or(learner.actor.encoder()).unwrap().clone()
        };
        let before = &learner.vision.as_ref().unwrap().target;
        assert_eq!(*before, online(&learner));
        let mut expected = before.clone();
        expected.follow(&online(&after), 0.005);
        assert_ne!(expected, *before);
        assert_eq!(after.vision.as_ref().unwrap().target, expected);
    }
}

fn experts() -> ReplayBuffer {
    let mut expert = ReplayBuffer::new(4, SeenReach::form(), 2).unwrap();
    let mut rng = Seed(8).rng();
    for _ in 0..4 {
        let mut state = SeenReach.start(&mut rng);
        let seen = SeenReach.observe(&state);
        let action = [0.3, -0.4];
        let (reward, _) = SeenReach.step(&mut state, &action);
        expert.push(Transition {
            observation: seen.into(),
            action: &action,
            reward: reward as f32,
            next: SeenReach.observe(&state).into(),
            terminated: false,
        });
    }
    expert
}

fn segment(training: &mut Training) {
    let go_on = |_| ControlFlow::Continue(());
    match training.algorithm() {
        Algorithm::Imitation => training.imitation_segment(go_on),
        _ => training.segment(&mut Toy::new(SeenReach, 4), go_on),
    }
    .unwrap();
}

#[test]
fn a_resumed_run_is_the_run() {
    let notes = BTreeMap::new();
    for (algorithm, separate) in [
        (Algorithm::Sac, false),
        (Algorithm::Sac, true),
        (Algorithm::Imitation, false),
    ] {
        let mut whole = Training::new(algorithm, config(separate), experts(), Seed(1)).unwrap();
        segment(&mut whole);
        let bytes = whole.to_bytes(&notes).unwrap();
        let (mut resumed, _) = Training::from_bytes(&bytes).unwrap();
        for training in [&mut whole, &mut resumed] {
            segment(training);
            assert!(training.is_done());
        }
        let [a, b] = [&whole, &resumed].map(|run| run.to_bytes(&notes).unwrap());
        assert!(a == b, "{algorithm:?} {separate}");
        let (actor, _) = Actor::from_bytes(&a).unwrap();
        assert_eq!(&actor, whole.actor());
    }
}

#[test]
fn encoders_want_pictures() {
    let numbers = ReplayBuffer::new(1, 2, 2).unwrap();
    let refused = Training::new(Algorithm::Sac, config(false), numbers, Seed(0));
    assert!(matches!(refused, Err(RlError::NoPicture { found: 2 })));
    // The same run over numbers is of another shape.
    let mut training = Training::new(Algorithm::Sac, config(false), experts(), Seed(1)).unwrap();
    let error = training.segment(&mut Toy::new(Reach, 4), |_| ControlFlow::Continue(()));
    assert!(matches!(error, Err(RlError::Shape { expected: 256, .. })));
}
