//! `ablate temperature|decay|history|chunking|quantization`: how decoding changes realism, and what
//! it costs.
//!
//! One setting at a time, under rules and without; scenes, seeds and weights stay. Realism is that of
//! the Waymo Sim Agents Challenge, since displacements alone would reward timid futures.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use gump_engine::{Mode, Precision, SamplingConfig, Surrogate};
use gump_eval::decoding::Decoding;
use gump_eval::digest;
use gump_eval::realism::{RolloutSource, recordings};
use gump_eval::worlds::WorldName;
use gump_metrics::interval;
use gump_scene::Seed;
use gump_viz::{Chart, Series};
use gump_wosac::realism::{Config, Reference, Scores, Year};
use serde::Serialize;
use serde_json::{Value, json};

use crate::cli::WrongArguments;
use crate::machine::cpu_seconds;
use crate::run::{Common, Run, stop_if_interrupted};
use crate::sampling::Draw;
use crate::shipped;

/// Arguments of the ablations of decoding.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// File or folder of recorded scenarios [default: the shipped procedural ones]
    #[arg(long, value_name = "PATH")]
    scenarios: Option<PathBuf>,
    /// model:WEIGHTS [default: the shipped weights]
    #[arg(long, value_name = "W")]
    world: Option<WorldName>,
    /// Rollouts of each scenario
    #[arg(long, value_name = "N", default_value = "8")]
    rollouts_per_scenario: NonZeroUsize,
    #[command(flatten)]
    #[serde(flatten)]
    draw: Draw,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// The setting that is varied.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Sweep {
    Temperature,
    Decay,
    History,
    Chunking,
    Quantization,
}

/// Frames of a rollout: 8 s, a tenth of a second apart.
const FRAMES: f64 = 80.0;

/// Seconds that a frame of one future takes, opening the session included.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Cost {
    wall: f64,
    /// Seconds of processor time.
    cpu: f64,
}

/// A value of the setting: its name in the table, its place on the axis, how to decode.
type Setting = (String, f64, Decoding);

impl Sweep {
    /// Label of the horizontal axis.
    fn label(self) -> &'static str {
        match self {
            Self::Temperature => "temperature",
            Self::Decay => "decay (0: no averaging)",
            Self::History => "frames of history, half a second apart",
            Self::Chunking => "what is made of the four poses of a chunk",
            Self::Quantization => "form of the weights",
        }
    }

    /// Whether its settings are numbers rather than names.
    fn is_numeric(self) -> bool {
        !matches!(self, Self::Chunking | Self::Quantization)
    }

    fn settings(self, base: &Decoding) -> Vec<Setting> {
        let with = |value: f64, turn: &dyn Fn(&mut SamplingConfig)| {
            (value.to_string(), value, base.with(turn))
        };
        match self {
            Self::Temperature => [0.3, 0.5, 0.7, 0.9, 1.1, 1.3]
                .map(|t| with(t, &|config| config.temperature = Some(t)))
                .into(),
            Self::Decay => [0.0, 0.3, 0.6, 0.9, 1.2, 1.5]
                .map(|decay| with(decay, &|config| config.decay = decay))
                .into(),
            Self::History => [1, 2, 3, 4]
                .map(|frames| with(frames as f64, &|config| config.history = frames))
                .into(),
            Self::Chunking => {
                let decay = base.sampling.decay;
                let average = if decay > 0.0 { decay } else { 1.2 };
                let ways = [
                    ("one pose", Surrogate::ConstantVelocity, 0.0),
                    ("surrogates from chunks", Surrogate::Chunk, 0.0),
                    ("chunks averaged", Surrogate::Chunk, average),
                ];
                let setting = |(i, (name, surrogate, decay)): (usize, (&str, _, _))| {
                    let turned = base.with(|config| {
                        config.surrogate = surrogate;
                        config.decay = decay;
                    });
                    (name.to_owned(), (i + 1) as f64, turned)
                };
                ways.into_iter().enumerate().map(setting).collect()
            }
            Self::Quantization => {
                let setting = |(i, precision): (usize, Precision)| {
                    let turned = base.with(|config| config.precision = precision);
                    (precision.to_string(), (i + 1) as f64, turned)
                };
                Precision::ALL
                    .into_iter()
                    .enumerate()
                    .map(setting)
                    .collect()
            }
        }
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run, sweep: Sweep) -> anyhow::Result<()> {
        let world = self.world.clone().unwrap_or_else(shipped::sequence_world);
        if !matches!(world, WorldName::Model(_)) {
            let wrong = format!("--world: expected model:WEIGHTS, found {world}");
            return Err(WrongArguments(wrong).into());
        }
        let procedural = || shipped::data().join("procedural.tfrecord.gz");
        let path = self.scenarios.clone().unwrap_or_else(procedural);
        run.setting("scenarios", path.display().to_string())?;
        let (mut rows, mut curves, mut categories) = (Vec::new(), Vec::new(), Vec::new());
        let mut digests = Vec::new();
        for base in self.draw.decodings(Mode::PartialAr)? {
            let (mut first, mut curve) = (None, Series::default());
            curve.name = base.name.into();
            categories.clear();
            for (name, at, decoding) in sweep.settings(&base) {
                let phase = format!("{name}, {}", base.name);
                let judged = run.phase(&phase, |run| {
                    let n = self.rollouts_per_scenario.get();
                    score(run, &path, &world, &decoding, n)
                })?;
                let (mut row, low_high) = judged.row(&path)?;
                row["setting"] = json!(name);
                row["decoding"] = json!(base.name);
                row["bits"] = json!(decoding.sampling.precision.bits());
                let cpu = judged.cost.cpu;
                row["ratio"] = json!(*first.get_or_insert(cpu) / cpu);
                let digest = judged.digest;
                digests.push(json!({"setting": name, "decoding": base.name, "digest": digest}));
                let mean = row["metametric"].as_f64().unwrap_or(f64::NAN);
                curve.points.push((at, mean));
                curve
                    .spans
                    .extend(low_high.map(|(low, high)| (at, low, high)));
                categories.push(name);
                rows.push(row);
            }
            curves.push(curve);
        }
        run.result("rows", rows)?;
        run.result("digests", digests)?;
        let chart = Chart {
            x_label: sweep.label().into(),
            y_label: "realism (2025), mean and 95 % interval".into(),
            markers: true,
            categories: if sweep.is_numeric() {
                Vec::new()
            } else {
                categories
            },
            series: curves,
            ..Chart::default()
        };
        Ok(chart.save(&run.path("realism"))?)
    }
}

/// Scores and cost of the rollouts of every scenario.
pub(super) struct Judged {
    pub(super) scores: Vec<Scores>,
    cost: Cost,
    digest: Option<String>,
}

impl Judged {
    /// Means, and the ends of the interval of the mean realism.
    ///
    /// Error: no scenarios.
    fn row(&self, path: &Path) -> anyhow::Result<(Value, Option<(f64, f64)>)> {
        let mean = Scores::mean(&self.scores)
            .with_context(|| format!("expected scenarios, found none: {}", path.display()))?;
        let metametrics: Vec<f64> = self.scores.iter().map(|s| s.metametric).collect();
        let interval = interval(&metametrics, Seed(0)).map(|i| (i.low, i.high));
        let row = json!({
            "setting": null,
            "decoding": null,
            "metametric": mean.metametric,
            "low": interval.map(|(low, _)| low),
            "high": interval.map(|(_, high)| high),
            "kinematic": mean.kinematic,
            "interactive": mean.interactive,
            "map_based": mean.map_based,
            "min_ade": mean.min_ade,
            "ade": mean.ade,
            "collision_rate": mean.collision_rate,
            "offroad_rate": mean.offroad_rate,
            "bits": null,
            "ratio": null,
            "frames_per_second": 1.0 / self.cost.wall,
            "cpu_milliseconds_per_frame": 1e3 * self.cost.cpu,
        });
        Ok((row, interval))
    }
}

/// The realism of 2025 of `n` rollouts of each scenario, and what they cost.
///
/// Error: scenarios that cannot be read, a world that cannot imagine them, or Ctrl-C.
pub(super) fn score(
    run: &Run,
    scenarios: &Path,
    world: &WorldName,
    decoding: &Decoding,
    n: usize,
) -> anyhow::Result<Judged> {
    let config = Config::of(Year::Y2025);
    let mut source = RolloutSource::world(world.clone(), decoding.clone(), n, run.seed());
    let progress = run.progress("evaluating", 0, "scenarios");
    let (mut scores, mut digests) = (Vec::new(), Vec::new());
    let (mut cost, mut frames) = (Cost::default(), 0.0);
    let scenarios = [scenarios.to_owned()];
    for recorded in recordings(&scenarios, source.read_options(), |_| true)? {
        stop_if_interrupted()?;
        let recorded = recorded?;
        let (cpu, began) = (cpu_seconds(), Instant::now());
        let simulating = run.simulating(source.frames(&recorded.scenario));
        let found = source.rollouts(run.device(), &recorded, config.mode, &simulating)?;
        let wall = began.elapsed().as_secs_f64();
        let spent = |before| cpu_seconds().map_or(wall, |after| after - before);
        cost.cpu += cpu.map_or(wall, spent);
        cost.wall += wall;
        frames += n as f64 * FRAMES;
        let reference = Reference::new(&recorded.log, &config)?;
        scores.push(reference.evaluate(&found.rollouts)?.scores);
        digests.extend(found.digest);
        progress.advance(1);
    }
    cost.cpu /= frames;
    cost.wall /= frames;
    Ok(Judged {
        scores,
        cost,
        digest: digest::of_digests(digests.iter().map(String::as_str)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sweep_changes_nothing_else() {
        let config = SamplingConfig {
            decay: 1.2,
            ..SamplingConfig::default()
        };
        let base = Decoding::of(config.clone());
        let settings = Sweep::Temperature.settings(&base);
        assert!(settings.iter().any(|(_, at, _)| *at == 1.1));
        for (_, at, decoding) in settings {
            assert_eq!(decoding.sampling.temperature, Some(at));
            let back = decoding.with(|turned| turned.temperature = config.temperature);
            assert_eq!(back, base);
        }
        let chunking = Sweep::Chunking.settings(&base);
        assert_eq!(chunking[2].2, base);
        assert_eq!(
            chunking[0].2.sampling.surrogate,
            Surrogate::ConstantVelocity
        );
    }
}
