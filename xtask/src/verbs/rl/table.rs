//! `rl table`: the paper's table in one go, policies first, then their drives.

use std::path::PathBuf;

use gump_eval::datasets::Split;
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_rl::sac::Algorithm;
use gump_scene::Seed;
use serde::Serialize;

use super::evaluate::{Candidate, Test, load};
use super::train::Job;
use super::{RlWorld, Settings, prepared};
use crate::cli::WrongArguments;
use crate::run::{Common, Run};
use crate::sampling::Sampling;

/// Arguments of `rl table`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// World to train in besides the log: model:WEIGHTS, or any other world
    #[arg(long, value_name = "W")]
    world: WorldName,
    /// Worlds to test in besides the log and --world, such as a model not used in training
    #[arg(long, value_name = "W", value_delimiter = ',')]
    test_world: Vec<WorldName>,
    /// Scenarios to train on: a folder with a manifest.toml, or any file or folder
    #[arg(long, value_name = "PATH")]
    scenarios: PathBuf,
    /// Scenarios to test on [default: the test scenarios of --scenarios]
    #[arg(long, value_name = "PATH")]
    test_scenarios: Option<PathBuf>,
    /// Gradient steps of each policy [default: the configuration's]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Policies of each kind, which differ in their seeds
    #[arg(long, value_name = "N", default_value_t = 3)]
    policies: u64,
    /// Drives per scenario, each in other traffic of the same world
    #[arg(long, value_name = "N", default_value_t = 1)]
    repeats: usize,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        if self.policies == 0 || self.repeats == 0 {
            let wrong = "--policies and --repeats: expected at least 1, found 0";
            return Err(WrongArguments(wrong.into()).into());
        }
        if self.world == WorldName::Log {
            let wrong = "--world: the log is trained in anyway, expected another world";
            return Err(WrongArguments(wrong.into()).into());
        }
        let mut settings = Settings::read(self.common.config.as_deref())?;
        settings.sac.steps = self.steps.unwrap_or(settings.sac.steps);
        run.setting("env", settings.env)?;
        run.setting("sac", &settings.sac)?;
        let files = self.train(run, &settings)?;
        self.test(run, &settings, &files)
    }

    /// Trains whatever is not there yet; the files of the policies, kind by kind.
    fn train(&self, run: &mut Run, settings: &Settings) -> anyhow::Result<Vec<PathBuf>> {
        let prepared = run.phase("read", |run| {
            prepared(run, &self.scenarios, Split::Train, None)
        })?;
        let sampling = self.sampling.resolve()?;
        let device = run.device().clone();
        let world = run.phase("load", |_| RlWorld::load(&device, &self.world, &sampling))?;
        let (log_name, log) = (WorldName::Log, RlWorld::Log);
        let mut files = Vec::new();
        let mut trained = Vec::new();
        for (algorithm, world_name, world, name) in [
            (Algorithm::Imitation, &log_name, &log, "imitation"),
            (Algorithm::Sac, &log_name, &log, "sac-log"),
            (Algorithm::Sac, &self.world, &world, "sac-world"),
        ] {
            for k in 0..self.policies {
                let folder = run.path(&format!("{name}-{k}"));
                std::fs::create_dir_all(&folder)?;
                let job = Job {
                    algorithm,
                    world_name,
                    world,
                    prepared: &prepared,
                    settings,
                    seed: Seed(run.seed().0 + k),
                    resume: folder.join("checkpoint.safetensors").exists(),
                    folder,
                    stop_at: usize::MAX,
                };
                trained.push(run.phase(name, |run| job.execute(run))?);
                files.push(job.policy());
            }
        }
        run.result("trained", trained)?;
        Ok(files)
    }

    /// Lets all policies, and rules to compare them with, drive everywhere.
    fn test(&self, run: &mut Run, settings: &Settings, files: &[PathBuf]) -> anyhow::Result<()> {
        let path = self.test_scenarios.as_ref().unwrap_or(&self.scenarios);
        let prepared = run.phase("read", |run| prepared(run, path, Split::Test, None))?;
        let rules = ["random", "brake", "constant-speed"].map(PathBuf::from);
        let all = rules.iter().chain(files);
        let candidates: Vec<Candidate> = all
            .map(|file| Ok(Candidate::read(file)?.0))
            .collect::<anyhow::Result<_>>()?;
        let trained_in = [&WorldName::Log, &self.world].into_iter();
        let worlds = load(run, trained_in.chain(&self.test_world), &self.sampling)?;
        let test = Test {
            candidates: &candidates,
            worlds,
            env: &settings.env,
            repeats: self.repeats,
            sampling: &self.sampling,
            shard: Shard::WHOLE,
        };
        test.execute(run, &prepared)
    }
}
