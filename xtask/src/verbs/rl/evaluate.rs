//! `rl evaluate`: the paper's columns for any policies in any worlds.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::Context as _;
use gump_eval::datasets::Split;
use gump_eval::results::{Entry, Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_rl::{Actor, EnvConfig, Episodes, EvaluatedPolicy, PreparedScenario, evaluate};
use serde::Serialize;
use sha2::{Digest as _, Sha256};

use super::columns::{DriveRecord, Driven, Policy, Tested, report};
use super::{Notes, RlWorld, Settings, prepared, read};
use crate::cli::WrongArguments;
use crate::run::{Common, Run, stop_if_interrupted};
use crate::sampling::Sampling;
use crate::sharding::shard;

/// Name of the benchmark in stores of results.
pub(crate) const BENCHMARK: &str = "rl";

/// Scenarios that are driven before their results are stored: what an interruption costs. Chosen by
/// hand.
const SCENARIOS_PER_ROUND: usize = 32;

/// Arguments of `rl evaluate`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Files of policies, or expert, random, constant-speed, brake; those of one algorithm and
    /// training world, which differ in their seeds, make one row
    #[arg(long, value_name = "FILE", required = true, num_args = 1.., value_delimiter = ',')]
    policy: Vec<PathBuf>,
    /// log, idm, constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W", default_value = "log", num_args = 1.., value_delimiter = ',')]
    test_world: Vec<WorldName>,
    /// A folder with a manifest.toml, whose test scenarios are taken, or any file or folder
    #[arg(long, value_name = "PATH")]
    scenarios: PathBuf,
    /// Maximum number of scenarios [default: all]
    #[arg(long, value_name = "N")]
    limit: Option<usize>,
    /// Drives per scenario, each in other traffic of the same world
    #[arg(long, value_name = "N", default_value_t = 1)]
    repeats: usize,
    /// Evaluate shard K of N; auto: the shard that a cluster's variables name. Merge shards with
    /// `evaluate merge`
    #[arg(long, value_name = "K/N|auto", default_value = "1/1", value_parser = shard)]
    shard: Shard,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// A policy to evaluate.
pub(super) struct Candidate {
    /// The algorithm, or the name of a fixed rule.
    policy: String,
    train_world: Option<String>,
    file: PathBuf,
    /// Of the file; none of a fixed rule.
    sha256: Option<String>,
    kind: Kind,
}

enum Kind {
    Learned(Box<Actor>),
    Expert,
    Random,
    Constant([f32; 2]),
}

/// An evaluation: policies, worlds and scenarios.
pub(super) struct Test<'a> {
    pub(super) candidates: &'a [Candidate],
    pub(super) worlds: Vec<(&'a WorldName, RlWorld)>,
    pub(super) env: &'a EnvConfig,
    pub(super) repeats: usize,
    pub(super) sampling: &'a Sampling,
    pub(super) shard: Shard,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        if self.repeats == 0 {
            return Err(WrongArguments("--repeats: expected at least 1, found 0".into()).into());
        }
        let (candidates, env) = self.candidates()?;
        let limit = self.limit;
        let prepared = run.phase("read", |run| {
            prepared(run, &self.scenarios, Split::Test, limit)
        })?;
        let worlds = load(run, &self.test_world, &self.sampling)?;
        let test = Test {
            candidates: &candidates,
            worlds,
            env: &env,
            repeats: self.repeats,
            sampling: &self.sampling,
            shard: self.shard,
        };
        test.execute(run, &prepared)
    }

    /// Reads the policies; the environment is that of the config file, else that of the first.
    fn candidates(&self) -> anyhow::Result<(Vec<Candidate>, EnvConfig)> {
        let mut env = match &self.common.config {
            Some(path) => Some(Settings::read(Some(path))?.env),
            None => None,
        };
        let mut candidates = Vec::new();
        for file in &self.policy {
            let (candidate, of_policy) = Candidate::read(file)?;
            env = env.or(of_policy);
            candidates.push(candidate);
        }
        Ok((candidates, env.unwrap_or_default()))
    }
}

/// Loads every world with what it needs.
pub(super) fn load<'a>(
    run: &mut Run,
    names: impl IntoIterator<Item = &'a WorldName>,
    sampling: &Sampling,
) -> anyhow::Result<Vec<(&'a WorldName, RlWorld)>> {
    let (sampling, device) = (sampling.resolve()?, run.device().clone());
    run.phase("load", |_| {
        let load = |name| Ok((name, RlWorld::load(&device, name, &sampling)?));
        names.into_iter().map(load).collect()
    })
}

impl Test<'_> {
    /// Drives the scenarios whose results the folder does not have yet, and reports on all.
    pub(super) fn execute(
        &self,
        run: &mut Run,
        prepared: &Arc<[PreparedScenario]>,
    ) -> anyhow::Result<()> {
        let tested = self.tested(run, prepared)?;
        let header = Header {
            benchmark: BENCHMARK.into(),
            shard: self.shard,
            settings: toml::Table::try_from(&tested)?,
        };
        let mut store = ResultStore::open(run.out(), &header)?;
        let missing = |index: &usize| self.shard.holds(*index) && !store.has(*index);
        let todo: Vec<usize> = (0..prepared.len()).filter(missing).collect();
        let (mut steps, began) = (0, Instant::now());
        run.phase("drive", |run| {
            let n = todo.len() * self.worlds.len() * self.candidates.len();
            let progress = run.progress("driving", n as u64, "scenarios x policies x worlds");
            for round in todo.chunks(SCENARIOS_PER_ROUND) {
                let mut driven = vec![Driven::default(); round.len()];
                for w in 0..self.worlds.len() {
                    for p in 0..self.candidates.len() {
                        stop_if_interrupted()?;
                        steps += self.drive(run, prepared, (w, p), round, &mut driven)?;
                        progress.advance(round.len() as u64);
                    }
                }
                for (&index, scores) in round.iter().zip(driven) {
                    let id = prepared[index].scenario().id.clone();
                    store.add(Entry { index, id, scores })?;
                }
            }
            anyhow::Ok(())
        })?;
        let entries = store.close()?;
        anyhow::ensure!(
            !entries.is_empty(),
            "expected scenarios in shard {}, found none among {}",
            self.shard,
            prepared.len()
        );
        report(run, &tested, &entries)?;
        run.result(
            "steps_per_second",
            f64::from(steps) / began.elapsed().as_secs_f64(),
        )
    }

    /// Lets one candidate drive these scenarios in one world; steps made.
    fn drive(
        &self,
        run: &Run,
        prepared: &Arc<[PreparedScenario]>,
        (w, p): (usize, usize),
        scenarios: &[usize],
        driven: &mut [Driven],
    ) -> anyhow::Result<u32> {
        let (candidate, (_, world)) = (&self.candidates[p], &self.worlds[w]);
        let episodes = Episodes {
            scenarios: scenarios.to_vec(),
            repeats: self.repeats,
            seed: run.seed(),
        };
        let drives = evaluate(
            prepared,
            world.traffic(),
            self.env,
            candidate.driver(),
            &episodes,
        )
        .with_context(|| candidate.file.display().to_string())?;
        let of_scenario = drives.chunks_exact(self.repeats);
        for (driven, drives) in driven.iter_mut().zip(of_scenario) {
            driven
                .drives
                .extend(drives.iter().map(|drive| DriveRecord::new(w, p, drive)));
        }
        Ok(drives.iter().map(|drive| drive.steps as u32).sum())
    }

    fn tested(&self, run: &Run, prepared: &[PreparedScenario]) -> anyhow::Result<Tested> {
        let ids: Vec<&str> = prepared.iter().map(|c| c.scenario().id.as_str()).collect();
        Ok(Tested {
            scenarios: prepared.len(),
            sha256_of_ids: sha256(ids.join("\n").as_bytes()),
            repeats: self.repeats,
            seed: run.seed().0.to_string(),
            env: toml::to_string(self.env)?,
            sampling: serde_json::to_string(self.sampling)?,
            worlds: self
                .worlds
                .iter()
                .map(|(name, _)| name.to_string())
                .collect(),
            policies: self.candidates.iter().map(Candidate::named).collect(),
        })
    }
}

impl Candidate {
    /// A rule by its name, else a stored policy and the environment it learned in.
    ///
    /// Error: a file that holds no policy.
    pub(super) fn read(file: &Path) -> anyhow::Result<(Self, Option<EnvConfig>)> {
        let rule = match file.to_str() {
            Some("expert") => Some(Kind::Expert),
            Some("random") => Some(Kind::Random),
            Some("constant-speed") => Some(Kind::Constant([0.0, 0.0])),
            Some("brake") => Some(Kind::Constant([-1.0, 0.0])),
            _ => None,
        };
        if let Some(kind) = rule {
            let rule = Self {
                policy: file.display().to_string(),
                train_world: None,
                file: file.to_owned(),
                sha256: None,
                kind,
            };
            return Ok((rule, None));
        }
        let in_file = || file.display().to_string();
        let bytes = read(file)?;
        let (actor, notes) = Actor::from_bytes(&bytes).with_context(in_file)?;
        let notes = Notes::from_map(&notes).with_context(in_file)?;
        let learned = Self {
            policy: notes.algorithm,
            train_world: Some(notes.train_world),
            file: file.to_owned(),
            sha256: Some(sha256(&bytes)),
            kind: Kind::Learned(Box::new(actor)),
        };
        Ok((learned, Some(notes.env)))
    }

    fn named(&self) -> Policy {
        Policy {
            policy: self.policy.clone(),
            train_world: self.train_world.clone(),
            file: self.file.clone(),
            sha256: self.sha256.clone(),
        }
    }

    fn driver(&self) -> EvaluatedPolicy<'_> {
        match &self.kind {
            Kind::Learned(actor) => EvaluatedPolicy::Learned(actor),
            Kind::Expert => EvaluatedPolicy::Expert,
            Kind::Random => EvaluatedPolicy::Random,
            Kind::Constant(action) => EvaluatedPolicy::Constant(action),
        }
    }
}

fn sha256(bytes: &[u8]) -> String {
    let digest = Sha256::digest(bytes);
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}
