//! `rl evaluate`: the paper's columns for any policies in any worlds.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::Context as _;
use gump_eval::worlds::WorldName;
use gump_metrics::interval;
use gump_rl::{
    Actor, Columns, Course, Drive, Driver, EnvConfig, evaluate, paired_difference,
    score_by_scenario,
};
use gump_scene::Seed;
use serde::Serialize;
use serde_json::{Value, json};

use super::{Notes, RlWorld, Settings, courses, read, write};
use crate::cli::WrongArguments;
use crate::dataset::Split;
use crate::run::{Common, Run, stop_if_interrupted};
use crate::sampling::Sampling;

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
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Who is evaluated.
pub(super) struct Candidate {
    /// The algorithm, or the name of a fixed rule.
    policy: String,
    train_world: Option<String>,
    file: PathBuf,
    kind: Kind,
}

enum Kind {
    Learned(Box<Actor>),
    Expert,
    Random,
    Constant([f32; 2]),
}

/// Policies of a kind in a world: a row of the table.
struct Group {
    policy: String,
    train_world: Option<String>,
    test_world: String,
    /// Drives of each policy of the group.
    drives: Vec<Vec<Drive>>,
}

/// The table in the making.
pub(super) struct Table<'a> {
    courses: &'a Arc<[Course]>,
    repeats: usize,
    groups: Vec<Group>,
    csv: String,
    steps: usize,
    began: Instant,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        if self.repeats == 0 {
            return Err(WrongArguments("--repeats: expected at least 1, found 0".into()).into());
        }
        let sampling = self.sampling.resolve()?;
        let (candidates, env) = self.candidates()?;
        let limit = self.limit;
        let courses = run.phase("read", |run| {
            courses(run, &self.scenarios, Split::Test, limit)
        })?;
        let mut table = Table::new(&courses, self.repeats);
        let device = run.device().clone();
        for name in &self.test_world {
            let world = run.phase("load", |_| RlWorld::load(&device, name, &sampling))?;
            run.phase("drive", |run| {
                table.drive(run, &candidates, &env, (name, &world))
            })?;
        }
        table.report(run)
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
                kind,
            };
            return Ok((rule, None));
        }
        let in_file = || file.display().to_string();
        let (actor, notes) = Actor::from_bytes(&read(file)?).with_context(in_file)?;
        let notes = Notes::from_map(&notes).with_context(in_file)?;
        let learned = Self {
            policy: notes.algorithm,
            train_world: Some(notes.train_world),
            file: file.to_owned(),
            kind: Kind::Learned(Box::new(actor)),
        };
        Ok((learned, Some(notes.env)))
    }

    fn driver(&self) -> Driver<'_> {
        match &self.kind {
            Kind::Learned(actor) => Driver::Learned(actor),
            Kind::Expert => Driver::Expert,
            Kind::Random => Driver::Random,
            Kind::Constant(action) => Driver::Constant(action),
        }
    }
}

impl<'a> Table<'a> {
    pub(super) fn new(courses: &'a Arc<[Course]>, repeats: usize) -> Self {
        let csv = "policy,train_world,test_world,file,scenario,repeat,collided,offroad,\
                   progress_m,comfortable,score\n";
        Self {
            courses,
            repeats,
            groups: Vec::new(),
            csv: csv.into(),
            steps: 0,
            began: Instant::now(),
        }
    }

    /// Lets all candidates drive in one world.
    pub(super) fn drive(
        &mut self,
        run: &Run,
        candidates: &[Candidate],
        env: &EnvConfig,
        (name, world): (&WorldName, &RlWorld),
    ) -> anyhow::Result<()> {
        let label = format!("driving in {name}");
        let progress = run.progress(&label, candidates.len() as u64, "policies");
        for candidate in candidates {
            stop_if_interrupted()?;
            let episodes = (self.repeats, run.seed());
            let drives = evaluate(
                self.courses,
                world.traffic(),
                env,
                candidate.driver(),
                episodes,
            )
            .with_context(|| candidate.file.display().to_string())?;
            self.steps += drives.iter().map(|drive| drive.steps).sum::<usize>();
            self.note(candidate, name, &drives)?;
            self.group(candidate, name).drives.push(drives);
            progress.advance(1);
        }
        Ok(())
    }

    /// The row of a candidate in a world.
    fn group(&mut self, candidate: &Candidate, name: &WorldName) -> &mut Group {
        let test_world = name.to_string();
        let is_it = |g: &Group| {
            let of_candidate = (&g.policy, &g.train_world, &g.test_world);
            of_candidate == (&candidate.policy, &candidate.train_world, &test_world)
        };
        let i = self.groups.iter().position(is_it).unwrap_or_else(|| {
            self.groups.push(Group {
                policy: candidate.policy.clone(),
                train_world: candidate.train_world.clone(),
                test_world: test_world.clone(),
                drives: Vec::new(),
            });
            self.groups.len() - 1
        });
        &mut self.groups[i]
    }

    fn note(
        &mut self,
        candidate: &Candidate,
        test_world: &WorldName,
        drives: &[Drive],
    ) -> anyhow::Result<()> {
        let train_world = candidate.train_world.as_deref().unwrap_or("");
        for drive in drives {
            writeln!(
                self.csv,
                "{},{train_world},{test_world},{},{},{},{},{},{},{},{}",
                candidate.policy,
                candidate.file.display(),
                self.courses[drive.scenario].scenario().id,
                drive.repeat,
                u8::from(drive.collided),
                u8::from(drive.off_road),
                drive.progress,
                u8::from(drive.comfortable),
                drive.score(),
            )?;
        }
        Ok(())
    }

    /// Writes every drive to a file, rows and paired differences to the report.
    pub(super) fn report(&self, run: &mut Run) -> anyhow::Result<()> {
        write(&run.path("drives.csv"), self.csv.as_bytes())?;
        let seed = run.seed();
        let rows: Vec<Value> = self.groups.iter().map(|group| group.row(seed)).collect();
        run.result("rows", rows)?;
        run.result("differences", self.differences(seed))?;
        run.result("scenarios", self.courses.len())?;
        let seconds = self.began.elapsed().as_secs_f64();
        run.result("steps_per_second", self.steps as f64 / seconds)
    }

    /// Every row against every earlier row of the same test world, on the same scenarios.
    fn differences(&self, seed: Seed) -> Vec<Value> {
        let mut differences = Vec::new();
        for (i, than) in self.groups.iter().enumerate() {
            for group in self.groups[i + 1..].iter() {
                if group.test_world != than.test_world {
                    continue;
                }
                let scores = [group, than].map(Group::scores);
                if let Some((difference, span)) = paired_difference(&scores[0], &scores[1], seed) {
                    differences.push(json!({
                        "test_world": group.test_world,
                        "policy": group.label(),
                        "than": than.label(),
                        "difference": difference,
                        "low": span.low,
                        "high": span.high,
                    }));
                }
            }
        }
        differences
    }
}

impl Group {
    fn label(&self) -> String {
        match &self.train_world {
            Some(world) => format!("{} in {world}", self.policy),
            None => self.policy.clone(),
        }
    }

    fn all(&self) -> Vec<Drive> {
        self.drives.concat()
    }

    fn scores(&self) -> Vec<f64> {
        score_by_scenario(&self.all())
    }

    fn row(&self, seed: Seed) -> Value {
        let all = self.all();
        let columns = Columns::of(&all);
        let span = interval(&self.scores(), seed);
        json!({
            "policy": self.policy,
            "train_world": self.train_world,
            "test_world": self.test_world,
            "policies": self.drives.len(),
            "episodes": all.len(),
            "score": columns.map(|c| c.score),
            "low": span.map(|span| span.low),
            "high": span.map(|span| span.high),
            "collision_rate": columns.map(|c| c.collision_rate),
            "offroad_rate": columns.map(|c| c.offroad_rate),
            "progress_m": columns.and_then(|c| c.progress),
            "comfort": columns.and_then(|c| c.comfort),
        })
    }
}
