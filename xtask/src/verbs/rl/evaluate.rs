//! `rl evaluate`: the paper's columns for any policies in any worlds.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::Context as _;
use gump_eval::benchmarks::ScenarioSetName;
use gump_eval::closed_loop::checksums;
use gump_eval::datasets::Split;
use gump_eval::results::{Entry, Header, ResultStore};
use gump_eval::shard::Shard;
use gump_eval::worlds::WorldName;
use gump_rl::{
    Actor, EnvConfig, Episodes, EvaluatedPolicy, PreparedScenario, evaluate, recorded_drive,
};
use serde::Serialize;
use sha2::{Digest as _, Sha256};

use super::columns::{DivergedPolicy, DriveRecord, Driven, Policy, Tested, report};
use super::{Notes, PreparedSet, RlWorld, Settings, read};
use crate::cli::WrongArguments;
use crate::films;
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
    /// Files of policies, or expert, random, constant-speed, brake; those of one algorithm, training
    /// world and configuration, begun with policies of one kind, differ in their seeds and make one
    /// row
    #[arg(long, value_name = "FILE", required = true, num_args = 1.., value_delimiter = ',')]
    policy: Vec<PathBuf>,
    /// log, idm, constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W", default_value = "log", num_args = 1.., value_delimiter = ',')]
    test_world: Vec<WorldName>,
    /// A file, a folder, or LIST.toml#SPLIT; of a list or a folder with a manifest.toml the test
    /// split
    #[arg(long, value_name = "SCENARIOS")]
    scenarios: ScenarioSetName,
    /// Maximum number of scenarios [default: all]
    #[arg(long, value_name = "N")]
    limit: Option<usize>,
    /// Maximum number of scenarios in learned worlds, which are slow [default: as in the others]
    #[arg(long, value_name = "N")]
    model_limit: Option<NonZeroUsize>,
    /// Drives per scenario, each in other traffic of the same world
    #[arg(long, value_name = "N", default_value_t = 1)]
    repeats: usize,
    /// Films of the first N scenarios, one per policy and world, in films/
    #[arg(long, value_name = "N", default_value_t = 0)]
    films: usize,
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
    /// As of [`Notes`].
    from: Option<String>,
    settings: Option<String>,
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
    /// Of the scenarios, in worlds that are models; all if none.
    pub(super) model_limit: Option<NonZeroUsize>,
    pub(super) repeats: usize,
    pub(super) sampling: &'a Sampling,
    pub(super) shard: Shard,
    /// Policies that were to be tested as well, but diverged while they learned.
    pub(super) diverged: Vec<DivergedPolicy>,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        if self.repeats == 0 {
            return Err(WrongArguments("--repeats: expected at least 1, found 0".into()).into());
        }
        let (candidates, env) = self.candidates()?;
        let set = PreparedSet::read(run, &self.scenarios, Split::Test, self.limit)?;
        let worlds = load(run, &self.test_world, &self.sampling, env.live_lights)?;
        let test = Test {
            candidates: &candidates,
            worlds,
            env: &env,
            model_limit: self.model_limit,
            repeats: self.repeats,
            sampling: &self.sampling,
            shard: self.shard,
            diverged: Vec::new(),
        };
        test.execute(run, &set)?;
        test.film(run, &set, self.films)
    }

    /// Reads the policies; the environment is that of the config file, else that of all of them.
    ///
    /// Error: [`WrongArguments`] for policies of different environments without a config file.
    fn candidates(&self) -> anyhow::Result<(Vec<Candidate>, EnvConfig)> {
        let mut env = match &self.common.config {
            Some(path) => Some(Settings::read(Some(path))?.env),
            None => None,
        };
        let mut candidates = Vec::new();
        for file in &self.policy {
            let (candidate, of_policy) = Candidate::read(file)?;
            let is_given = self.common.config.is_some();
            if let (Some(env), Some(own), false) = (&env, &of_policy, is_given)
                && env != own
            {
                let wrong = format!(
                    "--policy {}: it learned in another environment than the policies before it; \
                     evaluate it apart, or give the environment with --config",
                    file.display()
                );
                return Err(WrongArguments(wrong).into());
            }
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
    live_lights: bool,
) -> anyhow::Result<Vec<(&'a WorldName, RlWorld)>> {
    let names: Vec<&WorldName> = names.into_iter().collect();
    let (sampling, device) = (sampling.resolve_for(&names)?, run.device().clone());
    run.phase("load", |_| {
        let load = |name| Ok((name, RlWorld::load(&device, name, &sampling, live_lights)?));
        names.into_iter().map(load).collect()
    })
}

/// Those of these scenarios, which are in order, that are driven in a world: of a model the ones
/// before the limit.
fn driven_in<'a>(
    world: &WorldName,
    model_limit: Option<NonZeroUsize>,
    scenarios: &'a [usize],
) -> &'a [usize] {
    match (world, model_limit) {
        (WorldName::Model(_), Some(limit)) => {
            &scenarios[..scenarios.partition_point(|&index| index < limit.get())]
        }
        _ => scenarios,
    }
}

impl Test<'_> {
    /// Drives the scenarios whose results the folder does not have yet, and reports on all.
    pub(super) fn execute(&self, run: &mut Run, set: &PreparedSet) -> anyhow::Result<()> {
        let prepared = &set.scenarios;
        let tested = self.tested(run, set)?;
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
            let limit = self.model_limit;
            let n_driven = |(name, _): &(&WorldName, _)| driven_in(name, limit, &todo).len();
            let n = self.worlds.iter().map(n_driven).sum::<usize>() * self.candidates.len();
            let progress = run.progress("driving", n as u64, "scenarios x policies x worlds");
            for round in todo.chunks(SCENARIOS_PER_ROUND) {
                let mut driven = vec![Driven::default(); round.len()];
                for w in 0..self.worlds.len() {
                    let round = driven_in(self.worlds[w].0, limit, round);
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

    /// Films the first `n` scenarios of the shard, driven again as in the evaluation.
    fn film(&self, run: &mut Run, set: &PreparedSet, n: usize) -> anyhow::Result<()> {
        let own = (0..set.scenarios.len()).filter(|index| self.shard.holds(*index));
        let filmed: Vec<usize> = own.take(n).collect();
        if filmed.is_empty() {
            return Ok(());
        }
        let folder = run.path("films");
        std::fs::create_dir_all(&folder)?;
        run.phase("film", |run| {
            for (name, world) in &self.worlds {
                for &index in driven_in(name, self.model_limit, &filmed) {
                    for (p, candidate) in self.candidates.iter().enumerate() {
                        stop_if_interrupted()?;
                        let drive = recorded_drive(
                            &set.scenarios,
                            world.traffic(),
                            self.env,
                            candidate.driver(),
                            (index, run.seed()),
                        );
                        let drive = drive.with_context(|| candidate.file.display().to_string())?;
                        let label = films::label(&candidate.policy, name);
                        let scenario = set.scenarios[index].scenario();
                        let film = films::film(scenario, &[(label.as_str(), &drive)])?;
                        let file = format!(
                            "{index}-{p}-{}-{}.gif",
                            candidate.policy,
                            films::short(name)
                        );
                        film.save(&folder.join(file))?;
                    }
                }
            }
            Ok(())
        })
    }

    fn tested(&self, run: &Run, set: &PreparedSet) -> anyhow::Result<Tested> {
        let ids = set.scenarios.iter().map(|one| one.scenario().id.clone());
        let ids: Vec<String> = ids.collect();
        let worlds = self.worlds.iter().map(|(name, _)| *name);
        Ok(Tested {
            set: Some(set.name.clone()),
            checksums: checksums(&ids, worlds)?,
            scenarios: ids.len(),
            model_limit: self.model_limit.map(NonZeroUsize::get),
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
            diverged: self.diverged.clone(),
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
                from: None,
                settings: None,
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
            from: notes.from,
            settings: notes.settings,
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
            from: self.from.clone(),
            settings: self.settings.clone(),
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

pub(super) fn sha256(bytes: &[u8]) -> String {
    let digest = Sha256::digest(bytes);
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn learned_worlds_have_the_first_scenarios() {
        let model = WorldName::Model("weights".into());
        let (limit, of_shard) = (NonZeroUsize::new(4), [1, 3, 5, 7]);
        assert_eq!(driven_in(&model, limit, &of_shard), [1, 3]);
        assert_eq!(driven_in(&model, None, &of_shard), of_shard);
        assert_eq!(driven_in(&WorldName::Idm, limit, &of_shard), of_shard);
    }
}
