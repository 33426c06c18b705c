//! Requests to the decoder for one object, and the processing of their results.

use std::fmt;
use std::sync::Arc;

use gump_geometry::{DVec2, Pose};
use gump_model::decoder::{Bins, STEPS};
use gump_model::local_frame::LocalFrame;
use gump_scene::{AgentState, Seed};
use gump_tokenizer::{Field, QuantizedState};

use crate::agreement;
use crate::kinematic_limits::Limits;
use crate::sampling::SamplingConfig;
use crate::temporal_ensemble::ChunkBuffer;

/// A request to the decoder for one object.
#[derive(Clone, Debug)]
pub struct Request {
    /// The frame in which the bins are expressed.
    pub local_frame: LocalFrame,
    /// Bins that are given, per step.
    pub forced: [Option<u16>; STEPS.len()],
    /// The object's own stream of randomness in this frame.
    pub stream: Seed,
    /// Pose 0 must be within this distance of a point along both axes, scene frame, metres.
    pub near: Option<(DVec2, f64)>,
    /// Predictions of earlier chunks; empty for an object that is driven.
    pub ring: ChunkBuffer,
    /// Its previous pose and its kinematic limits.
    pub limits: Option<(Pose, Limits)>,
    /// Number of the frame being decoded.
    pub frame: usize,
    /// Further adjustments of the draws.
    pub guide: Option<Arc<dyn Guide>>,
}

/// Adjustments of draws in addition to the logits, given the bins drawn before.
pub trait Guide: fmt::Debug + Send + Sync {
    /// Factors on the probabilities of the bins of `step` after the steps in `drawn`, 0 for
    /// excluded bins; `None` for no change. If all are excluded, the draw is unconstrained, and the
    /// caller must check the result.
    fn weights(&self, step: usize, drawn: &[u16]) -> Option<Vec<f32>>;

    /// Factor on the temperature of `step`.
    fn boldness(&self, step: usize) -> f64;

    /// Smoothing of the targets of `step` in training, where it is to be removed: standard
    /// deviation in bins.
    fn smoothing(&self, step: usize) -> Option<f32>;

    /// The number in [0, 1) that decides `step`, in place of one from the object's stream.
    fn number(&self, step: usize) -> Option<f64>;
}

impl Request {
    /// Whether the state is given completely.
    pub(crate) fn is_driven(&self) -> bool {
        self.forced[..7].iter().all(Option::is_some)
    }

    /// The previous pose of the object, scene frame; `None` if it is not known.
    pub(crate) fn from(&self) -> Option<Pose> {
        let limited = self.limits.map(|(from, _)| from);
        limited.or(self.local_frame.origin())
    }

    /// The final state of a decoded object: sampled, averaged over chunks, within its limits, with
    /// a consistent velocity; scene frame, not quantised.
    pub(crate) fn resolve(&self, bins: &Bins, config: &SamplingConfig) -> AgentState {
        let decoded = AgentState {
            pose: self.local_frame.poses(bins)[0],
            velocity: self.local_frame.velocity(bins),
        };
        let average = self.ring.aggregate(self.frame, decoded.pose, config.decay);
        let Some(from) = self.from().filter(|_| !self.is_driven()) else {
            return AgentState {
                pose: average,
                ..decoded
            };
        };
        let steers = self.limits.is_some();
        let velocity = agreement::follow(from, decoded, average, steers);
        let mut settled = AgentState {
            pose: average,
            velocity,
        };
        if let Some((from, limits)) = self.limits {
            let kept = limits.keep(from, settled);
            settled = AgentState {
                velocity: agreement::follow(from, settled, kept.pose, steers),
                ..kept
            };
        }
        if config.limits {
            settled.velocity = agreement::allowed(from, settled.pose, settled.velocity);
        }
        settled
    }

    /// The token state of a decoded object whose final state is `settled`: the one value from which
    /// embedding, sine features, geometry and the next surrogate are derived.
    pub(crate) fn settled_state(&self, bins: &Bins, settled: AgentState) -> QuantizedState {
        let mut state = QuantizedState::default();
        for (field, &bin) in STEPS.iter().zip(bins).take(2) {
            state.set(*field, bin);
        }
        state.with_motion(&settled)
    }
}

/// The same state at another pose.
pub(crate) fn set_pose(mut state: QuantizedState, pose: Pose) -> QuantizedState {
    state.x = Field::X.quantize(pose.position.x).bin;
    state.y = Field::Y.quantize(pose.position.y).bin;
    state.heading = Field::Heading.quantize(pose.heading).bin;
    state
}
