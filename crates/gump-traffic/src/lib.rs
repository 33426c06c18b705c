//! Long rollouts of any world: traffic signals with phases, and agents that enter and leave.
//!
//! A [`WorldModel`](gump_rollout::WorldModel) determines how agents move. Lights and the set of
//! agents are its inputs: they stay as at the present, or [`Living`] updates them.
//!
//! # Terms
//! * **movement**: a path through a junction that a light controls. **Signal group**: movements
//!   whose lights always show the same colour. **Phase**: groups that are green together.
//! * **gate**: a place where a lane enters the simulated area.
//!
//! ```
//! use gump_rollout::{SimulateConfig, Start, simulate, worlds::Idm};
//! use gump_scene::{LightState, Seed};
//! use gump_traffic::{Living, LivingConfig};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: -60,0 -8,0 next 3
//!      lane 2: 0,-60 0,-8 next 4
//!      lane 3: -8,0 60,0
//!      lane 4: 0,-8 0,60
//!      light 3 red:
//!      light 4 green:
//!      ego vehicle 0: -30,0 velocity 8,0",
//! ).unwrap();
//! let world = Living::new(Idm::default(), LivingConfig::default());
//! let start = Start { scene: scenario.present(), n_futures: 1, seed: Seed(0) };
//! let minute = SimulateConfig { seconds: 60.0, ..SimulateConfig::default() };
//! let futures = simulate(&world, &[start], None, &minute).unwrap();
//! // The light turns green in the end, and the ego has driven on.
//! assert!(futures[0].last().ego_now().state.pose.position.x > 60.0);
//! ```

mod gates;
mod living;
mod notes;
mod signals;

pub use gates::Arrivals;
pub use living::{LightControl, Living, LivingConfig, RecordedLights};
pub use notes::{Note, NoteCount, Notes};
pub use signals::{SignalPlan, Signals};
