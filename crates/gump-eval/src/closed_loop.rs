//! Closed-loop drives of several planners in several worlds, with nuPlan's scores.
//!
//! [`ClosedLoopEvaluation`] drives through one scenario, or through all that a store of results does
//! not have yet; the outcomes of a scenario are stored as [`ScenarioDrives`]. A planner is one of
//! ours by name, one of PDM's proposals alone, or any [`PlannerFactory`]. One drive and its score are
//! in [`gump_planner::closed_loop`].

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
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
use crate::planners::{PlannerConfig, PlannerName, PlanningWorld, TimedDriver};
use crate::recordings::{Case, Named};
use crate::results::{Entry, ResultStore};
use crate::worlds::WorldName;
use crate::{EvalError, Monitor, ResumePoint};

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
}

/// The drives through one scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScenarioDrives {
    /// The log that the scenario belongs to.
    pub log_name: String,
    /// nuPlan's type of scenario; "unknown" for other formats.
    pub scenario_type: String,
    /// World by world, in each the planners in their order.
    pub outcomes: Vec<DriveOutcome>,
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

/// A planner to evaluate.
#[derive(Clone, Copy)]
#[non_exhaustive]
pub enum EvaluatedPlanner<'a> {
    /// One of ours; [`PlannerName::Proposals`] stands for every proposal alone.
    Named(PlannerName),
    /// Any other.
    Custom(&'a dyn PlannerFactory),
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
            Self::Requested(EvaluatedPlanner::Named(planner)) => planner.name().into(),
            Self::Requested(EvaluatedPlanner::Custom(planner)) => planner.name(),
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
    /// An error of the visitor. A failed drive is an outcome.
    pub fn through(
        &self,
        index: usize,
        named: Named,
        monitor: &dyn Monitor,
        visit: DriveVisitor<'_>,
    ) -> Result<ScenarioDrives, EvalError> {
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
        })
    }

    fn is_parallel(&self) -> bool {
        self.planners.iter().all(|planner| match planner {
            EvaluatedPlanner::Named(_) => true,
            EvaluatedPlanner::Custom(planner) => planner.is_parallel(),
        })
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

    /// One drive with the milliseconds of a plan, or why it failed. A planner that panics has failed
    /// like any other.
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
        match catch_unwind(AssertUnwindSafe(drive)) {
            Ok(driven) => driven.map_err(|error| sentence(&*error)),
            Err(panic) => {
                let message = panic
                    .downcast_ref::<&str>()
                    .map(|text| (*text).to_owned())
                    .or_else(|| panic.downcast_ref::<String>().cloned());
                let message = message.unwrap_or_else(|| "without a message".into());
                Err(format!("{} panicked: {message}", planner.name()))
            }
        }
    }

    fn build<'p>(
        &'p self,
        planner: &RowPlanner<'p>,
        case: &Case,
        seed: Seed,
    ) -> Result<Box<dyn Explain + 'p>, BoxError> {
        match planner {
            RowPlanner::Requested(EvaluatedPlanner::Named(planner)) => {
                Ok(planner.build(case, self.imagination, seed, self.config)?)
            }
            RowPlanner::Requested(EvaluatedPlanner::Custom(planner)) => planner.build(case, seed),
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
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use gump_engine::SamplingConfig;
    use gump_model::Device;
    use gump_nuplan::closed_loop::Tracking;

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

    fn named(id: &str) -> Named {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 250,0\nego vehicle 0: 0,0 velocity 8,0\n\
             agent vehicle 1: 40,0 velocity 8,0\nhistory 1 future 4 dt 0.1",
        )
        .unwrap();
        Named {
            id: id.into(),
            log_name: "log".into(),
            scenario_type: "unknown".into(),
            case: of_boxes(scenario),
        }
    }

    fn check(work: impl FnOnce(&ClosedLoopEvaluation<'_>)) {
        let world = WorldName::Idm;
        let sampling = SamplingConfig::default();
        let loaded = PlanningWorld::load(&Device::Cpu, &world, &sampling).unwrap();
        let worlds = [(world, loaded)];
        let planners = [
            EvaluatedPlanner::Named(PlannerName::Simple),
            EvaluatedPlanner::Custom(&Panics),
        ];
        let config = PlannerConfig::default();
        work(&ClosedLoopEvaluation {
            planners: &planners,
            worlds: &worlds,
            imagination: worlds[0].1.imagination(),
            config: &config,
            drive: DriveConfig {
                tracking: Tracking::Perfect,
                seconds: 3.0,
                keep_plans: false,
            },
            budget: None,
            seed: Seed(0),
        });
    }

    #[test]
    fn a_drive_is_scored_and_a_planner_that_panics_has_failed() {
        check(|evaluation| {
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
        check(|evaluation| {
            let folder = tempfile::tempdir().unwrap();
            let header = Header {
                benchmark: BENCHMARK.into(),
                shard: "2/2".parse::<Shard>().unwrap(),
                settings: toml::Table::new(),
            };
            let store = ResultStore::open(folder.path(), &header).unwrap();
            let cases = ["a", "b", "c", "d"].map(named).into_iter();
            let entries = evaluation.fill(store, cases, &(), &|_| Ok(())).unwrap();
            let ids: Vec<&str> = entries.iter().map(|entry| entry.id.as_str()).collect();
            assert_eq!(ids, ["b", "d"]);
        });
    }
}
