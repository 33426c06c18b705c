//! The report of an evaluation, from stored results alone.

use std::collections::BTreeSet;
use std::path::PathBuf;

use gump_eval::Notes;
use gump_eval::behaviour::{BehaviourSettings, ScenarioCounts, ScenarioTallies};
use gump_eval::decoding::DecodedWorldName;
use gump_eval::results::{self, Entry, MissingShards};
use gump_metrics::behaviour::{Class, Count, Key, Measure, Tally};
use gump_metrics::{Interval, intervals};
use gump_scene::Seed;
use gump_viz::Bars;
use serde_json::{Map, Value, json};

use super::super::columns::label;
use crate::run::Run;
use crate::{charts, notes, table};

/// Draws of scenarios for an interval; its ends move by a few percent of its width with the seed.
const DRAWS: usize = 1000;

/// A chart: its name, what its axis says, and which measures are on it.
type Chart = (&'static str, &'static str, fn(Measure) -> bool);

const CHARTS: [Chart; 6] = [
    (
        "shares",
        "share, or number per agent, with 95 % intervals over scenarios",
        |measure| !measure.is_rate() && !measure.is_duration() && !measure.is_of_moments(),
    ),
    (
        "rates",
        "events per minute, with 95 % intervals over scenarios",
        Measure::is_rate,
    ),
    (
        "standing",
        "share that stands, with 95 % intervals over scenarios",
        |measure| matches!(measure, Measure::Standing | Measure::ComeToRest),
    ),
    (
        "speeds",
        "mean speed of agents that do not stand in the present, m/s, with 95 % intervals over scenarios",
        |measure| measure == Measure::Speed,
    ),
    (
        "around",
        "agents near the ego, and share of egos on a lane, with 95 % intervals over scenarios",
        |measure| matches!(measure, Measure::NearEgo | Measure::EgoOnLane),
    ),
    (
        "phases",
        "mean seconds of red and green, with 95 % intervals over scenarios",
        Measure::is_duration,
    ),
];

/// Reports on the shards in some folders.
pub(crate) fn report_merged(
    run: &mut Run,
    folders: &[PathBuf],
    missing: MissingShards,
) -> anyhow::Result<()> {
    let (header, entries) = results::merge::<ScenarioCounts>(folders, missing)?;
    report(run, &header.settings.try_into()?, &entries)
}

/// One number of one column.
#[derive(Clone, Copy, Default)]
struct Number {
    count: Count,
    span: Option<Interval>,
}

/// The log or a world, over all scenarios.
struct Column {
    name: Option<DecodedWorldName>,
    numbers: Vec<Number>,
}

impl Column {
    /// Adds up `tallies`, one per scenario, for every key.
    fn of(name: Option<DecodedWorldName>, keys: &[Key], tallies: &[Tally]) -> Self {
        let sums = |drawn: &mut dyn Iterator<Item = usize>| {
            let mut sums = vec![Count::default(); keys.len()];
            for i in drawn {
                for (sum, key) in sums.iter_mut().zip(keys) {
                    let count = tallies[i].0.get(key).copied().unwrap_or_default();
                    sum.events += count.events;
                    sum.of += count.of;
                }
            }
            sums
        };
        // Not the run's seed: an interval says nothing about the worlds' chance.
        let spans = intervals(tallies.len(), DRAWS, Seed(0), |drawn| {
            let sums = sums(&mut drawn.iter().copied());
            sums.into_iter().map(Count::rate).collect()
        });
        let counts = sums(&mut (0..tallies.len())).into_iter().enumerate();
        let numbers = counts.map(|(i, count)| Number {
            count,
            span: spans.get(i).copied().flatten(),
        });
        Self {
            name,
            numbers: numbers.collect(),
        }
    }

    fn is_same(&self, other: &Self) -> bool {
        let mut counts = self.numbers.iter().zip(&other.numbers);
        counts.all(|(a, b)| a.count == b.count)
    }

    /// Its heading.
    fn label(&self) -> String {
        self.name.as_ref().map_or("log".into(), label)
    }
}

/// Totals, intervals, the table and the charts.
pub(super) fn report(
    run: &mut Run,
    settings: &BehaviourSettings,
    entries: &[Entry<ScenarioCounts>],
) -> anyhow::Result<()> {
    let tallies = ScenarioTallies::of(entries, settings.worlds.len())?;
    let all = tallies.worlds.iter().flatten().chain(&tallies.log);
    let counted = all.flat_map(|tally| &tally.0);
    let counted = counted.filter(|(_, count)| count.of > 0.0);
    let keys: BTreeSet<Key> = counted.map(|(key, _)| *key).collect();
    let keys: Vec<Key> = keys.into_iter().collect();
    let log = Column::of(None, &keys, &tallies.log);
    let worlds: Vec<Column> = settings
        .worlds
        .iter()
        .zip(&tallies.worlds)
        .map(|(name, tallies)| Column::of(Some(name.clone()), &keys, tallies))
        .collect();
    run.result("scenarios", entries.len())?;
    run.result("set", &settings.scenarios)?;
    run.result("futures", settings.futures)?;
    let rows = worlds.iter().flat_map(|world| rows(world, &log, &keys));
    run.result_hidden("rows", rows.collect::<Vec<_>>())?;
    // The log replayed is the log, unless the worlds go on for longer.
    let others = worlds.iter().filter(|world| !world.is_same(&log));
    let columns: Vec<&Column> = std::iter::once(&log).chain(others).collect();
    run.print(&table::text(
        &json!({ "behaviour": lines(&columns, &keys) }),
        run.width(),
    ));
    for (stem, label, shows) in CHARTS {
        charts::save(run, stem, &chart(label, &columns, &keys, shows))?;
    }
    let mut noted = Notes::default();
    entries
        .iter()
        .for_each(|entry| noted.merge(&entry.scores.notes()));
    notes::report(run, &noted, entries.len())
}

/// The rows of one world.
fn rows<'a>(
    world: &'a Column,
    log: &'a Column,
    keys: &'a [Key],
) -> impl Iterator<Item = Value> + 'a {
    let numbers = keys.iter().zip(&world.numbers).zip(&log.numbers);
    numbers
        .filter(|((_, number), _)| number.count.of > 0.0)
        .map(|((key, number), logged)| {
            let name = world.name.as_ref();
            json!({
                "world": name.map(|name| &name.world),
                "decoding": name.map(|name| &name.decoding),
                "class": key.class.name(),
                "measure": key.measure.name(),
                "seconds": key.seconds,
                "per": key.measure.per(),
                "value": number.count.rate(),
                "log": logged.count.rate(),
                "low": number.span.map(|span| span.low),
                "high": number.span.map(|span| span.high),
                "log_low": logged.span.map(|span| span.low),
                "log_high": logged.span.map(|span| span.high),
                "events": number.count.events,
                "of": number.count.of,
            })
        })
}

/// The table for reading: a line per number, a column for the log and each world.
fn lines(columns: &[&Column], keys: &[Key]) -> Vec<Value> {
    let line = |(i, key): (usize, &Key)| {
        let head = [
            ("measure", json!(key.measure.name())),
            ("class", json!(key.class.name())),
            ("s", json!(key.seconds)),
            ("per", json!(key.measure.per())),
        ];
        let mut line: Map<String, Value> = head
            .map(|(name, value)| (name.to_owned(), value))
            .into_iter()
            .collect();
        for column in columns {
            line.insert(column.label(), json!(cell(column.numbers[i])));
        }
        Value::Object(line)
    };
    keys.iter().enumerate().map(line).collect()
}

/// A number with its interval if it has any width, `-` where nothing was counted.
fn cell(number: Number) -> String {
    let Some(rate) = number.count.rate() else {
        return "-".into();
    };
    let short = |x: f64| {
        if x == 0.0 {
            return "0".into();
        }
        let digits = if x >= 9.95 {
            1
        } else if x >= 0.995 {
            2
        } else {
            3
        };
        format!("{x:.digits$}")
    };
    match number.span.filter(|span| span.low < span.high) {
        Some(span) => format!("{} ({}-{})", short(rate), short(span.low), short(span.high)),
        None => short(rate),
    }
}

fn chart(label: &str, columns: &[&Column], keys: &[Key], shows: impl Fn(Measure) -> bool) -> Bars {
    let shown: Vec<usize> = (0..keys.len())
        .filter(|&i| shows(keys[i].measure))
        .collect();
    let names = shown.iter().map(|&i| {
        let Key {
            measure,
            class,
            seconds,
        } = keys[i];
        match measure {
            Measure::Standing | Measure::Speed => format!("{class}, {seconds} s"),
            Measure::ComeToRest => format!("{class}, slow, {seconds} s"),
            Measure::NearEgo => format!("{class}, near, {seconds} s"),
            Measure::EgoOnLane => format!("ego on a lane, {seconds} s"),
            _ => {
                let name = measure.name();
                // The title of the axis has the unit.
                let words = name.strip_suffix("_s").unwrap_or(name).replace('_', " ");
                match class {
                    Class::Light => words,
                    _ => format!("{words}, {class}"),
                }
            }
        }
    });
    let legend = columns.iter().map(|column| column.label()).collect();
    charts::bars(label, names.collect(), legend, |row, column| {
        let number = columns[column].numbers[shown[row]];
        let span = number.span.map(|span| (span.low, span.high));
        let value = number.count.rate()?;
        Some(gump_viz::Bar { value, span })
    })
}
