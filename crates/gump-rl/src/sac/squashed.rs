//! A normal distribution squashed into (-1, 1) by tanh: one component of a policy.
//!
//! Densities are those of the action, so they include the Jacobian of tanh. Source: Haarnoja et al.
//! 2018, appendix C; `ln(1 - tanh(u)^2) = 2 (ln 2 - u - softplus(-2u))` keeps its precision for
//! large `u`.

use std::f64::consts::{LN_2, PI};

/// Farthest from 0 that an action may be before it is taken back through tanh, where the value
/// before is 7.25: logged actions at a limit would have an infinite one.
const EDGE: f64 = 1.0 - 1e-6;

/// Farthest from 0 that an expert's action is imitated, where the value before tanh is 2.3: beyond,
/// an action hardly changes, but the gradient grows with that value. Chosen by hand.
const SHOWN: f64 = 0.98;

/// The distribution of one component of an action.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Squashed {
    mean: f64,
    log_std: f64,
    /// The network's output, less the nearest value within bounds.
    beyond: f64,
}

/// A sample, its density, and their derivatives; [`Squashed::descent`] makes gradients by the
/// network's outputs of these.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Draw {
    /// In (-1, 1).
    pub action: f64,
    /// Of the action, nats.
    pub log_density: f64,
    /// d action / d (mean, log standard deviation), with fixed noise.
    pub action_by: [f64; 2],
    /// d log density / d (mean, log standard deviation), with fixed noise.
    pub log_density_by: [f64; 2],
}

impl Squashed {
    /// From two outputs of a network; the second is clamped to `bounds`.
    pub fn new(mean: f32, log_std: f32, bounds: [f64; 2]) -> Self {
        let raw = f64::from(log_std);
        let clamped = raw.clamp(bounds[0], bounds[1]);
        Self {
            mean: f64::from(mean),
            log_std: clamped,
            beyond: raw - clamped,
        }
    }

    /// The action without exploration: tanh of the mean.
    pub fn mode(&self) -> f64 {
        self.mean.tanh()
    }

    /// The gradient of a loss by the network's outputs, from that by (mean, log standard deviation):
    /// where the second output is out of bounds, 0 if descent would carry it farther out.
    pub fn descent(&self, [by_mean, by_log_std]: [f64; 2]) -> [f64; 2] {
        let leads_out = self.beyond * by_log_std < 0.0;
        [by_mean, if leads_out { 0.0 } else { by_log_std }]
    }

    /// The action of standard normal `noise`.
    pub fn draw(&self, noise: f64) -> Draw {
        let spread = self.log_std.exp() * noise;
        let u = self.mean + spread;
        let action = u.tanh();
        let slope = 1.0 - action * action;
        Draw {
            action,
            log_density: log_normal(noise, self.log_std) - log_slope(u),
            action_by: [slope, slope * spread],
            log_density_by: [2.0 * action, 2.0 * action * spread - 1.0],
        }
    }

    /// [`Self::log_density`] of an expert's action, taken as at most 0.98 from 0: those at a limit
    /// of the dynamics would demand means that no gradient of rewards moves away from.
    pub fn log_density_of_shown(&self, action: f64) -> (f64, [f64; 2]) {
        self.log_density(action.clamp(-SHOWN, SHOWN))
    }

    /// Log density of an action, nats, and its gradient by (mean, log standard deviation).
    ///
    /// Actions are taken as at most 1e-6 from the edge, where the density vanishes.
    pub fn log_density(&self, action: f64) -> (f64, [f64; 2]) {
        let u = action.clamp(-EDGE, EDGE).atanh();
        let noise = (u - self.mean) / self.log_std.exp();
        let by_mean = noise / self.log_std.exp();
        let by_log_std = noise * noise - 1.0;
        let value = log_normal(noise, self.log_std) - log_slope(u);
        (value, [by_mean, by_log_std])
    }
}

/// Log density of `mean + std * noise`, nats.
fn log_normal(noise: f64, log_std: f64) -> f64 {
    -0.5 * (noise * noise + (2.0 * PI).ln()) - log_std
}

/// `ln(1 - tanh(u)^2)`.
fn log_slope(u: f64) -> f64 {
    let x = -2.0 * u;
    let softplus = x.max(0.0) + (-x.abs()).exp().ln_1p();
    2.0 * (LN_2 - u - softplus)
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS: [f64; 2] = [-20.0, 2.0];

    #[test]
    fn densities_integrate_to_1() {
        for mean in [0.0f32, 1.0, 3.0] {
            for std in [0.1f32, 1.0] {
                let policy = Squashed::new(mean, std.ln(), BOUNDS);
                // Over u, where the integrand is smooth: da = (1 - tanh(u)^2) du.
                let (n, lo, hi) = (40_000, -9.0, 9.0);
                let h = (hi - lo) / f64::from(n);
                let integral: f64 = (0..n)
                    .map(|i| lo + (f64::from(i) + 0.5) * h)
                    .filter(|u| u.tanh().abs() < EDGE)
                    .map(|u: f64| (policy.log_density(u.tanh()).0 + log_slope(u)).exp() * h)
                    .sum();
                assert!((integral - 1.0).abs() < 1e-4, "{mean}, {std}: {integral}");
            }
        }
    }

    #[test]
    fn densities_far_out_are_finite_and_right() {
        // u = 30: 1 - tanh^2 is 4 exp(-60), which f64 cannot tell from 0 as 1 - 1.
        let draw = Squashed::new(30.0, 0.0, BOUNDS).draw(0.0);
        let expected = -0.5 * (2.0 * PI).ln() - (4.0f64.ln() - 60.0);
        assert!(
            (draw.log_density - expected).abs() < 1e-9,
            "{}",
            draw.log_density
        );
        assert_eq!(draw.action, 1.0);
        assert!((log_slope(0.7) - (1.0 - 0.7f64.tanh().powi(2)).ln()).abs() < 1e-14);
    }

    #[test]
    fn a_draw_has_the_density_of_its_action() {
        for (mean, log_std, noise) in [(0.3f32, -1.0f32, 0.7), (-1.2, 0.1, -0.4), (2.0, -3.0, 1.5)]
        {
            let policy = Squashed::new(mean, log_std, BOUNDS);
            let draw = policy.draw(noise);
            let (log_density, _) = policy.log_density(draw.action);
            assert!((draw.log_density - log_density).abs() < 1e-6);
        }
    }

    fn check_gradient(value: impl Fn(f32, f32) -> f64, found: [f64; 2], at: [f32; 2]) {
        let h = 1.0f32 / 1024.0;
        let [m, s] = at;
        let by_mean = (value(m + h, s) - value(m - h, s)) / f64::from(2.0 * h);
        let by_std = (value(m, s + h) - value(m, s - h)) / f64::from(2.0 * h);
        for (found, expected) in found.into_iter().zip([by_mean, by_std]) {
            let error = (found - expected).abs();
            assert!(error < 1e-4 * (1.0 + expected.abs()), "{found}, {expected}");
        }
    }

    #[test]
    fn gradients_are_finite_differences() {
        for at in [[0.25f32, -1.0], [-1.5, 0.5], [0.0, -2.5]] {
            let of = |m, s| Squashed::new(m, s, BOUNDS);
            let draw = of(at[0], at[1]).draw(0.8);
            check_gradient(|m, s| of(m, s).draw(0.8).action, draw.action_by, at);
            check_gradient(
                |m, s| of(m, s).draw(0.8).log_density,
                draw.log_density_by,
                at,
            );
            let (_, gradient) = of(at[0], at[1]).log_density(0.6);
            check_gradient(|m, s| of(m, s).log_density(0.6).0, gradient, at);
        }
    }

    #[test]
    fn beyond_the_bounds_only_the_gradient_back_counts() {
        let wide = Squashed::new(0.5, 3.0, BOUNDS);
        let action = wide.draw(-0.2).action;
        assert!((action - (0.5 - 0.2 * 2.0f64.exp()).tanh()).abs() < 1e-12);
        let narrow = Squashed::new(0.5, -30.0, BOUNDS);
        let within = Squashed::new(0.5, -1.0, BOUNDS);
        for (policy, widens, narrows) in
            [(wide, 0.0, 2.0), (narrow, -2.0, 0.0), (within, -2.0, 2.0)]
        {
            // Descent widens by a negative gradient.
            assert_eq!(policy.descent([3.0, -2.0]), [3.0, widens]);
            assert_eq!(policy.descent([3.0, 2.0]), [3.0, narrows]);
        }
    }

    #[test]
    fn actions_at_the_edge_are_imitated_as_nearly_there() {
        let policy = Squashed::new(0.0, 0.0, BOUNDS);
        let (_, by) = policy.log_density_of_shown(-1.0);
        assert!((by[0] + 0.98f64.atanh()).abs() < 1e-12, "{by:?}");
        assert_eq!(policy.log_density_of_shown(0.3), policy.log_density(0.3));
    }
}
