//! `rl train`: a policy, from rewards in a world or from the log alone.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use gump_eval::datasets::Split;
use gump_eval::worlds::WorldName;
use gump_rl::sac::{Algorithm, Training};
use gump_rl::{DrivingEnv, PreparedScenario, demonstrations};
use gump_scene::Seed;
use serde::Serialize;

use super::curves::Curves;
use super::{Notes, RlWorld, Settings, prepared, read, write};
use crate::choices::{ALGORITHMS, one_of};
use crate::cli::WrongArguments;
use crate::run::{self, Common, Run};
use crate::sampling::Sampling;

/// Time between checkpoints: what a crash may cost.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(60);
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
    /// A folder with a manifest.toml, or any file or folder of scenarios
    #[arg(long, value_name = "PATH")]
    scenarios: PathBuf,
    /// Gradient steps [default: the configuration's]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Stop at the first checkpoint from this gradient step on; continue with --resume
    #[arg(long, value_name = "N")]
    stop_at: Option<usize>,
    /// Continue the run in --out with its original configuration
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
    pub(super) world_name: &'a WorldName,
    pub(super) world: &'a RlWorld,
    pub(super) prepared: &'a Arc<[PreparedScenario]>,
    pub(super) settings: &'a Settings,
    pub(super) seed: Seed,
    pub(super) folder: PathBuf,
    /// Whether to resume the run in the folder.
    pub(super) resume: bool,
    /// Gradient steps after which to stop early.
    pub(super) stop_at: usize,
}

/// Result of a [`Job`].
#[derive(Debug, Serialize)]
pub(super) struct Trained {
    algorithm: Algorithm,
    train_world: String,
    seed: u64,
    steps: usize,
    env_steps: u64,
    /// Gradient steps per environment step; none without an environment.
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
        settings.sac.steps = self.steps.unwrap_or(settings.sac.steps);
        if self.algorithm == Algorithm::Imitation && self.train_world != WorldName::Log {
            let wrong = "--train-world: imitation learns from the log, expected log";
            return Err(WrongArguments(wrong.into()).into());
        }
        let sampling = self.sampling.resolve()?;
        let prepared = run.phase("read", |run| {
            prepared(run, &self.scenarios, Split::Train, None)
        })?;
        let device = run.device().clone();
        let world = run.phase("load", |_| {
            RlWorld::load(&device, &self.train_world, &sampling)
        })?;
        run.setting("env", settings.env)?;
        run.setting("sac", &settings.sac)?;
        let job = Job {
            algorithm: self.algorithm,
            world_name: &self.train_world,
            world: &world,
            prepared: &prepared,
            settings: &settings,
            seed: run.seed(),
            folder: run.out().to_owned(),
            resume: self.resume,
            stop_at: self.stop_at.unwrap_or(usize::MAX),
        };
        let trained = run.phase("train", |run| job.execute(run))?;
        run.result("scenarios", prepared.len())?;
        let results = serde_json::to_value(&trained)?;
        for (key, value) in results.as_object().into_iter().flatten() {
            run.result(key, value)?;
        }
        Ok(())
    }
}

impl Job<'_> {
    /// Path of the policy's file.
    pub(super) fn policy(&self) -> PathBuf {
        self.folder.join("policy.safetensors")
    }

    /// Trains to the end, to `stop_at` or to Ctrl-C.
    ///
    /// Error: an error of the environment, or a folder whose run cannot be resumed.
    pub(super) fn execute(&self, run: &Run) -> anyhow::Result<Trained> {
        let checkpoint = self.folder.join("checkpoint.safetensors");
        let notes = Notes {
            algorithm: self.algorithm.to_string(),
            train_world: self.world_name.to_string(),
            env: self.settings.env,
        };
        let mut training = if self.resume {
            self.resumed(&checkpoint, &notes)?
        } else {
            let experts = demonstrations(self.prepared, &self.settings.env)?;
            let config = self.settings.sac.clone();
            Training::new(self.algorithm, config, experts, self.seed)?
        };
        let window = (training.config().segment / POINTS_PER_SEGMENT).max(1);
        let mut curves = if self.resume {
            Curves::read(&self.folder.join("curves.csv"), window, training.steps())?
        } else {
            Curves::new(window)
        };
        let (steps, env_steps) = (training.steps(), training.env_steps());
        let began = Instant::now();
        self.learn(run, &mut training, &mut curves, &notes)?;
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

    /// The run in the folder, if it has the requested settings.
    fn resumed(&self, checkpoint: &Path, notes: &Notes) -> anyhow::Result<Training> {
        let bytes = read(checkpoint)?;
        let in_file = || checkpoint.display().to_string();
        let (training, found) = Training::from_bytes(&bytes).with_context(in_file)?;
        let found = Notes::from_map(&found).with_context(in_file)?;
        let requested = &self.settings.sac;
        for (flag, requested, begun) in [
            ("--algorithm", notes.algorithm.clone(), found.algorithm),
            (
                "--train-world",
                notes.train_world.clone(),
                found.train_world,
            ),
            (
                "--steps",
                requested.steps.to_string(),
                training.config().steps.to_string(),
            ),
        ] {
            if requested != begun {
                let wrong = format!("{flag} {requested}: the run to resume began with {begun}");
                return Err(WrongArguments(wrong).into());
            }
        }
        if found.env != notes.env || training.config() != requested {
            let wrong = "--config: the run to resume began with another configuration";
            return Err(WrongArguments(wrong.into()).into());
        }
        Ok(training)
    }

    fn learn(
        &self,
        run: &Run,
        training: &mut Training,
        curves: &mut Curves,
        notes: &Notes,
    ) -> anyhow::Result<()> {
        let total = training.config().steps;
        let label = format!("{} in {}", self.algorithm, self.world_name);
        let progress = run.progress(&label, total as u64, "steps");
        progress.advance(training.steps() as u64);
        let traffic = self.world.traffic();
        let mut env = DrivingEnv::new(Arc::clone(self.prepared), traffic, self.settings.env)?;
        let mut saved = Instant::now();
        while training.steps() < total.min(self.stop_at) {
            let observe = |report| {
                progress.advance(1);
                curves.push(report);
                match run::interrupted() {
                    true => ControlFlow::Break(()),
                    false => ControlFlow::Continue(()),
                }
            };
            match self.algorithm {
                Algorithm::Imitation => training.imitation_segment(observe)?,
                _ => training.segment(&mut env, observe)?,
            }
            anyhow::ensure!(
                !run::interrupted(),
                "stopped by Ctrl-C after step {} of {total}, continue with --resume from the last \
                 checkpoint",
                training.steps()
            );
            let is_last = training.steps() >= total.min(self.stop_at);
            if is_last || saved.elapsed() > CHECKPOINT_EVERY {
                self.write(training, curves, notes)?;
                saved = Instant::now();
            }
        }
        Ok(())
    }

    /// First the curves: rows beyond the checkpoint are cut off when the run is resumed.
    fn write(&self, training: &Training, curves: &Curves, notes: &Notes) -> anyhow::Result<()> {
        curves.write(&self.folder)?;
        let notes = notes.to_map()?;
        let checkpoint = self.folder.join("checkpoint.safetensors");
        write(&checkpoint, &training.to_bytes(&notes)?)?;
        write(&self.policy(), &training.actor().to_bytes(&notes)?)
    }
}
