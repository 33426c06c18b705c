//! Drawing states from the decoder: temperature, top-k, forced fields, and streams that never
//! depend on the batch.

use candle_core::Tensor;
use gump_geometry::{DVec2, Pose};
use gump_scene::Seed;
use gump_tokenizer::{Field, QuantizedState};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::ModelError;
use crate::aggregation::Ring;
use crate::decoder::{CHUNK, STEPS};
use crate::network::Network;

/// How futures are decoded.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SamplingConfig {
    /// One object after another, or all objects of a frame at once.
    pub mode: Mode,
    /// What is kept between the passes of a frame.
    pub cache: CacheMode,
    /// Divides the logits (paper, simulation: 1.1); above 1 is bolder.
    pub temperature: f64,
    /// Bins that may be drawn per field (paper, simulation: 40).
    pub top_k: usize,
    /// Weight of a prediction made `i` frames ago is `decay^i` (paper: 1.2); 0 switches aggregation
    /// off.
    pub decay: f64,
    /// Frames of history in the window (paper: 3).
    pub history: usize,
    /// Where provisional states come from in partial-AR decoding.
    pub surrogate: Surrogate,
}

impl Default for SamplingConfig {
    fn default() -> Self {
        Self {
            mode: Mode::PartialAr,
            cache: CacheMode::Window,
            temperature: 1.1,
            top_k: 40,
            decay: 1.2,
            history: 3,
            surrogate: Surrogate::Chunk,
        }
    }
}

/// In which order the objects of a frame are decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// All at once against surrogates: one transformer pass per frame.
    PartialAr,
    /// One after another: one pass per object.
    FullAr,
}

/// What is kept between the passes of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CacheMode {
    /// Nothing: every pass sees the whole window.
    None,
    /// Keys and values of the window; it is read afresh for every frame, so the result is that of
    /// no cache.
    Window,
}

/// Where provisional states come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Surrogate {
    /// Chunks decoded for earlier frames.
    Chunk,
    /// The last state moved on.
    ConstantVelocity,
    /// The last state itself.
    Copy,
}

/// What is asked of the decoder for one object.
#[derive(Clone, Debug)]
pub(crate) struct Request {
    /// Bins that are given, per step.
    pub(crate) forced: [Option<u16>; STEPS.len()],
    /// The object's own stream of randomness in this frame.
    pub(crate) stream: Seed,
    /// Pose 0 must lie within this distance of a point along both axes, scene frame, metres.
    pub(crate) near: Option<(DVec2, f64)>,
    /// What earlier chunks say; empty for an object that is driven.
    pub(crate) ring: Ring,
    /// Number of the frame being decoded.
    pub(crate) frame: usize,
}

impl Request {
    /// The final pose of a decoded object: its sample, aggregated; scene frame, not quantised.
    pub(crate) fn settle(&self, bins: &Bins, config: &SamplingConfig) -> Pose {
        self.ring
            .aggregate(self.frame, poses(bins)[0], config.decay)
    }
}

/// The token state of a decoded object whose final pose is `pose`: the one value that embedding,
/// sine, geometry and the next surrogate all derive from.
pub(crate) fn settled_state(bins: &Bins, pose: Pose) -> QuantizedState {
    let mut state = QuantizedState::default();
    for (field, &bin) in STEPS.iter().zip(bins).take(4) {
        state.set(*field, bin);
    }
    set_pose(state, pose)
}

/// The same state at another pose.
pub(crate) fn set_pose(mut state: QuantizedState, pose: Pose) -> QuantizedState {
    state.x = Field::X.quantize(pose.position.x).bin;
    state.y = Field::Y.quantize(pose.position.y).bin;
    state.heading = Field::Heading.quantize(pose.heading).bin;
    state
}

/// What the decoder says of one object: a bin per step.
pub(crate) type Bins = [u16; STEPS.len()];

/// The poses of a chunk, scene frame.
pub(crate) fn poses(bins: &Bins) -> [Pose; CHUNK] {
    std::array::from_fn(|i| {
        let at = 4 + 3 * i;
        Pose::new(
            Field::X.dequantize(bins[at]),
            Field::Y.dequantize(bins[at + 1]),
            Field::Heading.dequantize(bins[at + 2]),
        )
    })
}

/// Decodes one state per request; `hidden` [K, C] are the hidden vectors at the keys.
pub(crate) fn sample_states(
    network: &Network,
    hidden: &Tensor,
    requests: &[Request],
    config: &SamplingConfig,
) -> Result<Vec<Bins>, ModelError> {
    let table = network.decoder.input_table(&network.mct.token_table()?)?;
    let mut states = network.decoder.begin(hidden);
    let mut bins = vec![[0; STEPS.len()]; requests.len()];
    let mut previous: Option<Tensor> = None;
    for (step, field) in STEPS.into_iter().enumerate() {
        let forced = requests
            .iter()
            .all(|request| request.forced[step].is_some());
        let output = network
            .decoder
            .step(&table, &mut states, step, previous.as_ref())?;
        if forced {
            bins.iter_mut()
                .zip(requests)
                .for_each(|(b, r)| b[step] = r.forced[step].unwrap_or_default());
        } else {
            let n = field.n_bins();
            let logits = network
                .decoder
                .logits(&output, field)?
                .flatten_all()?
                .to_vec1::<f32>()?;
            bins.par_iter_mut()
                .zip(requests)
                .zip(logits.par_chunks(n))
                .for_each(|((bins, request), logits)| {
                    bins[step] = request.forced[step].unwrap_or_else(|| {
                        draw(
                            logits,
                            field,
                            allowed(request, step, field),
                            step,
                            request,
                            config,
                        )
                    });
                });
        }
        let tokens: Vec<u32> = bins.iter().map(|bins| field.token(bins[step])).collect();
        previous = Some(Tensor::from_vec(tokens, requests.len(), network.device())?);
    }
    Ok(bins)
}

/// The bins of pose 0 near enough to where the object can be.
///
/// The released code throws away a sample more than 5 m off; restricting the draw instead is the
/// same distribution given that it is near, and never fails.
fn allowed(request: &Request, step: usize, field: Field) -> std::ops::Range<usize> {
    let all = 0..field.n_bins();
    let Some((centre, reach)) = request.near else {
        return all;
    };
    let centre = match step {
        4 => centre.x,
        5 => centre.y,
        _ => return all,
    };
    let (low, high) = (
        field.quantize(centre - reach).bin,
        field.quantize(centre + reach).bin,
    );
    usize::from(low)..usize::from(high) + 1
}

/// Draws a bin from tempered, truncated logits.
fn draw(
    logits: &[f32],
    field: Field,
    allowed: std::ops::Range<usize>,
    step: usize,
    request: &Request,
    config: &SamplingConfig,
) -> u16 {
    debug_assert_eq!(logits.len(), field.n_bins());
    let mut candidates: Vec<(f32, u16)> = allowed
        .clone()
        .map(|bin| (logits[bin], bin as u16))
        .collect();
    let k = config.top_k.clamp(1, candidates.len());
    // Ties are broken by the bin, so the choice never depends on the sort.
    let order = |a: &(f32, u16), b: &(f32, u16)| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1));
    if k < candidates.len() {
        candidates.select_nth_unstable_by(k - 1, order);
        candidates.truncate(k);
    }
    candidates.sort_unstable_by(order);
    let best = candidates[0];
    if config.temperature <= 0.0 {
        return best.1;
    }
    let weight = |logit: f32| (f64::from(logit - best.0) / config.temperature).exp();
    let total: f64 = candidates.iter().map(|c| weight(c.0)).sum();
    let mut left = uniform(request.stream.fork(step as u64)) * total;
    for candidate in &candidates {
        left -= weight(candidate.0);
        if left < 0.0 {
            return candidate.1;
        }
    }
    best.1
}

/// A number in [0, 1) that is a function of the seed alone: no generator, no state.
fn uniform(seed: Seed) -> f64 {
    (seed.fork(0).0 >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request() -> Request {
        Request {
            forced: [None; STEPS.len()],
            stream: Seed(3),
            near: None,
            ring: Ring::default(),
            frame: 0,
        }
    }

    fn check(logits: &[f32], config: &SamplingConfig, seed: u64) -> u16 {
        let request = Request {
            stream: Seed(seed),
            ..request()
        };
        draw(logits, Field::Width, 0..logits.len(), 0, &request, config)
    }

    #[test]
    fn top_1_and_temperature_0_take_the_best() {
        let mut logits = [0.0; 14];
        logits[5] = 1.0;
        let one = SamplingConfig {
            top_k: 1,
            ..SamplingConfig::default()
        };
        let cold = SamplingConfig {
            temperature: 0.0,
            ..SamplingConfig::default()
        };
        for seed in 0..50 {
            assert_eq!(
                (check(&logits, &one, seed), check(&logits, &cold, seed)),
                (5, 5)
            );
        }
    }

    #[test]
    fn draws_follow_the_tempered_distribution() {
        let mut logits = [f32::NEG_INFINITY; 14];
        (logits[2], logits[9]) = (0.0, (3.0f32).ln());
        let config = SamplingConfig {
            temperature: 1.0,
            ..SamplingConfig::default()
        };
        let n = 4000;
        let nines = (0..n)
            .filter(|&seed| check(&logits, &config, seed) == 9)
            .count();
        // Standard deviation of the count is 27.
        assert!((nines as i64 - 3000).abs() < 120, "{nines}");
    }

    #[test]
    fn pose_0_stays_near_the_surrogate() {
        let request = Request {
            near: Some((DVec2::new(0.0, 50.0), 5.0)),
            ..request()
        };
        assert_eq!(allowed(&request, 4, Field::X), 475..526);
        assert_eq!(allowed(&request, 5, Field::Y), 725..776);
        assert_eq!(allowed(&request, 7, Field::X), 0..1000);
    }
}
