//! What is good and what is bad: metrics of rollouts and rewards made of them.
//!
//! Start with [`Metric`]; [`ALL`] lists what there is. [`summarize`] answers the usual questions
//! about many futures at once, [`Reward`] says what is wanted. The benchmarks of the field are
//! modules: [`wosac`] for realism, [`motion`] for prediction, [`mmd`] for scene generation;
//! [`behaviour`] counts what a driver would notice, [`statistics`] says what any set of scenes is
//! like. Nothing here steps a simulation or reads a
//! file.
//!
//! # Terms
//! * **metric** measures, **reward** combines, **score** is the number with its parts.
//! * **gate**: a factor of a reward. **Term**: a summand.
//! * **ADE**, **FDE**: average and final displacement from the log; *min* is over futures.
//!
//! ```
//! use gump_metrics::{Collision, logged, over_rollout, summarize};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "ego vehicle 0: 0,0 velocity 5,0
//!      agent vehicle 1: 30,0",
//! ).unwrap();
//! let rollout = logged(&scenario);
//! assert_eq!(over_rollout(&Collision, &rollout, scenario.ego), Some(1.0));
//! assert_eq!(summarize(&[rollout], Some(&scenario)).total().collision_rate(), Some(1.0));
//! ```
//!
//! Realism of one's own arrays under the rules of the Waymo Sim Agents Challenge, no file needed:
//!
//! ```
//! use gump_metrics::wosac::{Config, Log, Rollouts, State, Track, Trajectory, Year, score};
//! use gump_scene::{AgentId, AgentKind};
//!
//! // One car of 4.8 x 2 m drives along x at 10 m/s: 91 steps of 0.1 s, the present is step 10.
//! let at = |step| State::new([step as f32, 0.0, 0.0], 0.0, [4.8, 2.0, 1.5]);
//! let car = Track::new(AgentId(7), AgentKind::Vehicle, (0..91).map(at).collect());
//! let edge = vec![[-50.0, -4.0, 0.0], [150.0, -4.0, 0.0]];
//! let log = Log::new("my scene", vec![car]).ego(AgentId(7))?.road_edges(vec![edge]);
//! // A world that drives 5 % too fast, 32 times alike: x, y, z and heading of 80 steps.
//! let x = (1..=80).map(|step| 10.0 + 1.05 * step as f32).collect();
//! let drive = Trajectory::new(AgentId(7), x, vec![0.0; 80], vec![0.0; 80], vec![0.0; 80]);
//! let rollouts = Rollouts::new("my scene", vec![vec![drive]]).repeated(32);
//! let scores = score(&log, &rollouts, &Config::of(Year::Y2025))?;
//! assert!(0.8 < scores.metametric && scores.metametric < 1.0);
//! # Ok::<(), gump_metrics::wosac::WosacError>(())
//! ```

pub mod behaviour;
mod bootstrap;
mod border;
mod collision;
mod comfort;
mod displacement;
pub mod kinematics;
mod metric;
pub mod mmd;
pub mod motion;
pub mod nuplan;
mod offroad;
mod progress;
mod red_light;
mod reward;
mod road_edge;
pub mod statistics;
mod summary;
pub mod tags;
pub mod wosac;

pub use bootstrap::{Interval, interval, intervals};
pub use border::Border;
pub use collision::{Collision, overlapping};
pub use comfort::{ComfortBounds, Discomfort, Felt};
pub use displacement::{Displacement, average_displacement};
pub use kinematics::{Acceleration, Speed, YawRate};
pub use metric::{ALL, Metric, Reduce, logged, over_rollout, over_rollouts};
pub use offroad::{OffRoad, metres_off_road};
pub use progress::Progress;
pub use red_light::RedLight;
pub use reward::{Gate, Reward, Score, Term};
pub use road_edge::{DistanceToRoadEdge, signed_distance_to_road_edge};
pub use summary::{Part, Summary, summarize};
