//! A normal distribution squashed into (-1, 1) by tanh: one component of a policy.
//!
//! Densities are those of the action, so they include the Jacobian of tanh. Source: Haarnoja et al.
//! 2018, appendix C; `ln(1 - tanh(u)^2) = 2 (ln 2 - u - softplus(-2u))` keeps its precision for
//! large `u`.

use std::f64::consts::{LN_2, PI};

/// Farthest from 0 that an action may be before it is taken back through tanh, where the value
/// before is 7.25: logged actions at a limit would have an infinite one.
const EDGE: f64 = 1.0 - 1e-6;

/// The distribution of one component of an action.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Squashed {
    mean: f64,
    log_std: f64,
    /// 0 where the bounds of the standard deviation hold, else 1.
    std_moves: f64,
}

/// A sample, its density, and their derivatives by the network's outputs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Draw {
    /// In (-1, 1).
    pub action: f64,
    /// Of the action, nats.
    pub log_density: f64,
    /// d action / d (mean, raw log standard deviation), with fixed noise.
    pub action_by: [f64; 2],
    /// d log density / d (mean, raw log standard deviation), with fixed noise.
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
            std_moves: if clamped == raw { 1.0 } else { 0.0 },
        }
    }

    /// The action without exploration: tanh of the mean.
    pub fn mode(&self) -> f64 {
        self.mean.tanh()
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
            action_by: [slope, slope * spread * self.std_moves],
            log_density_by: [2.0 * action, (2.0 * action * spread - 1.0) * self.std_moves],
        }
    }

    /// Log density of an action, nats, and its gradient by (mean, raw log standard deviation).
    ///
    /// Actions are taken as at most 1e-6 from the edge, where the density vanishes.
    pub fn log_density(&self, action: f64) -> (f64, [f64; 2]) {
        let u = action.clamp(-EDGE, EDGE).atanh();
        let noise = (u - self.mean) / self.log_std.exp();
        let by_mean = noise / self.log_std.exp();
        let by_log_std = (noise * noise - 1.0) * self.std_moves;
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
    fn bounds_of_the_standard_deviation_stop_its_gradient() {
        let draw = Squashed::new(0.5, 3.0, BOUNDS).draw(-0.2);
        assert_eq!((draw.action_by[1], draw.log_density_by[1]), (0.0, 0.0));
        assert!((draw.action - (0.5 - 0.2 * 2.0f64.exp()).tanh()).abs() < 1e-12);
        let (_, gradient) = Squashed::new(0.5, -30.0, [-5.0, 2.0]).log_density(0.4);
        assert_eq!(gradient[1], 0.0);
    }
}
