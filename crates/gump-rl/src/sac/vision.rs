//! Learners on images: encoders, and the losses that train them.
//!
//! The actor's encoder is part of the policy. By default the critics use it as well, and only their
//! loss trains it; with separate encoders each side trains its own. The target critics use a slowly
//! updated copy of the critics' encoder.

use std::borrow::Cow;

use gump_scene::Seed;

use super::{Batch, SacConfig};
use crate::Actor;
use crate::networks::{Adam, ConvNet, ConvPass, clip};

/// The encoders of a learner beside the actor's, and what trains them all.
#[derive(Clone, Debug)]
pub(crate) struct Vision {
    /// Training state of the actor's encoder.
    pub(crate) training: EncoderTraining,
    /// The critics' own encoder, if they have one.
    pub(crate) separate: Option<(ConvNet, EncoderTraining)>,
    /// Encoder of the target critics.
    pub(crate) target: ConvNet,
    future: ConvPass,
}

/// Optimizer, gradient and activations for training one encoder.
#[derive(Clone, Debug)]
pub(crate) struct EncoderTraining {
    pub(crate) optimizer: Adam,
    gradient: Vec<f32>,
    now: ConvPass,
    next: ConvPass,
}

/// A batch as the dense networks read it: `[observations, nexts]` for the actor and for the
/// critics.
pub(super) struct Seen<'a> {
    pub(super) by_actor: [Cow<'a, [f32]>; 2],
    by_critics: Option<[Cow<'a, [f32]>; 2]>,
    /// The nexts alone.
    pub(super) by_targets: Cow<'a, [f32]>,
}

impl<'a> Seen<'a> {
    /// Vector observations, which all networks read unchanged.
    pub(super) fn unchanged(batch: &'a Batch) -> Self {
        let nexts = || Cow::Borrowed(batch.nexts.as_slice());
        Self {
            by_actor: [Cow::Borrowed(&batch.observations), nexts()],
            by_critics: None,
            by_targets: nexts(),
        }
    }

    pub(super) fn by_critics(&self) -> &[Cow<'a, [f32]>; 2] {
        self.by_critics.as_ref().unwrap_or(&self.by_actor)
    }
}

impl EncoderTraining {
    fn new(encoder: &ConvNet) -> Self {
        let n = encoder.parameters().len();
        Self {
            optimizer: Adam::new(n),
            gradient: vec![0.0; n],
            now: ConvPass::default(),
            next: ConvPass::default(),
        }
    }

    fn see(&mut self, encoder: &ConvNet, batch: &Batch) -> [Cow<'static, [f32]>; 2] {
        encoder.forward(&batch.observations, &mut self.now);
        encoder.forward(&batch.nexts, &mut self.next);
        [&self.now, &self.next].map(|pass| Cow::Owned(pass.output().to_vec()))
    }

    /// Takes the gradient, given those of the features of now and perhaps of what came next.
    fn learn(&mut self, encoder: &ConvNet, by_now: &[f32], by_next: Option<&[f32]>) {
        self.gradient.fill(0.0);
        encoder.backward(by_now, &mut self.now, &mut self.gradient);
        if let Some(by_next) = by_next {
            encoder.backward(by_next, &mut self.next, &mut self.gradient);
        }
    }

    fn step(&mut self, encoder: &mut ConvNet, rate: f64, limit: Option<f64>) {
        clip(&mut self.gradient, limit);
        self.optimizer
            .step(encoder.parameters_mut(), &self.gradient, rate);
    }
}

impl Vision {
    /// The encoders beside that of `actor`; none if it has none.
    pub(crate) fn new(config: &SacConfig, actor: &Actor, seed: Seed) -> Option<Self> {
        let shared = actor.encoder()?;
        let separate = config.separate_encoders.then(|| {
            let (architecture, picture) = (shared.architecture(), shared.picture());
            let encoder = ConvNet::new(architecture, picture, &mut seed.rng());
            let training = EncoderTraining::new(&encoder);
            (encoder, training)
        });
        Some(Self {
            training: EncoderTraining::new(shared),
            target: separate.as_ref().map_or(shared, |(own, _)| own).clone(),
            separate,
            future: ConvPass::default(),
        })
    }

    /// Encodes a batch for the actor, the critics and the target critics.
    pub(super) fn see(&mut self, encoder: &ConvNet, batch: &Batch) -> Seen<'static> {
        self.target.forward(&batch.nexts, &mut self.future);
        let separate = self.separate.as_mut();
        Seen {
            by_actor: self.training.see(encoder, batch),
            by_critics: separate.map(|(own, training)| training.see(own, batch)),
            by_targets: Cow::Owned(self.future.output().to_vec()),
        }
    }

    /// The features of observations alone, for imitation.
    pub(super) fn see_now(&mut self, encoder: &ConvNet, batch: &Batch) -> &[f32] {
        encoder.forward(&batch.observations, &mut self.training.now);
        self.training.now.output()
    }

    /// The gradients of the actor's encoder and of the critics' own in the last step.
    #[cfg(test)]
    pub(super) fn gradients_taken(&self) -> [&[f32]; 2] {
        let separate = self.separate.as_ref();
        let own = separate.map_or([].as_slice(), |(_, training)| &training.gradient);
        [&self.training.gradient, own]
    }

    /// True if the actor's loss trains its encoder, not the critics'.
    pub(super) fn is_separate(&self) -> bool {
        self.separate.is_some()
    }

    /// Takes the gradient of the critics' loss, given that of the features they saw.
    pub(super) fn learn_from_critics(&mut self, encoder: &ConvNet, by_features: &[f32]) {
        match &mut self.separate {
            Some((own, training)) => training.learn(own, by_features, None),
            None => self.training.learn(encoder, by_features, None),
        }
    }

    /// Takes the gradient of the actor's loss, given those of the features it saw.
    pub(super) fn learn_from_actor(
        &mut self,
        encoder: &ConvNet,
        by_now: &[f32],
        by_next: Option<&[f32]>,
    ) {
        self.training.learn(encoder, by_now, by_next);
    }

    /// Moves the actor's encoder by its gradient.
    pub(super) fn step_actors(&mut self, encoder: &mut ConvNet, rate: f64, limit: Option<f64>) {
        self.training.step(encoder, rate, limit);
    }

    /// Moves the critics' own encoder by its gradient, if there is one.
    pub(super) fn step_critics(&mut self, rate: f64, limit: Option<f64>) {
        if let Some((own, training)) = &mut self.separate {
            training.step(own, rate, limit);
        }
    }

    /// Moves the target encoder towards the critics' encoder.
    pub(super) fn move_target(&mut self, encoder: &ConvNet, tau: f32) {
        let online = self.separate.as_ref().map_or(encoder, |(own, _)| own);
        self.target.follow(online, tau);
    }
}
