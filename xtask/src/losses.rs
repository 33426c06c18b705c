//! Loss curves: kept while training, written as a table and drawn.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

use anyhow::Context as _;
use gump_train::StepReport;
use gump_viz::{Chart, Series};
use gump_wosac::realism::Scores;

/// Points of a drawn curve; more cannot be distinguished.
const DRAWN: usize = 300;

/// One optimiser step.
#[derive(Clone, Debug, PartialEq)]
struct Row {
    step: usize,
    total: f64,
    state: f64,
    control: f64,
    trajectory: f64,
    reconstruction: f64,
    learning_rate: f64,
    gradient_norm: f64,
    tokens: usize,
    /// Realism of the rollouts that were learned from.
    rollouts: Option<f64>,
    rewarded: Rewarded,
    validation: Option<Validation>,
}

/// Means over the rewarded moves of a step, if there were any.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Rewarded {
    /// Nats a move.
    entropy: Option<f64>,
    /// Divergence from the network at the start, nats a move.
    kl: Option<f64>,
    /// Weight of the divergence in the loss.
    kl_weight: Option<f64>,
}

/// Validation after a step.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Validation {
    loss: f64,
    /// Realism (2025), and the distance of the best future from the log in metres; `None` if the
    /// scenes were not simulated.
    imagined: Option<(f64, f64)>,
}

/// The curves of a run.
#[derive(Debug, Default)]
pub(crate) struct Losses {
    rows: Vec<Row>,
    last: Option<StepReport>,
}

const HEADER: &str = "step,total,state,control,trajectory,reconstruction,learning_rate,\
                      gradient_norm,tokens,rollouts,entropy,kl,kl_weight,validation,realism,\
                      min_ade";

/// Number of cells of files from before there were those of `Rewarded`, and where these are now.
const FORMER_CELLS: usize = 13;
const REWARDED: usize = 10;

impl Losses {
    /// Reads the rows up to `steps` of an earlier part of the run.
    ///
    /// Error: the file is missing or not what [`Self::write`] writes.
    pub(crate) fn read(path: &Path, steps: usize) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        let mut rows = Vec::new();
        for (number, line) in text.lines().enumerate().skip(1) {
            let row = Row::parse(line).with_context(|| {
                format!("{}, line {}: expected {HEADER}", path.display(), number + 1)
            })?;
            rows.push(row);
        }
        rows.retain(|row| row.step <= steps);
        Ok(Self { rows, last: None })
    }

    /// Adds a step.
    pub(crate) fn push(&mut self, report: StepReport) {
        self.rows.push(Row {
            step: report.step,
            total: report.loss.total,
            state: report.loss.state,
            control: report.loss.control,
            trajectory: report.loss.trajectory,
            reconstruction: report.loss.reconstruction,
            learning_rate: report.learning_rate,
            gradient_norm: report.gradient_norm,
            tokens: report.tokens,
            rollouts: report.rollouts,
            rewarded: Rewarded {
                entropy: report.entropy,
                kl: report.kl,
                kl_weight: report.kl_weight,
            },
            validation: None,
        });
        self.last = Some(report);
    }

    /// Records the validation loss after the last step, and the scores of the simulations.
    pub(crate) fn push_validation(&mut self, step: usize, loss: f64, scores: Option<&Scores>) {
        if let Some(row) = self.rows.last_mut().filter(|row| row.step == step) {
            let imagined = scores.map(|scores| (scores.metametric, scores.min_ade));
            row.validation = Some(Validation { loss, imagined });
        }
    }

    /// The last step of this part of the run.
    pub(crate) fn last(&self) -> Option<&StepReport> {
        self.last.as_ref()
    }

    /// Number of steps.
    pub(crate) fn steps(&self) -> usize {
        self.rows.len()
    }

    /// Mean total loss of the first `n` steps.
    pub(crate) fn mean_of_first(&self, n: usize) -> Option<f64> {
        mean(self.rows.iter().take(n))
    }

    /// Mean total loss of the last `n` steps.
    pub(crate) fn mean_of_last(&self, n: usize) -> Option<f64> {
        mean(self.rows.iter().rev().take(n))
    }

    /// The latest validation loss.
    pub(crate) fn last_validation(&self) -> Option<f64> {
        let mut rows = self.rows.iter().rev();
        rows.find_map(|row| Some(row.validation?.loss))
    }

    /// The latest realism of held-out scenes.
    pub(crate) fn last_realism(&self) -> Option<f64> {
        let mut rows = self.rows.iter().rev();
        rows.find_map(|row| Some(row.validation?.imagined?.0))
    }

    /// Tokens presented after `step`.
    pub(crate) fn tokens_since(&self, step: usize) -> usize {
        let since = self.rows.iter().filter(|row| row.step > step);
        since.map(|row| row.tokens).sum()
    }

    /// Writes one line per step, whole or not at all.
    pub(crate) fn write(&self, path: &Path) -> anyhow::Result<()> {
        let mut text = format!("{HEADER}\n");
        for row in &self.rows {
            row.print(&mut text);
        }
        gump_data::write_atomically(path, |file| {
            file.write_all(text.as_bytes())
                .with_context(|| format!("cannot write {}", path.display()))
        })
    }

    /// The curves; `None` before the first step.
    pub(crate) fn chart(&self) -> Option<Chart> {
        if self.rows.is_empty() {
            return None;
        }
        Some(Chart {
            x_label: "step".into(),
            y_label: "loss, nats".into(),
            series: vec![
                self.curve("total", |row| row.total),
                self.curve("state", |row| row.state),
                self.curve("control", |row| row.control),
                Series {
                    name: "validation".into(),
                    points: self.validations(|validation| Some(validation.loss)),
                    ..Series::default()
                },
            ],
            ..Chart::default()
        })
    }

    /// Realism over the run: of held-out scenes, and of the rollouts that were learned from; `None`
    /// where nothing was imagined.
    pub(crate) fn realism_chart(&self) -> Option<Chart> {
        let held_out = self.validations(|validation| Some(validation.imagined?.0));
        let series = named([
            ("held-out scenes", held_out),
            ("rollouts learned from", self.measured(|row| row.rollouts)),
        ]);
        (!series.is_empty()).then(|| Chart {
            x_label: "step".into(),
            y_label: "realism (2025)".into(),
            series,
            ..Chart::default()
        })
    }

    /// What rewards do to the network over the run, on a logarithmic axis, where they differ by
    /// orders of magnitude: entropy, divergence from the start and its weight; `None` without
    /// rewards.
    pub(crate) fn rewards_chart(&self) -> Option<Chart> {
        let series = named([
            ("entropy", self.measured(|row| row.rewarded.entropy)),
            ("KL to the start", self.measured(|row| row.rewarded.kl)),
            ("weight of KL", self.measured(|row| row.rewarded.kl_weight)),
        ]);
        (!series.is_empty()).then(|| Chart {
            x_label: "step".into(),
            y_label: "nats a move; weight".into(),
            log_y: true,
            series,
            ..Chart::default()
        })
    }

    /// A curve of means over the steps that have a number.
    fn measured(&self, of: impl Fn(&Row) -> Option<f64>) -> Vec<(f64, f64)> {
        let chunk = self.rows.len().div_ceil(DRAWN).max(20);
        let points = self.rows.chunks(chunk).filter_map(|rows| {
            let numbers: Vec<f64> = rows.iter().filter_map(&of).collect();
            let mean = numbers.iter().sum::<f64>() / numbers.len() as f64;
            (!numbers.is_empty()).then(|| (rows[rows.len() / 2].step as f64, mean))
        });
        points.collect()
    }

    fn validations(&self, of: impl Fn(&Validation) -> Option<f64>) -> Vec<(f64, f64)> {
        let rows = self.rows.iter();
        rows.filter_map(|row| Some((row.step as f64, of(row.validation.as_ref()?)?)))
            .collect()
    }

    /// A curve of means over equal runs of steps.
    fn curve(&self, name: &str, of: impl Fn(&Row) -> f64) -> Series {
        let chunk = self.rows.len().div_ceil(DRAWN).max(1);
        let points = self.rows.chunks(chunk).map(|rows| {
            let n = rows.len() as f64;
            let step = rows.iter().map(|row| row.step as f64).sum::<f64>() / n;
            (step, rows.iter().map(&of).sum::<f64>() / n)
        });
        Series {
            name: name.into(),
            points: points.collect(),
            ..Series::default()
        }
    }
}

impl Row {
    fn parse(line: &str) -> Option<Self> {
        let mut cells: Vec<&str> = line.split(',').collect();
        if cells.len() == FORMER_CELLS {
            cells.splice(REWARDED..REWARDED, [""; 3]);
        }
        let [
            step,
            total,
            state,
            control,
            trajectory,
            reconstruction,
            rate,
            norm,
            tokens,
            rollouts,
            entropy,
            kl,
            kl_weight,
            validation,
            realism,
            min_ade,
        ] = cells.as_slice()
        else {
            return None;
        };
        Some(Self {
            step: step.parse().ok()?,
            total: total.parse().ok()?,
            state: state.parse().ok()?,
            control: control.parse().ok()?,
            trajectory: trajectory.parse().ok()?,
            reconstruction: reconstruction.parse().ok()?,
            learning_rate: rate.parse().ok()?,
            gradient_norm: norm.parse().ok()?,
            tokens: tokens.parse().ok()?,
            rollouts: number(rollouts)?,
            rewarded: Rewarded {
                entropy: number(entropy)?,
                kl: number(kl)?,
                kl_weight: number(kl_weight)?,
            },
            validation: match (*validation, *realism, *min_ade) {
                ("", "", "") => None,
                (loss, realism, min_ade) => Some(Validation {
                    loss: loss.parse().ok()?,
                    imagined: match realism {
                        "" => None,
                        realism => Some((realism.parse().ok()?, min_ade.parse().ok()?)),
                    },
                }),
            },
        })
    }

    fn print(&self, text: &mut String) {
        let Self {
            step,
            total,
            state,
            control,
            trajectory,
            reconstruction,
            learning_rate,
            gradient_norm,
            tokens,
            rollouts,
            rewarded,
            validation,
        } = self;
        let (realism, min_ade) = validation.and_then(|v| v.imagined).unzip();
        let cell = |number: Option<f64>| number.map_or(String::new(), |number| number.to_string());
        let validation = validation.map(|v| v.loss);
        let [rollouts, validation, realism, min_ade] =
            [*rollouts, validation, realism, min_ade].map(cell);
        let Rewarded {
            entropy,
            kl,
            kl_weight,
        } = *rewarded;
        let [entropy, kl, kl_weight] = [entropy, kl, kl_weight].map(cell);
        writeln!(
            text,
            "{step},{total},{state},{control},{trajectory},{reconstruction},{learning_rate},\
             {gradient_norm},{tokens},{rollouts},{entropy},{kl},{kl_weight},{validation},\
             {realism},{min_ade}"
        )
        .expect("writing to a string cannot fail");
    }
}

/// The decoder's steps in order: sizes and velocity once, then a pose per half second.
pub(crate) fn field_names(n: usize) -> Vec<String> {
    let fixed = ["width", "length", "vx", "vy"].map(str::to_owned);
    let poses =
        (0..n.saturating_sub(4)).map(|i| format!("{}_{}", ["x", "y", "heading"][i % 3], i / 3));
    fixed.into_iter().chain(poses).take(n).collect()
}

/// The number of a cell, if it is not empty; `None` if it is not a number.
fn number(cell: &str) -> Option<Option<f64>> {
    match cell {
        "" => Some(None),
        number => number.parse().ok().map(Some),
    }
}

/// The curves that have points.
fn named<const N: usize>(curves: [(&str, Vec<(f64, f64)>); N]) -> Vec<Series> {
    let curves = curves.into_iter();
    let curves = curves.filter(|(_, points)| !points.is_empty());
    let series = curves.map(|(name, points)| Series {
        name: name.into(),
        points,
        ..Series::default()
    });
    series.collect()
}

fn mean<'a>(rows: impl Iterator<Item = &'a Row>) -> Option<f64> {
    let totals: Vec<f64> = rows.map(|row| row.total).collect();
    (!totals.is_empty()).then(|| totals.iter().sum::<f64>() / totals.len() as f64)
}

#[cfg(test)]
mod tests {
    use gump_train::LossParts;

    use super::*;

    const IMAGINED: (f64, f64) = (0.8, 2.5);

    /// With a validation at the end, and one where futures were imagined in the middle.
    fn losses(n: usize) -> Losses {
        let mut losses = Losses::default();
        for step in 1..=n {
            let loss = LossParts {
                total: 1.0 / step as f64,
                ..LossParts::default()
            };
            losses.push(StepReport {
                step,
                loss,
                learning_rate: 1e-3,
                gradient_norm: 0.1,
                tokens: 10,
                rollouts: (step % 2 == 0).then_some(0.5),
                entropy: (step % 2 == 0).then_some(4.5),
                kl: (step % 2 == 0).then_some(0.25 * step as f64),
                kl_weight: (step % 2 == 0).then_some(2.0),
            });
        }
        losses.push_validation(n, 0.25, None);
        losses.rows[n / 2].validation = Some(Validation {
            loss: 0.5,
            imagined: Some(IMAGINED),
        });
        losses
    }

    #[test]
    fn what_is_written_reads_back_up_to_the_checkpoint() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("losses.csv");
        let written = losses(7);
        written.write(&path).unwrap();
        assert_eq!(Losses::read(&path, 7).unwrap().rows, written.rows);
        let cut = Losses::read(&path, 3).unwrap();
        assert_eq!((cut.rows.len(), cut.last_validation()), (3, None));
        assert_eq!(written.tokens_since(3), 40);
        assert_eq!(written.last_validation(), Some(0.25));
        assert_eq!(written.last_realism(), Some(IMAGINED.0));
        assert_eq!(written.realism_chart().unwrap().series[0].points.len(), 1);
        let chart = written.rewards_chart().unwrap();
        let names: Vec<&str> = chart.series.iter().map(|curve| &*curve.name).collect();
        assert_eq!(names, ["entropy", "KL to the start", "weight of KL"]);
        assert_eq!(chart.series[1].points, [(4.0, 1.0)]);
        assert!(chart.to_svg().is_ok());
        let learned = Losses::read(&path, 1).unwrap();
        assert!(learned.realism_chart().is_none() && learned.rewards_chart().is_none());
    }

    #[test]
    fn files_from_before_the_cells_of_rewards_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("losses.csv");
        let lines =
            "header\n1,2,3,0,0,0,0.001,0.5,10,0.75,,,\n2,1,3,0,0,0,0.001,0.5,10,,0.5,0.8,2\n";
        std::fs::write(&path, lines).unwrap();
        let rows = Losses::read(&path, 2).unwrap().rows;
        assert_eq!(
            (rows[0].rollouts, rows[0].rewarded),
            (Some(0.75), Rewarded::default())
        );
        assert_eq!(rows[1].validation.unwrap().imagined, Some((0.8, 2.0)));
    }

    #[test]
    fn long_curves_are_drawn_thinned() {
        let curve = losses(1000).curve("total", |row| row.total);
        assert_eq!(curve.points.len(), 250);
        assert!(losses(3).chart().unwrap().to_svg().is_ok());
        assert!(Losses::default().chart().is_none());
    }

    #[test]
    fn fields_have_names() {
        let names = field_names(16);
        assert_eq!(names[3..8], ["vy", "x_0", "y_0", "heading_0", "x_1"]);
        assert_eq!(names[15], "heading_3");
    }
}
