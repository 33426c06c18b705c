//! Planners by name, with a clock: `log`, `idm`, `simple`, `pdm-closed`, `imitation` and
//! `interactive`; and `grpc:HOST:PORT`, one in another process.

use std::ffi::OsStr;
use std::fmt;
use std::time::{Duration, Instant};

use clap::builder::{EnumValueParser, PossibleValue, TypedValueParser};
use clap::{Arg, Command};
use gump_model::Device;
use gump_nuplan::closed_loop::{Driver, Imagined, Mission, Moment, Replayed, Traffic};
use gump_nuplan::reactive_agents::NuplanIdm;
use gump_nuplan::tracking::Trajectory;
use gump_planner::{
    Explain, ImitationDriver, InteractiveDriver, InteractiveDriverConfig, LogDriver,
    NuplanIdmDriver, PdmClosed, PlanBudget, SimpleDriver, Worth,
};
use gump_rollout::worlds::Idm;
use gump_rollout::{BoxError, WorldModel};
use gump_scene::Seed;
use serde::{Serialize, Serializer};

use crate::cli::WrongArguments;
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
    /// What the imagined world has the ego do: the mean of several futures
    #[value(alias = "model")]
    Imitation,
    /// 15 policies and imitation, each imagined among others who react
    Interactive,
    /// PDM's 15 proposals, each alone to the end: two rows, the best of them and the best in each
    /// scenario, an oracle
    Proposals,
}

impl PlannerName {
    /// The name on the command line.
    pub(crate) fn name(self) -> &'static str {
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

    /// The planner for one case; `imagination` is the world that those think in who do.
    ///
    /// Error: `proposals`, who are many.
    pub(crate) fn build<'w>(
        self,
        case: &Case,
        imagination: &'w dyn WorldModel,
        seed: Seed,
        thinking: &Thinking,
    ) -> anyhow::Result<Box<dyn Explain + 'w>> {
        Ok(match self {
            Self::Log => Box::new(LogDriver::new(&case.recording, &case.after)),
            Self::Idm => Box::new(NuplanIdmDriver::default()),
            Self::Simple => Box::new(SimpleDriver::default()),
            Self::PdmClosed => Box::new(PdmClosed::default()),
            Self::Imitation => Box::new(thinking.imitation(imagination, seed)?),
            Self::Interactive => Box::new(thinking.interactive(imagination, seed)?),
            Self::Proposals => {
                let wrong = "proposals are fifteen planners, only evaluate closed-loop takes them";
                return Err(WrongArguments(wrong.into()).into());
            }
        })
    }
}

/// Who plans: one of ours, or whoever serves nuPlan's planner protocol.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Chosen {
    /// One of ours.
    Ours(PlannerName),
    /// The one at `HOST:PORT`.
    Remote(String),
}

impl Chosen {
    /// Refuses what this build cannot call.
    ///
    /// Error: [`WrongArguments`] for a planner in another process, in a build without `grpc`.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        if matches!(self, Self::Remote(_)) && !cfg!(feature = "grpc") {
            let wrong = format!(
                "--planner {self}: expected a build with the feature grpc, found one without; \
                 use cargo run -p xtask --features grpc -- evaluate closed-loop"
            );
            return Err(WrongArguments(wrong).into());
        }
        Ok(())
    }
}

impl fmt::Display for Chosen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ours(planner) => f.write_str(planner.name()),
            Self::Remote(address) => write!(f, "{REMOTE}{address}"),
        }
    }
}

impl Serialize for Chosen {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// How planners in other processes begin.
const REMOTE: &str = "grpc:";

/// Reads a [`Chosen`], and lists ours in the help.
#[derive(Clone)]
pub(crate) struct ChosenParser;

impl TypedValueParser for ChosenParser {
    type Value = Chosen;

    fn parse_ref(
        &self,
        command: &Command,
        arg: Option<&Arg>,
        value: &OsStr,
    ) -> Result<Chosen, clap::Error> {
        let told = value.to_str().unwrap_or_default();
        if told.starts_with(REMOTE) {
            return remote.parse_ref(command, arg, value);
        }
        let ours = EnumValueParser::<PlannerName>::new();
        ours.parse_ref(command, arg, value).map(Chosen::Ours)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        let elsewhere = "The planner that serves nuPlan's planner protocol there, any language";
        let elsewhere = PossibleValue::new("grpc:HOST:PORT").help(elsewhere);
        let ours = EnumValueParser::<PlannerName>::new();
        let ours: Vec<_> = ours.possible_values().into_iter().flatten().collect();
        Some(Box::new(ours.into_iter().chain([elsewhere])))
    }
}

/// `grpc:HOST:PORT`.
fn remote(told: &str) -> Result<Chosen, String> {
    let address = told.strip_prefix(REMOTE).unwrap_or(told);
    let port = address
        .rsplit_once(':')
        .filter(|(host, _)| !host.is_empty());
    match port.and_then(|(_, port)| port.parse().ok()) {
        Some(1u16..) => Ok(Chosen::Remote(address.into())),
        _ => Err("expected grpc:HOST:PORT with a port from 1 to 65535".into()),
    }
}

/// How planners that imagine do it.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct Thinking {
    /// Futures that imagining planners see
    #[arg(long, value_name = "N", default_value_t = 4)]
    futures: usize,
    /// Agents that are imagined, those nearest to the ego
    #[arg(long, value_name = "N", default_value_t = 12)]
    nearest: usize,
    /// Seconds that the interactive planner imagines
    #[arg(long, value_name = "S", default_value_t = 4.0)]
    horizon: f64,
    /// The interactive planner stops imagining after so long [default: no limit]
    #[arg(long, value_name = "MS")]
    think_ms: Option<f64>,
    /// Planners that imagine decide at every N-th step
    #[arg(long, value_name = "N", default_value_t = 5)]
    replan_every: usize,
    /// Discount per half second; without it a future is worth the score of the whole drive
    #[arg(long, value_name = "X")]
    discount: Option<f64>,
}

impl Thinking {
    /// The interactive planner with a clock.
    ///
    /// Error: a number out of its range.
    pub(crate) fn interactive<'w>(
        &self,
        world: &'w dyn WorldModel,
        seed: Seed,
    ) -> anyhow::Result<InteractiveDriver<'w>> {
        let wall = match self.think_ms {
            Some(ms) if !(ms > 0.0 && ms.is_finite()) => {
                let wrong = format!("--think-ms: expected a number above 0, found {ms}");
                return Err(WrongArguments(wrong).into());
            }
            ms => ms.map(|ms| Duration::from_secs_f64(ms * 1e-3)),
        };
        let config = InteractiveDriverConfig {
            n_futures: self.futures,
            seed,
            replan_every: self.replan_every,
            worth: self
                .discount
                .map_or(Worth::Rollout, |gamma| Worth::DiscountedStep { gamma }),
            budget: PlanBudget {
                nearest: self.nearest,
                horizon: self.horizon,
                wall,
            },
            ..InteractiveDriverConfig::default()
        };
        let began = Instant::now();
        Ok(InteractiveDriver::new(world, config)?.with_clock(move || began.elapsed()))
    }

    /// The imitating planner.
    ///
    /// Error: a number out of its range.
    fn imitation<'w>(
        &self,
        world: &'w dyn WorldModel,
        seed: Seed,
    ) -> anyhow::Result<ImitationDriver<'w>> {
        Ok(ImitationDriver::new(
            world,
            self.futures,
            self.replan_every,
            seed,
        )?)
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
        device: &Device,
        name: &WorldName,
        sampling: &gump_model::SamplingConfig,
    ) -> anyhow::Result<Self> {
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

    /// As [`Surroundings::load`], to imagine in: what planners look ahead fits a window that grows,
    /// in which nothing is read twice.
    ///
    /// Error: weights that cannot be read.
    pub(crate) fn load_imagination(
        device: &Device,
        name: &WorldName,
        sampling: &gump_model::SamplingConfig,
    ) -> anyhow::Result<Self> {
        let growing = gump_model::SamplingConfig {
            cache: gump_model::CacheMode::Growing,
            ..sampling.clone()
        };
        Self::load(device, name, &growing)
    }

    /// A world to imagine in: the network where there is one, else reactive rules.
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
