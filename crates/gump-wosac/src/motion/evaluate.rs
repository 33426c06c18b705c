//! Checks the predictions of one scenario and measures them.

use std::collections::BTreeSet;

use gump_geometry::DVec2;
use gump_scene::{AgentId, AgentKind, Prediction, Scenario};

use super::config::{Horizon, MotionConfig};
use super::error::{MotionError, MotionProblem};
use super::measure::Measured;
use super::shape::Shape;

/// The measurements of one prediction.
#[derive(Clone, Debug, PartialEq)]
pub struct PredictionScore {
    /// The predicted agents.
    pub agents: Vec<AgentId>,
    /// The kind of agent it counts for: the rarest among those predicted together.
    pub kind: AgentKind,
    /// The shape it counts for; `None` if no agent is recorded now and later.
    pub shape: Option<Shape>,
    /// In the order of [`MotionConfig::horizons`].
    pub horizons: Vec<HorizonScore>,
}

/// The measurements of one prediction at one horizon. `None` where nothing was recorded to compare
/// with.
#[derive(Clone, Debug, PartialEq)]
pub struct HorizonScore {
    /// Average displacement of the best mode, metres.
    pub min_ade: Option<f64>,
    /// Displacement of the best mode at the horizon, metres.
    pub min_fde: Option<f64>,
    /// True if the most confident mode has overlapped another agent by then.
    pub overlaps: bool,
    /// Every mode that counts, in the order of the predictor.
    pub modes: Vec<ModeScore>,
}

/// The measurements of one mode at one horizon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModeScore {
    /// As given by the predictor.
    pub confidence: f64,
    /// True if the mode matches the log; `None` if that is not known.
    pub matches: Option<bool>,
}

impl HorizonScore {
    /// True if no mode matches the log; `None` if that is not known of any.
    pub fn missed(&self) -> Option<bool> {
        let known = self.modes.iter().filter_map(|mode| mode.matches);
        known.fold(None, |missed, matches| {
            Some(missed.unwrap_or(true) && !matches)
        })
    }
}

/// Measures the predictions of one scenario against its log; the scores are in their order.
///
/// The agents predicted must be exactly the scenario's targets, alone or together. Modes beyond
/// [`MotionConfig::max_modes`] are ignored, even if one of them is the best.
///
/// # Errors
/// [`MotionError`] with the first mismatch.
///
/// Source: the metric code of the Waymo motion prediction challenge (as of March 2025); agrees
/// with its numbers to 1e-6.
pub fn evaluate_predictions(
    scenario: &Scenario,
    predictions: &[Prediction],
    config: &MotionConfig,
) -> Result<Vec<PredictionScore>, MotionError> {
    let scores = check(scenario, predictions, config).and_then(|stride| {
        let score = |prediction| {
            score(&Measured {
                scenario,
                prediction,
                config,
                stride,
            })
        };
        predictions.iter().map(score).collect()
    });
    scores.map_err(|problem| MotionError {
        scenario: scenario.id.clone(),
        problem,
    })
}

fn score(measured: &Measured<'_>) -> Result<PredictionScore, MotionProblem> {
    let agents = measured.prediction.agents.clone();
    let first_overlap = measured.first_overlap();
    let at = |horizon: &Horizon| HorizonScore {
        min_ade: measured.min_ade(horizon),
        min_fde: measured.min_fde(horizon),
        overlaps: first_overlap.is_some_and(|step| step <= horizon.step),
        modes: measured.modes(horizon),
    };
    Ok(PredictionScore {
        kind: measured.kind()?,
        shape: measured.shape(),
        horizons: measured.config.horizons.iter().map(at).collect(),
        agents,
    })
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
