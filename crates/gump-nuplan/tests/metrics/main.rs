//! nuPlan's metrics against values recorded from nuplan-devkit (commit e924167).
//!
//! The inputs were made for this purpose, but for `devkit_scenes.json`, the devkit's own test
//! scenes. Those that need the map of Las Vegas are left out, because it may not be shipped.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod aggregate;
mod bearings;
mod collisions;
mod common;
mod filters;
mod histories;
mod map;
mod open_loop;
mod recorded;
mod scenes;
