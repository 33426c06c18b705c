//! Targets that spread over neighbouring bins.

/// Spreads a target over its neighbours on an ordered scale of bins, as a discrete normal
/// distribution cut at four deviations, beyond which are 6e-5 of it, and scaled to sum 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OrdinalSmoothing {
    /// Standard deviation in bins, above 0.
    pub sigma_bins: f32,
    /// Whether the last bin neighbours the first, as for headings.
    pub circular: bool,
}

impl OrdinalSmoothing {
    /// Farthest bin that gets probability.
    pub fn radius(&self) -> usize {
        (4.0 * self.sigma_bins).ceil() as usize
    }

    fn weight(&self, distance: usize) -> f32 {
        let z = distance as f32 / self.sigma_bins;
        (-0.5 * z * z).exp()
    }

    /// Bins and probabilities of target `t` among `v` bins.
    pub fn spread(&self, t: usize, v: usize, bins: &mut Vec<(usize, f32)>) {
        let radius = self.radius();
        bins.clear();
        if self.circular {
            for step in 0..v {
                let distance = step.min(v - step);
                if distance <= radius {
                    bins.push(((t + step) % v, self.weight(distance)));
                }
            }
        } else {
            for bin in t.saturating_sub(radius)..(t + radius + 1).min(v) {
                bins.push((bin, self.weight(bin.abs_diff(t))));
            }
        }
        let total: f32 = bins.iter().map(|b| b.1).sum();
        for b in bins {
            b.1 /= total;
        }
    }
}
