//! Learning curves: means over windows of gradient steps, as a table and drawn.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Context as _;
use gump_rl::ppo::PpoReport;
use gump_rl::sac::{Episode, StepReport};
use gump_viz::{Chart, Series};

use super::write;

const N_COLUMNS: usize = 17;
const HEADER: [&str; N_COLUMNS] = [
    "step",
    "env_steps",
    "episodes",
    "return",
    "length",
    "terminated",
    "critic_loss",
    "actor_loss",
    "imitation_loss",
    "entropy",
    "alpha",
    "value",
    "learning_rate",
    "reward_gradient",
    "imitation_gradient",
    "divergence",
    "clipped",
];

/// Index of a column of [`HEADER`].
fn column(name: &str) -> usize {
    let index = HEADER.iter().position(|column| *column == name);
    index.expect("curves are drawn from columns of the table")
}

/// The curves of a run, one row per window.
#[derive(Debug)]
pub(super) struct Curves {
    window: usize,
    rows: Vec<[f64; N_COLUMNS]>,
    open: Vec<StepReport>,
}

impl Curves {
    /// Curves with a point every `window` gradient steps.
    pub(super) fn new(window: usize) -> Self {
        Self {
            window: window.max(1),
            rows: Vec::new(),
            open: Vec::new(),
        }
    }

    /// Reads the rows up to `steps` of an earlier part of the run.
    ///
    /// Error: the file is missing or not what [`Self::write`] writes.
    pub(super) fn read(path: &Path, window: usize, steps: usize) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        let mut curves = Self::new(window);
        for (number, line) in text.lines().enumerate().skip(1) {
            let numbers: Vec<f64> = line
                .split(',')
                .map(|word| {
                    if word.is_empty() {
                        Ok(f64::NAN)
                    } else {
                        word.parse()
                    }
                })
                .collect::<Result<_, _>>()
                .unwrap_or_default();
            let row = numbers.try_into().ok().with_context(|| {
                let expected = HEADER.join(",");
                format!(
                    "{}, line {}: expected {expected}",
                    path.display(),
                    number + 1
                )
            })?;
            curves.rows.push(row);
        }
        curves
            .rows
            .retain(|row| row[column("step")] <= steps as f64);
        Ok(curves)
    }

    /// Adds a gradient step.
    pub(super) fn push(&mut self, report: StepReport) {
        let ends_window = report.step.is_multiple_of(self.window);
        self.open.push(report);
        if ends_window {
            self.close();
        }
    }

    /// Ends the window.
    fn close(&mut self) {
        let Some(last) = self.open.last() else {
            return;
        };
        let n = self.open.len() as f64;
        let of_updates =
            |value: fn(&StepReport) -> f64| self.open.iter().map(value).sum::<f64>() / n;
        let [n_episodes, total, steps, terminated] =
            of_episodes(self.open.iter().flat_map(|r| &r.episodes));
        self.rows.push([
            last.step as f64,
            last.env_steps as f64,
            n_episodes,
            total,
            steps,
            terminated,
            of_updates(|r| r.update.critic_loss),
            of_updates(|r| r.update.actor_loss),
            of_updates(|r| r.update.imitation_loss),
            of_updates(|r| r.update.entropy),
            of_updates(|r| r.update.alpha),
            of_updates(|r| r.update.value),
            last.update.learning_rate,
            of_updates(|r| r.update.reward_gradient),
            of_updates(|r| r.update.imitation_gradient),
            f64::NAN,
            f64::NAN,
        ]);
        self.open.clear();
    }

    /// Adds a round of PPO, which is a point of its own; it has no temperature and no value.
    pub(super) fn push_round(&mut self, report: &PpoReport) {
        let update = &report.update;
        let [n_episodes, total, steps, terminated] = of_episodes(report.episodes.iter());
        self.rows.push([
            report.round as f64,
            report.env_steps as f64,
            n_episodes,
            total,
            steps,
            terminated,
            update.critic_loss,
            f64::NAN,
            update.imitation_loss,
            update.entropy,
            f64::NAN,
            f64::NAN,
            report.learning_rate,
            update.reward_gradient,
            update.imitation_gradient,
            update.divergence,
            update.clipped,
        ]);
    }

    /// Mean return over the first and the last tenth of the episodes' windows, and how many
    /// standard errors lie between; `None` without episodes.
    pub(super) fn gain(&self) -> Option<(f64, f64, f64)> {
        let returns: Vec<f64> = self
            .rows
            .iter()
            .map(|row| row[column("return")])
            .filter(|r| r.is_finite())
            .collect();
        let n = (returns.len() / 10).max(2);
        let (first, last) = (returns.get(..n)?, returns.get(returns.len() - n..)?);
        let mean = |values: &[f64]| values.iter().sum::<f64>() / n as f64;
        let error = |values: &[f64]| {
            let m = mean(values);
            let squares: f64 = values.iter().map(|x| (x - m).powi(2)).sum();
            squares / (n - 1) as f64 / n as f64
        };
        let (a, b) = (mean(first), mean(last));
        Some((a, b, (b - a) / (error(first) + error(last)).sqrt()))
    }

    /// Writes the table and the charts into a folder, each whole or not at all.
    pub(super) fn write(&self, folder: &Path) -> anyhow::Result<()> {
        let mut text = format!("{}\n", HEADER.join(","));
        for row in &self.rows {
            let words = row.map(|x| {
                if x.is_finite() {
                    x.to_string()
                } else {
                    String::new()
                }
            });
            writeln!(text, "{}", words.join(","))?;
        }
        write(&folder.join("curves.csv"), text.as_bytes())?;
        let returns = [("return", "return")];
        self.draw(
            &folder.join("return"),
            "return of an episode",
            &returns,
            false,
        )?;
        let losses = [("critic", "critic_loss"), ("temperature", "alpha")];
        self.draw(&folder.join("losses"), "loss", &losses, true)?;
        let gradients = [
            ("rewards", "reward_gradient"),
            ("imitation", "imitation_gradient"),
        ];
        self.draw(
            &folder.join("gradients"),
            "norm of the actor's gradient by its outputs",
            &gradients,
            true,
        )?;
        let nats = [("entropy", "entropy"), ("imitation", "imitation_loss")];
        self.draw(&folder.join("entropy"), "nats", &nats, false)
    }

    /// Draws columns, given as their labels and names, against gradient steps; nothing where there is nothing to draw.
    fn draw(
        &self,
        stem: &Path,
        y_label: &str,
        columns: &[(&str, &str)],
        log_y: bool,
    ) -> anyhow::Result<()> {
        let step = column("step");
        let drawable = |p: &(f64, f64)| p.1.is_finite() && (!log_y || p.1 > 0.0);
        let series = columns.iter().map(|&(label, name)| {
            let value = column(name);
            let points = self.rows.iter().map(|row| (row[step], row[value]));
            Series {
                name: label.to_owned(),
                points: points.filter(drawable).collect(),
                ..Series::default()
            }
        });
        let series: Vec<Series> = series.filter(|s| !s.points.is_empty()).collect();
        if series.is_empty() {
            return Ok(());
        }
        let chart = Chart {
            x_label: "gradient step".into(),
            y_label: y_label.into(),
            log_y,
            series,
            ..Chart::default()
        };
        Ok(chart.save(stem)?)
    }
}

/// The number of episodes, and their mean return, length and share that terminated; not a number
/// where no episode ended.
fn of_episodes<'a>(episodes: impl Iterator<Item = &'a Episode>) -> [f64; 4] {
    let mut sums = [0.0; 4];
    for episode in episodes {
        let terminated = f64::from(u8::from(episode.terminated));
        let values = [1.0, episode.total, episode.steps as f64, terminated];
        for (sum, value) in sums.iter_mut().zip(values) {
            *sum += value;
        }
    }
    let [n, total, steps, terminated] = sums;
    [n, total / n, steps / n, terminated / n]
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_rl::ppo::PpoUpdate;
    use gump_rl::sac::UpdateReport;

    fn report(step: usize, returns: &[f64]) -> StepReport {
        let episode = |&total| Episode {
            total,
            steps: 16,
            terminated: total < 0.0,
        };
        StepReport {
            step,
            env_steps: 4 * step as u64,
            update: UpdateReport {
                critic_loss: step as f64,
                ..UpdateReport::default()
            },
            episodes: returns.iter().map(episode).collect(),
        }
    }

    #[test]
    fn windows_are_means_and_come_back() {
        let mut curves = Curves::new(2);
        for step in 1..=40 {
            let rising = step as f64 / 40.0 + 0.01 * f64::from(step as u32 % 3);
            curves.push(report(step, &[rising, -1.0][..1 + step % 2]));
        }
        assert_eq!(curves.rows.len(), 20);
        assert_eq!(
            (curves.rows[0][0], curves.rows[0][2], curves.rows[0][6]),
            (2.0, 3.0, 1.5)
        );
        assert_eq!(curves.rows[0][5], 1.0 / 3.0);
        let (first, last, errors) = curves.gain().unwrap();
        assert!(first < last && errors > 3.0);
        let folder = tempfile::tempdir().unwrap();
        curves.write(folder.path()).unwrap();
        let svg = std::fs::read_to_string(folder.path().join("return.svg")).unwrap();
        assert!(svg.contains("<svg"));
        let path = folder.path().join("curves.csv");
        let cut = Curves::read(&path, 2, 10).unwrap();
        assert_eq!(cut.rows.len(), 5);
        for (read, row) in cut.rows.iter().zip(&curves.rows) {
            // What PPO alone has is empty.
            let own = column("divergence");
            assert_eq!(read[..own], row[..own]);
            assert!(read[own..].iter().all(|x| x.is_nan()));
        }
        std::fs::write(&path, "step\n1,2\n").unwrap();
        assert!(
            Curves::read(&path, 2, 10)
                .unwrap_err()
                .to_string()
                .contains("line 2")
        );
    }

    #[test]
    fn a_round_is_a_point() {
        let mut curves = Curves::new(5);
        let of_round = |round: usize| PpoReport {
            round,
            env_steps: 64 * round as u64,
            update: PpoUpdate {
                divergence: 0.01,
                imitation_gradient: 0.5,
                ..PpoUpdate::default()
            },
            learning_rate: 1e-4,
            episodes: vec![Episode::default(); round],
        };
        (1..=3).for_each(|round| curves.push_round(&of_round(round)));
        let folder = tempfile::tempdir().unwrap();
        curves.write(folder.path()).unwrap();
        let read = Curves::read(&folder.path().join("curves.csv"), 5, 2).unwrap();
        assert_eq!(read.rows.len(), 2);
        let cell = |name| read.rows[1][column(name)];
        assert_eq!((cell("env_steps"), cell("episodes")), (128.0, 2.0));
        assert!(cell("divergence") == 0.01 && cell("alpha").is_nan());
        assert_eq!(cell("imitation_gradient"), 0.5);
    }

    #[test]
    fn windows_without_episodes_are_empty_cells() {
        let mut curves = Curves::new(1);
        curves.push(report(1, &[]));
        let folder = tempfile::tempdir().unwrap();
        curves.write(folder.path()).unwrap();
        assert!(!folder.path().join("return.svg").exists());
        let read = Curves::read(&folder.path().join("curves.csv"), 1, 1).unwrap();
        assert!(read.rows[0][3].is_nan() && read.gain().is_none());
    }
}
