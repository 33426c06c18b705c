//! A track: the states of one agent as stated by a format.

use gump_geometry::{DVec2, DVec3};
use gump_scene::AgentKind;

/// One agent over time.
pub(crate) struct Track {
    pub(crate) id: i64,
    pub(crate) kind: AgentKind,
    /// Length, width, height in metres where the format states none for this one.
    pub(crate) usual_size: [f64; 3],
    /// States where it is present; need not be sorted.
    pub(crate) states: Vec<State>,
}

/// One agent at one step. Numbers that a format does not state are NaN.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct State {
    pub(crate) step: usize,
    /// Box centre, world frame, metres.
    pub(crate) position: DVec3,
    /// Radians.
    pub(crate) heading: f64,
    /// World frame, metres per second.
    pub(crate) velocity: DVec2,
    /// Length, width, height, metres.
    pub(crate) size: [f64; 3],
}

/// A number that is not stated.
pub(crate) const UNSTATED: f64 = f64::NAN;

/// The present of a recording that states none: one second in, if as much follows.
pub(crate) fn usual_present(steps: usize, dt: f64) -> usize {
    let second = (1.0 / dt).round() as usize;
    if steps > 2 * second { second } else { 0 }
}
