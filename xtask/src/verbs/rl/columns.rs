//! The report of an evaluation of policies, from the entries of its store alone.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::PathBuf;

use gump_eval::results::{self, Entry, MissingShards};
use gump_rl::{Columns, EpisodeResult, Estimate, estimate, estimate_difference, score_by_scenario};
use gump_scene::Seed;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::write;
use crate::run::Run;

/// Policies from which on an interval over them is not said to be over few: of fewer their variance
/// is hardly known. Chosen by hand.
const MANY: usize = 5;

/// Everything that the drives depend on.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Tested {
    /// Name of the set of scenarios; none as of version 0.1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) set: Option<String>,
    pub(super) scenarios: usize,
    /// Of the scenarios, in worlds that are models; all if none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) model_limit: Option<usize>,
    /// Of their ids, one per line.
    pub(super) sha256_of_ids: String,
    pub(super) repeats: usize,
    /// As text, because TOML has no unsigned numbers of 64 bits.
    pub(super) seed: String,
    pub(super) env: String,
    pub(super) sampling: String,
    pub(super) worlds: Vec<String>,
    pub(super) policies: Vec<Policy>,
    /// Policies that were to be tested as well.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) diverged: Vec<DivergedPolicy>,
    /// Of the ids and of the worlds' weights; none as of version 0.1.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub(super) checksums: BTreeMap<String, String>,
}

/// A policy that diverged while it learned, and therefore does not drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct DivergedPolicy {
    pub(super) policy: String,
    pub(super) train_world: String,
    /// As text, because TOML has no unsigned numbers of 64 bits.
    pub(super) seed: String,
    /// The sentence that its run ended with.
    pub(super) why: String,
}

/// A policy that drives.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Policy {
    /// The algorithm, or the name of a fixed rule.
    pub(super) policy: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) train_world: Option<String>,
    /// The kind of the policy it began with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) from: Option<String>,
    /// Digest of the settings it learned with; none as of version 0.1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) settings: Option<String>,
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
    /// None as of version 0.1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    at_fault: Option<bool>,
    off_road: bool,
    progress: f64,
    comfortable: bool,
    steps: usize,
}

/// Policies that differ in their seeds only, in one world: a row of the table.
struct Group<'a> {
    policy: &'a str,
    train_world: Option<&'a str>,
    from: Option<&'a str>,
    settings: Option<&'a str>,
    test_world: &'a str,
    /// Its name, which no other row of the same test world has.
    label: String,
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
            at_fault: Some(drive.at_fault),
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
            at_fault: self.at_fault.unwrap_or(self.collided),
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
    if let Some(set) = &tested.set {
        run.result("set", set)?;
    }
    let mut rows: Vec<Value> = groups.iter().map(|group| group.row(seed)).collect();
    if !tested.diverged.is_empty() {
        for row in &mut rows {
            let diverged = tested.diverged.iter();
            let of_row = diverged.filter(|one| {
                row["policy"] == one.policy.as_str()
                    && row["train_world"] == one.train_world.as_str()
            });
            row["diverged"] = json!(of_row.count());
        }
    }
    let mut warnings = missing_intervals(&groups, &rows);
    warnings.extend(left_out(tested));
    run.result("rows", rows)?;
    run.result("differences", differences(&groups, seed))?;
    if !tested.diverged.is_empty() {
        run.result("diverged", &tested.diverged)?;
    }
    for warning in &warnings {
        run.print(&format!("warning: {warning}"));
    }
    run.result_hidden("warnings", warnings)?;
    run.result("scenarios", entries.len())
}

/// Sentences about rows without an interval, about those whose interval is over few policies, and
/// about those whose interval is over scenarios alone although they are of policies that learned.
fn missing_intervals(groups: &[Group<'_>], rows: &[Value]) -> Vec<String> {
    let names = |is: &dyn Fn(&Value) -> bool| -> String {
        let found = groups.iter().zip(rows).filter(|(_, row)| is(row));
        let names = found.map(|(group, _)| format!("{} among {}", group.label, group.test_world));
        names.collect::<Vec<_>>().join(", ")
    };
    let has_score = |row: &Value| row["score"].is_number();
    let single = names(&|row| has_score(row) && row["low"].is_null());
    let alone = names(&|row| {
        row["low"].is_number() && row["policies"] == 1 && row["train_world"].is_string()
    });
    let few = names(&|row| row["interval_over"] == "scenarios and few policies");
    let mut sentences = Vec::new();
    if !few.is_empty() {
        sentences.push(format!(
            "an interval is over fewer than {MANY} policies, whose variance is hardly known, for {few}"
        ));
    }
    if !single.is_empty() {
        sentences.push(format!(
            "an interval takes at least 2 scenarios, found 1, so there is none for {single}"
        ));
    }
    if !alone.is_empty() {
        sentences.push(format!(
            "an interval over policies takes at least 2 of a kind, found 1, so the interval is over \
             scenarios alone, as if other seeds learned the same, for {alone}"
        ));
    }
    sentences
}

/// A sentence for every kind of policies of which some diverged.
fn left_out(tested: &Tested) -> Vec<String> {
    let mut sentences = Vec::new();
    for (i, one) in tested.diverged.iter().enumerate() {
        let is_same = |other: &DivergedPolicy| {
            (&other.policy, &other.train_world) == (&one.policy, &one.train_world)
        };
        if tested.diverged[..i].iter().any(is_same) {
            continue;
        }
        let n = tested
            .diverged
            .iter()
            .filter(|other| is_same(other))
            .count();
        let is_tested = |policy: &&Policy| {
            policy.policy == one.policy && policy.train_world.as_ref() == Some(&one.train_world)
        };
        let of = n + tested.policies.iter().filter(is_tested).count();
        let consequence = match of == n {
            true => "so it has no row",
            false => "and its rows are of the others, which favours a kind that diverges often",
        };
        sentences.push(format!(
            "{n} of {of} policies of {} in {} diverged, {consequence}",
            one.policy, one.train_world
        ));
    }
    sentences
}

fn groups<'a>(tested: &'a Tested, entries: &[Entry<Driven>]) -> Vec<Group<'a>> {
    let mut groups: Vec<Group<'_>> = Vec::new();
    for (w, test_world) in tested.worlds.iter().enumerate() {
        let first = groups.len();
        for (p, policy) in tested.policies.iter().enumerate() {
            let train_world = policy.train_world.as_deref();
            let (from, settings) = (policy.from.as_deref(), policy.settings.as_deref());
            let is_it = |g: &Group<'_>| {
                let found = (g.policy, g.train_world, g.from, g.settings);
                found == (policy.policy.as_str(), train_world, from, settings)
            };
            let known = groups[first..].iter().position(is_it);
            let i = first + known.unwrap_or(groups.len() - first);
            if known.is_none() {
                groups.push(Group {
                    policy: &policy.policy,
                    train_world,
                    from,
                    settings,
                    test_world,
                    label: String::new(),
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
    let labels: Vec<String> = groups
        .iter()
        .map(|group| group.label_among(&groups))
        .collect();
    for (group, label) in groups.iter_mut().zip(labels) {
        group.label = label;
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
                "policy": group.label,
                "than": than.label,
                "difference": found.mean,
                "low": found.interval.map(|span| span.low),
                "high": found.interval.map(|span| span.high),
                "interval_over": found.interval.map(|_| over(&found)),
            }));
        }
    }
    differences
}

impl Group<'_> {
    /// What its policies have in common, with their settings if `with_settings`.
    fn name(&self, with_settings: bool) -> String {
        let mut name = self.policy.to_owned();
        for (word, part) in [
            (" in ", self.train_world),
            (", settings ", self.settings.filter(|_| with_settings)),
            (", from ", self.from),
        ] {
            if let Some(part) = part {
                name.push_str(word);
                name.push_str(part);
            }
        }
        name
    }

    /// Its name, with its settings if others of the same test world have the same name without.
    fn label_among(&self, groups: &[Self]) -> String {
        let name = self.name(false);
        let same = groups
            .iter()
            .filter(|other| other.test_world == self.test_world && other.name(false) == name);
        match same.count() {
            0 | 1 => name,
            _ => self.name(true),
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
        let over = span.and(found).map(|found| over(&found));
        json!({
            "policy": self.policy,
            "train_world": self.train_world,
            "from": self.from,
            "settings": self.settings,
            "test_world": self.test_world,
            "policies": self.drives.len(),
            "episodes": all.len(),
            "score": columns.map(|c| c.score),
            "low": span.map(|span| span.low),
            "high": span.map(|span| span.high),
            "interval_over": over,
            "collision_rate": columns.map(|c| c.collision_rate),
            "at_fault_rate": columns.map(|c| c.at_fault_rate),
            "offroad_rate": columns.map(|c| c.offroad_rate),
            "progress_m": columns.and_then(|c| c.progress),
            "comfort": columns.and_then(|c| c.comfort),
        })
    }
}

/// Units that an interval resamples.
fn over(found: &Estimate) -> &'static str {
    match (found.over_policies, found.n_policies < MANY) {
        (true, true) => "scenarios and few policies",
        (true, false) => "scenarios and policies",
        (false, _) => "scenarios",
    }
}

fn csv(tested: &Tested, entries: &[Entry<Driven>]) -> anyhow::Result<String> {
    let mut csv = String::from(
        "policy,train_world,test_world,file,scenario,repeat,collided,at_fault,offroad,\
         progress_m,comfortable,score\n",
    );
    for entry in entries {
        for one in &entry.scores.drives {
            let policy = &tested.policies[one.policy];
            writeln!(
                csv,
                "{},{},{},{},{},{},{},{},{},{},{},{}",
                cell(&policy.policy),
                cell(policy.train_world.as_deref().unwrap_or("")),
                cell(&tested.worlds[one.world]),
                cell(&policy.file.display().to_string()),
                cell(&entry.id),
                one.repeat,
                u8::from(one.collided),
                u8::from(one.drive(0).at_fault),
                u8::from(one.off_road),
                one.progress,
                u8::from(one.comfortable),
                one.drive(0).score(),
            )?;
        }
    }
    Ok(csv)
}

/// A text as a cell, in quotation marks where RFC 4180 asks for them.
fn cell(text: &str) -> Cow<'_, str> {
    match text.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")).into(),
        false => text.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_with_commas_stay_in_their_column() {
        let trained = policy("sac", Some("model:w, yielding learned"));
        let text = csv(&tested(vec![trained], &[]), &entries(1, 3)).unwrap();
        let row = text.lines().nth(1).unwrap();
        assert_eq!(
            row,
            "sac,\"model:w, yielding learned\",idm,sac,0,0,0,0,0,31,1,0.75"
        );
        assert_eq!(cell("a \"b\""), "\"a \"\"b\"\"\"");
    }

    fn policy(policy: &str, train_world: Option<&str>) -> Policy {
        Policy {
            policy: policy.into(),
            train_world: train_world.map(str::to_owned),
            from: None,
            settings: None,
            file: policy.into(),
            sha256: None,
        }
    }

    fn tested(policies: Vec<Policy>, diverged: &[(&str, &str)]) -> Tested {
        let diverged = diverged.iter().map(|(policy, train_world)| DivergedPolicy {
            policy: (*policy).into(),
            train_world: (*train_world).into(),
            seed: "0".into(),
            why: "a loss is not finite".into(),
        });
        Tested {
            set: None,
            scenarios: 3,
            model_limit: None,
            sha256_of_ids: String::new(),
            repeats: 1,
            seed: "0".into(),
            env: String::new(),
            sampling: String::new(),
            worlds: vec!["idm".into(), "model:a".into()],
            policies,
            diverged: diverged.collect(),
            checksums: BTreeMap::new(),
        }
    }

    /// Three scenarios, of which the first `n` are driven in the second world as well.
    fn entries(n_policies: usize, n: usize) -> Vec<Entry<Driven>> {
        let drive = |world, policy, index: usize| DriveRecord {
            world,
            policy,
            repeat: 0,
            collided: false,
            at_fault: None,
            off_road: false,
            progress: 31.0 * (1 + index + policy) as f64,
            comfortable: true,
            steps: 16,
        };
        let entry = |index| {
            let in_world = |world| (0..n_policies).map(move |policy| drive(world, policy, index));
            let second = in_world(1).filter(|_| index < n);
            Entry {
                index,
                id: index.to_string(),
                scores: Driven {
                    drives: in_world(0).chain(second).collect(),
                },
            }
        };
        (0..3).map(entry).collect()
    }

    #[test]
    fn worlds_with_fewer_scenarios_are_compared_on_those() {
        let policies = vec![policy("sac", Some("log")), policy("brake", None)];
        let (tested, entries) = (tested(policies, &[]), entries(2, 2));
        let groups = groups(&tested, &entries);
        let rows: Vec<Value> = groups.iter().map(|group| group.row(Seed(0))).collect();
        let episodes: Vec<&Value> = rows.iter().map(|row| &row["episodes"]).collect();
        assert_eq!(episodes, [3, 3, 2, 2]);
        // Progress of 31, 62 and 93 m, and of the first two alone.
        assert_eq!(
            (&rows[0]["score"], &rows[2]["score"]),
            (&json!(1.0), &json!(0.875))
        );
        let differences = differences(&groups, Seed(0));
        let of = |i: usize| (&differences[i]["test_world"], &differences[i]["difference"]);
        assert_eq!(of(0), (&json!("idm"), &json!(0.25)));
        assert_eq!(of(1), (&json!("model:a"), &json!(0.25)));
    }

    #[test]
    fn policies_of_other_settings_make_rows_of_their_own() {
        let learned = |settings: &str, from: Option<&str>| Policy {
            settings: Some(settings.into()),
            from: from.map(str::to_owned),
            ..policy("ppo", Some("idm"))
        };
        let policies = vec![
            learned("a", None),
            learned("b", None),
            learned("a", None),
            learned("a", Some("ppo in log")),
            policy("ppo", Some("idm")),
        ];
        let (tested, entries) = (tested(policies, &[]), entries(5, 3));
        let groups = groups(&tested, &entries);
        let in_idm = groups.iter().filter(|group| group.test_world == "idm");
        let sizes: Vec<usize> = in_idm.clone().map(|group| group.drives.len()).collect();
        assert_eq!(sizes, [2, 1, 1, 1]);
        let labels: Vec<&str> = in_idm.map(|group| group.label.as_str()).collect();
        let expected = ["ppo in idm, settings a", "ppo in idm, settings b"];
        assert_eq!(labels[..2], expected);
        assert_eq!(labels[2..], ["ppo in idm, from ppo in log", "ppo in idm"]);
    }

    #[test]
    fn intervals_that_are_not_there_are_said() {
        let policies = |n| vec![policy("sac", Some("log")); n];
        let sentences = |n_policies: usize, n: usize| {
            let mut tested = tested(policies(n_policies), &[]);
            tested.policies.push(policy("brake", None));
            let entries = entries(n_policies + 1, n);
            let groups = groups(&tested, &entries);
            let rows: Vec<Value> = groups.iter().map(|group| group.row(Seed(0))).collect();
            for row in &rows {
                assert_eq!(
                    row["low"].is_null(),
                    row["interval_over"].is_null(),
                    "{row}"
                );
            }
            missing_intervals(&groups, &rows)
        };
        assert!(sentences(5, 3).is_empty());
        let few = sentences(4, 3);
        let names = "for sac in log among idm, sac in log among model:a";
        assert!(few.len() == 1 && few[0].ends_with(names), "{few:?}");
        let single = sentences(5, 1);
        let names = "none for sac in log among model:a, brake among model:a";
        assert!(
            single.len() == 1 && single[0].ends_with(names),
            "{single:?}"
        );
        // The interval of a fixed rule lacks nothing.
        let alone = sentences(1, 3);
        let names = "for sac in log among idm, sac in log among model:a";
        assert!(alone.len() == 1 && alone[0].ends_with(names), "{alone:?}");
        assert!(
            alone[0].starts_with("an interval over policies"),
            "{alone:?}"
        );
        // No drive, no interval to miss.
        assert!(sentences(5, 0).is_empty());
    }

    #[test]
    fn policies_that_diverged_are_counted() {
        let policies = vec![policy("sac", Some("log")); 3];
        let diverged = [("sac", "log"), ("sac", "idm"), ("sac", "log")];
        let sentences = left_out(&tested(policies, &diverged));
        assert_eq!(sentences.len(), 2);
        let [of_log, of_idm] = [&sentences[0], &sentences[1]];
        assert!(of_log.starts_with("2 of 5 policies of sac in log diverged, and its rows are"));
        assert_eq!(
            of_idm,
            "1 of 1 policies of sac in idm diverged, so it has no row"
        );
    }
}
