//! `evaluate generation`: how like recorded scenes generated ones are, beside simpler ways of
//! making them.
//!
//! The protocol, the sources of scenes and the scores are of [`gump_eval::generation`].

use std::collections::BTreeMap;
use std::path::PathBuf;

use gump_engine::SamplingConfig;
use gump_eval::benchmarks::{ScenarioSet, ScenarioSetName};
use gump_eval::datasets::{self, Split};
use gump_eval::generation::{
    ATTRIBUTES, ComparedScene, GenerationTally, LongObservation, PromptConfig, SceneMakers,
    SceneSource, long_scenes, observe_logs, observe_world, prompt_satisfaction, recorded_scenarios,
    summarize_long,
};
use gump_eval::worlds::{self, World};
use gump_generate::Placement;
use gump_generate::pipeline::GenerationWorlds;
use gump_metrics::Interval;
use gump_metrics::mmd::MmdProtocol;
use gump_scene::Scenario;
use gump_viz::Bars;
use serde::Serialize;
use serde_json::{Map, Value, json};

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
    /// Never steer the ego towards its prompt
    #[arg(long)]
    no_steering: bool,
    /// Do not show prompts to the network; they still choose places and scenes
    #[arg(long)]
    no_prompt_token: bool,
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
        let scenarios = run.phase("read", |run| {
            let monitor = run.monitor();
            Ok(recorded_scenarios(&found, self.limit, &protocol, &monitor)?)
        })?;
        let bank = run.phase("bank", |run| self.bank(run, &protocol))?;
        anyhow::ensure!(
            scenarios.len() > 1,
            "{} scenarios have {} vehicles within 50 m, expected at least 2",
            scenarios.len(),
            self.min_vehicles
        );
        let numbered = scenarios.iter().cloned().enumerate();
        let cases = numbered.flat_map(|(i, scenario)| {
            let seed = seed.fork(9).fork(i as u64);
            ComparedScene::of(i, scenario, self.centres, &protocol, seed)
        });
        let cases: Vec<ComparedScene> = cases.collect();
        run.result("scenarios", scenarios.len())?;
        run.result("scenes", cases.len())?;
        let makers = SceneMakers {
            world: &world,
            cases: &cases,
            bank: &bank,
            protocol,
        };
        let mut tallies = Vec::new();
        for source in SceneSource::ALL {
            stop_if_interrupted()?;
            let tally = run.phase(source.name(), |_| {
                Ok(GenerationTally::of(&makers, source, seed))
            })?;
            tallies.push((source, tally));
        }
        let prompts = run.phase("prompts", |run| {
            let worlds = GenerationWorlds {
                scenes: &world,
                traffic: traffic.model(),
            };
            let config = PromptConfig {
                maps: self.prompt_maps,
                attempts: self.attempts,
                steers: !self.no_steering,
                tokens: !self.no_prompt_token,
            };
            let monitor = run.monitor();
            Ok(prompt_satisfaction(
                worlds, &scenarios, config, seed, &monitor,
            )?)
        })?;
        let rows = tallies.iter().map(|(source, tally)| {
            let satisfaction = match source {
                SceneSource::Model(Placement::Guided) => prompts.satisfaction,
                SceneSource::Model(Placement::Free) => prompts.unconditional,
                SceneSource::Log => prompts.logged,
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
        if let Some(scenes) = prompts.scenes {
            run.result("prompted_scenes", scenes)?;
        }
        run.result("prompts", prompts.rows)?;
        if self.long_scenes > 0 {
            let rows = run.phase("long", |run| self.long_rows(run))?;
            charts::save(run, "life", &long_chart(&rows))?;
            run.result("life", rows)?;
        }
        Ok(())
    }

    /// The recordings that are retrieved.
    fn bank(&self, run: &Run, protocol: &MmdProtocol) -> anyhow::Result<Vec<Scenario>> {
        let monitor = run.monitor();
        let read = |path| -> anyhow::Result<Vec<Scenario>> {
            let set = ScenarioSet::of_path(path);
            Ok(recorded_scenarios(&set, None, protocol, &monitor)?)
        };
        if let Some(path) = &self.bank {
            return read(path);
        }
        let parts = datasets::parts(&shipped::data(), Split::Train)?;
        let parts = parts.iter().map(|part| read(&part.path));
        Ok(parts.collect::<anyhow::Result<Vec<_>>>()?.concat())
    }

    /// One row per world: the log, traffic without and with agents that come and leave.
    ///
    /// Error: weights that cannot be read, or a world that fails.
    fn long_rows(&self, run: &Run) -> anyhow::Result<Vec<Value>> {
        let seed = run.seed();
        let scenarios = long_scenes(self.long_scenes, seed);
        let logged = observe_logs(&scenarios);
        let mut rows = vec![long_row("log", &logged, &logged)?];
        for (name, life) in [("those who are there", false), ("life", true)] {
            stop_if_interrupted()?;
            let sampling = SamplingConfig {
                spawn: life,
                ..SamplingConfig::default()
            };
            let traffic = World::without_log(run.device(), &shipped::world(), &sampling)?;
            let observed = observe_world(traffic.model(), &scenarios, seed)?;
            rows.push(long_row(name, &observed, &logged)?);
        }
        stop_if_interrupted()?;
        let world = generate::world(run.device(), self.weights.as_ref(), true)?;
        let observed = observe_world(&world, &scenarios, seed)?;
        rows.push(long_row(
            "life of the sequence network",
            &observed,
            &logged,
        )?);
        Ok(rows)
    }
}

/// The name of a world, then its numbers.
fn long_row(
    world: &str,
    observed: &[LongObservation],
    logged: &[LongObservation],
) -> anyhow::Result<Value> {
    let mut row = Map::from_iter([("world".to_owned(), json!(world))]);
    let numbers = serde_json::to_value(summarize_long(observed, logged))?;
    if let Value::Object(numbers) = numbers {
        row.extend(numbers);
    }
    Ok(Value::Object(row))
}

/// Changes within half a minute, in every world.
fn long_chart(rows: &[Value]) -> Bars {
    let counts = [
        ("agents at 30 s", "agents_at_30_s"),
        ("error of the count", "agent_count_error"),
        ("entries", "entries"),
        ("exits", "exits"),
        ("changes per light", "changes_per_light"),
    ];
    let worlds = rows.iter().filter_map(|row| row["world"].as_str());
    let legend = worlds.map(String::from).collect();
    let label = "within 80 m of the ego, mean over scenes";
    let names = counts.map(|(name, _)| name.into()).into();
    charts::bars(label, names, legend, |count, world| {
        charts::bar(&rows[world][counts[count].1], &Value::Null, &Value::Null)
    })
}

/// The discrepancy of every source on every attribute; the log's is none.
fn chart(rows: &[Value], intervals: &[Value]) -> Bars {
    let is_shown = |row: &&Value| row["source"] != SceneSource::Log.name();
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

fn spans_row(source: SceneSource, spans: &[Option<Interval>]) -> Value {
    let mut row = json!({ "source": source.name() });
    for (name, span) in ATTRIBUTES.iter().zip(spans) {
        row[format!("{name}_low")] = json!(span.map(|span| span.low));
        row[format!("{name}_high")] = json!(span.map(|span| span.high));
    }
    row
}

/// By which share of random placement's discrepancy guided generation is below it.
fn gain(rows: &[Value]) -> Value {
    let of = |source: SceneSource| rows.iter().find(|row| row["source"] == source.name());
    let guided = of(SceneSource::Model(Placement::Guided));
    let gain = |name: &str| {
        let value = |row: Option<&Value>| row.and_then(|row| row[name].as_f64());
        Some(1.0 - value(guided)? / value(of(SceneSource::Random))?)
    };
    json!(BTreeMap::from(ATTRIBUTES.map(|name| (name, gain(name)))))
}

fn row(source: SceneSource, tally: &GenerationTally, prompt_satisfaction: Option<f64>) -> Value {
    let mean = tally.mean();
    let rate = |n: usize, of: usize| n as f64 / of.max(1) as f64;
    let mut row = Map::from_iter([("source".to_owned(), json!(source.name()))]);
    for (name, value) in ATTRIBUTES.iter().zip(mean.values()) {
        row.insert((*name).to_owned(), json!(value));
    }
    let rates = [
        ("overlap_rate", rate(tally.overlapping, tally.vehicles)),
        ("offroad_rate", rate(tally.off_road, tally.vehicles)),
        ("wrong_way_rate", rate(tally.wrong_way, tally.moving)),
    ];
    row.extend(rates.map(|(name, value)| (name.to_owned(), json!(value))));
    row.insert("prompt_satisfaction".to_owned(), json!(prompt_satisfaction));
    row.insert("scenes".to_owned(), json!(tally.mmd.len()));
    row.insert("failed".to_owned(), json!(tally.failed));
    Value::Object(row)
}
