//! `ablate temperature|decay|history|chunking|quantization`: how decoding changes realism, and what
//! it costs.
//!
//! One knob at a time; scenes, seeds and weights stay. Realism is that of the Waymo Sim Agents
//! Challenge, since displacements alone would reward timid futures.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use gump_metrics::interval;
use gump_metrics::wosac::{Config, Reference, Scores, Year};
use gump_model::{Mode, Precision, SamplingConfig, Surrogate};
use gump_scene::Seed;
use gump_viz::{Chart, Series};
use serde::Serialize;
use serde_json::json;

use crate::cli::WrongArguments;
use crate::machine::cpu_seconds;
use crate::run::{Common, Run, stop_if_interrupted};
use crate::shipped;
use crate::verbs::evaluate::wosac::{Source, recordings};
use crate::worlds::{Draw, WorldName};

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

/// What is turned.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Knob {
    Temperature,
    Decay,
    History,
    Chunking,
    Precision,
}

/// Frames of a rollout: 8 s, half a second apart.
const FRAMES: f64 = 16.0;

/// Seconds that a frame of one future takes, opening the session included.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Cost {
    wall: f64,
    /// Of processor time.
    cpu: f64,
}

/// One setting of a knob: what the table calls it, its place on the axis, how to decode.
type Setting = (String, f64, SamplingConfig);

impl Knob {
    /// What the horizontal axis says.
    fn label(self) -> &'static str {
        match self {
            Self::Temperature => "temperature",
            Self::Decay => "decay (0: no averaging)",
            Self::History => "frames of history, half a second apart",
            Self::Chunking => "what is made of the four poses of a chunk",
            Self::Precision => "form of the weights",
        }
    }

    /// Whether its settings are numbers, and not ways.
    fn is_numeric(self) -> bool {
        !matches!(self, Self::Chunking | Self::Precision)
    }

    fn settings(self, base: &SamplingConfig) -> Vec<Setting> {
        let with = |value: f64, change: &dyn Fn(&mut SamplingConfig)| {
            let mut config = base.clone();
            change(&mut config);
            (value.to_string(), value, config)
        };
        match self {
            Self::Temperature => [0.3, 0.5, 0.7, 0.9, 1.1, 1.3]
                .map(|t| with(t, &|config| config.temperature = t))
                .into(),
            Self::Decay => [0.0, 0.3, 0.6, 0.9, 1.2, 1.5]
                .map(|decay| with(decay, &|config| config.decay = decay))
                .into(),
            Self::History => [1, 2, 3, 4]
                .map(|frames| with(frames as f64, &|config| config.history = frames))
                .into(),
            Self::Chunking => {
                let average = if base.decay > 0.0 { base.decay } else { 1.2 };
                let ways = [
                    ("one pose", Surrogate::ConstantVelocity, 0.0),
                    ("surrogates from chunks", Surrogate::Chunk, 0.0),
                    ("chunks averaged", Surrogate::Chunk, average),
                ];
                let setting = |(i, (name, surrogate, decay)): (usize, (&str, _, _))| {
                    let config = SamplingConfig {
                        surrogate,
                        decay,
                        ..base.clone()
                    };
                    (name.to_owned(), (i + 1) as f64, config)
                };
                ways.into_iter().enumerate().map(setting).collect()
            }
            Self::Precision => {
                let forms = [
                    ("f32", Precision::F32),
                    ("bf16", Precision::Bf16),
                    ("int8", Precision::Int8),
                ];
                let setting = |(i, (name, precision)): (usize, (&str, _))| {
                    let config = SamplingConfig {
                        precision,
                        ..base.clone()
                    };
                    (name.to_owned(), (i + 1) as f64, config)
                };
                forms.into_iter().enumerate().map(setting).collect()
            }
        }
    }
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run, knob: Knob) -> anyhow::Result<()> {
        let world = self.world.clone().unwrap_or_else(shipped::world);
        if !matches!(world, WorldName::Model(_)) {
            let wrong = format!("--world: expected model:WEIGHTS, found {world}");
            return Err(WrongArguments(wrong).into());
        }
        let procedural = || shipped::data().join("procedural.tfrecord.gz");
        let path = self.scenarios.clone().unwrap_or_else(procedural);
        run.setting("scenarios", path.display().to_string())?;
        let settings = knob.settings(&self.draw.resolve(Mode::PartialAr)?);
        let (mut rows, mut first) = (Vec::new(), None);
        let (mut curve, mut ways) = (Series::default(), Vec::new());
        for (name, at, sampling) in settings {
            let bits = sampling.precision.bits();
            let n = self.rollouts_per_scenario.get();
            let (scores, cost) = run.phase(&name, |run| score(run, &path, &world, sampling, n))?;
            let mean = Scores::mean(&scores)
                .with_context(|| format!("expected scenarios, found none: {}", path.display()))?;
            let metametrics: Vec<f64> = scores.iter().map(|scores| scores.metametric).collect();
            let interval = interval(&metametrics, Seed(0));
            curve.points.push((at, mean.metametric));
            let span = interval.map(|interval| (at, interval.low, interval.high));
            curve.spans.extend(span);
            ways.push(name.clone());
            rows.push(json!({
                "setting": name,
                "metametric": mean.metametric,
                "low": interval.map(|interval| interval.low),
                "high": interval.map(|interval| interval.high),
                "kinematic": mean.kinematic,
                "interactive": mean.interactive,
                "map_based": mean.map_based,
                "min_ade": mean.min_ade,
                "ade": mean.ade,
                "collision_rate": mean.collision_rate,
                "offroad_rate": mean.offroad_rate,
                "bits": bits,
                "ratio": *first.get_or_insert(cost.cpu) / cost.cpu,
                "frames_per_second": 1.0 / cost.wall,
                "cpu_milliseconds_per_frame": 1e3 * cost.cpu,
            }));
        }
        run.result("rows", rows)?;
        let chart = Chart {
            x_label: knob.label().into(),
            y_label: "realism (2025), mean and 95 % interval".into(),
            markers: true,
            ways: if knob.is_numeric() { Vec::new() } else { ways },
            series: vec![curve],
            ..Chart::default()
        };
        Ok(chart.save(&run.path("realism"))?)
    }
}

/// The realism of 2025 of `n` rollouts of each scenario, and what they cost.
///
/// Error: scenarios that cannot be read, a world that cannot imagine them, or Ctrl-C.
pub(super) fn score(
    run: &Run,
    scenarios: &Path,
    world: &WorldName,
    sampling: SamplingConfig,
    n: usize,
) -> anyhow::Result<(Vec<Scores>, Cost)> {
    let config = Config::of(Year::Y2025);
    let mut source = Source::world(world.clone(), sampling, n, run.seed());
    let progress = run.progress("evaluating", 0, "scenarios");
    let (mut all, mut cost, mut frames) = (Vec::new(), Cost::default(), 0.0);
    let scenarios = [scenarios.to_owned()];
    for recorded in recordings(&scenarios, source.read_options(), |_| true)? {
        stop_if_interrupted()?;
        let recorded = recorded?;
        let (cpu, began) = (cpu_seconds(), Instant::now());
        let rollouts = source.rollouts(run, &recorded, config.mode)?;
        let wall = began.elapsed().as_secs_f64();
        let spent = |before| cpu_seconds().map_or(wall, |after| after - before);
        cost.cpu += cpu.map_or(wall, spent);
        cost.wall += wall;
        frames += n as f64 * FRAMES;
        let reference = Reference::new(&recorded.log, &config)?;
        all.push(reference.evaluate(&rollouts)?.scores);
        progress.advance(1);
    }
    cost.cpu /= frames;
    cost.wall /= frames;
    Ok((all, cost))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_knob_turns_nothing_else() {
        let base = SamplingConfig {
            decay: 1.2,
            ..SamplingConfig::default()
        };
        let strip = |config: SamplingConfig| SamplingConfig {
            temperature: base.temperature,
            ..config
        };
        let settings = Knob::Temperature.settings(&base);
        assert!(settings.iter().any(|(_, at, _)| *at == 1.1));
        for (_, at, config) in settings {
            assert_eq!(config.temperature, at);
            assert_eq!(strip(config), base);
        }
        let chunking = Knob::Chunking.settings(&base);
        assert_eq!(chunking[2].2, base);
        assert_eq!(chunking[0].2.surrogate, Surrogate::ConstantVelocity);
    }
}
