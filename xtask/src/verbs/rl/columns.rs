//! The report of an evaluation of policies, from the entries of its store alone.

use std::fmt::Write as _;
use std::path::PathBuf;

use gump_eval::results::{self, Entry, MissingShards};
use gump_rl::{Columns, EpisodeResult, estimate, estimate_difference, score_by_scenario};
use gump_scene::Seed;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::write;
use crate::run::Run;

/// Everything that the drives depend on.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Tested {
    pub(super) scenarios: usize,
    /// Of their ids, one per line.
    pub(super) sha256_of_ids: String,
    pub(super) repeats: usize,
    /// As text, because TOML has no unsigned numbers of 64 bits.
    pub(super) seed: String,
    pub(super) env: String,
    pub(super) sampling: String,
    pub(super) worlds: Vec<String>,
    pub(super) policies: Vec<Policy>,
}

/// A policy that drives.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Policy {
    /// The algorithm, or the name of a fixed rule.
    pub(super) policy: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) train_world: Option<String>,
    pub(super) file: PathBuf,
    /// Of the file; none of a fixed rule.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) sha256: Option<String>,
}

/// All drives of one scenario.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Driven {
    pub(super) drives: Vec<DriveRecord>,
}

/// One drive.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct DriveRecord {
    /// Index in [`Tested::worlds`].
    pub(super) world: usize,
    /// Index in [`Tested::policies`].
    pub(super) policy: usize,
    repeat: usize,
    collided: bool,
    off_road: bool,
    progress: f64,
    comfortable: bool,
    steps: usize,
}

/// Policies that differ in their seeds only, in one world: a row of the table.
struct Group<'a> {
    policy: &'a str,
    train_world: Option<&'a str>,
    test_world: &'a str,
    /// Drives of each policy of the group, by scenario.
    drives: Vec<Vec<EpisodeResult>>,
}

impl DriveRecord {
    pub(super) fn new(world: usize, policy: usize, drive: &EpisodeResult) -> Self {
        Self {
            world,
            policy,
            repeat: drive.repeat,
            collided: drive.collided,
            off_road: drive.off_road,
            progress: drive.progress,
            comfortable: drive.comfortable,
            steps: drive.steps,
        }
    }

    /// The drive in the scenario at this place of the report.
    fn drive(&self, scenario: usize) -> EpisodeResult {
        EpisodeResult {
            scenario,
            repeat: self.repeat,
            collided: self.collided,
            off_road: self.off_road,
            progress: self.progress,
            comfortable: self.comfortable,
            steps: self.steps,
        }
    }
}

/// Merges shards and reports on all of them.
pub(crate) fn report_merged(
    run: &mut Run,
    folders: &[PathBuf],
    missing: MissingShards,
) -> anyhow::Result<()> {
    let (header, entries) = results::merge::<Driven>(folders, missing)?;
    report(run, &header.settings.try_into()?, &entries)
}

/// Writes every drive to a file, rows and paired differences to the report.
pub(super) fn report(
    run: &mut Run,
    tested: &Tested,
    entries: &[Entry<Driven>],
) -> anyhow::Result<()> {
    write(&run.path("drives.csv"), csv(tested, entries)?.as_bytes())?;
    let groups = groups(tested, entries);
    let seed = Seed(tested.seed.parse()?);
    let rows: Vec<Value> = groups.iter().map(|group| group.row(seed)).collect();
    run.result("rows", rows)?;
    run.result("differences", differences(&groups, seed))?;
    run.result("scenarios", entries.len())
}

fn groups<'a>(tested: &'a Tested, entries: &[Entry<Driven>]) -> Vec<Group<'a>> {
    let mut groups: Vec<Group<'_>> = Vec::new();
    for (w, test_world) in tested.worlds.iter().enumerate() {
        let first = groups.len();
        for (p, policy) in tested.policies.iter().enumerate() {
            let train_world = policy.train_world.as_deref();
            let is_it = |g: &Group<'_>| (g.policy, g.train_world) == (&policy.policy, train_world);
            let known = groups[first..].iter().position(is_it);
            let i = first + known.unwrap_or(groups.len() - first);
            if known.is_none() {
                groups.push(Group {
                    policy: &policy.policy,
                    train_world,
                    test_world,
                    drives: Vec::new(),
                });
            }
            let of_entry = |(scenario, entry): (usize, &Entry<Driven>)| {
                let drives = entry.scores.drives.iter();
                let own = drives.filter(|one| (one.world, one.policy) == (w, p));
                own.map(|one| one.drive(scenario)).collect::<Vec<_>>()
            };
            let drives = entries.iter().enumerate().flat_map(of_entry).collect();
            groups[i].drives.push(drives);
        }
    }
    groups
}

/// Every row against every earlier row of the same test world, on the same scenarios.
fn differences(groups: &[Group<'_>], seed: Seed) -> Vec<Value> {
    let mut differences = Vec::new();
    for (i, than) in groups.iter().enumerate() {
        for group in &groups[i + 1..] {
            if group.test_world != than.test_world {
                continue;
            }
            let [scores, others] = [group, than].map(Group::scores);
            let Some(found) = estimate_difference(&scores, &others, seed) else {
                continue;
            };
            differences.push(json!({
                "test_world": group.test_world,
                "policy": group.label(),
                "than": than.label(),
                "difference": found.mean,
                "low": found.interval.map(|span| span.low),
                "high": found.interval.map(|span| span.high),
                "interval_over": over(found.over_policies),
            }));
        }
    }
    differences
}

impl Group<'_> {
    fn label(&self) -> String {
        match self.train_world {
            Some(world) => format!("{} in {world}", self.policy),
            None => self.policy.to_owned(),
        }
    }

    /// Scores by policy and scenario.
    fn scores(&self) -> Vec<Vec<f64>> {
        let of_policy = |drives: &Vec<EpisodeResult>| score_by_scenario(drives);
        self.drives.iter().map(of_policy).collect()
    }

    fn row(&self, seed: Seed) -> Value {
        let all = self.drives.concat();
        let columns = Columns::of(&all);
        let found = estimate(&self.scores(), seed);
        let span = found.and_then(|found| found.interval);
        json!({
            "policy": self.policy,
            "train_world": self.train_world,
            "test_world": self.test_world,
            "policies": self.drives.len(),
            "episodes": all.len(),
            "score": columns.map(|c| c.score),
            "low": span.map(|span| span.low),
            "high": span.map(|span| span.high),
            "interval_over": found.map(|found| over(found.over_policies)),
            "collision_rate": columns.map(|c| c.collision_rate),
            "offroad_rate": columns.map(|c| c.offroad_rate),
            "progress_m": columns.and_then(|c| c.progress),
            "comfort": columns.and_then(|c| c.comfort),
        })
    }
}

/// Units that an interval resamples.
fn over(policies: bool) -> &'static str {
    match policies {
        true => "scenarios and policies",
        false => "scenarios",
    }
}

fn csv(tested: &Tested, entries: &[Entry<Driven>]) -> anyhow::Result<String> {
    let mut csv = String::from(
        "policy,train_world,test_world,file,scenario,repeat,collided,offroad,progress_m,\
         comfortable,score\n",
    );
    for entry in entries {
        for one in &entry.scores.drives {
            let policy = &tested.policies[one.policy];
            writeln!(
                csv,
                "{},{},{},{},{},{},{},{},{},{},{}",
                policy.policy,
                policy.train_world.as_deref().unwrap_or(""),
                tested.worlds[one.world],
                policy.file.display(),
                entry.id,
                one.repeat,
                u8::from(one.collided),
                u8::from(one.off_road),
                one.progress,
                u8::from(one.comfortable),
                one.drive(0).score(),
            )?;
        }
    }
    Ok(csv)
}
