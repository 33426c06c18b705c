//! Planners on the command line: ours by name, those in other processes by `grpc:HOST:PORT`, and
//! the settings of planners with rollouts.

use std::ffi::OsStr;
use std::fmt;
use std::time::Duration;

use clap::builder::{PossibleValue, TypedValueParser};
use clap::{Arg, Command};
use gump_engine::SamplingConfig;
use gump_eval::planners::{PlannerConfig, PlannerName};
use gump_planner::{Aggregate, Allocation, WarmStart};
use serde::{Serialize, Serializer};

use crate::choices::{AGGREGATES, ALLOCATIONS, WARM_STARTS, named, one_of};
use crate::cli::WrongArguments;

/// Our planners as the help lists them.
fn ours() -> Vec<PossibleValue> {
    let value = |planner: PlannerName| {
        let value = PossibleValue::new(planner.name()).help(planner.description());
        match planner {
            PlannerName::Imitation => value.alias("model"),
            _ => value,
        }
    };
    PlannerName::ALL.map(value).into()
}

/// The parser of the name of one of our planners.
pub(crate) fn planner() -> impl TypedValueParser<Value = PlannerName> {
    named(ours())
}

/// A planner: one of ours, or a process that serves nuPlan's planner protocol.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Chosen {
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

/// Prefix of the names of planners in other processes.
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
        let name = value.to_str().unwrap_or_default();
        if name.starts_with(REMOTE) {
            return remote.parse_ref(command, arg, value);
        }
        let known = || ours().into_iter().any(|known| known.get_name() == name);
        if !known() && name != "model" {
            // The names of ours, and the form of the others.
            let all: Vec<String> = self
                .possible_values()
                .into_iter()
                .flatten()
                .map(|value| value.get_name().to_owned())
                .collect();
            let wrong = format!(
                "--planner: expected one of {}, found {name}\n",
                all.join(", ")
            );
            return Err(clap::Error::raw(
                clap::error::ErrorKind::InvalidValue,
                wrong,
            ));
        }
        let ours = planner().parse_ref(command, arg, value);
        ours.map(Chosen::Ours)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        let elsewhere = "The planner that serves nuPlan's planner protocol there, any language";
        let elsewhere = PossibleValue::new("grpc:HOST:PORT").help(elsewhere);
        Some(Box::new(ours().into_iter().chain([elsewhere])))
    }
}

/// `grpc:HOST:PORT`.
fn remote(text: &str) -> Result<Chosen, String> {
    let address = text.strip_prefix(REMOTE).unwrap_or(text);
    let port = address
        .rsplit_once(':')
        .filter(|(host, _)| !host.is_empty());
    match port.and_then(|(_, port)| port.parse().ok()) {
        Some(1u16..) => Ok(Chosen::Remote(address.into())),
        _ => Err("expected grpc:HOST:PORT with a port from 1 to 65535".into()),
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum YieldingName {
    /// Rules resample those that would hit it, whoever has the right of way
    Ruled,
    /// As the network itself reacts
    Learned,
}

impl YieldingName {
    /// The sampling of a world with this choice.
    pub(crate) fn sampling(self, sampling: &SamplingConfig) -> SamplingConfig {
        SamplingConfig {
            yields_to_driven: matches!(self, Self::Ruled),
            ..sampling.clone()
        }
    }
}

/// The most futures of a candidate and the most drives of the network's own ego: the planner has four
/// and none, and each is simulated at every decision.
const MOST_FUTURES: usize = 1024;
const MOST_MODES: usize = 64;

/// Settings of planners with rollouts.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct ImaginationArgs {
    /// Futures that planners with rollouts simulate
    #[arg(long, value_name = "N", default_value_t = 4)]
    futures: usize,
    /// Allocation of futures to the interactive planner's candidates
    #[arg(long, value_parser = one_of(ALLOCATIONS), default_value_t = Allocation::Halving)]
    allocation: Allocation,
    /// What a decision of the interactive planner takes over from the last one
    #[arg(long, value_parser = one_of(WARM_STARTS), default_value_t = PlannerConfig::default().warm_start)]
    warm_start: WarmStart,
    /// Drives of the network's own ego among the interactive planner's candidates, from 2 on
    #[arg(long, value_name = "N", default_value_t = PlannerConfig::default().network_modes)]
    network_modes: usize,
    /// Aggregation of a candidate's scores over its futures
    #[arg(long, value_parser = one_of(AGGREGATES), default_value_t = Aggregate::Mean)]
    aggregate: Aggregate,
    /// Weight of a future in which the others keep their velocity, 0 to 1
    #[arg(long, value_name = "X", default_value_t = PlannerConfig::default().hedge)]
    hedge: f64,
    /// Bonus on the score of the previous choice, 0 to 1
    #[arg(long, value_name = "X", default_value_t = PlannerConfig::default().hysteresis)]
    hysteresis: f64,
    /// Agents that are simulated, those nearest to the ego
    #[arg(long, value_name = "N", default_value_t = 12)]
    nearest: usize,
    /// Length of the interactive planner's rollouts, seconds
    #[arg(long, value_name = "S", default_value_t = 4.0)]
    horizon: f64,
    /// Time limit of the interactive planner's rollouts [default: no limit]
    #[arg(long, value_name = "MS")]
    think_ms: Option<f64>,
    /// Planners with rollouts decide at every N-th step
    #[arg(long, value_name = "N", default_value_t = 5)]
    replan_every: usize,
    /// Reaction of simulated agents to the interactive planner's ego
    #[arg(long, value_enum, default_value_t = YieldingName::Ruled)]
    yielding: YieldingName,
    /// Discount per half second; without it a future's score is that of the whole drive
    #[arg(long, value_name = "X")]
    discount: Option<f64>,
}

impl ImaginationArgs {
    /// Sampling of the world of the rollouts: `sampling` with the choice of `--yielding`.
    pub(crate) fn sampling(&self, sampling: &SamplingConfig) -> SamplingConfig {
        self.yielding.sampling(sampling)
    }

    /// Converts the arguments to a [`PlannerConfig`].
    ///
    /// Error: [`WrongArguments`] for a number out of its range.
    pub(crate) fn config(&self) -> anyhow::Result<PlannerConfig> {
        let wall = match self.think_ms {
            Some(ms) if !(ms > 0.0 && ms.is_finite()) => {
                let wrong = format!("--think-ms: expected a number above 0, found {ms}");
                return Err(WrongArguments(wrong).into());
            }
            ms => ms.map(|ms| Duration::from_secs_f64(ms * 1e-3)),
        };
        for (flag, number) in [
            ("--futures", self.futures),
            ("--nearest", self.nearest),
            ("--replan-every", self.replan_every),
        ] {
            if number == 0 {
                let wrong = format!("{flag}: expected at least 1, found 0");
                return Err(WrongArguments(wrong).into());
            }
        }
        for (flag, number, most) in [
            ("--futures", self.futures, MOST_FUTURES),
            ("--network-modes", self.network_modes, MOST_MODES),
        ] {
            if number > most {
                let wrong = format!("{flag}: expected at most {most}, found {number}");
                return Err(WrongArguments(wrong).into());
            }
        }
        for (flag, share) in [("--hedge", self.hedge), ("--hysteresis", self.hysteresis)] {
            if !(0.0..=1.0).contains(&share) {
                let wrong = format!("{flag}: expected a number from 0 to 1, found {share}");
                return Err(WrongArguments(wrong).into());
            }
        }
        let wrong = if !(0.5..=4.0).contains(&self.horizon) {
            format!(
                "--horizon: expected a number of seconds from 0.5 to 4, found {}",
                self.horizon
            )
        } else if let Some(x) = self.discount.filter(|x| !(*x > 0.0 && *x <= 1.0)) {
            format!("--discount: expected a number above 0 and at most 1, found {x}")
        } else {
            String::new()
        };
        if !wrong.is_empty() {
            return Err(WrongArguments(wrong).into());
        }
        Ok(PlannerConfig {
            futures: self.futures,
            allocation: self.allocation,
            warm_start: self.warm_start,
            network_modes: self.network_modes,
            aggregate: self.aggregate,
            hedge: self.hedge,
            hysteresis: self.hysteresis,
            nearest: self.nearest,
            horizon: self.horizon,
            wall,
            replan_every: self.replan_every,
            discount: self.discount,
        })
    }
}
