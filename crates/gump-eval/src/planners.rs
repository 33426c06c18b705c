//! Planners by name, the worlds that they roll out and drive in, and timing.
#![allow(
    clippy::disallowed_methods,
    reason = "planners are timed; layers 0-3 may not look at the clock"
)]

use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::str::FromStr;
use std::time::{Duration, Instant};

use gump_engine::{CacheMode, SamplingConfig};
use gump_model::Device;
use gump_nuplan::closed_loop::{
    Driver, ImaginedTraffic, PlannerInitialization, PlannerInput, Replayed, Traffic,
};
use gump_nuplan::reactive_agents::NuplanIdm;
use gump_nuplan::tracking::Trajectory;
use gump_planner::{
    Aggregate, Allocation, Explain, ImitationDriver, InteractiveDriver, InteractiveDriverConfig,
    LogDriver, NuplanIdmDriver, PdmClosed, PlanBudget, SimpleDriver, ValueEstimate, WarmStart,
};
use gump_rollout::worlds::{ConstantVelocity, Idm};
use gump_rollout::{BoxError, WorldModel};
use gump_scene::Seed;
use serde::{Serialize, Serializer};

use crate::recordings::Case;
use crate::worlds::{World, WorldName};
use crate::{ArgumentError, EvalError};

/// A planner by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PlannerName {
    /// The recorded driver: an oracle.
    Log,
    /// nuPlan's IDM planner.
    Idm,
    /// Drives straight on.
    Simple,
    /// PDM-Closed.
    PdmClosed,
    /// The mean of the ego's motion in the rollouts of a world.
    Imitation,
    /// Policies, lane changes among them, and imitation, each rolled out among reactive agents.
    Interactive,
    /// PDM's 15 proposals, each as a separate planner.
    Proposals,
}

impl PlannerName {
    /// Every planner, simple ones first.
    pub const ALL: [Self; 7] = [
        Self::Log,
        Self::Idm,
        Self::Simple,
        Self::PdmClosed,
        Self::Imitation,
        Self::Interactive,
        Self::Proposals,
    ];

    /// Its name, as [`FromStr`] reads it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Log => "log",
            Self::Idm => "idm",
            Self::Simple => "simple",
            Self::PdmClosed => "pdm-closed",
            Self::Imitation => "imitation",
            Self::Interactive => "interactive",
            Self::Proposals => "proposals",
        }
    }

    /// A short description, as a sentence without a final stop.
    pub fn description(self) -> &'static str {
        match self {
            Self::Log => "The recorded driver: an oracle",
            Self::Idm => "nuPlan's IDM planner: the route at the speed limit, following the leader",
            Self::Simple => "Straight on",
            Self::PdmClosed => "PDM-Closed: 15 proposals against a constant-velocity forecast",
            Self::Imitation => "Mean ego trajectory of the world model over several futures",
            Self::Interactive => {
                "19 policies, lane changes and imitation, each rolled out among reactive agents"
            }
            Self::Proposals => {
                "PDM's 15 proposals, each alone to the end: two rows, the best of them and the best \
                 in each scenario, an oracle"
            }
        }
    }

    /// The planner for one case; `imagination` is the world that planners with rollouts use.
    ///
    /// # Errors
    /// [`Self::Proposals`], which stands for many planners, and a configuration out of its range.
    pub fn build<'w>(
        self,
        case: &Case,
        imagination: &'w dyn WorldModel,
        seed: Seed,
        config: &PlannerConfig,
    ) -> Result<Box<dyn Explain + 'w>, EvalError> {
        Ok(match self {
            Self::Log => Box::new(LogDriver::new(&case.recording, &case.after)),
            Self::Idm => Box::new(NuplanIdmDriver::default()),
            Self::Simple => Box::new(SimpleDriver::default()),
            Self::PdmClosed => Box::new(PdmClosed::default()),
            Self::Imitation => Box::new(config.imitation(imagination, seed)?),
            Self::Interactive => Box::new(config.interactive(imagination, seed)?),
            Self::Proposals => return Err(ArgumentError::SeveralPlanners.into()),
        })
    }
}

impl FromStr for PlannerName {
    type Err = EvalError;

    fn from_str(name: &str) -> Result<Self, EvalError> {
        if name == "model" {
            return Ok(Self::Imitation);
        }
        let found = Self::ALL.into_iter().find(|planner| planner.name() == name);
        found.ok_or_else(|| {
            let found = name.into();
            ArgumentError::NoSuchPlanner { found }.into()
        })
    }
}

impl fmt::Display for PlannerName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Serialize for PlannerName {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// Settings of planners that use rollouts.
#[derive(Clone, Debug, PartialEq)]
pub struct PlannerConfig {
    /// Number of futures.
    pub futures: usize,
    /// Distribution of rollouts over the candidates of the interactive planner.
    pub allocation: Allocation,
    /// What the last decision of the interactive planner spares the next one.
    pub warm_start: WarmStart,
    /// Fixed drives of the world's own ego among the candidates of the interactive planner, from 2
    /// on; with 0 or 1 there are none.
    pub network_modes: usize,
    /// Aggregation of the values of a candidate's futures into one.
    pub aggregate: Aggregate,
    /// Weight of a future in which other agents keep their velocity, 0 to 1.
    pub hedge: f64,
    /// Bonus for the previous choice, added to its value.
    pub hysteresis: f64,
    /// Number of agents to simulate, those nearest to the ego.
    pub nearest: usize,
    /// Horizon of the interactive planner, seconds.
    pub horizon: f64,
    /// Time limit for the rollouts of the interactive planner.
    pub wall: Option<Duration>,
    /// Planners with rollouts decide once in this many steps.
    pub replan_every: usize,
    /// Discount per half second; without one a future has the score of the whole drive.
    pub discount: Option<f64>,
}

impl Default for PlannerConfig {
    /// Four futures of four seconds are the paper's; a decision every half second, the step of the
    /// networks, and twelve agents are chosen by hand.
    fn default() -> Self {
        Self {
            futures: 4,
            allocation: Allocation::default(),
            warm_start: WarmStart::default(),
            network_modes: InteractiveDriverConfig::default().network_modes,
            aggregate: Aggregate::default(),
            hedge: InteractiveDriverConfig::default().hedge,
            hysteresis: 0.0,
            nearest: 12,
            horizon: 4.0,
            wall: None,
            replan_every: 5,
            discount: None,
        }
    }
}

impl PlannerConfig {
    /// The interactive planner with a clock.
    ///
    /// # Errors
    /// A number out of its range.
    pub fn interactive<'w>(
        &self,
        world: &'w dyn WorldModel,
        seed: Seed,
    ) -> Result<InteractiveDriver<'w>, EvalError> {
        let config = InteractiveDriverConfig {
            n_futures: self.futures,
            allocation: self.allocation,
            warm_start: self.warm_start,
            network_modes: self.network_modes,
            aggregate: self.aggregate,
            hedge: self.hedge,
            hysteresis: self.hysteresis,
            seed,
            replan_every: self.replan_every,
            value: self.discount.map_or(ValueEstimate::Rollout, |gamma| {
                ValueEstimate::DiscountedStep { gamma }
            }),
            budget: PlanBudget {
                nearest: self.nearest,
                horizon: self.horizon,
                wall: self.wall,
            },
            ..InteractiveDriverConfig::default()
        };
        let began = Instant::now();
        Ok(InteractiveDriver::new(world, config)?.with_clock(move || began.elapsed()))
    }

    /// The imitating planner.
    ///
    /// # Errors
    /// A number out of its range.
    pub fn imitation<'w>(
        &self,
        world: &'w dyn WorldModel,
        seed: Seed,
    ) -> Result<ImitationDriver<'w>, EvalError> {
        let (futures, every) = (self.futures, self.replan_every);
        Ok(ImitationDriver::new(world, futures, every, seed)?)
    }
}

/// The result of a planner's work. A planner that panics has failed like any other, so that the
/// others and the other scenarios go on.
pub(crate) fn catch_panics<T>(
    planner: &str,
    work: impl FnOnce() -> Result<T, BoxError>,
) -> Result<T, BoxError> {
    // Whatever the planner left half done is dropped with it.
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let message = panic
            .downcast_ref::<&str>()
            .copied()
            .or_else(|| panic.downcast_ref::<String>().map(String::as_str));
        let message = message.unwrap_or("without a message");
        Err(format!("{planner} panicked: {message}").into())
    })
}

/// Part of the seed of traffic.
const TRAFFIC: u64 = 0x7261_6666;

/// The traffic of a drive and the world that planners roll out, by the world's name.
pub struct PlanningWorld {
    name: WorldName,
    learned: Option<World>,
    rules: Idm,
}

impl PlanningWorld {
    /// Loads what the world needs, once for all scenarios.
    ///
    /// # Errors
    /// Weights that cannot be read.
    pub fn load(
        device: &Device,
        name: &WorldName,
        sampling: &SamplingConfig,
    ) -> Result<Self, EvalError> {
        let learned = match name {
            WorldName::Model(_) => Some(World::without_log(device, name, sampling)?),
            _ => None,
        };
        Ok(Self {
            name: name.clone(),
            learned,
            rules: Idm::default(),
        })
    }

    /// As [`PlanningWorld::load`], for rollouts of a planner: a planner's horizon fits into a
    /// growing window, in which nothing is computed twice.
    ///
    /// # Errors
    /// Weights that cannot be read.
    pub fn load_imagination(
        device: &Device,
        name: &WorldName,
        sampling: &SamplingConfig,
    ) -> Result<Self, EvalError> {
        let growing = SamplingConfig {
            cache: CacheMode::Growing,
            ..sampling.clone()
        };
        Self::load(device, name, &growing)
    }

    /// The world that planners roll out. Instead of the log, which knows the future, reactive rules.
    pub fn imagination(&self) -> &dyn WorldModel {
        match (&self.name, &self.learned) {
            (_, Some(world)) => world.model(),
            (WorldName::ConstantVelocity, None) => &ConstantVelocity,
            _ => &self.rules,
        }
    }

    /// The traffic of one drive. Its draws are not those of a planner with the same seed, whose
    /// imagination would otherwise foresee them.
    pub fn traffic(&self, seed: Seed) -> Box<dyn Traffic + '_> {
        let seed = seed.fork(TRAFFIC);
        match (&self.name, &self.learned) {
            (WorldName::Log, _) => Box::new(Replayed),
            (WorldName::Idm, _) => Box::new(NuplanIdm::default()),
            (_, Some(world)) => Box::new(ImaginedTraffic::new(world.model(), seed)),
            (_, None) => Box::new(ImaginedTraffic::new(&ConstantVelocity, seed)),
        }
    }
}

/// A driver with timing and, optionally, a time limit.
pub struct TimedDriver<'a> {
    inner: &'a mut dyn Driver,
    limit: Option<Duration>,
    spent: Duration,
    steps: u32,
}

impl<'a> TimedDriver<'a> {
    /// Times a driver; a step longer than `limit` is a failure.
    pub fn new(inner: &'a mut dyn Driver, limit: Option<Duration>) -> Self {
        Self {
            inner,
            limit,
            spent: Duration::ZERO,
            steps: 0,
        }
    }

    /// Mean milliseconds per step so far; 0 before the first.
    pub fn milliseconds_per_step(&self) -> f64 {
        self.spent.as_secs_f64() * 1e3 / f64::from(self.steps.max(1))
    }
}

impl Driver for TimedDriver<'_> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        self.inner.start(initialization)
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let began = Instant::now();
        let plan = self.inner.drive(input);
        let took = began.elapsed();
        self.spent += took;
        self.steps += 1;
        match self.limit {
            Some(limit) if took > limit => Err(format!(
                "took {:.1} ms for a plan, expected at most {:.1}",
                took.as_secs_f64() * 1e3,
                limit.as_secs_f64() * 1e3
            )
            .into()),
            _ => plan,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_read_as_they_are_written() {
        for planner in PlannerName::ALL {
            assert_eq!(planner.to_string().parse::<PlannerName>().unwrap(), planner);
        }
        let error = "racer".parse::<PlannerName>().unwrap_err();
        assert!(error.is_argument());
        assert!(error.to_string().contains("pdm-closed"), "{error}");
    }
}
