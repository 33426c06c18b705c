//! Velocities consistent with displacements.
//!
//! The network predicts position and velocity of an object separately; temporal averaging and
//! kinematic limits then change only the position. Later predictions depend on both, and other
//! objects see both, so the velocity is made consistent with the position:
//!
//! * an object that did not move has velocity zero;
//! * if averaging or limits changed the displacement, the velocity is rotated and scaled with it;
//! * the speed at the end of the half second is limited by the displacement: no speed changes by
//!   more than twice `REACH_M_PER_S` within it, and an object that started from rest is at most as
//!   fast as twice the mean.
//!
//! The paper has no such rule: there, as in the released code, positions and velocities diverge.

use gump_geometry::{DVec2, Pose, angle_difference};
use gump_model::steps::TOKEN_DT;
use gump_scene::AgentState;

/// Maximum difference between the speed at the end of half a second and the mean, metres per
/// second: 8 m/s² throughout, the hardest braking on a dry road.
const REACH_M_PER_S: f64 = 8.0 * TOKEN_DT / 2.0;
/// Speeds nearer than this are equal, metres per second: a little more than a token's bin (0.25).
const SLACK_M_PER_S: f64 = 0.3;
/// Displacements shorter than this have neither direction nor proportion, metres: two bins of the
/// finest chunk.
const SHORT_M: f64 = 0.1;

/// The velocity of an object that was at `from`, was decoded to the state `decoded`, and is at
/// `pose`; `steers` states whether it moves along its heading.
pub(crate) fn follow(from: Pose, decoded: AgentState, pose: Pose, steers: bool) -> DVec2 {
    let (intended, moved) = (
        decoded.pose.position - from.position,
        pose.position - from.position,
    );
    let long = intended.length() > SHORT_M && moved.length() > SHORT_M;
    let turn = match (steers, long) {
        (true, _) => angle_difference(pose.heading, decoded.pose.heading),
        (false, true) => intended.angle_to(moved),
        (false, false) => 0.0,
    };
    let stretch = match long {
        true => moved.length() / intended.length(),
        false => 1.0,
    };
    DVec2::from_angle(turn).rotate(decoded.velocity) * stretch
}

/// The velocity nearest to `velocity` that a motion of half a second from `from` to `pose` allows;
/// zero for an object that has not moved at all.
pub(crate) fn allowed(from: Pose, pose: Pose, velocity: DVec2) -> DVec2 {
    let moved = pose.position - from.position;
    if moved == DVec2::ZERO {
        return DVec2::ZERO;
    }
    let mean = moved.length() / TOKEN_DT;
    let most = (mean + REACH_M_PER_S).min(2.0 * mean) + SLACK_M_PER_S;
    let least = (mean - REACH_M_PER_S - SLACK_M_PER_S).max(0.0);
    let speed = velocity.length();
    if speed > most {
        velocity * (most / speed)
    } else if speed >= least {
        velocity
    } else if speed > SLACK_M_PER_S {
        velocity * (least / speed)
    } else {
        moved.normalize() * least
    }
}

#[cfg(test)]
mod tests {
    use gump_geometry::dvec2;

    use super::*;

    fn moving_to(x: f64, y: f64, heading: f64, velocity: DVec2) -> AgentState {
        AgentState {
            pose: Pose::new(x, y, heading),
            velocity,
        }
    }

    #[test]
    fn what_goes_where_it_said_keeps_its_velocity() {
        let state = moving_to(4.0, 0.3, 0.1, dvec2(8.2, 0.9));
        let velocity = follow(Pose::default(), state, state.pose, true);
        assert!(velocity.distance(state.velocity) < 1e-12);
        assert_eq!(allowed(Pose::default(), state.pose, velocity), velocity);
    }

    #[test]
    fn a_shorter_way_is_a_lower_speed_and_a_turn_turns_it() {
        let state = moving_to(4.0, 0.0, 0.2, dvec2(8.0, 0.0));
        let half = follow(Pose::default(), state, Pose::new(2.0, 0.0, 0.2), true);
        assert!(half.distance(dvec2(4.0, 0.0)) < 1e-12);
        // A car goes where it faces, a person where it goes.
        let turned = follow(Pose::default(), state, Pose::new(4.0, 0.0, 0.7), true);
        assert!(turned.distance(DVec2::from_angle(0.5) * 8.0) < 1e-12);
        let walked = follow(Pose::default(), state, Pose::new(0.0, 4.0, 0.7), false);
        assert!(walked.distance(dvec2(0.0, 8.0)) < 1e-9);
    }

    #[test]
    fn no_speed_without_a_way_and_no_way_without_a_speed() {
        let from = Pose::default();
        assert_eq!(allowed(from, from, dvec2(3.0, 0.0)), DVec2::ZERO);
        // From rest 0.2 m in half a second end at 0.8 m/s.
        let crawling = allowed(from, Pose::new(0.2, 0.0, 0.0), dvec2(5.0, 0.0));
        assert!((crawling.x - 1.1).abs() < 1e-9);
        // 8 m in half a second do not end at rest.
        let racing = allowed(from, Pose::new(8.0, 0.0, 0.0), DVec2::ZERO);
        assert!((racing.x - 13.7).abs() < 1e-9);
        // Braking hard is possible.
        let braking = allowed(from, Pose::new(4.0, 0.0, 0.0), dvec2(6.0, 0.0));
        assert_eq!(braking, dvec2(6.0, 0.0));
    }
}
