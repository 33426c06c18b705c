//! Kinematic limits: motion that is possible within half a second.
//!
//! A network that predicts positions in bins cannot represent standing exactly, and random draws
//! rotate parked cars in place. With these limits, vehicles and bicycles turn only as they move,
//! and one that stands and moves less than a bin stays in place. The paper has no such rule;
//! simulators with a vehicle model do.

use gump_geometry::{DVec2, Pose, wrap_angle};
use gump_scene::{AgentKind, AgentState};

/// An object that moves less than this in half a second stays, metres: one bin of the first pose of
/// a chunk.
const STILL_M: f64 = 0.05;
/// And whose speed is below this, metres per second: a little more than a bin (0.25).
const STILL_M_PER_S: f64 = 0.3;

/// Limits on the motion of a kind of object. `agreement` adjusts the velocity of a limited pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Maximum change of heading per metre.
    curvature: f64,
    /// Maximum sideways metres per metre ahead, at the box centre.
    slip: f64,
}

impl Limits {
    /// The limits of a kind; `None` for kinds that may turn and step anywhere.
    ///
    /// A car turns about its rear axle with a radius of 4.5 m; its centre, 1.4 m ahead of it, then
    /// slips by about 0.3. A bicycle turns with a radius of 1.5 m; 0.4 is a centre 0.6 m ahead.
    pub(crate) fn of(kind: AgentKind) -> Option<Self> {
        match kind {
            AgentKind::Vehicle => Some(Self {
                curvature: 0.22,
                slip: 0.3,
            }),
            AgentKind::Bicycle => Some(Self {
                curvature: 0.65,
                slip: 0.4,
            }),
            _ => None,
        }
    }

    /// The pose nearest to `state` that an object at `from` can reach.
    pub(crate) fn keep(self, from: Pose, state: AgentState) -> AgentState {
        let step = from.inverse() * state.pose;
        if step.position.length() <= STILL_M && state.velocity.length() <= STILL_M_PER_S {
            return AgentState {
                pose: from,
                velocity: DVec2::ZERO,
            };
        }
        let (ahead, aside) = (step.position.x, step.position.y);
        let widest = self.slip * ahead.abs() + 0.5 * self.curvature * ahead * ahead;
        let position = DVec2::new(ahead, aside.clamp(-widest, widest));
        let most = self.curvature * position.length();
        let heading = wrap_angle(step.heading).clamp(-most, most);
        AgentState {
            pose: from * Pose { position, heading },
            velocity: state.velocity,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moving_to(x: f64, y: f64, heading: f64, speed: f64) -> AgentState {
        AgentState {
            pose: Pose::new(x, y, heading),
            velocity: DVec2::new(speed, 0.0),
        }
    }

    #[test]
    fn what_stands_does_not_turn() {
        let limits = Limits::of(AgentKind::Vehicle).expect("vehicles have limits");
        let from = Pose::new(3.0, -2.0, 1.0);
        let kept = limits.keep(from, moving_to(3.02, -1.98, 1.3, 0.1));
        assert_eq!((kept.pose, kept.velocity), (from, DVec2::ZERO));
        // Setting off is not standing.
        let kept = limits.keep(from, moving_to(3.02, -1.97, 1.0, 0.5));
        assert_eq!(kept.velocity, DVec2::new(0.5, 0.0));
        assert!(kept.pose.position.distance(DVec2::new(3.02, -1.97)) < 0.01);
    }

    #[test]
    fn turns_and_slips_are_held_back_and_the_feasible_is_left_alone() {
        let limits = Limits::of(AgentKind::Vehicle).expect("vehicles have limits");
        let from = Pose::default();
        let kept = limits.keep(from, moving_to(2.0, 3.0, 2.0, 4.0));
        assert!((kept.pose.position - DVec2::new(2.0, 1.04)).length() < 1e-9);
        assert!((kept.pose.heading - 0.22 * DVec2::new(2.0, 1.04).length()).abs() < 1e-9);
        // A quarter of a circle of 12 m in steps of half a second at 8 m/s.
        let step = moving_to(
            12.0 * (1.0f64 / 3.0).sin(),
            12.0 * (1.0 - (1.0f64 / 3.0).cos()),
            1.0 / 3.0,
            8.0,
        );
        let kept = limits.keep(from, step);
        assert!(kept.pose.position.distance(step.pose.position) < 1e-12);
        assert!((kept.pose.heading - step.pose.heading).abs() < 1e-12);
        assert!(Limits::of(AgentKind::Pedestrian).is_none());
    }
}
