//! From the predictions of one scenario to measurements, after a look at whether they fit.

use std::collections::{BTreeMap, BTreeSet};

use gump_geometry::DVec2;
use gump_scene::{AgentId, Prediction, Scenario};

use super::config::MotionConfig;
use super::error::{MotionError, MotionProblem};
use super::measure::{Measured, kind_of};
use super::precision::PrecisionSamples;
use super::shape::Shape;
use super::tally::{MotionCell, MotionTally};

/// Measures the predictions of one scenario against its log.
///
/// The agents predicted must be exactly the scenario's targets, alone or together. Modes beyond
/// [`MotionConfig::max_modes`] are ignored, even if one of them is the best.
///
/// # Errors
/// [`MotionError`] with the first thing that does not fit.
///
/// Source: the metric code of the Waymo motion prediction challenge (as of March 2025); agrees
/// with its numbers to 1e-6.
pub fn evaluate_predictions(
    scenario: &Scenario,
    predictions: &[Prediction],
    config: &MotionConfig,
) -> Result<MotionTally, MotionError> {
    let stride = check(scenario, predictions, config).map_err(|problem| MotionError {
        scenario: scenario.id.clone(),
        problem,
    })?;
    let mut tally = MotionTally::default();
    for prediction in predictions {
        let measured = Measured {
            scenario,
            prediction,
            config,
            stride,
        };
        add(&mut tally, &measured);
    }
    Ok(tally)
}

fn add(tally: &mut MotionTally, measured: &Measured<'_>) {
    let Some(kind) = measured.kind() else {
        return;
    };
    let shape = measured.shape();
    let first_overlap = measured.first_overlap();
    for (h, horizon) in measured.config.horizons.iter().enumerate() {
        let cell = tally.cells.entry((kind, h)).or_default();
        if let Some(error) = measured.min_ade(horizon) {
            cell.min_ade.add(error);
        }
        if let Some(error) = measured.min_fde(horizon) {
            cell.min_fde.add(error);
        }
        let overlaps = first_overlap.is_some_and(|step| step <= horizon.step);
        cell.overlap_rate.add(f64::from(overlaps));
        let matches = measured.matches(horizon);
        let known: Vec<bool> = matches.iter().copied().flatten().collect();
        if !known.is_empty() {
            let missed = !known.contains(&true);
            cell.miss_rate.add(f64::from(missed));
        }
        if let Some(shape) = shape {
            let modes = measured.modes().iter().map(|mode| mode.confidence);
            let modes: Vec<_> = modes.zip(matches).collect();
            let MotionCell {
                precision,
                soft_precision,
                ..
            } = cell;
            let of_shape = |by_shape: &mut BTreeMap<Shape, PrecisionSamples>,
                            later_matches_count| {
                let samples = by_shape.entry(shape).or_default();
                samples.add(&modes, later_matches_count);
            };
            of_shape(precision, true);
            of_shape(soft_precision, false);
        }
    }
}

/// The recorded frames between positions of a path, if everything fits.
fn check(
    scenario: &Scenario,
    predictions: &[Prediction],
    config: &MotionConfig,
) -> Result<usize, MotionProblem> {
    let stride = stride(scenario, config)?;
    let (expected, found) = (config.n_steps * stride, scenario.future().len());
    if found < expected {
        return Err(MotionProblem::ShortLog { expected, found });
    }
    let mut seen = BTreeSet::new();
    for (i, prediction) in predictions.iter().enumerate() {
        check_prediction(i, prediction, config)?;
        for &agent in &prediction.agents {
            if !seen.insert(agent) {
                return Err(MotionProblem::Duplicate(agent));
            }
            if !scenario.targets.contains(&agent) {
                return Err(MotionProblem::Unexpected(agent));
            }
            if kind_of(scenario, agent).is_none() {
                return Err(MotionProblem::NeverPresent(agent));
            }
        }
    }
    match scenario
        .targets
        .iter()
        .find(|target| !seen.contains(target))
    {
        Some(&missing) => Err(MotionProblem::Missing(missing)),
        None => Ok(stride),
    }
}

/// Recorded frames between positions of a path.
pub(crate) fn stride(scenario: &Scenario, config: &MotionConfig) -> Result<usize, MotionProblem> {
    let stride = (config.step_seconds / scenario.dt).round();
    // Time steps are decimal fractions, so their ratio is exact up to rounding.
    let fits = (stride * scenario.dt - config.step_seconds).abs() < 1e-6;
    if stride >= 1.0 && fits {
        return Ok(stride as usize);
    }
    Err(MotionProblem::TimeStep {
        expected: config.step_seconds,
        found: scenario.dt,
    })
}

fn check_prediction(
    index: usize,
    prediction: &Prediction,
    config: &MotionConfig,
) -> Result<(), MotionProblem> {
    let Some(&first) = prediction.agents.first() else {
        return Err(MotionProblem::NoAgents(index));
    };
    if prediction.modes.is_empty() {
        return Err(MotionProblem::NoModes(first));
    }
    for (m, mode) in prediction.modes.iter().enumerate() {
        let (expected, found) = (prediction.agents.len(), mode.paths.len());
        if found != expected {
            return Err(MotionProblem::PathCount {
                agent: first,
                mode: m,
                expected,
                found,
            });
        }
        if !mode.confidence.is_finite() {
            return Err(MotionProblem::Confidence {
                agent: first,
                mode: m,
            });
        }
        for (&agent, path) in prediction.agents.iter().zip(&mode.paths) {
            check_path(agent, m, path, config.n_steps)?;
        }
    }
    Ok(())
}

fn check_path(
    agent: AgentId,
    mode: usize,
    path: &[DVec2],
    expected: usize,
) -> Result<(), MotionProblem> {
    let found = path.len();
    if found != expected {
        return Err(MotionProblem::PathLength {
            agent,
            mode,
            expected,
            found,
        });
    }
    match path.iter().position(|position| !position.is_finite()) {
        Some(step) => Err(MotionProblem::Position { agent, mode, step }),
        None => Ok(()),
    }
}
