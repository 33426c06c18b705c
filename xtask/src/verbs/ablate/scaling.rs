//! `ablate scaling`: one network in three widths, trained on the same samples: how loss falls with
//! tokens and parameters, and how real the traffic of each is.
//!
//! The law is loss = A · tokens^-t · parameters^-p. Every width is measured after the same tokens, so
//! the two exponents are fitted apart from each other.

use anyhow::Context as _;
use gump_viz::{Chart, Series};
use serde::Serialize;
use serde_json::json;

use super::train_variant::{Learned, TrainVariant, of_width};
use crate::run::{Common, Run};

/// Widths of the network, doubling; the last is that of `tiny`.
const WIDTHS: [usize; 3] = [32, 64, 128];
/// Losses measured, while tokens grow to so many times as many: the beginning of a run, in which the
/// learning rate warms up, follows no law (docs/results/0014-scaling.md: a tenfold growth left a
/// residual six times as large).
const MEASURED: usize = 7;
const GROWTH: f64 = 5.0;

/// Arguments of `ablate scaling`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    #[serde(flatten)]
    train_variant: TrainVariant,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let held_out = self.train_variant.begin(run)?;
        let (mut rows, mut sizes) = (Vec::new(), Vec::new());
        for width in WIDTHS {
            let name = format!("width-{width}");
            let measured = measured(self.train_variant.steps());
            let learned = held_out.teach(run, &name, of_width(width)?, &measured)?;
            let mut row = learned.row()?;
            row["width"] = json!(width);
            let slope = slope(&logarithms(&learned.losses));
            row["own_exponent"] = json!(slope.map(|slope| -slope));
            rows.push(row);
            run.result("rows", &rows)?;
            sizes.push(learned);
        }
        let law = Law::fit(&sizes).context("--steps: too few to fit a law to")?;
        run.result("tokens_exponent", law.tokens)?;
        run.result("parameters_exponent", law.parameters)?;
        run.result("residual", law.residual)?;
        Ok(chart(&sizes, &law).save(&run.path("scaling"))?)
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
    fn fit(curves: &[Learned]) -> Option<Self> {
        // The same tokens for every size make the two logarithms orthogonal: each slope is that of
        // the means over the other.
        let slopes: Option<Vec<f64>> = curves
            .iter()
            .map(|curve| slope(&logarithms(&curve.losses)))
            .collect();
        let tokens = -mean(slopes?);
        let by_size = |curve: &Learned| {
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

fn chart(curves: &[Learned], law: &Law) -> Chart {
    let millions = |curve: &Learned| format!("{:.2} M", curve.parameters / 1e6);
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
        let curve = |parameters: f64| {
            let losses = [1e5, 3e5, 1e6].map(|t| (t, law(t, parameters)));
            Learned::of_losses(parameters, losses.into())
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
        let curve = |n: usize| Learned::of_losses(1e6, vec![(1e5, 2.0); n]);
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
}
