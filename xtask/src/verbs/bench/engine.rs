//! `bench engine`: what imagining costs, against full autoregression without a cache (the paper's
//! baseline) and against what the machine's matrix products reach.
//!
//! Weights are random: speed does not depend on them. Processor time is measured beside wall time,
//! and rates are per second of processor time, so that a busy machine blurs them less.

use std::time::Instant;

use anyhow::Context as _;
use gump_engine::{CacheMode, Mode, SamplingConfig, TransformerWorld};
use gump_model::Network;
use gump_model::config::ModelConfig;
use gump_rollout::{Start, WorldModel as _};
use gump_scene::Scenario;
use serde::Serialize;
use serde_json::json;

use crate::machine::{cpu_seconds, peak_rss_mb};
use crate::run::{Common, Run, stop_if_interrupted};
use crate::sampling::PrecisionName;

/// Arguments of `bench engine`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Sizes of the network
    #[arg(
        long,
        value_name = "NAME,...",
        value_delimiter = ',',
        default_value = "tiny,small,base"
    )]
    sizes: Vec<String>,
    /// Agents in the scene
    #[arg(
        long,
        value_name = "N,...",
        value_delimiter = ',',
        default_value = "32"
    )]
    agents: Vec<usize>,
    /// Futures simulated together
    #[arg(
        long,
        value_name = "N,...",
        value_delimiter = ',',
        default_value = "1,32"
    )]
    futures: Vec<usize>,
    /// Only these ways of decoding, as `ORDER/CACHE`, `partial-ar/growing` for instance; all
    /// others are left out
    #[arg(long, value_name = "WAY,...", value_delimiter = ',')]
    only: Vec<String>,
    /// Number format of the weights
    #[arg(long, value_enum, default_value_t = PrecisionName::F32)]
    precision: PrecisionName,
    /// Frames per measurement of partial autoregression, half a second each
    #[arg(long, value_name = "N", default_value_t = 16)]
    frames: usize,
    /// Only `tiny`, only a few frames, full autoregression only of one future
    #[arg(long)]
    quick: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// One way of decoding.
struct Way {
    name: &'static str,
    cache: &'static str,
    mode: Mode,
    kept: CacheMode,
    /// By the engine, or by the tensor library's operations.
    engine: bool,
}

const WAYS: [Way; 6] = [
    Way {
        name: "full-ar",
        cache: "none",
        mode: Mode::FullAr,
        kept: CacheMode::None,
        engine: true,
    },
    Way {
        name: "full-ar",
        cache: "window",
        mode: Mode::FullAr,
        kept: CacheMode::Window,
        engine: true,
    },
    Way {
        name: "partial-ar",
        cache: "none, by tensors",
        mode: Mode::PartialAr,
        kept: CacheMode::None,
        engine: false,
    },
    Way {
        name: "partial-ar",
        cache: "none",
        mode: Mode::PartialAr,
        kept: CacheMode::None,
        engine: true,
    },
    Way {
        name: "partial-ar",
        cache: "window",
        mode: Mode::PartialAr,
        kept: CacheMode::Window,
        engine: true,
    },
    Way {
        name: "partial-ar",
        cache: "growing",
        mode: Mode::PartialAr,
        kept: CacheMode::Growing,
        engine: true,
    },
];

/// What some frames of some futures cost.
struct Cost {
    frames: usize,
    steps: usize,
    wall: f64,
    cpu: f64,
    passes: u64,
    operations: u64,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let gemm = run.phase("gemm", |_| Ok(gemm_rate()))?;
        run.result("gemm_gflops_per_cpu_second", gemm / 1e9)?;
        let sizes = if self.quick {
            &self.sizes[..1]
        } else {
            &self.sizes[..]
        };
        let mut rows = Vec::new();
        for size in sizes {
            for &n_agents in &self.agents {
                let scenario = super::crowd(n_agents)?;
                let more = run.phase(size, |run| self.rows(run, size, &scenario, gemm))?;
                rows.extend(more);
                run.result("rows", &rows)?;
            }
        }
        run.result("peak_rss_mb", peak_rss_mb())
    }

    fn rows(
        &self,
        run: &Run,
        size: &str,
        scenario: &Scenario,
        gemm: f64,
    ) -> anyhow::Result<Vec<serde_json::Value>> {
        let mut rows = Vec::new();
        let mut baseline: Option<f64> = None;
        for &n_futures in &self.futures {
            for way in &WAYS {
                stop_if_interrupted()?;
                let is = |only: &String| *only == format!("{}/{}", way.name, way.cache);
                if !self.only.is_empty() && !self.only.iter().any(is) {
                    continue;
                }
                // Without a shared prefix to gain from, 32 uncached futures cost 32 times one.
                let tedious = way.mode == Mode::FullAr && n_futures > 1;
                if tedious && (self.quick || way.kept == CacheMode::None) {
                    continue;
                }
                let world = self.world(run, size, way)?;
                let cost = measure(&world, scenario, n_futures, self.steps(way), run)?;
                let frame = cost.cpu / cost.frames as f64;
                let base = *baseline.get_or_insert(frame);
                let rate = cost.operations as f64 / cost.cpu;
                let row = json!({
                    "size": size,
                    "agents": scenario.present().now().agents().len(),
                    "futures": n_futures,
                    "mode": way.name,
                    "cache": way.cache,
                    "ratio": base / frame,
                    "milliseconds_per_frame": 1e3 * cost.wall / cost.frames as f64,
                    "cpu_milliseconds_per_frame": 1e3 * frame,
                    "frames_per_second": cost.frames as f64 / cost.wall,
                    "passes_per_step": cost.passes as f64 / cost.steps as f64,
                    "gflop_per_frame": way.engine.then(|| cost.operations as f64 / cost.frames as f64 / 1e9),
                    "fraction_of_gemm": way.engine.then_some(rate / gemm),
                    "weights_mb": world.weight_bytes() as f64 / 1e6,
                    "kept_mb": world.context_bytes() as f64 / 1e6,
                });
                run.say(&format!(
                    "{size} x {n_futures}, {} {}: {:.1} ms of processor time a frame",
                    way.name,
                    way.cache,
                    1e3 * frame
                ));
                rows.push(row);
            }
        }
        Ok(rows)
    }

    fn world(&self, run: &Run, size: &str, way: &Way) -> anyhow::Result<TransformerWorld> {
        let config = ModelConfig::preset(size).with_context(|| {
            let known = ModelConfig::PRESETS.join(", ");
            format!("--sizes: expected one of {known}, found {size}")
        })?;
        let sampling = SamplingConfig {
            mode: way.mode,
            cache: way.kept,
            precision: self.precision.resolve(),
            ..SamplingConfig::default()
        };
        let network = Network::random(config, run.seed(), run.device())?;
        Ok(if way.engine {
            TransformerWorld::new(network, sampling)
        } else {
            TransformerWorld::plain(network, sampling)
        })
    }

    fn steps(&self, way: &Way) -> usize {
        match way.mode {
            Mode::FullAr => 1,
            Mode::PartialAr if self.quick || !way.engine => self.frames.min(2),
            Mode::PartialAr => self.frames,
        }
    }
}

/// Imagines some steps of some futures; opening is not counted, nor is one step to warm up where
/// there is more than one.
fn measure(
    world: &TransformerWorld,
    scenario: &Scenario,
    n_futures: usize,
    steps: usize,
    run: &Run,
) -> anyhow::Result<Cost> {
    let start = Start {
        scene: scenario.present(),
        n_futures,
        seed: run.seed(),
    };
    let failed = |error| anyhow::anyhow!("{error}");
    let mut session = world.open(&[start]).map_err(failed)?;
    if steps > 1 {
        // A session of its own, so that a growing window is measured from its beginning.
        let mut warm = world.open(&[start]).map_err(failed)?;
        warm.step(None).map_err(failed)?;
    }
    let (passes, operations) = (world.passes(), world.operations());
    let (cpu, began) = (cpu_seconds(), Instant::now());
    for _ in 0..steps {
        stop_if_interrupted()?;
        session.step(None).map_err(failed)?;
    }
    let wall = began.elapsed().as_secs_f64();
    let cpu = cpu_seconds()
        .zip(cpu)
        .map_or(wall, |(after, before)| after - before);
    Ok(Cost {
        frames: steps * n_futures,
        steps,
        wall,
        cpu,
        passes: world.passes() - passes,
        operations: world.operations() - operations,
    })
}

/// Products per measurement: half a second of work, for a clock of hundredths.
const REPEATS: usize = 24;

/// Floating-point operations per second of processor time in a large product: the best of several.
fn gemm_rate() -> f64 {
    let n = 1024;
    let number = |i: usize| (i * 7919 % 1013) as f32 / 500.0 - 1.0;
    let a: Vec<f32> = (0..n * n).map(number).collect();
    let mut best = 0f64;
    for _ in 0..6 {
        let (cpu, began) = (cpu_seconds(), Instant::now());
        for _ in 0..REPEATS {
            std::hint::black_box(gump_kernels::gemm::square_product(&a, &a, n));
        }
        let wall = began.elapsed().as_secs_f64();
        let cpu = cpu_seconds()
            .zip(cpu)
            .map_or(wall, |(after, before)| after - before);
        best = best.max((2 * REPEATS * n * n * n) as f64 / cpu);
    }
    best
}
