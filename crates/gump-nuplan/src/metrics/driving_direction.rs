//! Driving against the direction of traffic.

use super::history::SimulationHistory;
use super::lanes::Lanes;
use super::statistics::mean_step;

/// Thresholds of backward progress in a time window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DrivingDirectionConfig {
    /// Less than this is compliant, metres.
    pub compliant: f64,
    /// Less than this halves the score, metres; more cancels it.
    pub violation: f64,
    /// Length of the window, seconds.
    pub window: f64,
}

impl Default for DrivingDirectionConfig {
    /// The values of nuPlan's challenges and of the paper.
    fn default() -> Self {
        Self {
            compliant: 2.0,
            violation: 6.0,
            window: 1.0,
        }
    }
}

/// Whether the ego drove against the traffic.
#[derive(Clone, Debug, PartialEq)]
pub struct DrivingDirection {
    /// 1, 0.5 or 0.
    pub score: f64,
    /// Magnitude of the lowest progress in a window, metres. (Progress is 0 at first, so the
    /// minimum is never positive.)
    pub against: f64,
    /// Per sample, progress along the lane in the window that ends there, metres.
    pub series: Vec<f64>,
}

/// Evaluates a drive; `followed` are the lanes of its samples.
///
/// Progress is measured along the centre line of the first lane. After a change of lane it is 0 for
/// two samples, until there is a distance to compare with.
///
/// Source: nuPlan's `driving_direction_compliance`.
pub fn driving_direction(
    drive: &SimulationHistory<'_>,
    followed: &[Lanes<'_>],
    config: &DrivingDirectionConfig,
) -> DrivingDirection {
    let progress = lane_progress(drive, followed);
    let mean_us = mean_step(&drive.times_us()) * 1e6;
    let n_window = if mean_us > 0.0 {
        (1e6 * config.window / mean_us) as usize
    } else {
        0
    };
    let window = |k: usize| progress[k.saturating_sub(n_window)..=k].iter().sum();
    let series: Vec<f64> = (0..progress.len()).map(window).collect();
    let against = series
        .iter()
        .copied()
        .reduce(f64::min)
        .map_or(0.0, f64::abs);
    let score = if against < config.compliant {
        1.0
    } else if against < config.violation {
        0.5
    } else {
        0.0
    };
    DrivingDirection {
        score,
        against,
        series,
    }
}

/// Distance along the followed lane since the previous sample, metres.
fn lane_progress(drive: &SimulationHistory<'_>, followed: &[Lanes<'_>]) -> Vec<f64> {
    let mut lane_before = None;
    let mut distance_before = None;
    let centres = drive.centres();
    let steps = followed.iter().zip(centres).enumerate();
    let steps = steps.map(|(k, (lanes, centre))| {
        let Some(lane) = lanes.first() else {
            return 0.0;
        };
        let is_new = lane_before != Some(lane.id);
        lane_before = Some(lane.id);
        if is_new && k > 0 {
            distance_before = None;
            return 0.0;
        }
        let distance = lane.centerline.project(centre).arc_length;
        let before = distance_before.replace(distance);
        match before {
            // A distance of exactly 0 counts as unknown in the devkit.
            Some(before) if distance != 0.0 => distance - before,
            _ => 0.0,
        }
    });
    steps.collect()
}
