//! `ablate quantization`: realism against bits and speed.
//!
//! The same scenes, seeds and futures in every precision; what is compared with the log are
//! displacements, collisions and leaving the road.

use std::num::NonZeroUsize;
use std::time::Instant;

use anyhow::Context as _;
use gump_metrics::{Part, summarize};
use gump_model::{Mode, Precision, SamplingConfig, checkpoint, world::TransformerWorld};
use gump_rollout::{SimulateConfig, Start, simulate};
use gump_scene::Scenario;
use gump_viz::{Chart, Series};
use serde::Serialize;
use serde_json::{Map, Value, json};

use super::{RATES, Rate};
use crate::cli::WrongArguments;
use crate::dataset::{self, Split};
use crate::machine::cpu_seconds;
use crate::run::{Common, Run, stop_if_interrupted};
use crate::shipped;
use crate::worlds::{Draw, WorldName};

/// Arguments of `ablate quantization`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A data set; its test split is used [default: the shipped one]
    #[arg(long, value_name = "DIR")]
    data: Option<std::path::PathBuf>,
    /// model:WEIGHTS [default: the shipped weights]
    #[arg(long, value_name = "W")]
    world: Option<WorldName>,
    /// At most that many scenes
    #[arg(long, value_name = "N", default_value = "4")]
    scenes: NonZeroUsize,
    /// How many futures of each
    #[arg(long, value_name = "N", default_value = "16")]
    futures: NonZeroUsize,
    /// How far to imagine
    #[arg(long, value_name = "S", default_value_t = 8.0)]
    seconds: f64,
    #[command(flatten)]
    #[serde(flatten)]
    draw: Draw,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

const PRECISIONS: [(&str, Precision); 3] = [
    ("f32", Precision::F32),
    ("bf16", Precision::Bf16),
    ("int8", Precision::Int8),
];

/// What a precision costs and yields.
struct Outcome {
    part: Part,
    frames: usize,
    wall: f64,
    cpu: f64,
    weight_bytes: usize,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let scenarios = run.phase("read", |run| self.read(run))?;
        run.result("scenes", scenarios.len())?;
        let mut outcomes = Vec::new();
        for (name, precision) in PRECISIONS {
            let outcome = run.phase(name, |run| self.imagine(run, precision, &scenarios))?;
            outcomes.push((name, precision, outcome));
        }
        let first = outcomes
            .first()
            .map(|(.., outcome)| outcome.cpu_per_frame());
        let rows = outcomes.iter().map(|(name, precision, outcome)| {
            let mut row = Map::new();
            row.insert("precision".into(), json!(name));
            row.insert("bits".into(), json!(precision.bits()));
            let ratio = first.map(|first| first / outcome.cpu_per_frame());
            row.insert("ratio".into(), json!(ratio));
            let rate = outcome.frames as f64 / outcome.wall;
            row.insert("frames_per_second".into(), json!(rate));
            let cost = 1e3 * outcome.cpu_per_frame();
            row.insert("cpu_milliseconds_per_frame".into(), json!(cost));
            let megabytes = outcome.weight_bytes as f64 / 1e6;
            row.insert("weights_mb".into(), json!(megabytes));
            for (name, rate) in RATES {
                row.insert(name.into(), json!(rate(&outcome.part)));
            }
            Value::Object(row)
        });
        run.result("rows", rows.collect::<Vec<_>>())?;
        let parts = || outcomes.iter().map(|(.., outcome)| &outcome.part);
        let curve = |name: &str, of: Rate| Series {
            name: name.into(),
            points: (1..)
                .zip(parts())
                .filter_map(|(i, part)| Some((f64::from(i), of(part)?)))
                .collect(),
            ..Series::default()
        };
        let chart = Chart {
            x_label: "form of the weights".into(),
            y_label: "displacement from the log, m".into(),
            markers: true,
            ways: PRECISIONS.map(|(name, _)| name.into()).into(),
            series: vec![
                curve("average (ADE)", Part::ade),
                curve("best future (min ADE)", Part::min_ade),
            ],
            ..Chart::default()
        };
        // Scenes without a log to compare with leave nothing to draw.
        if chart.series.iter().any(|curve| !curve.points.is_empty()) {
            chart.save(&run.path("displacement"))?;
        }
        Ok(())
    }

    fn read(&self, run: &Run) -> anyhow::Result<Vec<Scenario>> {
        let data = self.data.clone().unwrap_or_else(shipped::data);
        let mut left = self.scenes.get();
        let mut parts = dataset::parts(&data, Split::Test)?;
        if parts.is_empty() {
            parts = dataset::parts(&data, Split::Train)?;
        }
        for part in &mut parts {
            let n = part.scenes.len().min(left);
            part.scenes.end = part.scenes.start + n;
            left -= n;
        }
        let progress = run.progress("reading", self.scenes.get() as u64, "scenes");
        dataset::read(&parts, &progress)
    }

    fn imagine(
        &self,
        run: &Run,
        precision: Precision,
        scenarios: &[Scenario],
    ) -> anyhow::Result<Outcome> {
        let sampling = SamplingConfig {
            precision,
            ..self.draw.resolve(Mode::PartialAr)?
        };
        let weights = match &self.world {
            None => shipped::weights(),
            Some(WorldName::Model(path)) => path.clone(),
            Some(found) => {
                let wrong = format!("--world: expected model:WEIGHTS, found {found}");
                return Err(WrongArguments(wrong).into());
            }
        };
        let network = checkpoint::load(&weights, &gump_model::Device::Cpu)?;
        let world = TransformerWorld::new(network, sampling);
        let config = SimulateConfig {
            seconds: self.seconds,
            ..SimulateConfig::default()
        };
        let mut outcome = Outcome {
            part: Part::default(),
            frames: 0,
            wall: 0.0,
            cpu: 0.0,
            weight_bytes: world.weight_bytes(),
        };
        for (i, scenario) in scenarios.iter().enumerate() {
            stop_if_interrupted()?;
            let start = Start {
                scene: scenario.present(),
                n_futures: self.futures.get(),
                seed: run.seed().fork(i as u64),
            };
            let (cpu, began) = (cpu_seconds(), Instant::now());
            let rollouts = simulate(&world, &[start], None, &config)
                .map_err(|error| anyhow::anyhow!(error))
                .with_context(|| format!("cannot simulate {}", scenario.id))?;
            let wall = began.elapsed().as_secs_f64();
            outcome.wall += wall;
            outcome.cpu += cpu_seconds()
                .zip(cpu)
                .map_or(wall, |(after, before)| after - before);
            outcome.frames += rollouts.len() * (2.0 * self.seconds).ceil() as usize;
            outcome
                .part
                .merge(&summarize(&rollouts, Some(scenario)).total());
        }
        Ok(outcome)
    }
}

impl Outcome {
    /// Seconds of processor time.
    fn cpu_per_frame(&self) -> f64 {
        self.cpu / self.frames.max(1) as f64
    }
}
