//! The archive of a sim agents submission: shards in a gzipped tar.
//!
//! Start with [`ArchiveWriter`]; [`check_archive`] checks one against the rules. Scenarios are
//! processed one at a time.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

use flate2::Compression;
use flate2::write::GzEncoder;
use gump_scene::{AgentId, Scenario};
use prost::Message;

use super::rollouts_problems;
use super::shard::{ShardReader, write_scenario};
use crate::io::stream::{self, io_error};
use crate::{DataError, write_atomically};
use gump_proto::{ScenarioRollouts, SimAgentsChallengeSubmission, SubmissionType};

/// A shard is closed at this size; protobuf has a limit of 2 GB.
const SHARD_BYTES: u64 = 1 << 30;
/// Maximum number of problems kept as sentences; further ones are only counted. Chosen by hand.
const MAX_SENTENCES: usize = 1000;
/// Prefix of the names of shards.
const SHARD_STEM: &str = "submission.binproto";

/// Writes an archive with the futures of many scenarios.
///
/// Shards are kept in unnamed files beside the archive, which appears under its name only when it
/// is complete; dropping the writer leaves nothing behind.
pub struct ArchiveWriter {
    path: PathBuf,
    metadata: SimAgentsChallengeSubmission,
    shard_bytes: u64,
    shards: Vec<File>,
    current: Option<(BufWriter<File>, u64)>,
}

impl ArchiveWriter {
    /// Begins an archive; `metadata` states the authors and contains no futures.
    pub fn create(path: &Path, metadata: SimAgentsChallengeSubmission) -> Self {
        Self {
            path: path.into(),
            metadata,
            shard_bytes: SHARD_BYTES,
            shards: Vec::new(),
            current: None,
        }
    }

    /// Closes a shard once it holds this many bytes, instead of 1 GB.
    pub fn with_shard_bytes(self, shard_bytes: u64) -> Self {
        Self {
            shard_bytes,
            ..self
        }
    }

    /// Adds the futures of one scenario.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn add(&mut self, rollouts: &ScenarioRollouts) -> Result<(), DataError> {
        let failed = |e| io_error("write a shard of", e, &self.path);
        let (mut shard, mut n_bytes) = match self.current.take() {
            Some(current) => current,
            None => (BufWriter::new(self.unnamed_file()?), 0),
        };
        n_bytes += write_scenario(&mut shard, rollouts).map_err(failed)?;
        self.current = Some((shard, n_bytes));
        if n_bytes >= self.shard_bytes {
            self.close_shard()?;
        }
        Ok(())
    }

    /// Writes the archive and returns the names of its shards.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn finish(mut self) -> Result<Vec<String>, DataError> {
        self.close_shard()?;
        let n_shards = self.shards.len();
        let names = (0..n_shards).map(|k| format!("{SHARD_STEM}-{k:05}-of-{n_shards:05}"));
        let names: Vec<String> = names.collect();
        let path = self.path.clone();
        write_atomically(&path, |file| {
            self.pack(&names, file)
                .map_err(|e| io_error("write", e, &path))
        })?;
        Ok(names)
    }

    fn pack(&mut self, names: &[String], out: &mut BufWriter<File>) -> std::io::Result<()> {
        let mut tar = tar::Builder::new(GzEncoder::new(out, Compression::default()));
        for (shard, name) in self.shards.iter_mut().zip(names) {
            let mut header = tar::Header::new_gnu();
            header.set_size(shard.stream_position()?);
            header.set_mode(0o644);
            shard.rewind()?;
            tar.append_data(&mut header, name, shard)?;
        }
        tar.into_inner()?.finish()?.flush()
    }

    fn close_shard(&mut self) -> Result<(), DataError> {
        let Some((mut shard, _)) = self.current.take() else {
            return Ok(());
        };
        let failed = |e| io_error("write a shard of", e, &self.path);
        let metadata = self.metadata.encode_to_vec();
        shard.write_all(&metadata).map_err(failed)?;
        let file = shard.into_inner().map_err(|e| failed(e.into_error()))?;
        self.shards.push(file);
        Ok(())
    }

    fn unnamed_file(&self) -> Result<File, DataError> {
        let folder = match self.path.parent() {
            Some(folder) if folder != Path::new("") => folder,
            _ => Path::new("."),
        };
        std::fs::create_dir_all(folder)
            .and_then(|()| tempfile::tempfile_in(folder))
            .map_err(|e| io_error("create a shard of", e, &self.path))
    }
}

/// The scenarios that a submission must contain, and the agents of each; a few bytes per agent.
#[derive(Clone, Debug, Default)]
pub struct ExpectedScenarios(BTreeMap<String, BTreeSet<AgentId>>);

impl ExpectedScenarios {
    /// Adds a scenario; all its agents in the present must be simulated.
    pub fn add(&mut self, scenario: &Scenario) {
        let agents = super::present_agents(scenario);
        self.0.insert(scenario.id.clone(), agents);
    }

    /// Number of scenarios.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

/// Problems of a submission, as sentences.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SubmissionCheck {
    /// Number of scenarios checked.
    pub scenarios: usize,
    /// Number of problems.
    pub n_problems: usize,
    /// The first of them, at most a thousand.
    pub problems: Vec<String>,
    seen: BTreeSet<String>,
}

impl SubmissionCheck {
    /// Checks the futures of one scenario; true if there is no problem.
    pub fn add(&mut self, rollouts: &ScenarioRollouts, expected: &ExpectedScenarios) -> bool {
        let before = self.n_problems;
        self.scenarios += 1;
        let id = rollouts.scenario_id();
        if !self.seen.insert(id.into()) {
            self.add_problem(format!("scenario {id} occurs twice"));
        }
        match expected.0.get(id) {
            Some(agents) => {
                for problem in rollouts_problems(rollouts, agents) {
                    self.add_problem(format!("scenario {id}: {problem}"));
                }
            }
            None => self.add_problem(format!("scenario \"{id}\" is not one of those expected")),
        }
        self.n_problems == before
    }

    /// Adds missing scenarios, once all others have been checked.
    pub fn finish(&mut self, expected: &ExpectedScenarios) {
        let missing = expected.0.keys().filter(|id| !self.seen.contains(*id));
        for id in missing.cloned().collect::<Vec<_>>() {
            self.add_problem(format!("scenario {id} is missing"));
        }
    }

    fn add_problem(&mut self, problem: String) {
        self.n_problems += 1;
        if self.problems.len() < MAX_SENTENCES {
            self.problems.push(problem);
        }
    }
}

/// All violations of the rules in the metadata of a submission.
///
/// Source: the comments of the published message, which state the server's requirements since 2024.
pub fn metadata_problems(metadata: &SimAgentsChallengeSubmission) -> Vec<String> {
    let mut problems = Vec::new();
    let mut require = |holds: bool, problem: &str| {
        if !holds {
            problems.push(problem.to_string());
        }
    };
    require(
        metadata.submission_type() == SubmissionType::SimAgentsSubmission,
        "submission_type is not SIM_AGENTS_SUBMISSION",
    );
    require(
        metadata.account_name().contains('@'),
        "account_name is not the e-mail address of an account",
    );
    require(
        !metadata.unique_method_name().is_empty(),
        "unique_method_name is missing",
    );
    require(
        metadata.uses_lidar_data.is_some(),
        "uses_lidar_data is missing",
    );
    require(
        metadata.uses_camera_data.is_some(),
        "uses_camera_data is missing",
    );
    require(
        metadata.uses_public_model_pretraining.is_some(),
        "uses_public_model_pretraining is missing",
    );
    require(
        !metadata.uses_public_model_pretraining() || !metadata.public_model_names.is_empty(),
        "public_model_names is missing although public models were used",
    );
    require(
        is_parameter_count(metadata.num_model_parameters()),
        "num_model_parameters is not a whole number with a suffix like \"200K\"",
    );
    require(
        metadata.acknowledge_complies_with_closed_loop_requirement(),
        "acknowledge_complies_with_closed_loop_requirement is not true",
    );
    problems
}

/// A whole number and one capital letter.
fn is_parameter_count(text: &str) -> bool {
    let mut chars = text.chars();
    let suffix = chars.next_back();
    let digits = chars.as_str();
    let is_number = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
    is_number && suffix.is_some_and(|letter| letter.is_ascii_uppercase())
}

/// Reads an archive and lists all violations of the challenge's rules: names of shards, metadata,
/// scenarios and agents that are missing, unknown or duplicated, wrong counts, numbers that are not
/// finite.
///
/// # Errors
/// [`DataError`] if it cannot be read as an archive of shards.
pub fn check_archive(
    path: &Path,
    expected: &ExpectedScenarios,
) -> Result<SubmissionCheck, DataError> {
    let failed = |e| io_error("read the archive", e, path);
    let mut archive = tar::Archive::new(stream::open(path)?);
    let mut check = SubmissionCheck::default();
    let (mut names, mut first) = (Vec::new(), None);
    for entry in archive.entries().map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let name = entry.path().map_err(failed)?.display().to_string();
        let mut shard = ShardReader::new(BufReader::new(entry), path.join(&name));
        for rollouts in shard.by_ref() {
            check.add(&rollouts?, expected);
        }
        let metadata = shard.metadata()?;
        match &first {
            None => {
                let problems = metadata_problems(&metadata);
                problems
                    .into_iter()
                    .for_each(|problem| check.add_problem(problem));
                first = Some(metadata);
            }
            Some(first) if *first != metadata => {
                check.add_problem(format!(
                    "{name} says other things of its makers than the first shard"
                ));
            }
            Some(_) => {}
        }
        names.push(name);
    }
    for problem in name_problems(&names) {
        check.add_problem(problem);
    }
    check.finish(expected);
    Ok(check)
}

/// Returns the problems with the names of the shards.
///
/// Source: the challenge's rule `.*\.binproto(-\d{5}-of-\d{5})?`.
fn name_problems(names: &[String]) -> Vec<String> {
    let mut problems = Vec::new();
    if names.is_empty() {
        problems.push("expected at least one shard, found none".into());
    }
    let mut seen = BTreeSet::new();
    for name in names {
        match shard_number(name) {
            None => problems.push(format!(
                "expected a shard named like x.binproto-00000-of-00001, found {name}"
            )),
            Some(Some((k, n))) if k >= n || n != names.len() => {
                let found = names.len();
                problems.push(format!("{name} does not fit an archive of {found} shards"));
            }
            Some(_) => {}
        }
        if !seen.insert(name) {
            problems.push(format!("{name} occurs twice"));
        }
    }
    problems
}

/// The numbers in a shard's name, if it has any; `None` if it is no name of a shard.
fn shard_number(name: &str) -> Option<Option<(usize, usize)>> {
    let (_, suffix) = name.rsplit_once(".binproto")?;
    if suffix.is_empty() {
        return Some(None);
    }
    let (k, n) = suffix.strip_prefix('-')?.split_once("-of-")?;
    let number = |text: &str| {
        let five_digits = text.len() == 5 && text.bytes().all(|byte| byte.is_ascii_digit());
        five_digits.then(|| text.parse().ok()).flatten()
    };
    Some(Some((number(k)?, number(n)?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_are_named_as_the_rule_says() {
        let check = |names: &[&str], expected: &[&str]| {
            let names: Vec<String> = names.iter().map(ToString::to_string).collect();
            assert_eq!(name_problems(&names), expected);
        };
        check(&["x.binproto"], &[]);
        check(
            &["a.binproto-00000-of-00002", "a.binproto-00001-of-00002"],
            &[],
        );
        check(&[], &["expected at least one shard, found none"]);
        for name in [
            "x.pb",
            "x.binproto-0-of-1",
            "x.binproto-00000-of-0000a",
            "x.binproto2",
        ] {
            let sentence =
                format!("expected a shard named like x.binproto-00000-of-00001, found {name}");
            check(&[name], &[&sentence]);
        }
        check(
            &["a.binproto-00001-of-00001"],
            &["a.binproto-00001-of-00001 does not fit an archive of 1 shards"],
        );
        check(&["a.binproto", "a.binproto"], &["a.binproto occurs twice"]);
    }

    #[test]
    fn parameters_are_counted_with_a_suffix() {
        for good in ["200K", "7M", "1B"] {
            assert!(is_parameter_count(good), "{good}");
        }
        for bad in ["", "K", "200", "2.5M", "200k", "many"] {
            assert!(!is_parameter_count(bad), "{bad}");
        }
    }
}
