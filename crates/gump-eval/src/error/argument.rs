//! Requests that do not exist or contradict themselves.

use std::fmt;
use std::path::PathBuf;

use gump_engine::LightSource;
use gump_synthesis::Profile;

use crate::fresh::PREFIX;
use crate::planners::PlannerName;
use crate::worlds::WorldName;

/// Why a request cannot be followed; another argument, rather than another file, would help.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ArgumentError {
    /// No world has this name.
    #[error(
        "expected log, idm, constant-velocity or model:WEIGHTS{}",
        weights_hint(found, *is_path)
    )]
    NoSuchWorld {
        /// The name.
        found: String,
        /// Whether it looks like the path of a file of weights.
        is_path: bool,
    },
    /// A file of weights is needed, and this world has none.
    #[error("expected a file of weights, found the world {found}")]
    NoWeights {
        /// The world.
        found: WorldName,
    },
    /// The world `log` replays one scenario, and none was given.
    #[error("the world log needs a scenario to replay")]
    LogWithoutScenario,
    /// Lights as recorded are those of one scenario, and none was given.
    #[error("lights as recorded need a world of one scenario; expected model or hold")]
    RecordedLightsWithoutScenario,
    /// A source of lights that worlds cannot be built with.
    #[error("expected lights of model, hold or log, found {found}")]
    UnsupportedLights {
        /// The source.
        found: LightSource,
    },
    /// No planner has this name.
    #[error(
        "no planner is called {found}, expected one of {}",
        PlannerName::ALL.map(PlannerName::name).join(", ")
    )]
    NoSuchPlanner {
        /// The name.
        found: String,
    },
    /// [`PlannerName::Proposals`] where one planner is needed.
    #[error("proposals are fifteen planners, only evaluate closed-loop takes them")]
    SeveralPlanners,
    /// No profile of synthetic scenes has this name.
    #[error(
        "expected one of the profiles {}, found {found:?}",
        Profile::ALL.map(Profile::name).join(", ")
    )]
    NoSuchProfile {
        /// The name.
        found: String,
    },
    /// The name of a stream of scenes has a seed that is not a number.
    #[error("expected a whole number as seed in {PREFIX}{stream}")]
    StreamSeed {
        /// The name, without its prefix.
        stream: String,
    },
    /// There is no path to read scenarios from.
    #[error("expected scenarios, found none")]
    NoScenarios,
    /// A name like `FILE#ID` without a matching scenario.
    #[error("no scenario {wanted} in {}", path.display())]
    NoSuchScenario {
        /// The requested index or id.
        wanted: String,
        /// The file or folder.
        path: PathBuf,
    },
    /// There is no source of rollouts to score.
    #[error("expected a source of rollouts, found none")]
    NoRollouts,
    /// A folder has no files of futures.
    #[error(
        "expected files named *.binproto*, found none in the folder {}",
        folder.display()
    )]
    NoRolloutFiles {
        /// The folder.
        folder: PathBuf,
    },
    /// Predictions of trajectory heads are requested of a network without heads.
    #[error(
        "expected a sequence network with trajectory heads, found {found}: {}",
        path.display()
    )]
    NoTrajectoryHeads {
        /// The network found.
        found: HeadlessNetwork,
        /// Its file.
        path: PathBuf,
    },
    /// The shard of this process is not known.
    #[error(transparent)]
    Shard(#[from] ShardError),
}

/// A network without trajectory heads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum HeadlessNetwork {
    /// A network with relative attention, which never has heads.
    Relative,
    /// A sequence network that was trained without heads.
    Sequence,
}

impl fmt::Display for HeadlessNetwork {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Relative => "a relative network",
            Self::Sequence => "one without",
        })
    }
}

/// Why text or the variables of a scheduler do not say which shard is meant.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ShardError {
    /// The text is not `K/N`, or K is not from 1 to N.
    #[error("expected K/N with K from 1 to N, like 2/8")]
    Malformed {
        /// The text.
        found: String,
    },
    /// An environment variable is not a number.
    #[error("expected a number in {variable}, found \"{found}\"")]
    Variable {
        /// Its name.
        variable: &'static str,
        /// Its value.
        found: String,
    },
    /// No variable of a known scheduler is set.
    #[error(
        "expected SLURM_ARRAY_TASK_ID, SLURM_PROCID or JOB_COMPLETION_INDEX for auto, found none \
         of them"
    )]
    NoScheduler,
    /// The scheduler does not say how many shards there are.
    #[error("expected the number of shards in GUMP_SHARDS, found none")]
    NoCount,
    /// The scheduler counts beyond the number of shards.
    #[error("expected fewer than {n} shards counted from 0, found number {index}")]
    BeyondLast {
        /// Number of shards.
        n: usize,
        /// Number of this one, from 0.
        index: usize,
    },
}

/// The weights that most come for, as seen from the folder of the checkout.
const SHIPPED: &str = "datasets/weights/gump-relative.safetensors";

/// The suggestion for a name that looks like the path of a file of weights, or that lacks one.
fn weights_hint(name: &str, is_path: bool) -> String {
    match name {
        "model" | "model:" => format!("; with the shipped weights: model:{SHIPPED}"),
        _ if is_path => format!("; for weights in a file: model:{name}"),
        _ => String::new(),
    }
}
