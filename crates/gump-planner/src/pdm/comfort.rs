//! Comfort of tracked proposals.
//!
//! The bounds are those of the metric; windows and polynomials are PDM's, because a proposal is
//! only as long as a window.

use gump_geometry::angle_difference;
use gump_metrics::{ComfortBounds, ComfortMeasurements};
use gump_nuplan::metrics::SavitzkyGolay;
use gump_scene::EgoState;

/// Filters for drives of one length, as matrices.
#[derive(Clone, Debug)]
pub(crate) struct ComfortFilters {
    acceleration: Filter,
    smoothing: Filter,
    jerk: Filter,
    yaw_rate: Filter,
    yaw_acceleration: Filter,
    scratch: [Vec<f64>; 6],
}

/// A linear filter of series of one length: for every value the start of its window and its
/// weights.
#[derive(Clone, Debug)]
struct Filter {
    rows: Vec<(usize, Vec<f64>)>,
}

impl Filter {
    fn new(n: usize, window: usize, polynomial: usize, derivative: usize, delta: f64) -> Self {
        let window = window.min(n);
        let filter = SavitzkyGolay {
            window,
            polynomial,
            derivative,
            delta,
        };
        // The filter is linear, so its impulse responses determine it; and it is the
        // metric's own.
        let mut columns = Vec::with_capacity(n);
        for i in 0..n {
            let mut impulse = vec![0.0; n];
            impulse[i] = 1.0;
            columns.push(
                filter
                    .filter(&impulse)
                    .expect("a window longer than its polynomial"),
            );
        }
        let row = |i: usize| {
            let weights: Vec<f64> = columns.iter().map(|column| column[i]).collect();
            let first = weights.iter().position(|&w| w != 0.0).unwrap_or(0);
            let last = weights.iter().rposition(|&w| w != 0.0).unwrap_or(0);
            (first, weights[first..=last].to_vec())
        };
        Self {
            rows: (0..n).map(row).collect(),
        }
    }

    fn apply(&self, values: &[f64], filtered: &mut Vec<f64>) {
        filtered.clear();
        filtered.extend(self.rows.iter().map(|(first, weights)| {
            let window = &values[*first..*first + weights.len()];
            weights.iter().zip(window).map(|(w, v)| w * v).sum::<f64>()
        }));
    }
}

impl ComfortFilters {
    /// For drives of `n` states, `dt` seconds apart.
    pub(crate) fn new(n: usize, dt: f64) -> Self {
        Self {
            acceleration: Filter::new(n, n, 2, 0, 1.0),
            smoothing: Filter::new(n, 8, 2, 0, 1.0),
            jerk: Filter::new(n, n, 2, 1, dt),
            yaw_rate: Filter::new(n, 5, 2, 1, dt),
            yaw_acceleration: Filter::new(n, 5, 3, 2, dt),
            scratch: Default::default(),
        }
    }

    /// True if all states of the drive stay within the bounds of nuPlan's comfort metric.
    pub(crate) fn are_comfortable(&mut self, states: &[EgoState]) -> bool {
        let bounds = &ComfortBounds::NUPLAN;
        let [raw, smooth, a, b, c, d] = &mut self.scratch;
        let read = |raw: &mut Vec<f64>, value: fn(&EgoState) -> f64| {
            raw.clear();
            raw.extend(states.iter().map(value));
        };
        read(raw, |s| s.acceleration.x);
        self.acceleration.apply(raw, a);
        self.smoothing.apply(raw, smooth);
        self.jerk.apply(smooth, b);
        read(raw, |s| s.acceleration.y);
        self.acceleration.apply(raw, c);
        read(raw, |s| s.acceleration.length());
        self.smoothing.apply(raw, smooth);
        self.jerk.apply(smooth, d);
        let felt = |i: usize| ComfortMeasurements {
            longitudinal_acceleration: a[i],
            lateral_acceleration: c[i],
            longitudinal_jerk: Some(b[i]),
            jerk: Some(d[i]),
            yaw_rate: None,
            yaw_acceleration: None,
        };
        if !(0..states.len()).all(|i| bounds.allow(&felt(i))) {
            return false;
        }
        let mut heading = states[0].rear_axle.heading;
        raw.clear();
        for state in states {
            heading += angle_difference(state.rear_axle.heading, heading);
            raw.push(heading);
        }
        self.yaw_rate.apply(raw, a);
        self.yaw_acceleration.apply(raw, b);
        let turned = |i: usize| ComfortMeasurements {
            longitudinal_acceleration: 0.0,
            lateral_acceleration: 0.0,
            longitudinal_jerk: None,
            jerk: None,
            yaw_rate: Some(a[i]),
            yaw_acceleration: Some(b[i]),
        };
        (0..states.len()).all(|i| bounds.allow(&turned(i)))
    }
}
