//! `data stats`: what scenes consist of, counted over files and directories, and how far their
//! distributions are from those of other scenes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use gump_data::{ReadOptions, groups, list_files, open_files};
use gump_metrics::statistics::{Comparison, Statistics, class_name};
use gump_scene::{AgentId, AgentKind, Scenario};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Value, json};

use crate::progress::Progress;
use crate::run::{self, Common, Run};
use crate::targets;

/// Distributions with fewer observations on either side do not count in the mean distance: their
/// distances are mostly chance. Chosen by hand; published distances use it.
const ENOUGH: u64 = 30;
/// Slower agents stand, metres per second: the bound of the table of speeds, not of the measures,
/// which have 0.3. Chosen by hand.
const STANDING: f64 = 0.5;

/// Arguments of `data stats`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Files or directories
    #[arg(value_name = "PATH", required = true)]
    paths: Vec<PathBuf>,
    /// Scenes, or a table of targets (.toml), to measure the distance of every distribution from
    #[arg(long, value_name = "PATH")]
    against: Option<PathBuf>,
    /// Write the distributions as a table of targets
    #[arg(long, value_name = "FILE.toml")]
    save_targets: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    /// Source of a table of targets: names of files and folders only.
    fn provenance(&self) -> String {
        let name = |path: &PathBuf| {
            let parts = path.components().rev().take(2).collect::<Vec<_>>();
            let parts = parts
                .iter()
                .rev()
                .map(|part| part.as_os_str().to_string_lossy());
            parts.collect::<Vec<_>>().join("/")
        };
        let names: Vec<String> = self.paths.iter().map(name).collect();
        format!("cargo xtask data stats of {}", names.join(", "))
    }

    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let distributions = self.against.is_some() || self.save_targets.is_some();
        let reference = match &self.against {
            Some(path) => Some(run.phase("reference", |run| reference(run, path))?),
            None => None,
        };
        let counted = run.phase("count", |run| {
            let progress = run.progress("counting", 0, "scenes");
            let of = |path: &PathBuf| Stats::of(path, distributions, &progress);
            let all = self.paths.iter().map(of);
            all.collect::<anyhow::Result<Vec<_>>>()
        })?;
        let mut sources = Vec::new();
        let mut all = Stats::default();
        for (path, stats) in self.paths.iter().zip(counted) {
            sources.push(stats.row(path));
            all.merge(stats);
        }
        all.durations_s.sort_by(f64::total_cmp);
        let durations = &all.durations_s;
        run.result("scenes", all.scenes())?;
        run.result("refused", all.refused.len())?;
        run.result("skipped", &all.skipped)?;
        run.result("hours", all.hours())?;
        run.result(
            "duration_s",
            json!({
                "shortest": durations.first(),
                "median": durations.get(durations.len() / 2),
                "longest": durations.last(),
            }),
        )?;
        run.result("lane_km", all.lane_m / 1000.0)?;
        run.result("sources", sources)?;
        run.result("classes", all.class_rows())?;
        run.result("tags", all.tag_rows())?;
        run.result("problems", &all.refused)?;
        if let Some(path) = &self.save_targets {
            targets::write(path, &self.provenance(), &all.statistics)?;
        }
        if let Some(reference) = &reference {
            tell_distance(run, &all.statistics.compare(reference))?;
        }
        anyhow::ensure!(
            all.scenes() > 0,
            "expected scenarios, found none; {} could not be read{}",
            all.refused.len(),
            all.refused
                .first()
                .map_or(String::new(), |why| format!(", the first because: {why}"))
        );
        Ok(())
    }
}

/// The distributions of a table of targets, or of scenes.
///
/// Error: nothing there that can be read, or Ctrl-C.
fn reference(run: &Run, path: &Path) -> anyhow::Result<Statistics> {
    if targets::is_table(path) {
        return targets::read(path);
    }
    let progress = run.progress("counting the reference", 0, "scenes");
    let stats = Stats::of(path, true, &progress)?;
    let why = stats.refused.first();
    anyhow::ensure!(
        stats.scenes() > 0,
        "{}: expected scenarios to compare with, found none{}",
        path.display(),
        why.map_or(String::new(), |why| format!("; {why}"))
    );
    Ok(stats.statistics)
}

/// One row per distribution, and the means of the distances.
fn tell_distance(run: &mut Run, compared: &[Comparison]) -> anyhow::Result<()> {
    let row = |row: &Comparison| {
        json!({
            "measure": row.measure.name(),
            "class": class_name(row.class),
            "mean": row.mean,
            "reference": row.reference_mean,
            "distance": row.wasserstein,
            "jensen_shannon": row.jensen_shannon,
            "n": row.n,
            "reference_n": row.reference_n,
        })
    };
    let mean = |of: fn(&Comparison) -> Option<f64>| {
        let enough = compared
            .iter()
            .filter(|row| row.n.min(row.reference_n) >= ENOUGH);
        let known: Vec<f64> = enough.filter_map(of).collect();
        known.iter().sum::<f64>() / (known.len() as f64).max(1.0)
    };
    run.result("distance_mean", mean(|row| row.wasserstein))?;
    run.result("jensen_shannon_mean", mean(|row| row.jensen_shannon))?;
    run.result("distances", compared.iter().map(row).collect::<Vec<_>>())
}

/// Statistics of some scenes.
#[derive(Default)]
struct Stats {
    /// Duration of each scene, seconds.
    durations_s: Vec<f64>,
    classes: BTreeMap<AgentKind, Class>,
    lanes: usize,
    lane_m: f64,
    with_lights: usize,
    with_route: usize,
    tags: BTreeMap<&'static str, usize>,
    refused: Vec<String>,
    skipped: BTreeMap<&'static str, usize>,
    /// Distributions, where they are requested.
    statistics: Statistics,
}

/// The agents of one class.
#[derive(Default)]
struct Class {
    tracks: usize,
    /// Number of agents in the present frame.
    now: usize,
    /// Number of states at standstill.
    standing: u64,
    /// Speeds of the moving states.
    speeds: Histogram,
}

impl Stats {
    /// Counts the scenes of a path.
    ///
    /// Error: nothing there, or Ctrl-C; what cannot be read is counted.
    fn of(path: &Path, distributions: bool, progress: &Progress) -> anyhow::Result<Self> {
        let files = list_files(path)?;
        let parts = groups(&files);
        let parts = parts.into_par_iter().map(|range| {
            let mut stats = Self::default();
            let mut reader = open_files(files[range].to_vec(), ReadOptions::ALL);
            for record in &mut reader {
                run::stop_if_interrupted()?;
                match record {
                    Ok(record) => {
                        stats.add(&record.scenario);
                        if distributions {
                            stats.statistics.add(&record.scenario);
                        }
                    }
                    Err(error) => stats.refused.push(error.to_string()),
                }
                progress.advance(1);
            }
            stats.skipped = reader.skipped().clone();
            Ok(stats)
        });
        let parts = parts.collect::<anyhow::Result<Vec<_>>>()?;
        let mut all = Self::default();
        parts.into_iter().for_each(|part| all.merge(part));
        Ok(all)
    }

    fn add(&mut self, scenario: &Scenario) {
        let steps = scenario.log.len().saturating_sub(1);
        self.durations_s.push(steps as f64 * scenario.dt);
        let mut tracks: BTreeMap<AgentId, AgentKind> = BTreeMap::new();
        for agent in scenario.log.iter().flat_map(|frame| frame.agents()) {
            tracks.insert(agent.id, agent.kind);
            let (class, speed) = (
                self.classes.entry(agent.kind).or_default(),
                agent.state.speed(),
            );
            if speed < STANDING {
                class.standing += 1;
            } else {
                class.speeds.add(speed);
            }
        }
        for kind in tracks.into_values() {
            self.classes.entry(kind).or_default().tracks += 1;
        }
        for agent in scenario.present().now().agents() {
            self.classes.entry(agent.kind).or_default().now += 1;
        }
        let lanes = scenario.map.lanes();
        self.lanes += lanes.len();
        self.lane_m += lanes
            .iter()
            .map(|lane| lane.centerline.length())
            .sum::<f64>();
        let lit = scenario.log.iter().any(|frame| !frame.lights().is_empty());
        self.with_lights += usize::from(lit);
        self.with_route += usize::from(scenario.route.is_some());
        let mined;
        let tags = if scenario.tags.is_empty() {
            mined = gump_metrics::tags::extract_tags(scenario);
            &mined
        } else {
            &scenario.tags
        };
        for tag in tags {
            *self.tags.entry(tag.name()).or_default() += 1;
        }
    }

    fn merge(&mut self, other: Self) {
        self.durations_s.extend(other.durations_s);
        for (kind, class) in other.classes {
            self.classes.entry(kind).or_default().merge(&class);
        }
        self.lanes += other.lanes;
        self.lane_m += other.lane_m;
        self.with_lights += other.with_lights;
        self.with_route += other.with_route;
        for (tag, n) in other.tags {
            *self.tags.entry(tag).or_default() += n;
        }
        self.refused.extend(other.refused);
        for (what, n) in other.skipped {
            *self.skipped.entry(what).or_default() += n;
        }
        self.statistics.merge(&other.statistics);
    }

    fn scenes(&self) -> usize {
        self.durations_s.len()
    }

    fn hours(&self) -> f64 {
        self.durations_s.iter().sum::<f64>() / 3600.0
    }

    /// One source as a line of the table: tracks by class, then roads.
    fn row(&self, path: &Path) -> Value {
        let mut row = serde_json::Map::new();
        let mut put = |key: &str, value: Value| drop(row.insert(key.into(), value));
        put("source", json!(path));
        put("scenes", json!(self.scenes()));
        put("hours", json!(self.hours()));
        let tracks = |kind| self.classes.get(&kind).map_or(0, |class| class.tracks);
        for kind in AgentKind::MOVING {
            put(kind.name(), json!(tracks(kind)));
        }
        let fixed: usize = AgentKind::STATIC.into_iter().map(tracks).sum();
        put("others", json!(fixed));
        put("lanes", json!(self.lanes));
        put("lane_km", json!(self.lane_m / 1000.0));
        put("with_lights", json!(self.with_lights));
        put("with_route", json!(self.with_route));
        put("refused", json!(self.refused.len()));
        Value::Object(row)
    }

    /// One line per class; speeds are of agents that move, metres per second.
    fn class_rows(&self) -> Vec<Value> {
        let scenes = self.scenes().max(1) as f64;
        let row = |(kind, class): (&AgentKind, &Class)| {
            let states = class.standing + class.speeds.n;
            json!({
                "class": kind.name(),
                "tracks": class.tracks,
                "present_per_scene": class.now as f64 / scenes,
                "standing": class.standing as f64 / states.max(1) as f64,
                "speed_median": class.speeds.quantile(0.5),
                "speed_p90": class.speeds.quantile(0.9),
                "speed_p99": class.speeds.quantile(0.99),
            })
        };
        self.classes.iter().map(row).collect()
    }

    /// One line per tag that occurs, the most frequent first.
    fn tag_rows(&self) -> Vec<Value> {
        let scenes = self.scenes().max(1) as f64;
        let mut tags: Vec<_> = self.tags.iter().collect();
        tags.sort_by(|a, b| b.1.cmp(a.1).then(a.0.cmp(b.0)));
        let row = |(tag, n): (&&str, &usize)| json!({"tag": tag, "scenes": n, "share": *n as f64 / scenes});
        tags.into_iter().map(row).collect()
    }
}

impl Class {
    fn merge(&mut self, other: &Self) {
        self.tracks += other.tracks;
        self.now += other.now;
        self.standing += other.standing;
        self.speeds.merge(&other.speeds);
    }
}

/// Speeds in steps of 0.1 m/s: quantiles of any number of states in little memory.
#[derive(Default)]
struct Histogram {
    n: u64,
    bins: BTreeMap<u32, u64>,
}

/// Bins per metre per second: quantiles are printed to a tenth.
const PER_METRE: f64 = 10.0;

impl Histogram {
    fn add(&mut self, speed: f64) {
        let bin = (speed * PER_METRE).round() as u32;
        *self.bins.entry(bin).or_default() += 1;
        self.n += 1;
    }

    fn merge(&mut self, other: &Self) {
        self.n += other.n;
        for (bin, n) in &other.bins {
            *self.bins.entry(*bin).or_default() += n;
        }
    }

    /// The speed that a share `q` of states does not exceed; `None` of none.
    fn quantile(&self, q: f64) -> Option<f64> {
        let wanted = ((self.n as f64 * q).ceil() as u64).max(1);
        let mut below = 0;
        let bin = self.bins.iter().find(|(_, n)| {
            below += **n;
            below >= wanted
        });
        bin.map(|(bin, _)| f64::from(*bin) / PER_METRE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_merged_histograms_are_those_of_all() {
        let [mut even, mut odd] = [Histogram::default(), Histogram::default()];
        for speed in 1..=100 {
            if speed % 2 == 0 { &mut even } else { &mut odd }.add(f64::from(speed));
        }
        even.merge(&odd);
        let found = [0.0, 0.5, 0.9, 0.99, 1.0].map(|q| even.quantile(q));
        assert_eq!(found, [1.0, 50.0, 90.0, 99.0, 100.0].map(Some));
        assert_eq!(Histogram::default().quantile(0.5), None);
    }
}
