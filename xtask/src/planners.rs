//! Planners by name, with a clock: `log`, `idm`, `simple`, `pdm-closed` and `interactive`.

use std::time::{Duration, Instant};

use gump_model::Device;
use gump_planner::{
    Explain, Interactive, InteractiveConfig, LogDriver, NuplanIdmDriver, PdmClosed, Planned,
    SimpleDriver,
};
use gump_rollout::closed_loop::{Driver, Imagined, Mission, Moment, Replayed, Traffic};
use gump_rollout::dynamics::Trajectory;
use gump_rollout::worlds::{Idm, NuplanIdm};
use gump_rollout::{BoxError, WorldModel};
use gump_scene::Seed;
use serde::Serialize;

use crate::recordings::Case;
use crate::worlds::{World, WorldName};

/// Who plans.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum PlannerName {
    /// The recorded driver: an oracle
    Log,
    /// nuPlan's IDM planner: the route, at the limit, behind whoever is ahead
    Idm,
    /// Straight on
    Simple,
    /// PDM-Closed: 15 proposals against a constant-velocity forecast
    PdmClosed,
    /// 15 proposals, each imagined in the world
    Interactive,
}

impl PlannerName {
    /// The name on the command line.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Log => "log",
            Self::Idm => "idm",
            Self::Simple => "simple",
            Self::PdmClosed => "pdm-closed",
            Self::Interactive => "interactive",
        }
    }

    /// The planner for one case; `imagination` is the world that the interactive one thinks in.
    pub(crate) fn build<'w>(
        self,
        case: &Case,
        imagination: &'w dyn WorldModel,
        seed: Seed,
        replan_every: usize,
    ) -> anyhow::Result<Box<dyn Explain + 'w>> {
        Ok(match self {
            Self::Log => Box::new(LogDriver::new(&case.recording, &case.after)),
            Self::Idm => Box::new(NuplanIdmDriver::default()),
            Self::Simple => Box::new(SimpleDriver::default()),
            Self::PdmClosed => Box::new(PdmClosed::default()),
            Self::Interactive => {
                let config = InteractiveConfig {
                    seed,
                    ..InteractiveConfig::default()
                };
                Box::new(Planned::new(
                    Interactive::new(imagination, config)?,
                    replan_every,
                ))
            }
        })
    }
}

/// What the ego meets and what planners imagine, by the name of the world.
pub(crate) struct Surroundings {
    name: WorldName,
    learned: Option<World>,
    rules: Idm,
}

impl Surroundings {
    /// Loads what the world needs, once for all scenarios.
    ///
    /// Error: weights that cannot be read.
    pub(crate) fn load(
        name: &WorldName,
        sampling: &gump_model::SamplingConfig,
    ) -> anyhow::Result<Self> {
        let learned = match name {
            WorldName::Model(_) => Some(World::without_log(&Device::Cpu, name, sampling)?),
            _ => None,
        };
        Ok(Self {
            name: name.clone(),
            learned,
            rules: Idm::default(),
        })
    }

    /// The world planners imagine in: the network where there is one, else reactive rules.
    pub(crate) fn imagination(&self) -> &dyn WorldModel {
        match &self.learned {
            Some(world) => world.model(),
            None => &self.rules,
        }
    }

    /// The traffic of one drive.
    pub(crate) fn traffic(&self, seed: Seed) -> Box<dyn Traffic + '_> {
        match (&self.name, &self.learned) {
            (WorldName::Log, _) => Box::new(Replayed),
            (WorldName::Idm, _) => Box::new(NuplanIdm::default()),
            (_, Some(world)) => Box::new(Imagined::new(world.model(), seed)),
            (_, None) => Box::new(Imagined::new(&gump_rollout::worlds::ConstantVelocity, seed)),
        }
    }
}

/// A driver with a stopwatch and, perhaps, a limit.
pub(crate) struct Timed<'a> {
    inner: &'a mut dyn Driver,
    limit: Option<Duration>,
    spent: Duration,
    steps: u32,
}

impl<'a> Timed<'a> {
    /// Watches a driver; a step longer than `limit` is a failure.
    pub(crate) fn new(inner: &'a mut dyn Driver, limit: Option<Duration>) -> Self {
        Self {
            inner,
            limit,
            spent: Duration::ZERO,
            steps: 0,
        }
    }

    /// Mean milliseconds per step so far; 0 before the first.
    pub(crate) fn milliseconds_per_step(&self) -> f64 {
        self.spent.as_secs_f64() * 1e3 / f64::from(self.steps.max(1))
    }
}

impl Driver for Timed<'_> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn start(&mut self, mission: &Mission<'_>) -> Result<(), BoxError> {
        self.inner.start(mission)
    }

    fn drive(&mut self, moment: &Moment<'_>) -> Result<Trajectory, BoxError> {
        let began = Instant::now();
        let plan = self.inner.drive(moment);
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
