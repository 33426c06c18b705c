//! `rl train`: a policy, from rewards in a world or from the log alone.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use gump_eval::benchmarks::ScenarioSetName;
use gump_eval::datasets::Split;
use gump_eval::worlds::WorldName;
use gump_rl::{Actor, Algorithm, DrivingEnv, PreparedScenario, RlError, demonstrations};
use gump_scene::Seed;
use serde::Serialize;

use super::curves::Curves;
use super::learner::Learner;
use super::{Notes, PreparedSet, RlWorld, Settings, read, write};
use crate::choices::{ALGORITHMS, one_of};
use crate::cli::WrongArguments;
use crate::planners::YieldingName;
use crate::run::{self, Common, Run};
use crate::sampling::Sampling;

/// Time between checkpoints: what a crash may cost.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(60);
/// Files of a run: what it is resumed from, and what it learned.
const CHECKPOINT: &str = "checkpoint.safetensors";
const POLICY: &str = "policy.safetensors";
/// Points of the curves per segment. Chosen by eye.
const POINTS_PER_SEGMENT: usize = 10;

/// Arguments of `rl train`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Learning algorithm
    #[arg(long, value_parser = one_of(ALGORITHMS), default_value_t = Algorithm::Sac)]
    algorithm: Algorithm,
    /// log, idm, constant-velocity or model:WEIGHTS; imitation only with log
    #[arg(long, value_name = "W", default_value = "log")]
    train_world: WorldName,
    /// Reaction to the ego of the agents of a learned world
    #[arg(long, value_enum, default_value_t = YieldingName::Ruled)]
    yielding: YieldingName,
    /// A file, a folder, or LIST.toml#SPLIT; of a list or a folder with a manifest.toml the train
    /// split
    #[arg(long, value_name = "SCENARIOS")]
    scenarios: ScenarioSetName,
    /// Gradient steps, of PPO rounds [default: the configuration's]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Stop at the first checkpoint from this step on; continue with --resume
    #[arg(long, value_name = "N")]
    stop_at: Option<usize>,
    /// Begin with the policy and the critic of this run of PPO, its checkpoint.safetensors
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Continue the run in --out with its original configuration; without it a folder with a run is
    /// refused
    #[arg(long)]
    resume: bool,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// One policy to be trained.
pub(super) struct Job<'a> {
    pub(super) algorithm: Algorithm,
    /// Name of the world, with the choice of `--yielding` where it is not the default.
    pub(super) world_name: String,
    /// Name of the scenarios.
    pub(super) scenes: String,
    pub(super) settings: &'a Settings,
    pub(super) seed: Seed,
    pub(super) folder: PathBuf,
    /// Whether to resume the run in the folder.
    pub(super) resume: bool,
    /// Steps after which to stop early.
    pub(super) stop_at: usize,
    /// The checkpoint of a run of PPO to begin with.
    pub(super) from: Option<PathBuf>,
}

/// Where a policy learns.
#[derive(Clone, Copy)]
pub(super) struct Place<'a> {
    pub(super) world: &'a RlWorld,
    pub(super) prepared: &'a Arc<[PreparedScenario]>,
}

/// The kind of a stored run.
///
/// Error: a file that holds none.
fn kind_of(path: &Path) -> anyhow::Result<String> {
    let in_file = || path.display().to_string();
    let (_, notes) = Actor::from_bytes(&read(path)?).with_context(in_file)?;
    Ok(Notes::from_map(&notes).with_context(in_file)?.kind())
}

/// A run that ended because a number was not finite.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(super) struct Diverged(String);

/// Result of a [`Job`].
#[derive(Debug, Serialize)]
pub(super) struct Trained {
    algorithm: Algorithm,
    train_world: String,
    seed: u64,
    steps: usize,
    env_steps: u64,
    /// Gradient steps, of PPO rounds, per environment step; none without an environment.
    updates_per_env_step: Option<f64>,
    /// Of this part of the run, everything included.
    steps_per_second: f64,
    env_steps_per_second: f64,
    demonstrated_steps: usize,
    return_first: Option<f64>,
    return_last: Option<f64>,
    /// Rise of the return, in standard errors.
    return_gain: Option<f64>,
    resumed: bool,
    policy: PathBuf,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let mut settings = Settings::read(self.common.config.as_deref())?;
        settings.set_steps(self.algorithm, self.steps);
        if self.steps == Some(0) {
            let wrong = "--steps: expected at least 1, found 0";
            return Err(WrongArguments(wrong.into()).into());
        }
        if self.from.is_some() && self.algorithm != Algorithm::Ppo {
            let wrong = format!("--from: expected --algorithm ppo, found {}", self.algorithm);
            return Err(WrongArguments(wrong).into());
        }
        if self.algorithm == Algorithm::Imitation && self.train_world != WorldName::Log {
            let wrong = "--train-world: imitation learns from the log, expected log";
            return Err(WrongArguments(wrong.into()).into());
        }
        self.check_folder(run.out())?;
        let sampling = self
            .yielding
            .sampling(&self.sampling.resolve_for(&[&self.train_world])?);
        let set = PreparedSet::read(run, &self.scenarios, Split::Train, None)?;
        let device = run.device().clone();
        let world = run.phase("load", |_| {
            RlWorld::load(
                &device,
                &self.train_world,
                &sampling,
                settings.env.live_lights,
            )
        })?;
        run.setting("env", settings.env)?;
        match self.algorithm {
            Algorithm::Ppo => run.setting("ppo", &settings.ppo)?,
            _ => run.setting("sac", &settings.sac)?,
        }
        let job = Job {
            algorithm: self.algorithm,
            world_name: match self.yielding {
                YieldingName::Ruled => self.train_world.to_string(),
                YieldingName::Learned => format!("{}, yielding learned", self.train_world),
            },
            scenes: self.scenarios.to_string(),
            settings: &settings,
            seed: run.seed(),
            folder: run.out().to_owned(),
            resume: self.resume,
            stop_at: self.stop_at.unwrap_or(usize::MAX),
            from: self.from.clone(),
        };
        run.result("set", &set.name)?;
        let place = Place {
            world: &world,
            prepared: &set.scenarios,
        };
        let trained = run.phase("train", |run| job.execute(run, place))?;
        run.result("scenarios", set.scenarios.len())?;
        let results = serde_json::to_value(&trained)?;
        for (key, value) in results.as_object().into_iter().flatten() {
            run.result(key, value)?;
        }
        Ok(())
    }

    /// Error: [`WrongArguments`] for a new run in the folder of an earlier one, and for none to
    /// resume.
    fn check_folder(&self, out: &Path) -> anyhow::Result<()> {
        let there = |name: &&str| out.join(name).is_file();
        let found = match self.resume {
            true => [CHECKPOINT].iter().find(|name| there(name)),
            false => [CHECKPOINT, POLICY].iter().find(|name| there(name)),
        };
        let wrong = match (self.resume, found) {
            (true, None) => format!(
                "--resume: expected a run in {}, found no {CHECKPOINT}",
                out.display()
            ),
            (false, Some(name)) => run::would_replace(&out.join(name)),
            _ => return Ok(()),
        };
        Err(WrongArguments(wrong).into())
    }
}

impl Job<'_> {
    /// Path of the policy's file.
    pub(super) fn policy(&self) -> PathBuf {
        self.folder.join(POLICY)
    }

    /// Path of the file that the run is resumed from.
    pub(super) fn checkpoint(&self) -> PathBuf {
        self.folder.join(CHECKPOINT)
    }

    /// The notes of a run that began with a policy of the kind `from`.
    fn notes(&self, from: Option<String>) -> anyhow::Result<Notes> {
        Ok(Notes {
            algorithm: self.algorithm.to_string(),
            train_world: self.world_name.clone(),
            scenes: Some(self.scenes.clone()),
            from,
            settings: Some(self.settings.digest(self.algorithm)?),
            env: self.settings.env,
        })
    }

    /// Whether the run in the folder has made all of its steps.
    ///
    /// Error: as [`Self::execute`], and another seed.
    pub(super) fn is_done(&self) -> anyhow::Result<bool> {
        let checkpoint = self.checkpoint();
        if !checkpoint.exists() {
            return Ok(false);
        }
        let (found, _) = self.resumed(&checkpoint)?;
        let (here, there) = (self.seed.0, found.seed().0);
        if here != there {
            let folder = self.folder.display();
            let wrong = format!("--seed: {folder} has a policy of seed {there}, expected {here}");
            return Err(WrongArguments(wrong).into());
        }
        Ok(found.is_done())
    }

    /// Trains to the end, to `stop_at` or to Ctrl-C.
    ///
    /// Error: [`Diverged`], an error of the environment, or a folder whose run cannot be resumed.
    pub(super) fn execute(&self, run: &Run, place: Place<'_>) -> anyhow::Result<Trained> {
        let (mut training, notes) = if self.resume {
            self.resumed(&self.checkpoint())?
        } else {
            let experts = demonstrations(place.prepared, &self.settings.env)?;
            let from = self.from.as_deref();
            let notes = self.notes(from.map(kind_of).transpose()?)?;
            let training = Learner::new(self.algorithm, self.settings, experts, self.seed, from)?;
            (training, notes)
        };
        let window = (training.segment_len() / POINTS_PER_SEGMENT).max(1);
        let mut curves = if self.resume {
            Curves::read(&self.folder.join("curves.csv"), window, training.steps())?
        } else {
            Curves::new(window)
        };
        let (steps, env_steps) = (training.steps(), training.env_steps());
        let began = Instant::now();
        self.learn(run, place, &notes, (&mut training, &mut curves))?;
        let seconds = began.elapsed().as_secs_f64();
        let gain = curves.gain();
        let n_env_steps = training.env_steps();
        Ok(Trained {
            algorithm: self.algorithm,
            train_world: notes.train_world,
            seed: training.seed().0,
            steps: training.steps(),
            env_steps: n_env_steps,
            updates_per_env_step: (n_env_steps > 0)
                .then(|| training.steps() as f64 / n_env_steps as f64),
            steps_per_second: (training.steps() - steps) as f64 / seconds,
            env_steps_per_second: (n_env_steps - env_steps) as f64 / seconds,
            demonstrated_steps: training.n_demonstrated(),
            return_first: gain.map(|gain| gain.0),
            return_last: gain.map(|gain| gain.1),
            return_gain: gain.map(|gain| gain.2),
            resumed: self.resume,
            policy: self.policy(),
        })
    }

    /// The run in the folder, if it has the requested settings, and its notes.
    fn resumed(&self, checkpoint: &Path) -> anyhow::Result<(Learner, Notes)> {
        let bytes = read(checkpoint)?;
        let in_file = || checkpoint.display().to_string();
        let (_, found) = Actor::from_bytes(&bytes).with_context(in_file)?;
        let found = Notes::from_map(&found).with_context(in_file)?;
        let notes = self.notes(found.from)?;
        for (flag, requested, begun) in [
            ("--algorithm", &notes.algorithm, &found.algorithm),
            ("--train-world", &notes.train_world, &found.train_world),
        ] {
            if requested != begun {
                let wrong = format!("{flag} {requested}: the run to resume began with {begun}");
                return Err(WrongArguments(wrong).into());
            }
        }
        if let Some(scenes) = found.scenes.filter(|scenes| *scenes != self.scenes) {
            let here = &self.scenes;
            let wrong = format!("--scenarios {here}: the run to resume began with {scenes}");
            return Err(WrongArguments(wrong).into());
        }
        let (training, _) = Learner::from_bytes(self.algorithm, &bytes).with_context(in_file)?;
        training.check(self.settings)?;
        if found.env != notes.env {
            let wrong = "--config: the run to resume began with another configuration";
            return Err(WrongArguments(wrong.into()).into());
        }
        Ok((training, notes))
    }

    fn learn(
        &self,
        run: &Run,
        place: Place<'_>,
        notes: &Notes,
        (training, curves): (&mut Learner, &mut Curves),
    ) -> anyhow::Result<()> {
        let total = training.total();
        let label = format!("{} in {}", self.algorithm, self.world_name);
        let progress = run.progress(&label, total as u64, "steps");
        progress.advance(training.steps() as u64);
        let (prepared, traffic) = (Arc::clone(place.prepared), place.world.traffic());
        let mut env = DrivingEnv::new(prepared, traffic, self.settings.env)?;
        let mut saved = Instant::now();
        let mut saved_step = self.resume.then(|| training.steps());
        while training.steps() < total.min(self.stop_at) {
            let learned = training.segment(&mut env, curves, || {
                progress.advance(1);
                !run::interrupted()
            });
            learned.map_err(|error| self.ended(error, saved_step))?;
            anyhow::ensure!(
                !run::interrupted(),
                "stopped by Ctrl-C after step {} of {total}, continue with --resume from the last \
                 checkpoint",
                training.steps()
            );
            let is_last = training.steps() >= total.min(self.stop_at);
            if is_last || saved.elapsed() > CHECKPOINT_EVERY {
                self.write(training, notes, curves, saved_step)?;
                (saved, saved_step) = (Instant::now(), Some(training.steps()));
            }
        }
        Ok(())
    }

    /// First the curves: rows beyond the checkpoint are cut off when the run is resumed. Nothing if
    /// a number of the run is not finite.
    fn write(
        &self,
        training: &Learner,
        notes: &Notes,
        curves: &Curves,
        saved_step: Option<usize>,
    ) -> anyhow::Result<()> {
        let notes = notes.to_map()?;
        let run = training.to_bytes(&notes);
        let run = run.map_err(|error| self.ended(error, saved_step))?;
        curves.write(&self.folder)?;
        write(&self.checkpoint(), &run)?;
        write(&self.policy(), &training.actor().to_bytes(&notes)?)
    }

    /// The error of a run that ended; of one that diverged with the checkpoint that is left, which
    /// is that of `saved_step`.
    fn ended(&self, error: RlError, saved_step: Option<usize>) -> anyhow::Error {
        if !matches!(error, RlError::Diverged { .. }) {
            return error.into();
        }
        let left = match saved_step {
            Some(step) => format!(
                "the last good checkpoint is {}, after step {step}",
                self.checkpoint().display()
            ),
            None => "this run has no checkpoint yet".into(),
        };
        Diverged(format!("{error}; {left}")).into()
    }
}
