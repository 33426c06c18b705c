//! nuPlan's benchmark, equal to its devkit: closed loop, reactive agents, metrics and scores.
//!
//! [`closed_loop::drive`] simulates a recording with a driver in control of the ego, [`tracking`]
//! moves the ego's vehicle along the driver's trajectory, [`reactive_agents`] is the traffic of the
//! reactive challenge, and [`metrics`] scores drives in closed loop and plans in open loop. Drivers
//! are in `gump-planner`, file formats in `gump-data`.
//!
//! ```
//! use gump_nuplan::metrics::{RolloutHistory, Scoring, score};
//! use gump_rollout::{SimulateConfig, Start, simulate, worlds::ConstantVelocity};
//! use gump_scene::Seed;
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 300,0 speed 15
//!      ego vehicle 0: 10,0 velocity 8,0
//!      agent vehicle 1: 60,0 velocity 8,0",
//! )?;
//! let start = Start { scene: scenario.present(), n_futures: 1, seed: Seed(0) };
//! let driven = simulate(&ConstantVelocity, &[start], None, &SimulateConfig::default())?;
//! // Nobody was hit, and the ego went as far as the log.
//! let metrics = score(&RolloutHistory::new(&driven[0], &scenario).on(&scenario.map))?;
//! assert_eq!(metrics.collisions.score, 1.0);
//! assert!(metrics.score(&Scoring::closed_loop()) > 0.99);
//! # Ok::<(), gump_rollout::BoxError>(())
//! ```

pub mod closed_loop;
pub mod metrics;
pub mod path;
pub mod reactive_agents;
pub mod tracking;
