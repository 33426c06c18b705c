//! The table of a motion evaluation, and how sure it is.

use std::path::PathBuf;

use anyhow::Context as _;
use gump_eval::decoding::Decoding;
use gump_eval::digest;
use gump_eval::motion::ScenarioPredictions;
use gump_eval::results::{self, Entry, MissingShards};
use gump_metrics::{Interval, intervals};
use gump_scene::AgentKind;
use gump_viz::Bars;
use gump_wosac::motion::{MotionConfig, MotionRow, MotionTally, ShapeRules};
use serde::Deserialize as _;
use serde_json::{Map, Value, json};

use super::{NAME, config};
use crate::charts;
use crate::run::Run;

/// Draws of scenarios for an interval; its ends move by a tenth of its width with the seed.
const DRAWS: usize = 200;

/// Charts: file, what is measured, and the numbers of a row that are.
const CHARTS: [(&str, &str, &[&str]); 2] = [
    ("distances", "displacement, m", &["min_ade", "min_fde"]),
    (
        "rates",
        "share, 0 to 1",
        &["miss_rate", "overlap_rate", "map", "soft_map"],
    ),
];

/// Fills the report of a run.
pub(super) fn report(
    run: &mut Run,
    set: &str,
    entries: &[Entry<ScenarioPredictions>],
    config: &MotionConfig,
    decoding: &str,
) -> anyhow::Result<()> {
    let tallies = entries.iter().map(|entry| {
        let scores = entry.scores.scores();
        let scores = scores.with_context(|| format!("scenario {}", entry.id))?;
        Ok(MotionTally::of(&scores))
    });
    let tallies: Vec<MotionTally> = tallies.collect::<anyhow::Result<_>>()?;
    let rows = merged(tallies.iter()).rows(config);
    let spans = run.phase("intervals", |run| {
        let keys: Vec<_> = rows.iter().map(key).collect();
        let statistic = |drawn: &[usize]| numbers_of(&keys, &tallies, drawn, config);
        Ok(intervals(tallies.len(), DRAWS, run.seed(), statistic))
    })?;
    let absent: usize = entries.iter().map(|entry| entry.scores.absent).sum();
    run.result("benchmark", NAME)?;
    run.result("set", set)?;
    run.result("decoding", decoding)?;
    run.result("scenarios", entries.len())?;
    run.result("predictions", rows.last().map_or(0, |row| row.predictions))?;
    run.result("targets_absent_now", absent)?;
    let digests = entries.iter().filter_map(|e| e.scores.digest.as_deref());
    run.result("digest", digest::of_digests(digests))?;
    let table: Vec<Value> = rows.iter().map(|row| Value::Object(line(row))).collect();
    let intervals = interval_lines(&rows, &spans);
    for (stem, label, columns) in CHARTS {
        charts::save(run, stem, &chart(label, columns, &table, &intervals))?;
    }
    run.result("rows", table)?;
    run.result("intervals", intervals)
}

/// Fills the report of shards put together.
pub(crate) fn report_merged(
    run: &mut Run,
    folders: &[PathBuf],
    missing: MissingShards,
) -> anyhow::Result<()> {
    let (header, entries) = results::merge::<ScenarioPredictions>(folders, missing)?;
    let shapes = header.settings.get("shapes").cloned();
    let shapes = shapes.context("expected the setting shapes in the ledger")?;
    let seed = header
        .settings
        .get("seed")
        .and_then(toml::Value::as_integer);
    run.reseed(seed.and_then(|seed| u64::try_from(seed).ok()).unwrap_or(0));
    let setting = |key: &str| header.settings.get(key).and_then(toml::Value::as_str);
    let set = setting("scenarios").unwrap_or_default();
    let decoding = setting("decoding").unwrap_or(Decoding::NONE);
    let config = config(ShapeRules::deserialize(shapes)?);
    report(run, set, &entries, &config, decoding)
}

fn merged<'a>(tallies: impl Iterator<Item = &'a MotionTally>) -> MotionTally {
    let mut all = MotionTally::default();
    tallies.for_each(|tally| all.merge(tally));
    all
}

type Key = (Option<AgentKind>, Option<u64>);

/// The key of a row.
fn key(row: &MotionRow) -> Key {
    (row.kind, row.seconds.map(f64::to_bits))
}

/// The numbers of the rows with these keys over some of the scenarios; a draw may lack a kind.
fn numbers_of(
    keys: &[Key],
    tallies: &[MotionTally],
    drawn: &[usize],
    config: &MotionConfig,
) -> Vec<Option<f64>> {
    let rows = merged(drawn.iter().map(|&i| &tallies[i])).rows(config);
    let numbers = keys.iter().flat_map(|wanted| {
        let row = rows.iter().find(|row| key(row) == *wanted);
        row.copied().unwrap_or_default().numbers()
    });
    numbers.map(|(_, number)| number).collect()
}

/// Class and horizon, then the numbers.
fn line(row: &MotionRow) -> Map<String, Value> {
    let mut line = head(row);
    line.insert("predictions".into(), row.predictions.into());
    for (name, number) in row.numbers() {
        line.insert(name.into(), number.into());
    }
    line
}

fn head(row: &MotionRow) -> Map<String, Value> {
    let mut head = Map::new();
    head.insert(
        "class".into(),
        row.kind.map_or("all", AgentKind::name).into(),
    );
    head.insert("horizon_s".into(), row.seconds.into());
    head
}

/// Some numbers of every class and horizon.
fn chart(label: &str, columns: &[&str], rows: &[Value], intervals: &[Value]) -> Bars {
    let name = |row: &Value| {
        let class = row["class"].as_str().unwrap_or_default();
        match row["horizon_s"].as_f64() {
            Some(seconds) => format!("{class}, {seconds} s"),
            None => format!("{class}, mean"),
        }
    };
    let legend = columns
        .iter()
        .map(|column| column.replace('_', " ").replace("map", "mAP"));
    let label = format!("{label}, with 95 % intervals over scenarios");
    charts::bars(
        &label,
        rows.iter().map(name).collect(),
        legend.collect(),
        |row, column| {
            let (value, span) = (
                &rows[row][columns[column]],
                &intervals[row][columns[column]],
            );
            charts::bar(value, &span[0], &span[1])
        },
    )
}

/// 95 % intervals over scenarios, [low, high] of every number of every row.
fn interval_lines(rows: &[MotionRow], spans: &[Option<Interval>]) -> Vec<Value> {
    let mut spans = spans.iter();
    let lines = rows.iter().map(|row| {
        let mut line = head(row);
        for (name, _) in row.numbers() {
            let span = spans.next().copied().flatten();
            line.insert(name.into(), json!(span.map(|span| [span.low, span.high])));
        }
        Value::Object(line)
    });
    lines.collect()
}
