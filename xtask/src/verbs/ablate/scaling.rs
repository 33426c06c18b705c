//! `ablate scaling`: one network in three widths, trained on the same samples: how loss falls with
//! tokens and parameters, and how real the traffic of each is.
//!
//! The law is loss = A · tokens^-t · parameters^-p. Every width is measured after the same tokens, so
//! the two exponents are fitted apart from each other.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use gump_metrics::interval;
use gump_metrics::wosac::Scores;
use gump_model::checkpoint::{self, Precision};
use gump_model::{Mode, ModelConfig, RunConfig, Trainer};
use gump_scene::{Scenario, Seed};
use gump_viz::{Chart, Series};
use serde::Serialize;
use serde_json::{Value, json};

use super::decoding;
use crate::dataset::{self, Part, Split, Training};
use crate::run::{Common, Run, stop_if_interrupted};
use crate::shipped;
use crate::worlds::{Draw, WorldName};

/// How the laptop model is trained.
const CONFIG: &str = include_str!("../../../../configs/tiny.toml");
/// Widths of the network; the last is that of `tiny`.
const WIDTHS: [usize; 3] = [32, 64, 128];
/// Width of an attention head.
const HEAD: usize = 32;
/// Losses measured, while tokens grow to so many times as many: the beginning of a run, in which the
/// learning rate warms up, follows no law.
const MEASURED: usize = 7;
const GROWTH: f64 = 5.0;

/// Arguments of `ablate scaling`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A folder with a manifest.toml, or any file or folder of scenarios, to train on
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Scenarios for loss and realism, none of them trained on [default: the shipped procedural
    /// ones]
    #[arg(long, value_name = "PATH")]
    scenarios: Option<PathBuf>,
    /// Optimiser steps of each size
    #[arg(long, value_name = "N", default_value = "1000")]
    steps: NonZeroUsize,
    /// Rollouts of each scenario
    #[arg(long, value_name = "N", default_value = "4")]
    rollouts_per_scenario: NonZeroUsize,
    #[command(flatten)]
    #[serde(flatten)]
    draw: Draw,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// What a size learned: its parameters, and the held-out loss after so many tokens.
struct Curve {
    parameters: f64,
    losses: Vec<(f64, f64)>,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let held_out = match &self.scenarios {
            Some(path) => path.clone(),
            None => shipped::data().join("procedural.tfrecord.gz"),
        };
        run.setting("scenarios", held_out.display().to_string())?;
        let progress = run.progress("reading", 0, "scenarios");
        let validation = dataset::read(&[Part::whole(&held_out)], &progress)?;
        drop(progress);
        let sampling = self.draw.resolve(Mode::PartialAr)?;
        let (mut rows, mut curves) = (Vec::new(), Vec::new());
        for width in WIDTHS {
            let weights = run.path(&format!("width-{width}.safetensors"));
            let began = Instant::now();
            let curve = run.phase(&format!("train {width}"), |run| {
                self.train(run, width, &validation, &weights)
            })?;
            let seconds = began.elapsed().as_secs_f64();
            let (scores, _) = run.phase(&format!("score {width}"), |run| {
                let world = WorldName::Model(weights.clone());
                let n = self.rollouts_per_scenario.get();
                decoding::score(run, &held_out, &world, sampling.clone(), n)
            })?;
            rows.push(row(width, &curve, &scores, seconds)?);
            run.result("rows", &rows)?;
            curves.push(curve);
        }
        let law = Law::fit(&curves).context("--steps: too few to fit a law to")?;
        run.result("tokens_exponent", law.tokens)?;
        run.result("parameters_exponent", law.parameters)?;
        run.result("residual", law.residual)?;
        Ok(chart(&curves, &law).save(&run.path("scaling"))?)
    }

    /// Trains one size, writes its weights and tells its losses.
    fn train(
        &self,
        run: &Run,
        width: usize,
        validation: &[Scenario],
        weights: &Path,
    ) -> anyhow::Result<Curve> {
        let progress = run.progress("reading", 0, "scenarios");
        let data = Training::open(&dataset::parts(&self.data, Split::Train)?, &progress)?;
        drop(progress);
        let steps = self.steps.get();
        let mut config = RunConfig::from_toml(CONFIG)?.train;
        config.steps = steps;
        config.seed = run.seed().0;
        config.optimizer.warmup = config.optimizer.warmup.min(steps / 10);
        let model = ModelConfig {
            width,
            heads: width / HEAD,
            ..ModelConfig::tiny()
        };
        let mut trainer = Trainer::new(model, config, data, run.device())?;
        let progress = run.progress("training", steps as u64, "steps");
        let (mut tokens, mut losses) = (0, Vec::new());
        for step in 1..=steps {
            stop_if_interrupted()?;
            tokens += trainer.step()?.tokens;
            progress.advance(1);
            if measured(steps).contains(&step) {
                let loss = trainer.validate(validation, usize::MAX)?.state;
                progress.message(&format!("width {width}, held-out loss {loss:.3}"));
                losses.push((tokens as f64, loss));
            }
        }
        checkpoint::save(trainer.network(), weights, Precision::Half)?;
        Ok(Curve {
            parameters: trainer.network().parameters().count() as f64,
            losses,
        })
    }
}

/// Steps after which the loss is measured: evenly on a logarithmic axis.
fn measured(steps: usize) -> Vec<usize> {
    let last = MEASURED - 1;
    let share = |i: usize| GROWTH.powf(i as f64 / last as f64 - 1.0);
    let mut at: Vec<usize> = (0..=last)
        .map(|i| ((steps as f64 * share(i)).round() as usize).max(1))
        .collect();
    at.dedup();
    at
}

fn row(width: usize, curve: &Curve, scores: &[Scores], seconds: f64) -> anyhow::Result<Value> {
    let mean = Scores::mean(scores).context("--scenarios: expected some, found none")?;
    let metametrics: Vec<f64> = scores.iter().map(|scores| scores.metametric).collect();
    let interval = interval(&metametrics, Seed(0));
    let (tokens, loss) = curve.losses.last().context("no loss was measured")?;
    Ok(json!({
        "width": width,
        "parameters": curve.parameters,
        "tokens": tokens,
        "loss": loss,
        "own_exponent": slope(&logarithms(&curve.losses)).map(|slope| -slope),
        "metametric": mean.metametric,
        "low": interval.map(|interval| interval.low),
        "high": interval.map(|interval| interval.high),
        "min_ade": mean.min_ade,
        "collision_rate": mean.collision_rate,
        "offroad_rate": mean.offroad_rate,
        "training_seconds": seconds,
    }))
}

/// loss = factor · tokens^-tokens · parameters^-parameters.
#[derive(Debug)]
struct Law {
    factor: f64,
    tokens: f64,
    parameters: f64,
    /// Root mean square of the logarithm of loss over law.
    residual: f64,
}

impl Law {
    /// The least squares in logarithms; `None` without two sizes or two losses each.
    fn fit(curves: &[Curve]) -> Option<Self> {
        // The same tokens for every size make the two logarithms orthogonal: each slope is that of
        // the means over the other.
        let slopes: Option<Vec<f64>> = curves
            .iter()
            .map(|curve| slope(&logarithms(&curve.losses)))
            .collect();
        let tokens = -mean(slopes?);
        let by_size = |curve: &Curve| {
            let losses = logarithms(&curve.losses).into_iter().map(|point| point.1);
            (curve.parameters.ln(), mean(losses))
        };
        let parameters = -slope(&curves.iter().map(by_size).collect::<Vec<_>>())?;
        let unscaled = Self {
            factor: 1.0,
            tokens,
            parameters,
            residual: 0.0,
        };
        let offs: Vec<f64> = curves
            .iter()
            .flat_map(|curve| curve.losses.iter().map(move |&point| (curve, point)))
            .map(|(curve, (tokens, loss))| (loss / unscaled.loss(tokens, curve.parameters)).ln())
            .collect();
        let factor = mean(offs.iter().copied());
        let residual = mean(offs.iter().map(|off| (off - factor).powi(2))).sqrt();
        Some(Self {
            factor: factor.exp(),
            residual,
            ..unscaled
        })
    }

    fn loss(&self, tokens: f64, parameters: f64) -> f64 {
        self.factor * tokens.powf(-self.tokens) * parameters.powf(-self.parameters)
    }
}

fn logarithms(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    points.iter().map(|(x, y)| (x.ln(), y.ln())).collect()
}

fn mean(values: impl IntoIterator<Item = f64>) -> f64 {
    let (sum, n) = values
        .into_iter()
        .fold((0.0, 0.0), |(sum, n), value| (sum + value, n + 1.0));
    sum / n
}

/// The slope of the line of least squares; `None` if all x are one.
fn slope(points: &[(f64, f64)]) -> Option<f64> {
    let (x, y) = (
        mean(points.iter().map(|p| p.0)),
        mean(points.iter().map(|p| p.1)),
    );
    let spread: f64 = points.iter().map(|p| (p.0 - x).powi(2)).sum();
    let together: f64 = points.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
    (spread > 0.0).then(|| together / spread)
}

fn chart(curves: &[Curve], law: &Law) -> Chart {
    let millions = |curve: &Curve| format!("{:.2} M", curve.parameters / 1e6);
    let measured = curves.iter().map(|curve| Series {
        name: format!("{} parameters", millions(curve)),
        points: curve.losses.clone(),
        ..Series::default()
    });
    let fitted = curves.iter().map(|curve| Series {
        name: format!("the law at {}", millions(curve)),
        points: [curve.losses.first(), curve.losses.last()]
            .into_iter()
            .flatten()
            .map(|&(tokens, _)| (tokens, law.loss(tokens, curve.parameters)))
            .collect(),
        ..Series::default()
    });
    Chart {
        x_label: "tokens trained on".into(),
        y_label: "held-out cross-entropy of a field, nats".into(),
        log_x: true,
        log_y: true,
        markers: true,
        series: measured.chain(fitted).collect(),
        ..Chart::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_law_is_found_again() {
        let law = |tokens: f64, parameters: f64| 30.0 * tokens.powf(-0.2) * parameters.powf(-0.05);
        let curve = |parameters: f64| Curve {
            parameters,
            losses: [1e5, 3e5, 1e6].map(|t| (t, law(t, parameters))).into(),
        };
        let curves = [3e5, 1e6, 3.5e6].map(curve);
        let found = Law::fit(&curves).unwrap();
        assert!((found.tokens - 0.2).abs() < 1e-9, "{found:?}");
        assert!((found.parameters - 0.05).abs() < 1e-9, "{found:?}");
        assert!(found.residual < 1e-9, "{found:?}");
        assert!((found.loss(2e5, 5e5) - law(2e5, 5e5)).abs() < 1e-9);
        assert!(chart(&curves, &found).to_svg().is_ok());
    }

    #[test]
    fn one_size_or_one_loss_make_no_law() {
        let curve = |n: usize| Curve {
            parameters: 1e6,
            losses: vec![(1e5, 2.0); n],
        };
        assert!(Law::fit(&[curve(3), curve(3)]).is_none());
        assert!(Law::fit(&[]).is_none());
    }

    #[test]
    fn the_last_fivefold_is_measured_evenly() {
        let at = measured(1000);
        assert_eq!((at[0], at[3], at[6]), (200, 447, 1000));
        assert_eq!(at.len(), MEASURED);
        assert_eq!(measured(3), [1, 2, 3]);
    }

    #[test]
    fn the_recorded_configuration_is_read() {
        let config = RunConfig::from_toml(CONFIG).unwrap();
        assert_eq!(config.model().unwrap(), ModelConfig::tiny());
    }
}
