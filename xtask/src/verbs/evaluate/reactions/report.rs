//! The report of an evaluation, from stored results alone.

use std::collections::BTreeMap;
use std::ops::AddAssign;
use std::path::PathBuf;

use gump_eval::decoding::DecodedWorldName;
use gump_eval::reactions::{ReactionSettings, ScenarioReactions, TriedManoeuvre, any_scored};
use gump_eval::results::{self, Entry, MissingShards};
use gump_metrics::reactions::Manoeuvre;
use gump_metrics::{Interval, intervals};
use gump_scene::Seed;
use gump_viz::Bars;
use serde_json::{Value, json};

use super::super::columns::label;
use crate::run::Run;
use crate::{charts, table};

/// Draws of scenarios for an interval; its ends move by a few percent of its width with the seed.
const DRAWS: usize = 1000;
/// The row of all manoeuvres that leave the log.
const ALL: &str = "all";

/// Reports on the shards in some folders.
pub(crate) fn report_merged(
    run: &mut Run,
    folders: &[PathBuf],
    missing: MissingShards,
) -> anyhow::Result<()> {
    let (header, entries) = results::merge::<ScenarioReactions>(folders, missing)?;
    any_scored(&entries)?;
    report(run, &header.settings.try_into()?, &entries)
}

/// Sums over manoeuvres of one scenario, or over scenarios.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Sum {
    /// Manoeuvres driven.
    scenes: f64,
    agents: f64,
    /// Agents near that ran into the ego, in the world and in the log.
    run_into: f64,
    log: f64,
    struck: f64,
    at_fault: f64,
    /// Number of manoeuvres in which an agent runs into the ego where the log is replayed.
    pressed_scenes: f64,
    pressed: f64,
}

impl AddAssign for Sum {
    fn add_assign(&mut self, other: Self) {
        self.scenes += other.scenes;
        self.agents += other.agents;
        self.run_into += other.run_into;
        self.log += other.log;
        self.struck += other.struck;
        self.at_fault += other.at_fault;
        self.pressed_scenes += other.pressed_scenes;
        self.pressed += other.pressed;
    }
}

impl Sum {
    fn of(tried: &TriedManoeuvre, world: usize) -> Option<Self> {
        let seen = tried.worlds.get(world)?;
        let is_pressed = f64::from(u8::from(tried.log > 0));
        Some(Self {
            scenes: 1.0,
            agents: tried.agents as f64,
            run_into: seen.run_into(),
            log: tried.log as f64,
            struck: seen.struck(),
            at_fault: seen.at_fault(),
            pressed_scenes: is_pressed,
            pressed: seen.run_into() * is_pressed,
        })
    }

    /// The numbers that get an interval.
    fn rates(&self) -> Vec<Option<f64>> {
        let share = |a: f64, b: f64| (b > 0.0).then(|| a / b);
        vec![
            share(self.run_into, self.agents),
            share(self.run_into, self.log),
            share(self.run_into, self.scenes),
            share(self.pressed, self.pressed_scenes),
        ]
    }
}

/// A world and a manoeuvre over all scenarios.
struct Line<'a> {
    name: &'a DecodedWorldName,
    manoeuvre: &'a str,
    sum: Sum,
    /// As [`Sum::rates`].
    spans: Vec<Option<Interval>>,
}

impl<'a> Line<'a> {
    /// `None` if it was not driven in any scenario.
    fn of(
        entries: &[Entry<ScenarioReactions>],
        name: &'a DecodedWorldName,
        world: usize,
        manoeuvre: &'a str,
    ) -> Option<Self> {
        let is_meant = |tried: &&TriedManoeuvre| match manoeuvre {
            ALL => tried.manoeuvre != Manoeuvre::Log.name(),
            one => tried.manoeuvre == one,
        };
        let of_scene = |entry: &Entry<ScenarioReactions>| {
            let meant = entry.scores.tried.iter().filter(is_meant);
            let sums = meant.filter_map(|tried| Sum::of(tried, world));
            sums.reduce(|mut a, b| {
                a += b;
                a
            })
        };
        let sums: Vec<Sum> = entries.iter().filter_map(of_scene).collect();
        let total = |drawn: &mut dyn Iterator<Item = usize>| {
            let mut total = Sum::default();
            drawn.for_each(|i| total += sums[i]);
            total
        };
        // Not the run's seed: an interval says nothing about the worlds' chance.
        let spans = intervals(sums.len(), DRAWS, Seed(0), |drawn| {
            total(&mut drawn.iter().copied()).rates()
        });
        let sum = total(&mut (0..sums.len()));
        (sum.scenes > 0.0).then_some(Self {
            name,
            manoeuvre,
            sum,
            spans,
        })
    }

    fn span(&self, i: usize) -> Option<Interval> {
        self.spans.get(i).copied().flatten()
    }

    fn row(&self) -> Value {
        let sum = &self.sum;
        let rates = sum.rates();
        let low = |i: usize| self.span(i).map(|span| span.low);
        let high = |i: usize| self.span(i).map(|span| span.high);
        json!({
            "world": self.name.world,
            "decoding": self.name.decoding,
            "manoeuvre": self.manoeuvre,
            "scenes": sum.scenes,
            "agents": sum.agents,
            "run_into_ego": rates[0],
            "low": low(0),
            "high": high(0),
            "log": (sum.agents > 0.0).then(|| sum.log / sum.agents),
            "of_log": rates[1],
            "of_log_low": low(1),
            "of_log_high": high(1),
            "per_scene": rates[2],
            "per_scene_low": low(2),
            "per_scene_high": high(2),
            "struck": sum.struck / sum.scenes,
            "ego_at_fault": sum.at_fault / sum.scenes,
            "pressed_scenes": sum.pressed_scenes,
            "per_pressed_scene": rates[3],
            "per_pressed_scene_low": low(3),
            "per_pressed_scene_high": high(3),
        })
    }

    /// The row for reading, in percent.
    fn shown(&self) -> Value {
        let sum = &self.sum;
        let rates = sum.rates();
        let percent = |x: f64| format!("{:.1}", 100.0 * x);
        let rate = match (rates[0], self.span(0)) {
            (Some(rate), Some(span)) => {
                let (low, high) = (percent(span.low), percent(span.high));
                format!("{} ({low}-{high})", percent(rate))
            }
            (rate, _) => rate.map_or("-".into(), percent),
        };
        let number = |x: Option<f64>| x.map_or("-".into(), |x| format!("{x:.2}"));
        json!({
            "world": label(self.name),
            "manoeuvre": self.manoeuvre,
            "scenes": sum.scenes as u64,
            "agents": sum.agents as u64,
            "run into ego, %": rate,
            "of log's": number(rates[1]),
            "per scene": number(rates[2]),
            "where log's do": number(rates[3]),
            "ego at fault, %": percent(sum.at_fault / sum.scenes),
        })
    }
}

/// Totals, intervals, the table and the chart.
pub(super) fn report(
    run: &mut Run,
    settings: &ReactionSettings,
    entries: &[Entry<ScenarioReactions>],
) -> anyhow::Result<()> {
    let mut names: Vec<&str> = settings.manoeuvres.iter().map(String::as_str).collect();
    names.push(ALL);
    let mut lines = Vec::new();
    for (world, name) in settings.worlds.iter().enumerate() {
        let of = |&one| Line::of(entries, name, world, one);
        lines.extend(names.iter().filter_map(of));
    }
    run.result("scenarios", entries.len())?;
    run.result("set", &settings.scenarios)?;
    run.result("futures", settings.futures)?;
    let rows: Vec<Value> = lines.iter().map(Line::row).collect();
    run.result_hidden("rows", rows)?;
    run.result_hidden("not_scored", not_scored(settings, entries))?;
    run.result_hidden("cases", cases(settings, entries))?;
    let shown: Vec<Value> = lines.iter().map(Line::shown).collect();
    run.print(&table::text(&json!({ "reactions": shown }), run.width()));
    let missing = json!({ "not scored": not_scored(settings, entries) });
    run.print(&table::text(&missing, run.width()));
    exclusions(run, entries)?;
    charts::save(run, "reactions", &chart(settings, &names, &lines))
}

/// Counts of manoeuvres that are not scored, by reason.
fn not_scored(settings: &ReactionSettings, entries: &[Entry<ScenarioReactions>]) -> Vec<Value> {
    let tried = || entries.iter().flat_map(|entry| &entry.scores.tried);
    let mut rows = Vec::new();
    for name in &settings.manoeuvres {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        let whys = tried().filter(|one| one.manoeuvre == *name);
        for why in whys.filter_map(|one| one.why.as_deref()) {
            *counts.entry(why).or_default() += 1;
        }
        let row = |(why, n): (&str, usize)| json!({"manoeuvre": name, "why": why, "scenarios": n});
        rows.extend(counts.into_iter().map(row));
    }
    rows
}

/// All agents that ran into the ego, for inspection.
fn cases(settings: &ReactionSettings, entries: &[Entry<ScenarioReactions>]) -> Vec<Value> {
    let mut rows = Vec::new();
    for entry in entries {
        for tried in &entry.scores.tried {
            for (name, seen) in settings.worlds.iter().zip(&tried.worlds) {
                rows.extend(seen.hits.iter().map(|hit| {
                    json!({
                        "scenario": entry.id,
                        "manoeuvre": tried.manoeuvre,
                        "world": name.world,
                        "decoding": name.decoding,
                        "future": hit.future,
                        "agent": hit.agent,
                        "at_s": hit.at_s,
                        "near": hit.near,
                    })
                }));
            }
        }
    }
    rows
}

/// Names scenarios that say nothing.
fn exclusions(run: &mut Run, entries: &[Entry<ScenarioReactions>]) -> anyhow::Result<()> {
    let why = |entry: &Entry<ScenarioReactions>| {
        let why = entry.scores.unfit.as_ref()?;
        Some(format!("scenario {}: {why}", entry.id))
    };
    let whys: Vec<String> = entries.iter().filter_map(why).collect();
    if let Some(first) = whys.first() {
        run.result("left_out", &whys)?;
        run.print(&format!("{} scenarios are left out: {first}", whys.len()));
    }
    Ok(())
}

fn chart(settings: &ReactionSettings, names: &[&str], lines: &[Line<'_>]) -> Bars {
    let legend = settings.worlds.iter().map(label).collect();
    let rows = names.iter().map(|name| (*name).to_owned()).collect();
    let label = "share of agents near that run into the ego, with 95 % intervals over scenarios";
    charts::bars(label, rows, legend, |row, column| {
        let mut found = lines
            .iter()
            .filter(|line| line.manoeuvre == names[row] && *line.name == settings.worlds[column]);
        let line = found.next()?;
        let span = line.span(0).map(|span| (span.low, span.high));
        let value = line.sum.rates()[0]?;
        Some(gump_viz::Bar { value, span })
    })
}
