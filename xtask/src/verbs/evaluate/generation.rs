//! `evaluate generation`: how like recorded scenes generated ones are, beside simpler ways of
//! making them.
//!
//! Likeness is the maximum mean discrepancy in TrafficGen's protocol, as the GUMP paper has it:
//! vehicles within 50 m of the recorded ego, which every source is given with as many vehicles as
//! were recorded. Prompts are judged on scenes of their own.

use std::collections::BTreeMap;
use std::path::PathBuf;

use gump_engine::SamplingConfig;
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::datasets::{self, Split};
use gump_eval::worlds::{self, World};
use gump_generate::Placement;
use gump_generate::baseline::{overlapping_vehicles, wrong_way};
use gump_generate::factory::GenerationWorlds;
use gump_generate::verdict::off_road;
use gump_metrics::mmd::{MmdMean, MmdProtocol, SceneMmd, scene_mmd};
use gump_metrics::{Interval, intervals};
use gump_scene::{Frame, Scenario, Seed};
use gump_viz::Bars;
use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Value, json};

use super::sources::{Case, Makers, Source};
use super::{long, prompts};
use crate::run::{Common, Run, stop_if_interrupted};
use crate::verbs::generate;
use crate::{benchmark, charts, shipped};

/// Arguments of `evaluate generation`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A file or folder of scenarios, or LIST.toml#SPLIT of datasets/benchmarks
    #[arg(long, value_name = "PATH")]
    scenarios: ScenarioSetName,
    /// Further scenes per scenario, each around another vehicle at another time
    #[arg(long, value_name = "N", default_value_t = 0)]
    centres: usize,
    /// A file or folder of recordings that are put onto the maps for comparison [default: those of
    /// the shipped data that are for training]
    #[arg(long, value_name = "PATH")]
    bank: Option<PathBuf>,
    /// Maximum number of scenarios [default: all]
    #[arg(long, value_name = "N")]
    limit: Option<usize>,
    /// Recorded vehicles within 50 m that a scenario needs at least
    #[arg(long, value_name = "N", default_value_t = 8)]
    min_vehicles: usize,
    /// Maps per prompt tag, among those that admit it; 0 leaves prompts out
    #[arg(long, value_name = "N", default_value_t = 2)]
    prompt_maps: usize,
    /// Attempts per prompt; the last one counts
    #[arg(long, value_name = "N", default_value_t = 12)]
    attempts: usize,
    /// Generated scenes rolled out for 30 s, with and without agents that spawn and leave
    #[arg(long, value_name = "N", default_value_t = 8)]
    long_scenes: usize,
    /// Weights of the model [default: the shipped ones]
    #[arg(long, value_name = "FILE", value_parser = worlds::weights)]
    weights: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// What one source made.
#[derive(Default)]
struct Tally {
    /// By recording.
    mmd: Vec<(usize, SceneMmd)>,
    failed: usize,
    vehicles: usize,
    overlapping: usize,
    off_road: usize,
    moving: usize,
    wrong_way: usize,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let world = run.phase("load", |run| {
            generate::world(run.device(), self.weights.as_ref(), false)
        })?;
        let traffic = run.phase("load", |run| {
            let sampling = SamplingConfig::default();
            Ok(World::without_log(
                run.device(),
                &shipped::world(),
                &sampling,
            )?)
        })?;
        let protocol = MmdProtocol {
            min_vehicles: self.min_vehicles,
            ..MmdProtocol::gump()
        };
        let seed = run.seed();
        let found = benchmark::find(run, &self.scenarios)?;
        run.result("set", &found.name)?;
        let scenarios = run.phase("read", |_| read(&found, self.limit, &protocol))?;
        let bank = run.phase("bank", |_| self.bank(&protocol))?;
        anyhow::ensure!(
            scenarios.len() > 1,
            "{} scenarios have {} vehicles within 50 m, expected at least 2",
            scenarios.len(),
            self.min_vehicles
        );
        let numbered = scenarios.iter().cloned().enumerate();
        let cases = numbered.flat_map(|(i, scenario)| {
            let seed = seed.fork(9).fork(i as u64);
            Case::of(i, scenario, self.centres, &protocol, seed)
        });
        let cases: Vec<Case> = cases.collect();
        run.result("scenarios", scenarios.len())?;
        run.result("scenes", cases.len())?;
        let makers = Makers {
            world: &world,
            cases: &cases,
            bank: &bank,
            protocol,
        };
        let mut tallies = Vec::new();
        for source in Source::ALL {
            stop_if_interrupted()?;
            let tally = run.phase(source.name(), |_| Ok(tally(&makers, source, seed)))?;
            tallies.push((source, tally));
        }
        let prompts = run.phase("prompts", |run| {
            let worlds = GenerationWorlds {
                scenes: &world,
                traffic: traffic.model(),
            };
            prompts::satisfaction(run, worlds, &scenarios, self.prompt_maps, self.attempts)
        })?;
        let rows = tallies.iter().map(|(source, tally)| {
            let satisfaction = match source {
                Source::Model(Placement::Guided) => prompts.satisfaction,
                Source::Model(Placement::Free) => prompts.unconditional,
                Source::Log => prompts.logged,
                _ => None,
            };
            row(*source, tally, satisfaction)
        });
        let rows: Vec<Value> = rows.collect();
        let intervals = tallies.iter().map(|(source, tally)| {
            let spans = tally.intervals(scenarios.len(), seed);
            spans_row(*source, &spans)
        });
        let intervals: Vec<Value> = intervals.collect();
        charts::save(run, "likeness", &chart(&rows, &intervals))?;
        run.result("gain_over_random", gain(&rows))?;
        run.result("rows", rows)?;
        run.result("intervals", intervals)?;
        run.result("prompts", prompts.rows)?;
        if self.long_scenes > 0 {
            let (weights, n) = (self.weights.as_ref(), self.long_scenes);
            let rows = run.phase("long", |run| long::rows(run, weights, n))?;
            charts::save(run, "life", &long::chart(&rows))?;
            run.result("life", rows)?;
        }
        Ok(())
    }

    /// The recordings that are retrieved.
    fn bank(&self, protocol: &MmdProtocol) -> anyhow::Result<Vec<Scenario>> {
        if let Some(path) = &self.bank {
            return read(&ScenarioSet::of_path(path), None, protocol);
        }
        let parts = datasets::parts(&shipped::data(), Split::Train)?;
        let parts = parts
            .iter()
            .map(|part| read(&ScenarioSet::of_path(&part.path), None, protocol));
        Ok(parts.collect::<anyhow::Result<Vec<_>>>()?.concat())
    }
}

/// The scenarios that take part.
fn read(
    found: &ScenarioSet,
    limit: Option<usize>,
    protocol: &MmdProtocol,
) -> anyhow::Result<Vec<Scenario>> {
    let mut scenarios = Vec::new();
    for record in found.open(gump_data::ReadOptions::ALL)? {
        stop_if_interrupted()?;
        let scenario = record?.scenario;
        let present = scenario.present();
        if scene_mmd(&present, present.now(), protocol).is_some() {
            scenarios.push(scenario);
        }
        if limit.is_some_and(|limit| scenarios.len() >= limit) {
            break;
        }
    }
    Ok(scenarios)
}

fn tally(makers: &Makers<'_>, source: Source, seed: Seed) -> Tally {
    let made: Vec<Option<Frame>> = (0..makers.cases.len())
        .into_par_iter()
        .map(|i| makers.make(source, i, seed.fork(i as u64)))
        .collect();
    let mut tally = Tally::default();
    for (case, frame) in makers.cases.iter().zip(made) {
        let Some(frame) = frame else {
            tally.failed += 1;
            continue;
        };
        let recorded = &case.recorded;
        if let Some(mmd) = scene_mmd(&recorded.present(), &frame, &makers.protocol) {
            tally.mmd.push((case.recording, mmd));
        }
        let (overlapping, vehicles) = overlapping_vehicles(&frame);
        let (wrong, moving) = wrong_way(&recorded.map, &frame);
        tally.overlapping += overlapping;
        tally.vehicles += vehicles;
        tally.wrong_way += wrong;
        tally.moving += moving;
        tally.off_road += off_road(&alone(recorded, frame));
    }
    tally
}

impl Tally {
    /// Means over scenes.
    fn mean(&self) -> SceneMmd {
        let mut mean = MmdMean::default();
        self.mmd.iter().for_each(|(_, mmd)| mean.add(mmd));
        mean.mean()
    }

    /// Where the means of position, heading, speed and size lie with 95 % confidence, recordings
    /// drawn with all their scenes.
    fn intervals(&self, n_recordings: usize, seed: Seed) -> Vec<Option<Interval>> {
        intervals(n_recordings, 1000, seed, |drawn| {
            let mut mean = MmdMean::default();
            for recording in drawn {
                let own = self.mmd.iter().filter(|(of, _)| of == recording);
                own.for_each(|(_, mmd)| mean.add(mmd));
            }
            attributes(&mean.mean()).to_vec()
        })
    }
}

/// The frame as the only one of a scenario.
fn alone(scenario: &Scenario, frame: Frame) -> Scenario {
    Scenario {
        log: vec![frame],
        now: 0,
        ..scenario.clone()
    }
}

/// What scenes are compared in.
const ATTRIBUTES: [&str; 4] = ["position", "heading", "speed", "size"];

/// The numbers of [`ATTRIBUTES`].
fn attributes(mmd: &SceneMmd) -> [Option<f64>; 4] {
    [mmd.position, mmd.heading, mmd.velocity, mmd.size]
}

/// The discrepancy of every source on every attribute; the log's is none.
fn chart(rows: &[Value], intervals: &[Value]) -> Bars {
    let is_shown = |row: &&Value| row["source"] != Source::Log.name();
    let rows: Vec<&Value> = rows.iter().filter(is_shown).collect();
    let spans: Vec<&Value> = intervals.iter().filter(is_shown).collect();
    let sources = rows.iter().filter_map(|row| row["source"].as_str());
    let legend = sources.map(String::from).collect();
    let label = "maximum mean discrepancy from recorded scenes, lower is nearer";
    let names = ATTRIBUTES.map(String::from).into();
    charts::bars(label, names, legend, |attribute, source| {
        let (name, span) = (ATTRIBUTES[attribute], spans[source]);
        let end = |end: &str| &span[format!("{name}_{end}")];
        charts::bar(&rows[source][name], end("low"), end("high"))
    })
}

fn spans_row(source: Source, spans: &[Option<Interval>]) -> Value {
    let mut row = json!({ "source": source.name() });
    for (name, span) in ATTRIBUTES.iter().zip(spans) {
        row[format!("{name}_low")] = json!(span.map(|span| span.low));
        row[format!("{name}_high")] = json!(span.map(|span| span.high));
    }
    row
}

/// By which share of random placement's discrepancy guided generation is below it.
fn gain(rows: &[Value]) -> Value {
    let of = |source: Source| rows.iter().find(|row| row["source"] == source.name());
    let guided = of(Source::Model(Placement::Guided));
    let gain = |name: &str| {
        let value = |row: Option<&Value>| row.and_then(|row| row[name].as_f64());
        Some(1.0 - value(guided)? / value(of(Source::Random))?)
    };
    json!(BTreeMap::from(ATTRIBUTES.map(|name| (name, gain(name)))))
}

fn row(source: Source, tally: &Tally, prompt_satisfaction: Option<f64>) -> Value {
    let mean = tally.mean();
    let rate = |n: usize, of: usize| n as f64 / of.max(1) as f64;
    json!({
        "source": source.name(),
        "position": mean.position,
        "heading": mean.heading,
        "speed": mean.velocity,
        "size": mean.size,
        "overlap_rate": rate(tally.overlapping, tally.vehicles),
        "offroad_rate": rate(tally.off_road, tally.vehicles),
        "wrong_way_rate": rate(tally.wrong_way, tally.moving),
        "prompt_satisfaction": prompt_satisfaction,
        "scenes": tally.mmd.len(),
        "failed": tally.failed,
    })
}
