//! Closed-loop drives of several planners in several worlds, with nuPlan's scores.
//!
//! [`ClosedLoopEvaluation`] drives through one scenario, or through all that a store of results does
//! not have yet; the outcomes of a scenario are stored as [`ScenarioDrives`]. A planner is one of
//! ours by name, one of PDM's proposals alone, or any [`PlannerFactory`]. One drive and its score are
//! in [`gump_planner::closed_loop`].

use std::collections::BTreeMap;
use std::fs;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use gump_nuplan::closed_loop::{DriveConfig, Driver, PlannerInitialization, PlannerInput};
use gump_nuplan::tracking::Trajectory;
use gump_planner::closed_loop::{Scored, drive_and_score, evaluate};
use gump_planner::{Explain, PdmClosed, PdmConfig, ProposalKind};
use gump_rollout::{BoxError, WorldModel};
use gump_scene::Seed;
use serde::{Deserialize, Serialize};

use crate::error::sentence;
use crate::planners::{PlannerConfig, PlannerName, PlanningWorld, TimedDriver, catch_panics};
use crate::recordings::{Case, Named};
use crate::results::{Entry, ResultStore};
use crate::worlds::WorldName;
use crate::{EvalError, Monitor, ResumePoint, digest};

/// Name of the benchmark in stored results.
pub const BENCHMARK: &str = "closed-loop";

/// The settings that the outcomes of a scenario depend on, as they are stored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClosedLoopSettings {
    /// The set, or the name of the file or folder.
    pub scenarios: String,
    /// Number of scenarios at most.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub limit: Option<usize>,
    /// Names of the worlds, in order.
    pub worlds: Vec<String>,
    /// Names of the planners, in order.
    pub planners: Vec<String>,
    /// Name of the world that planners roll out.
    pub imagination: String,
    /// Length of the drives and controller, as JSON.
    pub driving: String,
    /// Settings of planners with rollouts, as JSON.
    #[serde(rename = "thinking", alias = "imagining")]
    pub imagining: String,
    /// Sampling of learned worlds, as JSON.
    pub sampling: String,
    /// The seed, in decimal digits.
    pub seed: String,
    /// Those of [`checksums`]; none as of version 0.1.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub checksums: BTreeMap<String, String>,
}

/// Checksums of what drives depend on and names do not tell, as they are stored under
/// [`CHECKSUMS`](crate::results::CHECKSUMS): SHA-256 of the ids of the scenarios in their order, and
/// of the weights of each learned world by its name.
///
/// # Errors
/// Weights that cannot be read.
pub fn checksums<'a>(
    ids: &[String],
    worlds: impl IntoIterator<Item = &'a WorldName>,
) -> Result<BTreeMap<String, String>, EvalError> {
    let of_ids = digest::of_bytes(ids.join("\n").as_bytes());
    let mut checksums = BTreeMap::from([("scenario_ids".to_owned(), of_ids)]);
    for world in worlds {
        let name = world.to_string();
        if let WorldName::Model(path) = world
            && !checksums.contains_key(&name)
        {
            let weights = fs::read(path).map_err(|cause| EvalError::io("read", path, cause))?;
            checksums.insert(name, digest::of_bytes(&weights));
        }
    }
    Ok(checksums)
}

/// The drives through one scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScenarioDrives {
    /// The log that the scenario belongs to.
    pub log_name: String,
    /// nuPlan's type of scenario; "unknown" for other formats.
    pub scenario_type: String,
    /// World by world, in each the planners in their order; none if the scenario could not be read.
    pub outcomes: Vec<DriveOutcome>,
    /// Why the scenario could not be read, which is not for lack of a planner.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unreadable: Option<String>,
}

/// The outcome of one drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DriveOutcome {
    /// Name of the world.
    pub world: String,
    /// Name of the planner.
    pub planner: String,
    /// Whether the planner is one of the proposals, of which reports show the best and the oracle.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub proposal: bool,
    /// Of a drive that reached its end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub finished: Option<FinishedDrive>,
    /// Why it did not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

/// A drive that reached its end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FinishedDrive {
    /// nuPlan's score, 0 to 1.
    pub score: f64,
    /// Mean milliseconds per plan.
    pub milliseconds: f64,
    /// nuPlan's metrics that apply, by their names.
    pub metrics: BTreeMap<String, f64>,
}

/// Builds a planner that is not among [`PlannerName`], for instance one in another process.
pub trait PlannerFactory: Sync {
    /// Its name in results.
    fn name(&self) -> String;

    /// The planner for one case.
    ///
    /// # Errors
    /// Any error; the drive then counts as failed.
    fn build(&self, case: &Case, seed: Seed) -> Result<Box<dyn Explain + '_>, BoxError>;

    /// Whether several planners may drive at the same time.
    fn is_parallel(&self) -> bool {
        true
    }
}

/// Why a scenario cannot be read; `None` if it can, whether or not it can be driven through.
fn unreadable(named: &Named) -> Option<String> {
    let error = named.case.as_ref().err()?;
    matches!(error.cause(), EvalError::Data(_)).then(|| error.to_string())
}

/// A planner to evaluate.
#[derive(Clone, Copy)]
#[non_exhaustive]
pub enum EvaluatedPlanner<'a> {
    /// One of ours; [`PlannerName::Proposals`] stands for every proposal alone.
    Named(PlannerName),
    /// Any other.
    Custom(&'a dyn PlannerFactory),
}

impl From<PlannerName> for EvaluatedPlanner<'_> {
    fn from(planner: PlannerName) -> Self {
        Self::Named(planner)
    }
}

impl<'a> EvaluatedPlanner<'a> {
    /// Its name in results.
    pub fn name(&self) -> String {
        match self {
            Self::Named(planner) => planner.name().into(),
            Self::Custom(planner) => planner.name(),
        }
    }

    pub(crate) fn is_parallel(&self) -> bool {
        match self {
            Self::Named(_) => true,
            Self::Custom(planner) => planner.is_parallel(),
        }
    }

    pub(crate) fn build(
        &self,
        case: &Case,
        imagination: &'a dyn WorldModel,
        seed: Seed,
        config: &PlannerConfig,
    ) -> Result<Box<dyn Explain + 'a>, BoxError> {
        match self {
            Self::Named(planner) => Ok(planner.build(case, imagination, seed, config)?),
            Self::Custom(planner) => planner.build(case, seed),
        }
    }
}

/// The planner of a row: a requested one, or a single proposal.
enum RowPlanner<'a> {
    Requested(EvaluatedPlanner<'a>),
    Proposal {
        speed_fraction: f64,
        lateral_offset: f64,
    },
}

impl RowPlanner<'_> {
    fn name(&self) -> String {
        match *self {
            Self::Requested(ref planner) => planner.name(),
            Self::Proposal {
                speed_fraction,
                lateral_offset,
            } => ProposalKind::Idm {
                speed_fraction,
                lateral_offset,
            }
            .to_string(),
        }
    }
}

/// A drive that was just scored, for [`ClosedLoopEvaluation::through`]'s visitor.
pub struct VisitedDrive<'a> {
    /// Position of the scenario.
    pub index: usize,
    /// The scenario.
    pub case: &'a Case,
    /// The world it was driven in.
    pub world: &'a WorldName,
    /// Name of the planner.
    pub planner: &'a str,
    /// The drive.
    pub scored: &'a Scored,
}

/// Sees drives while they are in memory.
pub type DriveVisitor<'a> = &'a (dyn Fn(VisitedDrive<'_>) -> Result<(), BoxError> + Sync);

/// Planners, the worlds that they drive in, and the settings of the drives.
pub struct ClosedLoopEvaluation<'a> {
    /// The planners, in order.
    pub planners: &'a [EvaluatedPlanner<'a>],
    /// The worlds, in order.
    pub worlds: &'a [(WorldName, PlanningWorld)],
    /// The world that planners roll out.
    pub imagination: &'a dyn WorldModel,
    /// Settings of planners with rollouts.
    pub config: &'a PlannerConfig,
    /// Length and controller of the drives.
    pub drive: DriveConfig,
    /// Time limit of a planning step.
    pub budget: Option<Duration>,
    /// The seed, from which that of every scenario is forked by its position.
    pub seed: Seed,
}

impl ClosedLoopEvaluation<'_> {
    /// Drives through those of `cases` that the store wants, several at a time, and closes it. The
    /// monitor counts scenarios.
    ///
    /// # Errors
    /// An error of the visitor or the store, or [`EvalError::StoppedAndStored`]. A failed drive is
    /// an outcome.
    pub fn fill(
        &self,
        store: ResultStore<ScenarioDrives>,
        cases: impl Iterator<Item = Named> + Send,
        monitor: &dyn Monitor,
        visit: DriveVisitor<'_>,
    ) -> Result<Vec<Entry<ScenarioDrives>>, EvalError> {
        let done = store.indices();
        let shard = store.shard();
        let cases = cases
            .enumerate()
            .filter(|(index, _)| shard.holds(*index) && !done.contains(index))
            .take_while(|_| !monitor.is_stopped());
        let store = Mutex::new(store);
        let work = |index: usize, named: Named| {
            let entry = Entry {
                index,
                id: named.id.clone(),
                scores: self.through(index, named, monitor, visit)?,
            };
            // One that was stopped in its middle is not done.
            monitor.check()?;
            monitor.advance(1);
            // An entry is written before it is added, so a poisoned lock still holds a good store.
            let mut store = store.lock().unwrap_or_else(PoisonError::into_inner);
            store.add(entry)
        };
        let done: Vec<Result<(), EvalError>> = match self.is_parallel() {
            false => cases.map(|(index, named)| work(index, named)).collect(),
            true => evaluate(cases, |_, (index, named)| work(index, named)),
        };
        done.into_iter().collect::<Result<(), EvalError>>()?;
        if monitor.is_stopped() {
            let from = ResumePoint::Remaining;
            return Err(EvalError::StoppedAndStored { from });
        }
        let store = store.into_inner();
        store.unwrap_or_else(PoisonError::into_inner).close()
    }

    /// The outcomes of every planner in every world in the scenario at position `index`.
    ///
    /// # Errors
    /// An error of the visitor. A failed drive is an outcome, a scenario that cannot be read is
    /// [`ScenarioDrives::unreadable`].
    pub fn through(
        &self,
        index: usize,
        named: Named,
        monitor: &dyn Monitor,
        visit: DriveVisitor<'_>,
    ) -> Result<ScenarioDrives, EvalError> {
        if let Some(why) = unreadable(&named) {
            return Ok(ScenarioDrives {
                log_name: named.log_name,
                scenario_type: named.scenario_type,
                outcomes: Vec::new(),
                unreadable: Some(why),
            });
        }
        let seed = self.seed.fork(index as u64);
        let planners = self.row_planners();
        let mut outcomes = Vec::new();
        for (world, traffic) in self.worlds {
            for planner in &planners {
                let scored = match &named.case {
                    _ if monitor.is_stopped() => Err(EvalError::Stopped.to_string()),
                    Ok(case) => self.drive(planner, case, traffic, seed, monitor),
                    Err(error) => Err(error.to_string()),
                };
                if let (Ok((scored, _)), Ok(case)) = (&scored, &named.case) {
                    let visited = VisitedDrive {
                        index,
                        case,
                        world,
                        planner: &planner.name(),
                        scored,
                    };
                    visit(visited).map_err(EvalError::of_simulation)?;
                }
                let (finished, error) = match scored {
                    Ok((scored, milliseconds)) => (Some(finished(&scored, milliseconds)), None),
                    Err(error) => (None, Some(error)),
                };
                outcomes.push(DriveOutcome {
                    world: world.to_string(),
                    planner: planner.name(),
                    proposal: matches!(planner, RowPlanner::Proposal { .. }),
                    finished,
                    error,
                });
            }
        }
        Ok(ScenarioDrives {
            log_name: named.log_name,
            scenario_type: named.scenario_type,
            outcomes,
            unreadable: None,
        })
    }

    fn is_parallel(&self) -> bool {
        self.planners.iter().all(EvaluatedPlanner::is_parallel)
    }

    fn row_planners(&self) -> Vec<RowPlanner<'_>> {
        let mut planners = Vec::new();
        for &planner in self.planners {
            if !matches!(planner, EvaluatedPlanner::Named(PlannerName::Proposals)) {
                planners.push(RowPlanner::Requested(planner));
                continue;
            }
            let all = PdmConfig::default();
            for &lateral_offset in &all.lateral_offsets {
                for &speed_fraction in &all.speed_fractions {
                    planners.push(RowPlanner::Proposal {
                        speed_fraction,
                        lateral_offset,
                    });
                }
            }
        }
        planners
    }

    /// One drive with the milliseconds of a plan, or why it failed.
    fn drive<'p>(
        &'p self,
        planner: &RowPlanner<'p>,
        case: &Case,
        traffic: &PlanningWorld,
        seed: Seed,
        monitor: &dyn Monitor,
    ) -> Result<(Scored, f64), String> {
        let drive = || -> Result<(Scored, f64), BoxError> {
            let mut driver = self.build(planner, case, seed)?;
            let mut stoppable = StoppableDriver::new(&mut *driver, monitor);
            let mut timed = TimedDriver::new(&mut stoppable, self.budget);
            let scored = drive_and_score(
                &case.recording,
                &case.map,
                &mut *traffic.traffic(seed),
                &mut timed,
                &self.drive,
            )?;
            let milliseconds = timed.milliseconds_per_step();
            Ok((scored, milliseconds))
        };
        catch_panics(&planner.name(), drive).map_err(|error| sentence(&*error))
    }

    fn build<'p>(
        &'p self,
        planner: &RowPlanner<'p>,
        case: &Case,
        seed: Seed,
    ) -> Result<Box<dyn Explain + 'p>, BoxError> {
        match planner {
            RowPlanner::Requested(planner) => {
                planner.build(case, self.imagination, seed, self.config)
            }
            RowPlanner::Proposal {
                speed_fraction,
                lateral_offset,
            } => {
                let only = PdmConfig {
                    speed_fractions: vec![*speed_fraction],
                    lateral_offsets: vec![*lateral_offset],
                    ..PdmConfig::default()
                };
                Ok(Box::new(PdmClosed::new(only)?))
            }
        }
    }
}

/// A driver that fails once its monitor asks it to stop.
pub struct StoppableDriver<'a> {
    inner: &'a mut dyn Driver,
    monitor: &'a dyn Monitor,
}

impl<'a> StoppableDriver<'a> {
    /// A driver that `monitor` can stop.
    pub fn new(inner: &'a mut dyn Driver, monitor: &'a dyn Monitor) -> Self {
        Self { inner, monitor }
    }
}

impl Driver for StoppableDriver<'_> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        self.inner.start(initialization)
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        self.monitor.check()?;
        self.inner.drive(input)
    }
}

fn finished(scored: &Scored, milliseconds: f64) -> FinishedDrive {
    let metrics = scored.metrics.scores().into_iter();
    let metrics = metrics.filter_map(|(name, value)| Some((name, value?)));
    FinishedDrive {
        score: scored.score,
        milliseconds,
        metrics: metrics.collect(),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use gump_engine::SamplingConfig;
    use gump_model::Device;
    use gump_nuplan::closed_loop::Tracking;
    use gump_planner::{Candidate, SimpleDriver};
    use gump_scene::EgoState;

    use super::*;
    use crate::recordings::of_boxes;
    use crate::results::Header;
    use crate::shard::Shard;

    struct Panics;

    impl PlannerFactory for Panics {
        fn name(&self) -> String {
            "panics".into()
        }

        fn build(&self, _: &Case, _: Seed) -> Result<Box<dyn Explain + '_>, BoxError> {
            panic!("no wheels")
        }

        fn is_parallel(&self) -> bool {
            false
        }
    }

    /// What a planner does at a step; `None` is what it usually does.
    type Fault = fn(&PlannerInput<'_>) -> Result<Option<Trajectory>, BoxError>;

    /// Drives straight on, but in the scenario "b" has a fault at step 3.
    pub(crate) struct Faulty {
        name: &'static str,
        fault: Fault,
    }

    pub(crate) const PANICS: Faulty = Faulty {
        name: "panics",
        fault: |input| panic!("lost at step {}", input.iteration),
    };

    const LATE: Faulty = Faulty {
        name: "late",
        fault: |_| {
            std::thread::sleep(2 * BUDGET);
            Ok(None)
        },
    };

    pub(crate) const NOT_A_NUMBER: Faulty = Faulty {
        name: "not-a-number",
        fault: |input| {
            let next = EgoState {
                time_us: input.ego.time_us + 4_000_000,
                steering_angle: f64::NAN,
                ..*input.ego
            };
            Ok(Some(Trajectory::new(vec![*input.ego, next])?))
        },
    };

    /// A limit that no planner exceeds that does not sleep, on a busy machine either.
    const BUDGET: Duration = Duration::from_millis(600);

    struct FaultyDriver {
        inner: SimpleDriver,
        fault: Option<Fault>,
    }

    impl PlannerFactory for Faulty {
        fn name(&self) -> String {
            self.name.into()
        }

        fn build(&self, case: &Case, _: Seed) -> Result<Box<dyn Explain + '_>, BoxError> {
            let has_fault = case.recording.scenario().id == "b";
            Ok(Box::new(FaultyDriver {
                inner: SimpleDriver::default(),
                fault: has_fault.then_some(self.fault),
            }))
        }
    }

    impl Driver for FaultyDriver {
        fn name(&self) -> &str {
            "faulty"
        }

        fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
            self.inner.start(initialization)
        }

        fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
            let fault = self.fault.filter(|_| input.iteration == 3);
            match fault.map_or(Ok(None), |fault| fault(input))? {
                Some(plan) => Ok(plan),
                None => self.inner.drive(input),
            }
        }
    }

    impl Explain for FaultyDriver {
        fn candidates(&self) -> Vec<Candidate> {
            Vec::new()
        }
    }

    pub(crate) fn named(id: &str) -> Named {
        let mut scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 250,0\nego vehicle 0: 0,0 velocity 8,0\n\
             agent vehicle 1: 40,0 velocity 8,0\nhistory 1 future 10 dt 0.1",
        )
        .unwrap();
        scenario.id = id.into();
        Named {
            id: id.into(),
            log_name: "log".into(),
            scenario_type: "unknown".into(),
            case: of_boxes(scenario),
        }
    }

    fn check(planners: &[EvaluatedPlanner<'_>], work: impl FnOnce(&ClosedLoopEvaluation<'_>)) {
        let world = WorldName::Idm;
        let sampling = SamplingConfig::default();
        let loaded = PlanningWorld::load(&Device::Cpu, &world, &sampling).unwrap();
        let worlds = [(world, loaded)];
        let config = PlannerConfig::default();
        work(&ClosedLoopEvaluation {
            planners,
            worlds: &worlds,
            imagination: worlds[0].1.imagination(),
            config: &config,
            drive: DriveConfig {
                tracking: Tracking::Perfect,
                seconds: 3.0,
                keep_plans: false,
            },
            budget: Some(BUDGET),
            seed: Seed(0),
        });
    }

    const TWO: [EvaluatedPlanner<'_>; 2] = [
        EvaluatedPlanner::Named(PlannerName::Simple),
        EvaluatedPlanner::Custom(&Panics),
    ];

    fn fill(
        evaluation: &ClosedLoopEvaluation<'_>,
        shard: &str,
        ids: &[&str],
    ) -> Vec<Entry<ScenarioDrives>> {
        let folder = tempfile::tempdir().unwrap();
        let header = Header {
            benchmark: BENCHMARK.into(),
            shard: shard.parse::<Shard>().unwrap(),
            settings: toml::Table::new(),
        };
        let store = ResultStore::open(folder.path(), &header).unwrap();
        let cases = ids.iter().map(|id| named(id));
        evaluation.fill(store, cases, &(), &|_| Ok(())).unwrap()
    }

    #[test]
    fn planners_that_fail_in_one_scenario_leave_all_others_alone() {
        let planners = [
            PlannerName::Simple.into(),
            EvaluatedPlanner::Custom(&PANICS),
            EvaluatedPlanner::Custom(&LATE),
            EvaluatedPlanner::Custom(&NOT_A_NUMBER),
        ];
        check(&planners, |evaluation| {
            let entries = fill(evaluation, "1/1", &["a", "b", "c"]);
            let score = |scenario: usize, planner: usize| {
                let outcome = &entries[scenario].scores.outcomes[planner];
                outcome.finished.as_ref().map(|finished| finished.score)
            };
            let healthy = score(0, 0);
            assert!(healthy.is_some_and(|score| score > 0.0), "{healthy:?}");
            for planner in 0..planners.len() {
                assert_eq!(score(0, planner), healthy, "{planner}");
                assert_eq!(score(2, planner), healthy, "{planner}");
            }
            assert_eq!(score(1, 0), healthy);
            let errors = entries[1].scores.outcomes.iter();
            let errors: Vec<&str> = errors.filter_map(|o| o.error.as_deref()).collect();
            let [panics, late, not_a_number] = errors[..] else {
                panic!("{errors:?}")
            };
            assert_eq!(panics, "panics panicked: lost at step 3");
            assert!(late.starts_with("iteration 3: faulty: took "), "{late}");
            assert!(
                late.ends_with("ms for a plan, expected at most 600.0"),
                "{late}"
            );
            let expected = "iteration 3: faulty: ";
            assert!(not_a_number.starts_with(expected), "{not_a_number}");
            assert!(
                not_a_number.contains("not a finite number"),
                "{not_a_number}"
            );
        });
    }

    #[test]
    fn weights_and_scenarios_are_told_apart_by_their_contents() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.safetensors");
        let world = WorldName::Model(path.clone());
        let sums = |weights: &str, ids: &[&str]| {
            fs::write(&path, weights).unwrap();
            let ids: Vec<String> = ids.iter().map(ToString::to_string).collect();
            checksums(&ids, [&WorldName::Idm, &world, &world]).unwrap()
        };
        let first = sums("a", &["1", "2"]);
        let keys: Vec<&str> = first.keys().map(String::as_str).collect();
        assert_eq!(keys, [&world.to_string(), "scenario_ids"]);
        assert_eq!(sums("a", &["1", "2"]), first);
        let differing = |second: BTreeMap<String, String>| -> Vec<String> {
            let differs = second.into_iter().filter(|(key, sum)| first[key] != *sum);
            differs.map(|(key, _)| key).collect()
        };
        assert_eq!(differing(sums("b", &["1", "2"])), [world.to_string()]);
        assert_eq!(differing(sums("a", &["2", "1"])), ["scenario_ids"]);
        assert_eq!(differing(sums("a", &["12"])), ["scenario_ids"]);
        fs::remove_file(&path).unwrap();
        let error = checksums(&[], [&world]).unwrap_err().to_string();
        assert!(error.contains("w.safetensors"), "{error}");
    }

    #[test]
    fn a_drive_is_scored_and_a_planner_that_panics_has_failed() {
        check(&TWO, |evaluation| {
            let visited = AtomicUsize::new(0);
            let visit = |drive: VisitedDrive<'_>| {
                assert_eq!((drive.index, drive.planner), (7, "simple"));
                visited.fetch_add(1, Ordering::Relaxed);
                Ok(())
            };
            let driven = evaluation.through(7, named("a"), &(), &visit).unwrap();
            let [simple, panics] = &driven.outcomes[..] else {
                panic!("{driven:?}")
            };
            assert!(simple.finished.as_ref().unwrap().score > 0.0, "{simple:?}");
            let error = panics.error.as_deref();
            assert_eq!(error, Some("panics panicked: no wheels"));
            assert_eq!(visited.load(Ordering::Relaxed), 1);
        });
    }

    #[test]
    fn a_store_gets_the_scenarios_of_its_shard_that_it_lacks() {
        check(&TWO, |evaluation| {
            let entries = fill(evaluation, "2/2", &["a", "b", "c", "d"]);
            let ids: Vec<&str> = entries.iter().map(|entry| entry.id.as_str()).collect();
            assert_eq!(ids, ["b", "d"]);
        });
    }
}
