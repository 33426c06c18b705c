//! Sampling of bins from logits: temperature, top-k, a limit on position, and random streams that
//! do not depend on the batch.
//!
//! A draw inverts the cumulative distribution over the bins in order, at a number that is a
//! function of the object's stream only. Neighbouring bins are neighbouring values, so two futures
//! with slightly different logits draw slightly different values: candidates of a planner with the
//! same seed share their noise.

use std::ops::Range;

use gump_kernels::smoothing::OrdinalSmoothing;
use gump_model::decoder::STEPS;
use gump_scene::Seed;
use gump_tokenizer::Field;

use crate::deconvolution::unsmoothed;
use crate::nucleus::{least_kept, uniform};
use crate::request::{Guide, Request};
use crate::sampling::SamplingConfig;

/// The bins of a draw, with their logits and then their weights.
pub(crate) type Candidates = Vec<(usize, f32)>;

/// Draws the bin of a step; `logits` are those of its field's bins, `drawn` the bins of earlier
/// steps, `room` is working memory.
pub(crate) fn draw_field(
    logits: &[f32],
    step: usize,
    drawn: &[u16],
    request: &Request,
    config: &SamplingConfig,
    room: &mut Candidates,
) -> u16 {
    let field = STEPS[step];
    debug_assert_eq!(logits.len(), field.n_bins());
    let sharpness = Sharpness {
        temperature: config.temperature.unwrap_or(TEMPERATURE),
        top_k: config.top_k,
        top_p: config.top_p.unwrap_or(1.0),
    };
    if let Some(guide) = &request.guide {
        return guided(
            logits,
            step,
            drawn,
            (&**guide, request.stream),
            sharpness,
            room,
        );
    }
    let allowed = allowed(request, step, field);
    let uniform = uniform(request.stream.fork(step as u64));
    let found = draw(&logits[allowed.clone()], uniform, sharpness, room);
    (allowed.start + found) as u16
}

/// Default divisor of the logits of a sequence network: its targets were smoothed over neighbouring
/// bins, so its distributions are too wide. Lower values gain realism and lose variety (result 11).
const TEMPERATURE: f64 = 0.5;

/// Truncation and temperature of a draw.
#[derive(Clone, Copy, Debug)]
struct Sharpness {
    /// Divides the logits.
    temperature: f64,
    /// Maximum number of bins that may be drawn.
    top_k: usize,
    /// Nucleus: of those, the most likely ones that together have this probability.
    top_p: f64,
}

/// As [`draw_field`], with the adjustments of a guide.
fn guided(
    logits: &[f32],
    step: usize,
    drawn: &[u16],
    (guide, stream): (&dyn Guide, Seed),
    sharpness: Sharpness,
    room: &mut Candidates,
) -> u16 {
    let number = guide.number(step);
    let number = number.unwrap_or_else(|| uniform(stream.fork(step as u64)));
    let sharpness = Sharpness {
        temperature: guide.boldness(step) * sharpness.temperature,
        ..sharpness
    };
    let sharp = guide.smoothing(step).map(|sigma_bins| {
        let circular = STEPS[step].is_circular();
        unsmoothed(
            logits,
            OrdinalSmoothing {
                sigma_bins,
                circular,
            },
        )
    });
    let logits = sharp.as_deref().unwrap_or(logits);
    let weights = guide.weights(step, &drawn[..step]);
    let weights = weights.filter(|weights| weights.iter().any(|weight| *weight > 0.0));
    let Some(weights) = weights else {
        return draw(logits, number, sharpness, room) as u16;
    };
    let open: Vec<usize> = (0..logits.len()).filter(|i| weights[*i] > 0.0).collect();
    // Dividing by the temperature must leave the factors as they are.
    let tilted = |&i: &usize| logits[i] + sharpness.temperature as f32 * weights[i].ln();
    let tilted: Vec<f32> = open.iter().map(tilted).collect();
    open[draw(&tilted, number, sharpness, room)] as u16
}

/// The bins of pose 0 near enough to the object's possible positions.
///
/// The released code discards a sample more than 5 m off; restricting the draw gives the same
/// distribution conditioned on being near, and never fails.
fn allowed(request: &Request, step: usize, field: Field) -> Range<usize> {
    let all = 0..field.n_bins();
    let Some((centre, reach)) = request.near else {
        return all;
    };
    let [x, y] = request.local_frame.near(centre, reach);
    let bins = match step {
        4 => x,
        5 => y,
        _ => return all,
    };
    usize::from(*bins.start())..usize::from(*bins.end()) + 1
}

/// The index at which the tempered distribution over the `top_k` largest logits exceeds `uniform`.
fn draw(logits: &[f32], uniform: f64, sharpness: Sharpness, room: &mut Candidates) -> usize {
    let Sharpness {
        temperature,
        top_k,
        top_p,
    } = sharpness;
    let peak = gump_kernels::wide(
        #[inline(always)]
        || gump_kernels::rows::max(logits),
    );
    let best = || logits.iter().position(|l| *l == peak).unwrap_or(0);
    if temperature <= 0.0 || top_k <= 1 {
        return best();
    }
    let (threshold, mut spare) = threshold(logits, peak, top_k);
    room.clear();
    for (i, &logit) in logits.iter().enumerate() {
        if logit == threshold {
            // Of equal logits at the threshold the first few are in.
            spare = spare.saturating_sub(1);
        }
        if logit > threshold || (logit == threshold && spare > 0) {
            room.push((i, logit));
        }
    }
    let inverse = 1.0 / temperature;
    for (_, logit) in room.iter_mut() {
        *logit = (f64::from(*logit - peak) * inverse).exp() as f32;
    }
    if top_p < 1.0 {
        let mut weights: Vec<f32> = room.iter().map(|(_, weight)| *weight).collect();
        let least = least_kept(&mut weights, top_p);
        room.retain(|(_, weight)| *weight >= least);
    }
    let total: f64 = room.iter().map(|(_, weight)| f64::from(*weight)).sum();
    let mut left = uniform * total;
    for (i, weight) in room.iter() {
        left -= f64::from(*weight);
        if left < 0.0 {
            return *i;
        }
    }
    best()
}

/// The `k`-th largest logit, and one more than how many logits equal to it belong to the `k`
/// largest; minus infinity where there are no more than `k`.
fn threshold(logits: &[f32], peak: f32, k: usize) -> (f32, usize) {
    if k >= logits.len() {
        return (f32::NEG_INFINITY, usize::MAX);
    }
    // Bisection over floats in their order as integers: counting is one fast sweep.
    let reaches = |key: i32| gump_kernels::rows::count_from(logits, float_of(key)) >= k;
    let (mut low, mut high) = (key_of(f32::NEG_INFINITY), key_of(f32::INFINITY));
    // A few steps over the range that logits really have spare most of those over all floats.
    for reach in [1.0f32, 4.0, 16.0, 64.0] {
        if reaches(key_of(peak - reach)) {
            low = key_of(peak - reach);
            break;
        }
        high = key_of(peak - reach);
    }
    while i64::from(high) - i64::from(low) > 1 {
        let middle = ((i64::from(low) + i64::from(high)) / 2) as i32;
        if reaches(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    let threshold = float_of(low);
    let above = logits.iter().filter(|logit| **logit > threshold).count();
    (threshold, k - above + 1)
}

/// An integer ordered as the float is.
fn key_of(x: f32) -> i32 {
    let bits = x.to_bits() as i32;
    bits ^ (((bits >> 31) as u32) >> 1) as i32
}

fn float_of(key: i32) -> f32 {
    f32::from_bits((key ^ (((key >> 31) as u32) >> 1) as i32) as u32)
}

#[cfg(test)]
mod tests {
    use gump_geometry::DVec2;
    use gump_model::local_frame::LocalFrame;

    use super::*;
    use crate::temporal_ensemble::ChunkBuffer;

    fn request() -> Request {
        Request {
            local_frame: LocalFrame::SCENE,
            forced: [None; STEPS.len()],
            stream: Seed(3),
            near: None,
            ring: ChunkBuffer::default(),
            limits: None,
            frame: 0,
            guide: None,
        }
    }

    fn check(logits: &[f32], config: &SamplingConfig, seed: u64) -> u16 {
        let request = Request {
            stream: Seed(seed),
            ..request()
        };
        draw_field(logits, 0, &[], &request, config, &mut Vec::new())
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
            temperature: Some(0.0),
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
            temperature: Some(1.0),
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

    /// Prefers the first bin three to one, and allows but two.
    #[derive(Debug)]
    struct Prefers;

    impl Guide for Prefers {
        fn weights(&self, step: usize, _drawn: &[u16]) -> Option<Vec<f32>> {
            let mut weights = vec![0.0; STEPS[step].n_bins()];
            (weights[0], weights[5]) = (3.0, 1.0);
            Some(weights)
        }

        fn boldness(&self, _step: usize) -> f64 {
            4.0
        }

        fn smoothing(&self, _step: usize) -> Option<f32> {
            None
        }

        fn number(&self, step: usize) -> Option<f64> {
            (step == 1).then_some(0.76)
        }
    }

    #[test]
    fn guides_weigh_bins_whatever_the_temperature() {
        let guide: std::sync::Arc<dyn Guide> = std::sync::Arc::new(Prefers);
        let config = SamplingConfig {
            temperature: Some(0.5),
            top_k: 1000,
            ..SamplingConfig::default()
        };
        let drawn = |logits: &[f32], step: usize, i: u64| {
            let request = Request {
                stream: Seed(i),
                guide: Some(guide.clone()),
                ..request()
            };
            draw_field(logits, step, &[4], &request, &config, &mut Vec::new())
        };
        let n = |logits: &[f32]| {
            let draws = (0..4000).map(|i| drawn(logits, 0, i));
            draws
                .inspect(|bin| assert!([0, 5].contains(bin)))
                .filter(|bin| *bin == 0)
                .count() as i64
        };
        // Standard deviations are below 32.
        assert!((n(&[0.0; 14]) - 3000).abs() < 110);
        // At four times 0.5, odds of nine count as three.
        let mut logits = [0.0f32; 14];
        logits[5] = 9f32.ln();
        assert!((n(&logits) - 2000).abs() < 130);
        assert_eq!(drawn(&[0.0; 30], 1, 3), 5);
    }

    /// The `k` largest, the first of equal ones, by sorting.
    fn largest(logits: &[f32], k: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..logits.len()).collect();
        order.sort_by(|a, b| logits[*b].total_cmp(&logits[*a]).then(a.cmp(b)));
        order.truncate(k);
        order.sort_unstable();
        order
    }

    #[test]
    fn top_k_draws_from_the_k_largest() {
        let spread: Vec<f32> = (0..1000).map(|i| (i as f32 * 0.7).sin() * 9.0).collect();
        let ties: Vec<f32> = (0..1000).map(|i| (i % 7) as f32 - 3.0).collect();
        let flat = vec![-2.5; 1000];
        for logits in [spread, ties, flat] {
            for k in [2, 40, 999, 1000] {
                let sharpness = Sharpness {
                    top_k: k,
                    top_p: 1.0,
                    temperature: 1e6,
                };
                let mut room = Vec::new();
                let n = 4 * k;
                let mut drawn: Vec<usize> = (0..n)
                    .map(|i| draw(&logits, (i as f64 + 0.5) / n as f64, sharpness, &mut room))
                    .collect();
                drawn.dedup();
                assert_eq!(drawn, largest(&logits, k));
            }
        }
    }

    #[test]
    fn floats_keep_their_order_as_integers() {
        let floats = [
            f32::NEG_INFINITY,
            -2.0,
            -1e-30,
            0.0,
            1e-30,
            2.0,
            f32::INFINITY,
        ];
        assert!(floats.map(key_of).is_sorted());
        for x in floats {
            assert_eq!(float_of(key_of(x)).to_bits(), x.to_bits());
        }
    }
}
