//! Driving inside the learned world: the game, and its bindings for a page in a browser.
//!
//! What lives here: a drive through a scene, its inputs, its score, and the numbers that a page
//! draws, in plain Rust that is tested on any machine. What does not: the page (`page`, beside the
//! sources), which draws, and reads keys. Compiled for `wasm32-unknown-unknown` there is a module
//! `wasm` besides, which adapts [`Game`] to JavaScript and does nothing else.
//!
//! Start with [`Game`].

mod branches;
mod drivers;
mod engine;
mod error;
mod game;
mod score;
mod signals;
mod tape;
mod view;
#[cfg(target_arch = "wasm32")]
mod wasm;

pub use branches::{Branch, Branches, FUTURES, STEPS};
pub use engine::compute_as_browsers_do;
pub use error::{GameError, LinkError};
pub use game::{
    DT, Event, EventKind, FAN_STEPS, Fan, Game, MAX_AGENTS, MAX_FRAMES, MAX_POINTS, Settings,
};
pub use score::DriveScore;
pub use tape::{EgoDriver, Input, decode, encode};
pub use view::{AGENT, HEAD, WAY, checksum};
