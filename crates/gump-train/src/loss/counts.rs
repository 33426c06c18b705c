//! Numbers of targets in a batch, the denominators of its means.

use gump_model::decoder::STEPS;

use super::LossConfig;
use super::trajectory::limited_targets;
use crate::sample::{Sample, StateTarget};

/// Targets of each kind.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Counts {
    /// States by decoder step, weighted.
    pub(super) steps: Vec<f64>,
    pub(super) control: f64,
    pub(super) lights: f64,
    pub(super) classes: f64,
    pub(super) trajectories: f64,
    pub(crate) scenes: f64,
}

impl Counts {
    /// Those of some samples.
    pub(crate) fn of(samples: &[Sample], config: &LossConfig) -> Self {
        let sum =
            |count: &dyn Fn(&Sample) -> usize| samples.iter().map(count).sum::<usize>() as f64;
        let states = || samples.iter().flat_map(|sample| &sample.states);
        let of_step = |step| states().map(|target| weight(target, step, config)).sum();
        Self {
            steps: (0..STEPS.len()).map(of_step).collect(),
            control: sum(&|sample| sample.control.len()),
            lights: sum(&|sample| sample.lights.len()),
            classes: sum(&|sample| sample.classes.len()),
            trajectories: sum(&|sample| limited_targets(sample, config.max_trajectories).count()),
            scenes: samples.len() as f64,
        }
    }

    /// States over all steps, weighted; never 0, because it is a divisor.
    pub(super) fn states(&self) -> f64 {
        self.steps.iter().sum::<f64>().max(f64::MIN_POSITIVE)
    }

    /// All values in a row, for another process.
    pub(crate) fn numbers(&self) -> Vec<f32> {
        let others = [
            self.control,
            self.lights,
            self.classes,
            self.trajectories,
            self.scenes,
        ];
        let all = others.iter().chain(&self.steps);
        all.map(|&number| number as f32).collect()
    }

    /// From the values of [`Self::numbers`].
    pub(crate) fn of_numbers(numbers: &[f32]) -> Self {
        let number = |i: usize| f64::from(numbers[i]);
        Self {
            control: number(0),
            lights: number(1),
            classes: number(2),
            trajectories: number(3),
            scenes: number(4),
            steps: (5..numbers.len()).map(number).collect(),
        }
    }
}

/// Weight of a state target at a decoder step.
pub(super) fn weight(target: &StateTarget, step: usize, config: &LossConfig) -> f64 {
    match target.bins[step] {
        None => 0.0,
        Some(_) if target.is_known => 1.0,
        Some(_) => config.unknown,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_a_row_are_the_counts_again() {
        let row: Vec<f32> = (0..5 + STEPS.len()).map(|i| i as f32).collect();
        assert_eq!(Counts::of_numbers(&row).numbers(), row);
    }
}
