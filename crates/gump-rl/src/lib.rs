//! A vectorised driving environment over any world, and reinforcement learning in it.
//!
//! Start with [`DrivingEnv`]: many episodes in parallel, with one batched call of the world per
//! step. It implements [`VectorEnv`], the only interface that learning algorithms need. [`PreparedScenario`]
//! is a prepared scenario, [`Dynamics`] defines actions, [`ObservationSpec`] observations and
//! [`RewardWeights`] the reward. [`Rules`] is one episode as pure functions. [`ppo`] and [`sac`]
//! train an [`Actor`] from rewards, [`sac`] also from experts alone. On Unix, [`server`] provides environments to other
//! processes.
//!
//! # Terms
//! * **row**: an index of the batch. **Episode**: the steps of a row from a start to an end.
//! * **terminated**: ended by failure. **Truncated**: cut off before its end, so its value must be
//!   bootstrapped.
//! * **step**: the duration of an action, half a second; one or more frames of a world.
//!
//! ```
//! use gump_rl::{PreparedScenario, DrivingEnv, EnvConfig, TrafficSource, VectorEnv};
//! use gump_scene::Seed;
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 300,0 speed 15\nroute 1\nego vehicle 0: 10,0 velocity 8,0",
//! ).unwrap();
//! let prepared = PreparedScenario::prepare([scenario], 0.5).unwrap();
//! let config = EnvConfig { n_envs: 4, ..EnvConfig::default() };
//! let mut env = DrivingEnv::new(prepared, TrafficSource::Log, config).unwrap();
//! env.reset(Seed(0)).unwrap();
//! // Half of the hardest acceleration, straight ahead.
//! env.step(&[0.5, 0.0].repeat(4)).unwrap();
//! assert!(env.rewards().iter().all(|reward| *reward > 0.4));
//! assert!(!env.terminated()[0] && !env.truncated()[0]);
//! ```

mod actor;
mod algorithm;
mod dynamics;
mod env;
mod episode;
mod error;
mod evaluate;
mod imitation;
pub mod networks;
mod observation;
pub mod ppo;
mod prepared_scenario;
mod route;
pub mod sac;
#[cfg(unix)]
pub mod server;
mod vector_env;

pub use actor::Actor;
pub use algorithm::Algorithm;
pub use dynamics::{BicycleLimits, Dynamics, PoseLimits};
pub use env::{Autoreset, DrivingEnv, EnvConfig, EpisodeStart, Outcome, Sampling, TrafficSource};
pub use episode::{End, EpisodeState, Failure, RewardWeights, Rules, Totals};
pub use error::RlError;
pub use evaluate::{
    Columns, EpisodeResult, Episodes, Estimate, EvaluatedPolicy, LOGGED_PROGRESS, estimate,
    estimate_difference, evaluate, recorded_drive, score_by_scenario,
};
pub use imitation::demonstrations;
pub use observation::{
    AgentOrder, ObservationForm, ObservationSpec, RASTER_LAYERS, RasterView, VectorView, View,
    expand, observe,
};
pub use prepared_scenario::PreparedScenario;
pub use vector_env::VectorEnv;
