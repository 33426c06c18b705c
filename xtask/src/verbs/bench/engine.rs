//! `bench engine`: cost of simulation, against full autoregression without a cache (the paper's
//! baseline) and against the rate of the machine's matrix products.
//!
//! Weights are random: speed does not depend on them. Processor time is measured beside wall time,
//! and rates are per second of processor time, so that a busy machine blurs them less.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use gump_engine::{CacheMode, Mode, Precision, SamplingConfig, TransformerWorld};
use gump_model::{Network, checkpoint};
use gump_rollout::{Start, WorldModel as _};
use gump_scene::Scenario;
use serde::Serialize;
use serde_json::json;

use super::torch::{Timed, Torch};
use crate::choices::{PRECISIONS, one_of};
use crate::machine::{cpu_seconds, peak_rss_mb};
use crate::run::{Common, Run, stop_if_interrupted};

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
    #[arg(long, value_parser = one_of(PRECISIONS), default_value_t = Precision::F32)]
    precision: Precision,
    /// Frames per measurement of partial autoregression, half a second each
    #[arg(long, value_name = "N", default_value_t = 16)]
    frames: usize,
    /// Python with PyTorch, whose frames with and without cached keys and values are timed in the
    /// same run
    #[arg(long, value_name = "PYTHON")]
    torch: Option<PathBuf>,
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

/// Cost of some frames of some futures.
struct Cost {
    frames: usize,
    steps: usize,
    wall: f64,
    cpu: f64,
    passes: u64,
    operations: u64,
    cache_bytes: usize,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let torch = self.torch.as_deref().map(Torch::find).transpose()?;
        run.setting("torch_version", torch.as_ref().map(|torch| &torch.version))?;
        let gemm = run.phase("gemm", |_| Ok(gemm_rate()))?;
        run.result("gemm_gflops_per_cpu_second", gemm / 1e9)?;
        let sizes = if self.quick {
            &self.sizes[..1]
        } else {
            &self.sizes[..]
        };
        let mut rows = Vec::new();
        let mut pairs = Vec::new();
        for size in sizes {
            for &n_agents in &self.agents {
                let scenario = super::crowd(n_agents)?;
                let more = run.phase(size, |run| self.rows(run, size, &scenario, gemm))?;
                rows.extend(more);
                run.result("rows", &rows)?;
                if let Some(torch) = &torch {
                    let more = run.phase(&format!("{size} in PyTorch"), |run| {
                        self.beside_torch(run, size, &scenario, torch)
                    })?;
                    pairs.extend(more);
                    run.result("torch", &pairs)?;
                }
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
                    "kept_mb": cost.cache_bytes as f64 / 1e6,
                });
                run.print(&format!(
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

    /// A growing window in each number format beside PyTorch's frames, alternating.
    fn beside_torch(
        &self,
        run: &Run,
        size: &str,
        scenario: &Scenario,
        torch: &Torch,
    ) -> anyhow::Result<Vec<serde_json::Value>> {
        let growing = &WAYS[WAYS.len() - 1];
        let file = run.path(&format!("{size}.safetensors"));
        let (tensors, shape) = network(run, size)?.export()?;
        let header = [("shape".to_owned(), shape.to_string())];
        checkpoint::write(&file, tensors, header.into(), checkpoint::StorageType::Full)?;
        let steps = self.steps(growing);
        let mut rows = Vec::new();
        for &n_futures in &self.futures {
            let mut worlds = Vec::new();
            for precision in Precision::ALL {
                worlds.push(self.world_in(run, size, growing, precision)?);
            }
            let mut ours = [const { Vec::new() }; 3];
            let mut theirs = [const { Vec::new() }; TORCH_WAYS.len()];
            let mut operations = [0.0; 2];
            for _ in 0..ROUNDS {
                for (world, costs) in worlds.iter().zip(&mut ours) {
                    let cost = measure(world, scenario, n_futures, steps, run)?;
                    costs.push(cost.cpu / cost.frames as f64);
                    operations[0] = cost.operations as f64 / cost.frames as f64;
                }
                for (i, (way, costs)) in TORCH_WAYS.iter().zip(&mut theirs).enumerate() {
                    let timed = self.frames_in_torch(
                        torch,
                        &file,
                        way,
                        (scenario, n_futures, steps),
                        run.threads(),
                    )?;
                    let frames = (steps * n_futures) as f64;
                    costs.push(timed.cpu_seconds / frames);
                    if i == 0 {
                        operations[1] = timed.operations / frames;
                    }
                }
            }
            let middle = |all| super::median(all).unwrap_or(f64::NAN);
            let [f32, bf16, int8] = ours.map(middle);
            let [torch_f32, torch_bf16, torch_1_pass, torch_2_passes] = theirs.map(middle);
            rows.push(json!({
                "size": size,
                "agents": scenario.present().now().agents().len(),
                "futures": n_futures,
                "threads": run.threads(),
                "ratio_f32": torch_f32 / f32,
                "ratio_bf16": torch_bf16 / bf16,
                "f32_cpu_ms": 1e3 * f32,
                "bf16_cpu_ms": 1e3 * bf16,
                "int8_cpu_ms": 1e3 * int8,
                "torch_f32_cpu_ms": 1e3 * torch_f32,
                "torch_bf16_cpu_ms": 1e3 * torch_bf16,
                "torch_1_pass_cpu_ms": 1e3 * torch_1_pass,
                "torch_2_passes_cpu_ms": 1e3 * torch_2_passes,
                "gflop_per_frame": operations[0] / 1e9,
                "torch_gflop_per_frame": operations[1] / 1e9,
            }));
        }
        std::fs::remove_file(&file).with_context(|| format!("cannot remove {}", file.display()))?;
        Ok(rows)
    }

    fn frames_in_torch(
        &self,
        torch: &Torch,
        file: &Path,
        (precision, passes): &(&str, &str),
        (scenario, n_futures, steps): (&Scenario, usize, usize),
        threads: usize,
    ) -> anyhow::Result<Timed> {
        stop_if_interrupted()?;
        let agents = scenario.present().now().agents().len().to_string();
        let (futures, frames) = (n_futures.to_string(), steps.to_string());
        let history = SamplingConfig::default().history.to_string();
        let arguments = [
            &file.display().to_string(),
            "--agents",
            &agents,
            "--futures",
            &futures,
            "--frames",
            &frames,
            "--history",
            &history,
            "--precision",
            precision,
            "--passes",
            passes,
        ];
        torch.time("frame.py", threads, &arguments)
    }

    fn world(&self, run: &Run, size: &str, way: &Way) -> anyhow::Result<TransformerWorld> {
        self.world_in(run, size, way, self.precision)
    }

    fn world_in(
        &self,
        run: &Run,
        size: &str,
        way: &Way,
        precision: Precision,
    ) -> anyhow::Result<TransformerWorld> {
        let sampling = SamplingConfig {
            mode: way.mode,
            cache: way.kept,
            precision,
            ..SamplingConfig::default()
        };
        let network = network(run, size)?;
        Ok(if way.engine {
            TransformerWorld::new(network, sampling)
        } else {
            TransformerWorld::reference(network, sampling)
        })
    }

    fn steps(&self, way: &Way) -> usize {
        match way.mode {
            Mode::PartialAr if self.quick || !way.engine => self.frames.min(2),
            Mode::PartialAr => self.frames,
            // One pass per object takes seconds.
            _ => 1,
        }
    }
}

/// A network of this size with random weights.
///
/// Error: a size that does not exist.
fn network(run: &Run, size: &str) -> anyhow::Result<Network> {
    let config = super::preset(size)?;
    Ok(Network::random(config, run.seed(), run.device())?)
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
        // A separate session, so that a growing window is measured from its beginning.
        let mut warm = world.open(&[start]).map_err(failed)?;
        warm.step(None).map_err(failed)?;
    }
    let before = session.stats();
    let (cpu, began) = (cpu_seconds(), Instant::now());
    for _ in 0..steps {
        stop_if_interrupted()?;
        session.step(None).map_err(failed)?;
    }
    let wall = began.elapsed().as_secs_f64();
    let cpu = cpu_seconds()
        .zip(cpu)
        .map_or(wall, |(after, before)| after - before);
    let after = session.stats();
    Ok(Cost {
        frames: steps * n_futures,
        steps,
        wall,
        cpu,
        passes: after.passes - before.passes,
        operations: after.operations - before.operations,
        cache_bytes: after.cache_bytes,
    })
}

/// Measurements of each implementation, alternating; the median is reported. The fewest that have
/// one.
const ROUNDS: usize = 3;
/// The ways of a frame in PyTorch, as `--precision` and `--passes` of `frame.py`: with a cache, and
/// without one as in releases 1.1 and 1.0 of the authors' model.
const TORCH_WAYS: [(&str, &str); 4] = [("f32", "0"), ("bf16", "0"), ("f32", "1"), ("f32", "2")];

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
