//! The report of an evaluation, from the entries of its ledger alone.

use std::path::PathBuf;

use gump_data::Table;
use gump_eval::decoding::Decoding;
use gump_eval::digest;
use gump_eval::realism::ScenarioScores;
use gump_eval::results::{self, Entry, MissingShards};
use gump_metrics::interval;
use gump_scene::Seed;
use gump_viz::Bars;
use gump_wosac::realism::{Component, Scores};
use serde_json::{Map, Value, json};

use super::Settings;
use crate::run::Run;
use crate::{charts, tables};

/// The name of the log as a world.
const ORACLE: &str = "logged-oracle";
/// The name of the baseline.
const CONSTANT_VELOCITY: &str = "constant-velocity";

/// Reports on the shards in some folders.
pub(crate) fn report_merged(
    run: &mut Run,
    folders: &[PathBuf],
    missing: MissingShards,
) -> anyhow::Result<()> {
    let (header, entries) = results::merge::<ScenarioScores>(folders, missing)?;
    let settings: Settings = header.settings.try_into()?;
    report(run, &settings, &entries)
}

/// A world under one decoding, with its scores in every scenario.
struct WorldScores {
    world: String,
    decoding: String,
    /// Of all rollouts, where they were imagined.
    digest: Option<String>,
    scores: Vec<Scores>,
}

impl WorldScores {
    /// Its label in tables and charts.
    fn label(&self) -> String {
        Decoding::label(&self.world, &self.decoding)
    }

    fn row(&self, year: &str, scores: &Scores, scenarios: usize) -> Value {
        row((&self.world, &self.decoding), year, scenarios, scores)
    }
}

/// Scores of the evaluated world in every decoding, then of the log and of the baseline.
fn world_scores(settings: &Settings, entries: &[Entry<ScenarioScores>]) -> Vec<WorldScores> {
    let decodings = entries.first().map_or(&[][..], |e| &e.scores.evaluated);
    let evaluated = decodings.iter().enumerate().map(|(i, first)| {
        let of = entries.iter().filter_map(|e| e.scores.evaluated.get(i));
        let digests = of.clone().filter_map(|found| found.digest.as_deref());
        WorldScores {
            world: settings.world.clone(),
            decoding: first.decoding.clone(),
            digest: digest::of_digests(digests),
            scores: of.map(|found| found.scores.clone()).collect(),
        }
    });
    let other = |world: &str, pick: fn(&ScenarioScores) -> &Scores| WorldScores {
        world: world.into(),
        decoding: Decoding::NONE.into(),
        digest: None,
        scores: entries.iter().map(|e| pick(&e.scores).clone()).collect(),
    };
    let mut all: Vec<WorldScores> = evaluated.collect();
    all.push(other(ORACLE, |scored| &scored.oracle));
    if settings.world != CONSTANT_VELOCITY {
        all.push(other(CONSTANT_VELOCITY, |scored| &scored.constant_velocity));
    }
    all
}

/// Totals, intervals and the time it took.
pub(crate) fn report(
    run: &mut Run,
    settings: &Settings,
    entries: &[Entry<ScenarioScores>],
) -> anyhow::Result<()> {
    let worlds = world_scores(settings, entries);
    per_scenario(settings, entries, &worlds).write(&run.path("scores.parquet"))?;
    run.result("set", &settings.scenarios)?;
    run.result("scenarios", entries.len())?;
    let rows = worlds.iter().filter_map(|world| {
        let mean = Scores::mean(&world.scores)?;
        Some(world.row(&settings.year, &mean, world.scores.len()))
    });
    run.result("rows", rows.collect::<Vec<_>>())?;
    let imagined = worlds.iter().filter(|world| world.digest.is_some());
    let digests = imagined.map(|w| json!({"decoding": w.decoding, "digest": w.digest}));
    run.result("digests", digests.collect::<Vec<_>>())?;
    let labelled: Vec<(String, &[Scores])> = worlds
        .iter()
        .map(|world| (world.label(), &world.scores[..]))
        .collect();
    let intervals = intervals(&labelled);
    let names: Vec<&str> = labelled.iter().map(|(name, _)| name.as_str()).collect();
    charts::save(run, "realism", &chart(&intervals, &names))?;
    run.result("intervals", intervals)?;
    let is_undefined = |e: &&Entry<ScenarioScores>| {
        let mut evaluated = e.scores.evaluated.iter();
        evaluated.any(|found| found.scores.metametric.is_nan())
    };
    let undefined = entries.iter().filter(is_undefined);
    let undefined: Vec<&str> = undefined.map(|entry| entry.id.as_str()).collect();
    if let Some(first) = undefined.first() {
        run.print(&format!(
            "warning: {} scenarios have a component without any valid step, {first} for one; \
             as in the reference their scores and the means are no numbers",
            undefined.len()
        ));
    }
    let seconds: f64 = entries.iter().map(|entry| entry.scores.seconds).sum();
    run.result("seconds_per_scenario", seconds / entries.len() as f64)
}

fn row((world, decoding): (&str, &str), year: &str, scenarios: usize, scores: &Scores) -> Value {
    let components = scores.components.iter();
    let components: Map<String, Value> = components
        .map(|(component, score)| (component.name().into(), json!(score)))
        .collect();
    json!({
        "world": world,
        "decoding": decoding,
        "year": year,
        "scenarios": scenarios,
        "metametric": scores.metametric,
        "kinematic": scores.kinematic,
        "interactive": scores.interactive,
        "map_based": scores.map_based,
        "min_ade": scores.min_ade,
        "ade": scores.ade,
        "collision_rate": scores.collision_rate,
        "offroad_rate": scores.offroad_rate,
        "traffic_light_violation_rate": scores.traffic_light_violation_rate,
        "components": components,
    })
}

/// A row per world and scenario, in the order of the worlds.
fn per_scenario(
    settings: &Settings,
    entries: &[Entry<ScenarioScores>],
    worlds: &[WorldScores],
) -> Table {
    let rows = worlds.iter().flat_map(|world| {
        entries
            .iter()
            .zip(&world.scores)
            .map(move |(entry, scores)| {
                let mut row = world.row(&settings.year, scores, 1);
                row["scenario_id"] = json!(entry.id);
                row["index"] = json!(entry.index);
                row
            })
    });
    tables::of_rows(&rows.collect::<Vec<_>>())
}

/// Every likelihood of every world; distances are in other units.
fn chart(intervals: &[Value], worlds: &[&str]) -> Bars {
    let is_likelihood =
        |line: &&Value| !["min_ade", "ade"].iter().any(|name| line["score"] == *name);
    let lines: Vec<&Value> = intervals.iter().filter(is_likelihood).collect();
    let names = lines.iter().filter_map(|line| line["score"].as_str());
    let names = names.map(|name| name.replace('_', " ")).collect();
    let legend = charts::legends(worlds);
    let label = "realism, 0 to 1, with 95 % intervals over scenarios";
    charts::bars(label, names, legend, |row, column| {
        let (line, world) = (lines[row], worlds[column]);
        let end = |end: &str| &line[format!("{world} {end}")];
        charts::bar(&line[world], end("low"), end("high"))
    })
}

/// One line per number: mean and 95 % interval over scenarios for every world.
fn intervals(worlds: &[(String, &[Scores])]) -> Vec<Value> {
    type Number = Box<dyn Fn(&Scores) -> Option<f64>>;
    let mut numbers: Vec<(&str, Number)> = vec![
        ("metametric", Box::new(|s| Some(s.metametric))),
        ("kinematic", Box::new(|s| Some(s.kinematic))),
        ("interactive", Box::new(|s| Some(s.interactive))),
        ("map_based", Box::new(|s| Some(s.map_based))),
        ("min_ade", Box::new(|s| Some(s.min_ade))),
        ("ade", Box::new(|s| Some(s.ade))),
    ];
    for component in Component::ALL {
        let of = move |scores: &Scores| scores.components.get(&component).copied();
        numbers.push((component.name(), Box::new(of)));
    }
    let line = |(name, number): &(&str, Number)| {
        let mut line = Map::from_iter([("score".into(), json!(name))]);
        for (world, scores) in worlds {
            let values: Vec<f64> = scores.iter().filter_map(number).collect();
            if values.is_empty() {
                return None;
            }
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            // Not the run's seed: an interval says nothing about the worlds' chance.
            let interval = interval(&values, Seed(0));
            line.insert(world.clone(), json!(mean));
            line.insert(format!("{world} low"), json!(interval.map(|i| i.low)));
            line.insert(format!("{world} high"), json!(interval.map(|i| i.high)));
        }
        Some(Value::Object(line))
    };
    numbers.iter().filter_map(line).collect()
}
