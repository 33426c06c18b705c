//! Speed and curvature profiles of sequences of poses: the fits in the LQR tracker.
//!
//! Both fits are least squares over the displacements between poses a fixed time apart. Written in
//! speeds and curvatures instead of their rates of change the normal equations have two or fewer
//! off-diagonals, so they are solved exactly in linear time.
//!
//! Source: the profiles of nuPlan's LQR tracker (agree with its goldens to rounding).

use gump_geometry::{Pose, angle_difference};

// The weights are defaults of nuPlan's LQR tracker.
/// Weight of the squared change of acceleration between steps.
const JERK_WEIGHT: f64 = 1e-4;
/// Weight of the squared rate of change of curvature.
const CURVATURE_RATE_WEIGHT: f64 = 1e-2;
/// Weight of the first curvature squared; it matters only for standing vehicles.
const CURVATURE_WEIGHT: f64 = 1e-10;

/// The regularization of a fitted profile's accelerations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Smoothness {
    /// Changes of acceleration cost: nuPlan's tracker.
    Jerk,
    /// Accelerations except the last two cost, and the last change: PDM's batched tracker.
    Acceleration,
}

/// Speed and curvature over each displacement of a reference.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Profile {
    /// Metres per second; one per displacement.
    pub speeds: Vec<f64>,
    /// Radians per metre, positive to the left; one per displacement.
    pub curvatures: Vec<f64>,
}

/// Fits profiles to references of one length and time step; precomputes what depends only on those.
#[derive(Clone, Debug)]
pub struct ProfileFit {
    dt: f64,
    speeds: Banded,
    scratch: Banded,
}

impl ProfileFit {
    /// Prepares fits of `n` displacements, `dt` seconds each.
    pub fn new(n: usize, dt: f64, smoothness: Smoothness) -> Self {
        Self {
            dt,
            speeds: speed_equations(n, dt, smoothness),
            scratch: Banded::zeros(n),
        }
    }

    /// Number of displacements of a reference.
    pub fn n(&self) -> usize {
        self.speeds.diagonal.len()
    }

    /// Fits the speeds and curvatures of a reference of `n + 1` poses into `profile`.
    ///
    /// # Panics
    /// If the reference has another number of poses.
    pub fn fit(&mut self, poses: &[Pose], profile: &mut Profile) {
        let n = self.n();
        assert_eq!(
            poses.len(),
            n + 1,
            "a reference has one pose more than displacements"
        );
        profile.speeds.clear();
        profile.speeds.extend(poses.windows(2).map(|pair| {
            let moved = pair[1].position - pair[0].position;
            moved.dot(pair[0].direction()) * self.dt
        }));
        self.speeds.solve(&mut profile.speeds);
        self.fit_curvatures(poses, profile);
    }

    fn fit_curvatures(&mut self, poses: &[Pose], profile: &mut Profile) {
        let rate = CURVATURE_RATE_WEIGHT / (self.dt * self.dt);
        let n = self.n();
        self.scratch.reset();
        profile.curvatures.clear();
        for (i, (pair, &speed)) in poses.windows(2).zip(&profile.speeds).enumerate() {
            let driven = speed * self.dt;
            let turn = angle_difference(pair[1].heading, pair[0].heading);
            profile.curvatures.push(driven * turn);
            self.scratch.diagonal[i] += driven * driven;
            if i + 1 < n {
                self.scratch.diagonal[i] += rate;
                self.scratch.diagonal[i + 1] += rate;
                self.scratch.first[i] -= rate;
            }
        }
        if let Some(first) = self.scratch.diagonal.first_mut() {
            *first += CURVATURE_WEIGHT;
        }
        self.scratch.factorize();
        self.scratch.solve(&mut profile.curvatures);
    }
}

fn speed_equations(n: usize, dt: f64, smoothness: Smoothness) -> Banded {
    let mut equations = Banded::zeros(n);
    for i in 0..n {
        equations.diagonal[i] = dt * dt;
    }
    let per_speed = JERK_WEIGHT / (dt * dt);
    match smoothness {
        Smoothness::Jerk => {
            for j in 0..n.saturating_sub(2) {
                equations.add_jerk(j, per_speed);
            }
        }
        Smoothness::Acceleration => {
            for j in 0..n.saturating_sub(3) {
                equations.diagonal[j] += per_speed;
                equations.diagonal[j + 1] += per_speed;
                equations.first[j] -= per_speed;
            }
            if n >= 3 {
                equations.add_jerk(n - 3, per_speed);
            }
        }
    }
    equations.factorize();
    equations
}

/// A symmetric matrix with two off-diagonals, or its factors L D Lᵀ in the same place.
#[derive(Clone, Debug)]
struct Banded {
    diagonal: Vec<f64>,
    first: Vec<f64>,
    second: Vec<f64>,
}

impl Banded {
    fn zeros(n: usize) -> Self {
        Self {
            diagonal: vec![0.0; n],
            first: vec![0.0; n],
            second: vec![0.0; n],
        }
    }

    fn reset(&mut self) {
        for values in [&mut self.diagonal, &mut self.first, &mut self.second] {
            values.fill(0.0);
        }
    }

    /// Adds `weight * (x[j] - 2 x[j+1] + x[j+2])²`.
    fn add_jerk(&mut self, j: usize, weight: f64) {
        self.diagonal[j] += weight;
        self.diagonal[j + 1] += 4.0 * weight;
        self.diagonal[j + 2] += weight;
        self.first[j] -= 2.0 * weight;
        self.first[j + 1] -= 2.0 * weight;
        self.second[j] += weight;
    }

    fn factorize(&mut self) {
        for i in 0..self.diagonal.len() {
            if i >= 1 {
                self.diagonal[i] -= self.first[i - 1].powi(2) * self.diagonal[i - 1];
                self.first[i] -= self.second[i - 1] * self.first[i - 1] * self.diagonal[i - 1];
            }
            if i >= 2 {
                self.diagonal[i] -= self.second[i - 2].powi(2) * self.diagonal[i - 2];
            }
            self.first[i] /= self.diagonal[i];
            self.second[i] /= self.diagonal[i];
        }
    }

    /// Solves in place; the matrix must be factorized.
    fn solve(&self, x: &mut [f64]) {
        let n = x.len();
        for i in 0..n {
            if i >= 1 {
                x[i] -= self.first[i - 1] * x[i - 1];
            }
            if i >= 2 {
                x[i] -= self.second[i - 2] * x[i - 2];
            }
        }
        for i in (0..n).rev() {
            x[i] /= self.diagonal[i];
            if i + 1 < n {
                x[i] -= self.first[i] * x[i + 1];
            }
            if i + 2 < n {
                x[i] -= self.second[i] * x[i + 2];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    #[test]
    fn banded_solutions_satisfy_their_equations() {
        let mut equations = Banded::zeros(7);
        equations.diagonal.fill(0.5);
        for j in 0..5 {
            equations.add_jerk(j, 0.3 + 0.1 * j as f64);
        }
        let whole = equations.clone();
        equations.factorize();
        let right: Vec<f64> = (0..7).map(|i| (i as f64 * 1.7).sin()).collect();
        let mut x = right.clone();
        equations.solve(&mut x);
        for i in 0..7 {
            let mut sum = whole.diagonal[i] * x[i];
            for (band, reach) in [(&whole.first, 1), (&whole.second, 2)] {
                if i + reach < 7 {
                    sum += band[i] * x[i + reach];
                }
                if i >= reach {
                    sum += band[i - reach] * x[i - reach];
                }
            }
            assert_abs_diff_eq!(sum, right[i], epsilon = 1e-12);
        }
    }

    #[test]
    fn a_circle_at_constant_speed_is_recognised() {
        let (speed, curvature, dt) = (5.0, 0.05, 0.1);
        let poses: Vec<Pose> = (0..=20)
            .map(|i| {
                let angle = speed * curvature * dt * f64::from(i);
                Pose::new(
                    angle.sin() / curvature,
                    (1.0 - angle.cos()) / curvature,
                    angle,
                )
            })
            .collect();
        let mut profile = Profile::default();
        ProfileFit::new(20, dt, Smoothness::Jerk).fit(&poses, &mut profile);
        for i in 0..20 {
            // A chord is shorter than its arc.
            assert_abs_diff_eq!(profile.speeds[i], speed, epsilon = 2e-3);
            assert_abs_diff_eq!(profile.curvatures[i], curvature, epsilon = 2e-4);
        }
    }
}
