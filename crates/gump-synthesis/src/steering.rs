//! Headings of vehicles that are steered at the front.
//!
//! A simulated vehicle heads along the path of its centre. A real one turns about a point on the line of
//! its rear axle, so that in a turn its centre moves inward of its heading, and its heading follows the
//! path with a delay.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, Pose, angle_difference, wrap_angle};
use gump_scene::{AgentId, AgentKind, Frame, Scenario};

/// From the centre of a vehicle to its rear axle, as a share of its length. Measured alike, over half
/// seconds, the angle between the motion of the centre and the heading is that of 1.15 m for cars 4.67 m
/// long in recorded turns (`datasets/benchmarks/recorded.toml#train`), and of 1.36 m for those of 5.31 m.
pub(crate) const REAR_AXLE: f64 = 0.23;
/// The rear axle is drawn along in steps of this length, metres.
const STEP_M: f64 = 0.25;
/// The turn at the beginning is measured over this distance, metres.
const BEGINNING_M: f64 = 0.5;
/// Largest angle between the motion of the centre and the heading at the beginning, radians.
const STEEPEST: f64 = 0.35;
/// Standard deviation of the average along the path by which turns begin and end gradually, metres, and how
/// many of them it reaches to either side. With it yaw rates change about as recorded ones do.
const SIGMA_M: f64 = 3.0;
const REACH: f64 = 2.5;
/// Spacing of its terms, metres.
const SPACING_M: f64 = 0.5;
/// A step backwards, metres, but for jitter.
const BACKWARDS_M: f64 = 0.01;

/// Gives the vehicles of a scenario the headings of bodies whose rear axle is drawn along behind their
/// centre. Positions, velocities, and tracks with a part in reverse stay as they are.
pub fn steer(scenario: &mut Scenario) {
    let mut tracks: BTreeMap<AgentId, Vec<(usize, Pose, f64)>> = BTreeMap::new();
    for (step, frame) in scenario.log.iter().enumerate() {
        let vehicles = frame.agents().iter();
        for agent in vehicles.filter(|agent| agent.kind == AgentKind::Vehicle) {
            let track = tracks.entry(agent.id).or_default();
            track.push((step, agent.state.pose, agent.length));
        }
    }
    let mut turned: BTreeMap<(usize, AgentId), f64> = BTreeMap::new();
    for (id, track) in tracks {
        for stretch in track.chunk_by(|a, b| b.0 == a.0 + 1) {
            let mut poses: Vec<Pose> = stretch.iter().map(|(_, pose, _)| *pose).collect();
            draw_along(&mut poses, stretch[0].2);
            let headings = stretch.iter().zip(&poses);
            turned.extend(headings.map(|((step, ..), pose)| ((*step, id), pose.heading)));
        }
    }
    for (step, frame) in scenario.log.iter_mut().enumerate() {
        let mut agents = frame.agents().to_vec();
        for agent in &mut agents {
            if let Some(heading) = turned.get(&(step, agent.id)) {
                agent.state.pose.heading = *heading;
            }
        }
        *frame = Frame::new(agents, frame.lights().to_vec());
    }
}

/// Whether a part of the way is in reverse.
fn reverses(poses: &[Pose]) -> bool {
    poses.windows(2).any(|pair| {
        let step = pair[1].position - pair[0].position;
        step.dot(pair[0].direction()) < -BACKWARDS_M
    })
}

/// Averages the path of a vehicle over a few metres, so that its turns begin and end gradually: straight
/// parts stay, and each pose stays as far along. Ways with a part in reverse stay as they are.
pub(crate) fn round_off(poses: &mut [Pose]) {
    if reverses(poses) {
        return;
    }
    // Each pose's distance along the path, and the points of the path, metres.
    let (mut along, mut path) = (Vec::with_capacity(poses.len()), Vec::new());
    let mut s = 0.0;
    for (i, pose) in poses.iter().enumerate() {
        s += i
            .checked_sub(1)
            .map_or(0.0, |before| poses[before].position.distance(pose.position));
        along.push(s);
        if path.last().is_none_or(|(last, _)| s - last > 1e-3) {
            path.push((s, pose.position));
        }
    }
    if path.len() < 2 {
        return;
    }
    let (start, end) = (path[0].1, path[path.len() - 1].1);
    let length = path[path.len() - 1].0;
    let inside = |s: f64| {
        let i = path.partition_point(|(at, _)| *at <= s);
        let i = i.clamp(1, path.len() - 1);
        let ((from, a), (to, b)) = (path[i - 1], path[i]);
        a.lerp(b, ((s - from) / (to - from)).clamp(0.0, 1.0))
    };
    // Beyond its ends the path goes on by point reflection, so that a straight line stays one.
    let at = |s: f64| match s {
        s if s < 0.0 => 2.0 * start - inside((-s).min(length)),
        s if s > length => 2.0 * end - inside((2.0 * length - s).max(0.0)),
        s => inside(s),
    };
    let n = (REACH * SIGMA_M / SPACING_M) as i32;
    let weight = |k: i32| (-0.5 * (f64::from(k) * SPACING_M / SIGMA_M).powi(2)).exp();
    let total: f64 = (-n..=n).map(weight).sum();
    for (pose, s) in poses.iter_mut().zip(along) {
        let terms = (-n..=n).map(|k| at(s + f64::from(k) * SPACING_M) * (weight(k) / total));
        pose.position = terms.sum();
    }
}

/// Gives one vehicle of this length, metres, the headings of [`steer`]: its poses, one after another.
pub(crate) fn draw_along(poses: &mut [Pose], length: f64) {
    if poses.is_empty() || reverses(poses) {
        return;
    }
    let axle = REAR_AXLE * length;
    poses[0].heading = wrap_angle(poses[0].heading - lag_at_beginning(poses, axle));
    let mut rear = poses[0] * DVec2::new(-axle, 0.0);
    for i in 1..poses.len() {
        let (from, to) = (poses[i - 1].position, poses[i].position);
        if from == to {
            poses[i].heading = poses[i - 1].heading;
            continue;
        }
        let n = (from.distance(to) / STEP_M).ceil();
        for k in 1..=n as usize {
            let centre = from.lerp(to, k as f64 / n);
            rear = centre + (rear - centre).normalize_or(-poses[i - 1].direction()) * axle;
        }
        poses[i].heading = wrap_angle((to - rear).to_angle());
    }
}

/// The angle by which the heading is behind the motion in the turn in which a track begins.
fn lag_at_beginning(poses: &[Pose], axle: f64) -> f64 {
    let first = poses[0];
    let far = |pose: &&Pose| pose.position.distance(first.position) >= BEGINNING_M;
    let Some(next) = poses.iter().find(far) else {
        return 0.0;
    };
    let turn = angle_difference(next.heading, first.heading);
    let curvature = turn / next.position.distance(first.position);
    (axle * curvature).atan().clamp(-STEEPEST, STEEPEST)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Poses on a circle to the left of this radius, along its tangents.
    fn circle(radius: f64, step: f64) -> Vec<Pose> {
        let pose = |i: u32| {
            let angle = f64::from(i) * step / radius;
            let (sin, cos) = angle.sin_cos();
            Pose::new(radius * sin, radius * (1.0 - cos), angle)
        };
        (0..60).map(pose).collect()
    }

    #[test]
    fn in_a_turn_the_centre_moves_inward_of_the_heading() {
        for step in [0.2, 0.5, 1.0] {
            let along = circle(12.0, step);
            let mut poses = along.clone();
            draw_along(&mut poses, 4.8);
            // The rear axle is on a smaller circle about the same middle.
            let expected = (1.2_f64 / 12.0).asin();
            for (i, (pose, before)) in poses.iter().zip(&along).enumerate() {
                assert_eq!(pose.position, before.position);
                let lag = angle_difference(before.heading, pose.heading);
                assert!((lag - expected).abs() < 0.02, "{step}, {i}: {lag}");
            }
        }
    }

    #[test]
    fn who_drives_straight_or_stands_or_backs_up_keeps_its_heading() {
        let straight: Vec<Pose> = (0..20)
            .map(|i| Pose::new(0.5 * f64::from(i), 0.0, 0.0))
            .collect();
        let stands = vec![Pose::new(3.0, 4.0, 1.0); 20];
        let backs: Vec<Pose> = circle(8.0, 0.3).into_iter().rev().collect();
        for before in [straight, stands, backs] {
            let mut after = before.clone();
            draw_along(&mut after, 4.8);
            assert_eq!(before, after);
        }
    }

    #[test]
    fn a_sudden_turn_becomes_a_gradual_one() {
        let corner = |i: i32| match i < 10 {
            true => Pose::new(0.4 * f64::from(i - 10), 0.0, 0.0),
            false => Pose::new(0.0, 0.4 * f64::from(i - 10), std::f64::consts::FRAC_PI_2),
        };
        let mut poses: Vec<Pose> = (0..40).map(corner).collect();
        draw_along(&mut poses, 4.8);
        let turn = |pair: &[Pose]| angle_difference(pair[1].heading, pair[0].heading);
        let turns: Vec<f64> = poses.windows(2).map(turn).collect();
        assert!(
            turns.iter().all(|turn| (-1e-9..0.4).contains(turn)),
            "{turns:?}"
        );
        let left = angle_difference(std::f64::consts::FRAC_PI_2, poses[39].heading);
        assert!(left.abs() < 0.01, "{left}");
    }

    #[test]
    fn only_vehicles_of_a_scenario_are_turned() {
        let mut scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 100,0\nego vehicle 0: 10,0 velocity 8,0\nagent pedestrian 1: 20,5 velocity 0,1",
        )
        .unwrap();
        for (i, frame) in scenario.log.iter_mut().enumerate() {
            let angle = 0.03 * i as f64;
            let mut agents = frame.agents().to_vec();
            for agent in &mut agents {
                agent.state.pose = Pose {
                    position: agent.state.pose.position
                        + 25.0 * DVec2::new(angle.sin(), 1.0 - angle.cos()),
                    heading: angle,
                };
            }
            *frame = Frame::new(agents, Vec::new());
        }
        let before = scenario.clone();
        steer(&mut scenario);
        for (a, b) in before.log.iter().zip(&scenario.log) {
            for (a, b) in a.agents().iter().zip(b.agents()) {
                assert_eq!(a.state.pose.position, b.state.pose.position);
                let is_same = a.state.pose.heading == b.state.pose.heading;
                assert_eq!(is_same, a.kind == AgentKind::Pedestrian);
            }
        }
    }
}
