//! Time steps of the networks.

/// Seconds between token frames (paper: 2 Hz).
pub const TOKEN_DT: f64 = 0.5;

/// Frames of history that a rollout starts from (paper: 3).
pub const HISTORY: usize = 3;

/// Maximum number of frames that a rollout keeps its frame of reference: 8 s, the horizon of the
/// Waymo Sim Agents Challenge.
pub const LONGEST_ROLLOUT: usize = 16;

/// Log frames per token frame, for a log of steps of `dt` seconds.
pub fn stride_of(dt: f64) -> usize {
    (TOKEN_DT / dt).round().max(1.0) as usize
}
