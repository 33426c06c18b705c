//! The closed-loop engine, the traits [`WorldModel`] and [`Policy`], vehicle dynamics and
//! rule-based worlds.

mod policy;
mod world;

pub use policy::{Command, Policy};
pub use world::{BoxError, Session, Start, WorldModel};
