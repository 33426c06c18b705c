//! Loss curves: kept while training, written as a table and drawn.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

use anyhow::Context as _;
use gump_model::train::StepReport;
use gump_viz::{Chart, Series};

/// Points of a drawn curve; more cannot be told apart.
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
    validation: Option<f64>,
}

/// The curves of a run.
#[derive(Debug, Default)]
pub(crate) struct Losses {
    rows: Vec<Row>,
    last: Option<StepReport>,
}

const HEADER: &str = "step,total,state,control,trajectory,reconstruction,learning_rate,\
                      gradient_norm,tokens,validation";

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
            validation: None,
        });
        self.last = Some(report);
    }

    /// Notes the validation loss after the last step.
    pub(crate) fn push_validation(&mut self, step: usize, loss: f64) {
        if let Some(row) = self.rows.last_mut().filter(|row| row.step == step) {
            row.validation = Some(loss);
        }
    }

    /// The last step of this part of the run.
    pub(crate) fn last(&self) -> Option<&StepReport> {
        self.last.as_ref()
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
        self.rows.iter().rev().find_map(|row| row.validation)
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
                    points: self
                        .rows
                        .iter()
                        .filter_map(|row| Some((row.step as f64, row.validation?)))
                        .collect(),
                    ..Series::default()
                },
            ],
            ..Chart::default()
        })
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
        let cells: Vec<&str> = line.split(',').collect();
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
            validation,
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
            validation: match *validation {
                "" => None,
                number => Some(number.parse().ok()?),
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
            validation,
        } = self;
        let validation = validation.map_or(String::new(), |loss| loss.to_string());
        writeln!(
            text,
            "{step},{total},{state},{control},{trajectory},{reconstruction},{learning_rate},\
             {gradient_norm},{tokens},{validation}"
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

fn mean<'a>(rows: impl Iterator<Item = &'a Row>) -> Option<f64> {
    let totals: Vec<f64> = rows.map(|row| row.total).collect();
    (!totals.is_empty()).then(|| totals.iter().sum::<f64>() / totals.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_model::LossParts;

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
            });
        }
        losses.push_validation(n, 0.25);
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
