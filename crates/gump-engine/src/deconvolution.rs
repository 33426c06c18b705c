//! Removal of label smoothing by deconvolution: a network trained on targets smoothed over
//! neighbouring bins outputs equally smoothed distributions, which matters where bins are coarse.
//!
//! Source: Richardson 1972 and Lucy 1974.

use gump_kernels::smoothing::OrdinalSmoothing;

/// Number of iterations, enough to make peaks as sharp as the unsmoothed targets (see the test);
/// more would amplify the network's noise.
const ROUNDS: usize = 20;

/// The logits of the distribution that, smoothed as by `smoothing`, is that of `logits`.
pub(crate) fn unsmoothed(logits: &[f32], smoothing: OrdinalSmoothing) -> Vec<f32> {
    let n = logits.len();
    let peak = logits.iter().copied().fold(f32::MIN, f32::max);
    let observed: Vec<f32> = logits.iter().map(|logit| (logit - peak).exp()).collect();
    let mut spreads = vec![Vec::new(); n];
    for (bin, spread) in spreads.iter_mut().enumerate() {
        smoothing.spread(bin, n, spread);
    }
    let mut sharp = observed.clone();
    let mut blurred = vec![0.0f32; n];
    for _ in 0..ROUNDS {
        blurred.fill(0.0);
        for (mass, spread) in sharp.iter().zip(&spreads) {
            for (bin, share) in spread {
                blurred[*bin] += mass * share;
            }
        }
        for (mass, spread) in sharp.iter_mut().zip(&spreads) {
            let ratio =
                |&(bin, share): &(usize, f32)| share * observed[bin] / blurred[bin].max(1e-30);
            *mass *= spread.iter().map(ratio).sum::<f32>();
        }
    }
    sharp.iter().map(|mass| mass.max(1e-30).ln()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_spread_is_gathered() {
        let smoothing = OrdinalSmoothing {
            sigma_bins: 0.7,
            circular: false,
        };
        let mut truth = [0.0f32; 30];
        (truth[0], truth[9], truth[10], truth[23]) = (0.2, 0.5, 0.25, 0.05);
        let mut spread = Vec::new();
        let mut blurred = [1e-12f32; 30];
        for (bin, mass) in truth.iter().enumerate() {
            smoothing.spread(bin, 30, &mut spread);
            spread
                .iter()
                .for_each(|(at, share)| blurred[*at] += mass * share);
        }
        let logits = blurred.map(|mass| mass.ln() - 3.0);
        let sharp = unsmoothed(&logits, smoothing);
        let weights: Vec<f32> = sharp.iter().map(|logit| logit.exp()).collect();
        let total: f32 = weights.iter().sum();
        for (bin, mass) in truth.iter().enumerate() {
            let found = weights[bin] / total;
            assert!((found - mass).abs() < 0.05, "{bin}: {found} for {mass}");
        }
    }
}
