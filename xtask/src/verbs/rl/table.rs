//! `rl table`: the paper's table in one go, policies first, then their drives.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::Context as _;
use gump_eval::benchmarks::ScenarioSetName;
use gump_eval::datasets::Split;
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_rl::Algorithm;
use gump_scene::Seed;
use serde::{Deserialize, Serialize};

use super::columns::DivergedPolicy;
use super::evaluate::{Candidate, Test, load};
use super::train::{Diverged, Job, Place};
use super::{PreparedSet, Settings, read, write};
use crate::choices::{ALGORITHMS, one_of};
use crate::cli::WrongArguments;
use crate::run::{Common, Run};
use crate::sampling::Sampling;
use crate::sharding::shard;

/// Arguments of `rl table`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Worlds to train in besides the log: model:WEIGHTS, or any others
    #[arg(long, value_name = "W", required = true, num_args = 1.., value_delimiter = ',')]
    world: Vec<WorldName>,
    /// Worlds to test in besides the log and --world, such as a model not used in training
    #[arg(long, value_name = "W", num_args = 1.., value_delimiter = ',')]
    test_world: Vec<WorldName>,
    /// Scenarios to train on: a file, a folder, or LIST.toml#SPLIT; of a list or a folder with a
    /// manifest.toml the train split
    #[arg(long, value_name = "SCENARIOS")]
    scenarios: ScenarioSetName,
    /// Scenarios to test on, likewise [default: the test split of --scenarios]
    #[arg(long, value_name = "SCENARIOS")]
    test_scenarios: Option<ScenarioSetName>,
    /// Maximum number of test scenarios in learned worlds, which are slow [default: all]
    #[arg(long, value_name = "N")]
    model_limit: Option<NonZeroUsize>,
    /// Learning algorithm of the policies that learn from rewards: sac or ppo
    #[arg(long, value_parser = one_of(ALGORITHMS), default_value_t = Algorithm::Sac)]
    algorithm: Algorithm,
    /// Gradient steps of each policy, of PPO rounds [default: the configuration's]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Policies of each kind, which differ in their seeds
    #[arg(long, value_name = "N", default_value_t = 3)]
    policies: u64,
    /// Policies that learn by imitation [default: as --policies]
    #[arg(long, value_name = "N")]
    imitation_policies: Option<u64>,
    /// Drives per scenario, each in other traffic of the same world
    #[arg(long, value_name = "N", default_value_t = 1)]
    repeats: usize,
    /// Only train: with --shard, every N-th policy from the K-th on
    #[arg(long)]
    train_only: bool,
    /// Folder of the policies, which all shards share [default: --out]
    #[arg(long, value_name = "DIR")]
    policy_folder: Option<PathBuf>,
    /// Train or test shard K of N; auto: the shard that a cluster's variables name. First with
    /// --train-only, then without, which needs all policies; merge the latter with `evaluate merge`
    #[arg(long, value_name = "K/N|auto", default_value = "1/1", value_parser = shard)]
    shard: Shard,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Policies that differ in their seeds only.
struct Kind<'a> {
    algorithm: Algorithm,
    world: &'a WorldName,
    /// Beginning of the names of their folders.
    name: String,
    policies: u64,
}

/// What a policy that diverged leaves in its folder, so that the run goes on without it: the same
/// settings would diverge again.
#[derive(Debug, Serialize, Deserialize)]
struct DivergenceRecord {
    why: String,
    /// Everything that its training depended on, as TOML.
    settings: String,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        self.check()?;
        let mut settings = Settings::read(self.common.config.as_deref())?;
        settings.set_steps(self.algorithm, self.steps);
        run.setting("env", settings.env)?;
        run.setting("sac", &settings.sac)?;
        if self.algorithm == Algorithm::Ppo {
            run.setting("ppo", &settings.ppo)?;
        }
        let kinds = self.kinds();
        let jobs = self.jobs(run, &kinds, &settings);
        if self.train_only || self.shard == Shard::WHOLE {
            self.train(run, &jobs, settings.env.live_lights)?;
        }
        let mut files = Vec::new();
        let mut diverged = Vec::new();
        let mut unfinished = Vec::new();
        for (_, job) in &jobs {
            match DivergenceRecord::of(job)? {
                Some(record) => diverged.push(DivergedPolicy {
                    policy: job.algorithm.to_string(),
                    train_world: job.world_name.clone(),
                    seed: job.seed.0.to_string(),
                    why: record.why,
                }),
                None if self.train_only => {}
                None if job.is_done()? => files.push(job.policy()),
                None => unfinished.push(&job.folder),
            }
        }
        if self.train_only {
            return run.result("diverged", diverged);
        }
        if let Some(first) = unfinished.first() {
            anyhow::bail!(
                "expected {} trained policies before a shard is tested, found {} unfinished, {} for \
                 one: `rl table --train-only` with the same --policy-folder trains them",
                jobs.len(),
                unfinished.len(),
                first.display()
            );
        }
        self.test(run, &settings, &files, diverged)
    }

    /// Error: [`WrongArguments`].
    fn check(&self) -> anyhow::Result<()> {
        let wrong = |what: String| Err(WrongArguments(what).into());
        if self.policies == 0 || self.repeats == 0 || self.imitation_policies == Some(0) {
            return wrong(
                "--policies, --imitation-policies and --repeats: expected at least 1, found 0"
                    .into(),
            );
        }
        if self.algorithm == Algorithm::Imitation {
            return wrong(
                "--algorithm: imitation is in the table anyway, expected sac or ppo".into(),
            );
        }
        if self.world.contains(&WorldName::Log) {
            return wrong("--world: the log is trained in anyway, expected another world".into());
        }
        let again = (1..self.world.len()).find(|&i| self.world[..i].contains(&self.world[i]));
        if let Some(i) = again {
            return wrong(format!(
                "--world: expected every world once, found {} twice",
                self.world[i]
            ));
        }
        if self.train_only && self.shard != Shard::WHOLE && self.policy_folder.is_none() {
            return wrong("--train-only with --shard needs --policy-folder".into());
        }
        Ok(())
    }

    fn kinds(&self) -> Vec<Kind<'_>> {
        let kind = |algorithm, world, name: &str, policies| Kind {
            algorithm,
            world,
            name: name.to_owned(),
            policies,
        };
        let imitating = self.imitation_policies.unwrap_or(self.policies);
        let mut kinds = vec![
            kind(
                Algorithm::Imitation,
                &WorldName::Log,
                "imitation",
                imitating,
            ),
            kind(
                self.algorithm,
                &WorldName::Log,
                &format!("{}-log", self.algorithm),
                self.policies,
            ),
        ];
        for (i, world) in self.world.iter().enumerate() {
            let name = match i {
                0 => format!("{}-world", self.algorithm),
                _ => format!("{}-world{}", self.algorithm, i + 1),
            };
            kinds.push(kind(self.algorithm, world, &name, self.policies));
        }
        kinds
    }

    /// One job per policy with the name of its kind, kind by kind.
    fn jobs<'a>(
        &self,
        run: &Run,
        kinds: &'a [Kind<'_>],
        settings: &'a Settings,
    ) -> Vec<(&'a str, Job<'a>)> {
        let all = self.policy_folder.as_deref().unwrap_or(run.out());
        let mut jobs = Vec::new();
        for kind in kinds {
            for k in 0..kind.policies {
                let folder = all.join(format!("{}-{k}", kind.name));
                let job = Job {
                    algorithm: kind.algorithm,
                    world_name: kind.world.to_string(),
                    scenes: self.scenarios.to_string(),
                    settings,
                    seed: Seed(run.seed().0 + k),
                    resume: folder.join("checkpoint.safetensors").exists(),
                    folder,
                    stop_at: usize::MAX,
                    from: None,
                };
                jobs.push((kind.name.as_str(), job));
            }
        }
        jobs
    }

    /// Trains whatever of the shard is not there yet. A policy that diverges leaves a [`DivergenceRecord`], and
    /// the others go on.
    fn train(
        &self,
        run: &mut Run,
        jobs: &[(&str, Job<'_>)],
        live_lights: bool,
    ) -> anyhow::Result<()> {
        let set = PreparedSet::read(run, &self.scenarios, Split::Train, None)?;
        run.result("train_set", &set.name)?;
        let trained_in = [&WorldName::Log].into_iter().chain(&self.world);
        let worlds = load(run, trained_in, &self.sampling, live_lights)?;
        let mut trained = Vec::new();
        for (index, (kind, job)) in jobs.iter().enumerate() {
            if !self.shard.holds(index) {
                continue;
            }
            job.is_done()?;
            let record = DivergenceRecord::path(job);
            if DivergenceRecord::of(job)?.is_some() {
                run.print(&format!(
                    "note: {} diverged before, so it is left out; without {} it is trained again",
                    job.folder.display(),
                    record.display()
                ));
                continue;
            }
            std::fs::create_dir_all(&job.folder)
                .with_context(|| format!("cannot create the folder {}", job.folder.display()))?;
            let (_, world) = worlds
                .iter()
                .find(|(name, _)| name.to_string() == job.world_name)
                .with_context(|| format!("the world {} is not loaded", job.world_name))?;
            let place = Place {
                world,
                prepared: &set.scenarios,
            };
            match run.phase(kind, |run| job.execute(run, place)) {
                Ok(done) => trained.push(done),
                Err(error) => {
                    let diverged = error.downcast::<Diverged>()?;
                    run.print(&format!("warning: {}: {diverged}", job.folder.display()));
                    DivergenceRecord::write(job, &diverged)?;
                }
            }
        }
        run.result("trained", trained)
    }

    /// Lets all policies, and rules to compare them with, drive everywhere.
    fn test(
        &self,
        run: &mut Run,
        settings: &Settings,
        files: &[PathBuf],
        diverged: Vec<DivergedPolicy>,
    ) -> anyhow::Result<()> {
        let name = self.test_scenarios.as_ref().unwrap_or(&self.scenarios);
        let set = PreparedSet::read(run, name, Split::Test, None)?;
        let rules = ["random", "brake", "constant-speed"].map(PathBuf::from);
        let all = rules.iter().chain(files);
        let candidates: Vec<Candidate> = all
            .map(|file| Ok(Candidate::read(file)?.0))
            .collect::<anyhow::Result<_>>()?;
        let mut names = vec![&WorldName::Log];
        for name in self.world.iter().chain(&self.test_world) {
            if !names.contains(&name) {
                names.push(name);
            }
        }
        let worlds = load(run, names, &self.sampling, settings.env.live_lights)?;
        let test = Test {
            candidates: &candidates,
            worlds,
            env: &settings.env,
            model_limit: self.model_limit,
            repeats: self.repeats,
            sampling: &self.sampling,
            shard: self.shard,
            diverged,
        };
        test.execute(run, &set)
    }
}

impl DivergenceRecord {
    fn path(job: &Job<'_>) -> PathBuf {
        job.folder.join("diverged.toml")
    }

    fn settings(job: &Job<'_>) -> anyhow::Result<String> {
        let (algorithm, world, seed) = (job.algorithm, &job.world_name, job.seed.0);
        let settings = toml::to_string(job.settings)?;
        Ok(format!("# {algorithm} in {world}, seed {seed}\n{settings}"))
    }

    /// The record in the folder of a job, if it is of the same settings.
    ///
    /// Error: a record that cannot be read.
    fn of(job: &Job<'_>) -> anyhow::Result<Option<Self>> {
        let path = Self::path(job);
        if !path.exists() {
            return Ok(None);
        }
        let text = String::from_utf8_lossy(&read(&path)?).into_owned();
        let record: Self = toml::from_str(&text).with_context(|| path.display().to_string())?;
        Ok(Some(record).filter(|record| Self::settings(job).is_ok_and(|s| s == record.settings)))
    }

    fn write(job: &Job<'_>, diverged: &Diverged) -> anyhow::Result<()> {
        let record = Self {
            why: diverged.to_string(),
            settings: Self::settings(job)?,
        };
        write(&Self::path(job), toml::to_string(&record)?.as_bytes())
    }
}
