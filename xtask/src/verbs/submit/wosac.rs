//! `submit wosac`: the archive for the Waymo Sim Agents Challenge, packed and checked.

use std::path::{Path, PathBuf};

use gump_data::submission::{
    ArchiveWriter, ExpectedScenarios, N_FUTURES, N_STEPS, SubmissionCheck, check_archive,
    metadata_problems, read_rollouts, rollouts_to_proto,
};
use gump_data::{ReadOptions, open_with};
use gump_eval::digest;
use gump_eval::rollout_files;
use gump_eval::worlds::{WorldName, Worlds};
use gump_proto::{ScenarioRollouts, SimAgentsChallengeSubmission, SubmissionType};
use serde::Serialize;

use crate::cli::WrongArguments;
use crate::imagine::imagine;
use crate::run::{self, Common, Run};
use crate::sampling::Sampling;

/// Name of the archive in the output folder.
const ARCHIVE: &str = "submission.tar.gz";

/// Arguments of `submit wosac`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Every scenario of the split that is submitted to: a file or a folder
    #[arg(long, value_name = "PATH")]
    scenarios: PathBuf,
    #[command(flatten)]
    #[serde(flatten)]
    source: RolloutArgs,
    #[command(flatten)]
    #[serde(flatten)]
    maker: Maker,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Source of the rollouts.
#[derive(Debug, Serialize, clap::Args)]
#[group(required = true, multiple = false)]
struct RolloutArgs {
    /// A file of `ScenarioRollouts`, or a folder of such files
    #[arg(long, value_name = "PATH")]
    rollouts: Option<PathBuf>,
    /// Simulate them: idm, constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W")]
    world: Option<WorldName>,
    /// Only check this archive
    #[arg(long, value_name = "FILE")]
    archive: Option<PathBuf>,
}

/// Authors and method, which the server requires.
#[derive(Debug, Serialize, clap::Args)]
struct Maker {
    /// E-mail address of the account at waymo.com/open
    #[arg(long, value_name = "EMAIL", default_value = "")]
    account: String,
    /// Name of the method, short and unique
    #[arg(long, value_name = "NAME", default_value = "")]
    method: String,
    /// Authors, comma-separated
    #[arg(long, value_name = "NAMES", default_value = "")]
    authors: String,
    /// Their affiliation
    #[arg(long, value_name = "TEXT")]
    affiliation: Option<String>,
    /// Short description of the method
    #[arg(long, value_name = "TEXT")]
    description: Option<String>,
    /// URL of the method's description
    #[arg(long, value_name = "URL")]
    method_link: Option<String>,
    /// The number of parameters of the model with a suffix, like 200K
    #[arg(long, value_name = "N", default_value = "")]
    parameters: String,
    /// The method uses lidar data
    #[arg(long)]
    uses_lidar_data: bool,
    /// The method uses camera data
    #[arg(long)]
    uses_camera_data: bool,
    /// Public models it was pretrained with, comma-separated
    #[arg(long, value_name = "NAMES", default_value = "")]
    public_models: String,
    /// The futures were simulated in closed loop at 10 Hz, as the rules demand
    #[arg(long)]
    complies_with_closed_loop: bool,
}

impl Maker {
    fn metadata(&self) -> SimAgentsChallengeSubmission {
        let public_model_names = names(&self.public_models);
        SimAgentsChallengeSubmission {
            scenario_rollouts: Vec::new(),
            submission_type: Some(SubmissionType::SimAgentsSubmission.into()),
            account_name: Some(self.account.clone()),
            unique_method_name: Some(self.method.clone()),
            authors: names(&self.authors),
            affiliation: self.affiliation.clone(),
            description: self.description.clone(),
            method_link: self.method_link.clone(),
            uses_lidar_data: Some(self.uses_lidar_data),
            uses_camera_data: Some(self.uses_camera_data),
            uses_public_model_pretraining: Some(!public_model_names.is_empty()),
            num_model_parameters: Some(self.parameters.clone()),
            public_model_names,
            acknowledge_complies_with_closed_loop_requirement: Some(self.complies_with_closed_loop),
        }
    }
}

/// Fields of the submission by the flags that state them.
fn as_flags(problems: &str) -> String {
    [
        ("account_name", "--account"),
        ("unique_method_name", "--method"),
        ("authors", "--authors"),
        ("num_model_parameters", "--parameters"),
        (
            "acknowledge_complies_with_closed_loop_requirement",
            "--complies-with-closed-loop",
        ),
    ]
    .iter()
    .fold(problems.to_owned(), |text, (field, flag)| {
        text.replace(field, flag)
    })
}

fn names(text: &str) -> Vec<String> {
    let names = text.split(',').map(str::trim);
    names
        .filter(|name| !name.is_empty())
        .map(Into::into)
        .collect()
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let metadata = self.maker.metadata();
        if self.source.archive.is_none() {
            let problems = metadata_problems(&metadata);
            if !problems.is_empty() {
                return Err(WrongArguments(as_flags(&problems.join("; "))).into());
            }
        }
        let expected = run.phase("index", |run| self.expected(run))?;
        run.result("expected_scenarios", expected.len())?;
        if let Some(archive) = &self.source.archive {
            return run.phase("check", |run| check(run, archive, &expected));
        }
        let path = run.path(ARCHIVE);
        let mut packer = Packer {
            archive: ArchiveWriter::create(&path, metadata),
            check: SubmissionCheck::default(),
            expected: &expected,
            digests: Vec::new(),
        };
        run.phase("pack", |run| self.pack(run, &mut packer))?;
        if let Some(world) = &self.source.world {
            run.result("decoding", self.sampling.decoding(world)?.name)?;
            let digests = packer.digests.iter().map(String::as_str);
            run.result("digest", digest::of_digests(digests))?;
        }
        packer.check.finish(&expected);
        if packer.check.n_problems > 0 {
            return report(run, &packer.check);
        }
        let shards = run.phase("write", |_| Ok(packer.archive.finish()?))?;
        run.result("files", [ARCHIVE])?;
        run.result("shards", shards)?;
        run.phase("check", |run| check(run, &path, &expected))
    }

    /// Reads which agents must be simulated in which scenario.
    fn expected(&self, run: &Run) -> anyhow::Result<ExpectedScenarios> {
        let progress = run.progress("reading", 0, "scenarios");
        let mut expected = ExpectedScenarios::default();
        for record in open_with(&self.scenarios, ReadOptions::STATED)? {
            run::stop_if_interrupted()?;
            expected.add(&record?.scenario);
            progress.advance(1);
        }
        Ok(expected)
    }

    fn pack(&self, run: &Run, packer: &mut Packer<'_>) -> anyhow::Result<()> {
        if let Some(path) = &self.source.rollouts {
            for file in rollout_files::files(path)? {
                for rollouts in read_rollouts(&file)? {
                    run::stop_if_interrupted()?;
                    packer.add(&rollouts)?;
                }
            }
        }
        if let Some(world) = &self.source.world {
            let decoding = self.sampling.decoding(world)?;
            let mut worlds = Worlds::new(run.device(), world, decoding.sampling.clone());
            let scenarios = open_with(&self.scenarios, ReadOptions::ALL)?;
            for (index, record) in scenarios.enumerate() {
                let scenario = record?.scenario;
                let seed = run.seed().fork(index as u64);
                let config = decoding.frames(N_STEPS as f64 * scenario.dt);
                let world = worlds.of(&scenario)?;
                let imagined = imagine(run, world, &scenario, N_FUTURES, &config, seed)?;
                packer.digests.push(digest::of_rollouts(&imagined.rollouts));
                let (rollouts, _) = rollouts_to_proto(&scenario.id, &imagined.rollouts)?;
                packer.add(&rollouts)?;
            }
        }
        Ok(())
    }
}

/// An archive being written; invalid futures are reported, not packed.
struct Packer<'a> {
    archive: ArchiveWriter,
    check: SubmissionCheck,
    expected: &'a ExpectedScenarios,
    /// Digests of the simulated futures.
    digests: Vec<String>,
}

impl Packer<'_> {
    fn add(&mut self, rollouts: &ScenarioRollouts) -> anyhow::Result<()> {
        if self.check.add(rollouts, self.expected) {
            self.archive.add(rollouts)?;
        }
        Ok(())
    }
}

fn check(run: &mut Run, archive: &Path, expected: &ExpectedScenarios) -> anyhow::Result<()> {
    let found = check_archive(archive, expected)?;
    report(run, &found)
}

/// Reports what was found.
///
/// Error: if anything was.
fn report(run: &mut Run, found: &SubmissionCheck) -> anyhow::Result<()> {
    run.result("scenarios", found.scenarios)?;
    run.result("n_problems", found.n_problems)?;
    run.result("problems", &found.problems)?;
    match found.problems.first() {
        Some(first) => anyhow::bail!(
            "the submission breaks the challenge's rules in {} ways, the first: {first}",
            found.n_problems
        ),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_told_apart_by_commas() {
        assert_eq!(names(" A. B, C ,,"), ["A. B", "C"]);
        assert!(names("").is_empty());
    }
}
