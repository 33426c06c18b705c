//! Proposals: trajectories the ego might drive.
//!
//! This module has the trajectory and its interpolation. Rules and worlds that drive the ego make
//! proposals, [`crate::InteractiveDriver`] scores them.

use std::fmt;

use gump_geometry::{Pose, interpolate_angle};
use gump_scene::AgentState;

use crate::Side;

/// A trajectory of the ego and its origin.
#[derive(Clone, Debug, PartialEq)]
pub struct Proposal {
    /// Its origin.
    pub kind: ProposalKind,
    /// Seconds between states, > 0.
    pub dt: f64,
    /// Box-centre states in the world frame; the first is `dt` ahead of now. Never empty.
    pub states: Vec<AgentState>,
}

/// The origin of a proposal.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum ProposalKind {
    /// The Intelligent Driver Model along a line beside the centre of the way.
    Idm {
        /// Desired speed as a share of the limit, > 0.
        speed_fraction: f64,
        /// Metres to the left of the centre line.
        lateral_offset: f64,
    },
    /// The same along the centre, with a shorter headway and stronger acceleration.
    Brisk {
        /// Desired speed as a share of the limit, > 0.
        speed_fraction: f64,
    },
    /// The same along the centre, with a long headway and early braking.
    Yielding {
        /// Desired speed as a share of the limit, > 0.
        speed_fraction: f64,
    },
    /// The Intelligent Driver Model along a line into the lane beside the ego's.
    LaneChange {
        /// Desired speed as a share of the limit, > 0.
        speed_fraction: f64,
        /// The side of that lane.
        side: Side,
    },
    /// The world's own motion of the ego.
    Imitation,
    /// One draw of the world's own motion of the ego, which stays the same whatever the others do.
    NetworkMode {
        /// From 1, the mode that most draws are near first; a mode under way keeps its number.
        index: usize,
    },
    /// Braking straight ahead as hard as allowed.
    EmergencyBrake,
}

impl fmt::Display for ProposalKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Idm {
                speed_fraction,
                lateral_offset,
            } => {
                let percent = speed_fraction * 100.0;
                write!(f, "idm {percent:.0} % of the limit, {lateral_offset:+.1} m")
            }
            Self::Brisk { speed_fraction } => {
                write!(f, "brisk {:.0} % of the limit", speed_fraction * 100.0)
            }
            Self::Yielding { speed_fraction } => {
                write!(f, "yielding {:.0} % of the limit", speed_fraction * 100.0)
            }
            Self::LaneChange {
                speed_fraction,
                side,
            } => {
                let side = match side {
                    Side::Left => "left",
                    Side::Right => "right",
                };
                write!(
                    f,
                    "change to the {side}, {:.0} % of the limit",
                    speed_fraction * 100.0
                )
            }
            Self::Imitation => f.write_str("imitation"),
            Self::NetworkMode { index } => write!(f, "network mode {index}"),
            Self::EmergencyBrake => f.write_str("emergency brake"),
        }
    }
}

impl Proposal {
    /// Through these box centres, `dt` seconds apart, of which the first is now; velocities are
    /// taken over two steps, since simulated positions are quantised.
    ///
    /// # Panics
    /// If there are fewer than two places.
    pub fn through(kind: ProposalKind, places: &[Pose], dt: f64) -> Self {
        let last = places.len() - 1;
        let state = |i: usize| {
            let (a, b) = (i - 1, (i + 1).min(last));
            let moved = places[b].position - places[a].position;
            AgentState {
                pose: places[i],
                velocity: moved / ((b - a) as f64 * dt),
            }
        };
        let states: Vec<_> = (1..=last).map(state).collect();
        assert!(!states.is_empty(), "a proposal leads somewhere");
        Self { kind, dt, states }
    }

    /// The state `elapsed` seconds after `now`, between states by a cubic that matches positions
    /// and velocities; past the last state at its velocity.
    pub fn state_at(&self, now: &AgentState, elapsed: f64) -> AgentState {
        let place = elapsed / self.dt;
        // A sum of steps meets a state up to rounding; snap, so that states are met exactly.
        let place = if (place - place.round()).abs() < 1e-9 {
            place.round()
        } else {
            place
        };
        let before = place.floor().max(0.0) as usize;
        let knot = |i: usize| match i.checked_sub(1) {
            None => now,
            Some(i) => &self.states[i],
        };
        if before >= self.states.len() {
            let mut state = *knot(self.states.len());
            let beyond = elapsed - self.states.len() as f64 * self.dt;
            state.pose.position += state.velocity * beyond;
            return state;
        }
        if place == before as f64 {
            return *knot(before);
        }
        hermite(knot(before), knot(before + 1), self.dt, place.fract())
    }

    /// The same trajectory from `now` with a state every `dt` seconds, to its last state.
    pub fn resampled(&self, now: &AgentState, dt: f64) -> Vec<AgentState> {
        let n = (self.horizon() / dt).round().max(1.0) as usize;
        (1..=n).map(|i| self.state_at(now, i as f64 * dt)).collect()
    }

    /// Seconds from now to the last state.
    pub fn horizon(&self) -> f64 {
        self.states.len() as f64 * self.dt
    }
}

/// Between two states `dt` apart, by the cubic that matches both positions and velocities.
fn hermite(from: &AgentState, to: &AgentState, dt: f64, t: f64) -> AgentState {
    let (t2, t3) = (t * t, t * t * t);
    let step = to.pose.position - from.pose.position;
    let (v0, v1) = (from.velocity * dt, to.velocity * dt);
    let position = from.pose.position
        + step * (3.0 * t2 - 2.0 * t3)
        + v0 * (t3 - 2.0 * t2 + t)
        + v1 * (t3 - t2);
    let moved =
        step * (6.0 * t - 6.0 * t2) + v0 * (3.0 * t2 - 4.0 * t + 1.0) + v1 * (3.0 * t2 - 2.0 * t);
    AgentState {
        pose: Pose {
            position,
            heading: interpolate_angle(from.pose.heading, to.pose.heading, t),
        },
        velocity: moved / dt,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::dvec2;

    #[test]
    fn states_between_states_are_interpolated() {
        let state = |x: f64, v: f64| AgentState {
            pose: Pose::new(x, 0.0, 0.0),
            velocity: dvec2(v, 0.0),
        };
        // Uniform acceleration of 2 m/s² from 3 m/s.
        let proposal = Proposal {
            kind: ProposalKind::EmergencyBrake,
            dt: 0.5,
            states: vec![state(1.75, 4.0), state(4.0, 5.0)],
        };
        let now = state(0.0, 3.0);
        for (elapsed, x, v) in [
            (0.2, 0.64, 3.4),
            (0.5, 1.75, 4.0),
            (0.1 + 0.2 + 0.6, 3.51, 4.8),
            (1.4, 6.0, 5.0),
        ] {
            let found = proposal.state_at(&now, elapsed);
            assert_abs_diff_eq!(found.pose.position.x, x, epsilon = 1e-12);
            assert_abs_diff_eq!(found.velocity.x, v, epsilon = 1e-12);
        }
        assert_eq!(proposal.resampled(&now, 0.1).len(), 10);
    }
}
