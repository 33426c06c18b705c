//! Smoothing of simulated motion along polylines to drivable motion.
//!
//! Vehicles of a simulator turn at the corners of their lanes' lines. Here positions and headings
//! are averaged over a few tenths of a second, and velocities are derived from the positions.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, Pose, angle_difference, wrap_angle};
use gump_scene::{Agent, AgentId, AgentKind, Frame, Scenario};

/// Standard deviation of the average over time, seconds: vehicles steer over about a second.
/// Together with rounder curves it brings yaw rates near to recorded ones
/// (docs/results/0006-factory.md).
const SIGMA_S: f64 = 0.35;
/// Standard deviations after which the average ends: 0.3 % of the weight lies beyond.
const REACH: f64 = 3.0;

/// Averages the motion of vehicles and bicycles over time and derives their velocities from it.
///
/// Straight motion at constant speed and standing stay exactly unchanged; each stretch of
/// uninterrupted presence is processed separately.
pub fn smooth_motion(scenario: &mut Scenario) {
    let mut tracks: BTreeMap<AgentId, Vec<(usize, Agent)>> = BTreeMap::new();
    for (step, frame) in scenario.log.iter().enumerate() {
        for agent in frame.agents() {
            tracks.entry(agent.id).or_default().push((step, *agent));
        }
    }
    let n = scenario.log.len();
    let mut frames: Vec<Vec<Agent>> = vec![Vec::new(); n];
    for track in tracks.into_values() {
        for stretch in track.chunk_by(|a, b| b.0 == a.0 + 1) {
            let mut agents: Vec<Agent> = stretch.iter().map(|(_, agent)| *agent).collect();
            if matches!(agents[0].kind, AgentKind::Vehicle | AgentKind::Bicycle) {
                smooth(&mut agents, scenario.dt);
            }
            for ((step, _), agent) in stretch.iter().zip(agents) {
                frames[*step].push(agent);
            }
        }
    }
    let log = std::mem::take(&mut scenario.log);
    let smoothed = log.iter().zip(frames);
    scenario.log = smoothed
        .map(|(before, agents)| Frame::new(agents, before.lights().to_vec()))
        .collect();
}

/// Smooths one stretch of a track.
fn smooth(agents: &mut [Agent], dt: f64) {
    let mut poses: Vec<Pose> = agents.iter().map(|agent| agent.state.pose).collect();
    smooth_poses(&mut poses, SIGMA_S / dt);
    let last = agents.len() - 1;
    for (i, agent) in agents.iter_mut().enumerate() {
        let (before, after) = (i.saturating_sub(1), (i + 1).min(last));
        if before < after {
            let span = (after - before) as f64 * dt;
            agent.state.velocity = (poses[after].position - poses[before].position) / span;
        }
        agent.state.pose = poses[i];
    }
}

/// Averages the poses of one agent over `sigma` steps.
pub(crate) fn smooth_poses(poses: &mut [Pose], sigma: f64) {
    let Some(first) = poses.first() else {
        return;
    };
    let mut heading = first.heading;
    let unwrapped = poses.iter().map(|pose| {
        heading += angle_difference(pose.heading, heading);
        heading
    });
    let headings = average(&unwrapped.collect::<Vec<f64>>(), sigma);
    let positions: Vec<DVec2> = poses.iter().map(|pose| pose.position).collect();
    let positions = average(&positions, sigma);
    for ((pose, position), heading) in poses.iter_mut().zip(positions).zip(headings) {
        *pose = Pose {
            position,
            heading: wrap_angle(heading),
        };
    }
}

/// The Gaussian average of a series, which is continued beyond its ends by point reflection, so
/// that a straight line stays one.
fn average<T>(series: &[T], sigma: f64) -> Vec<T>
where
    T: Copy
        + std::ops::Add<Output = T>
        + std::ops::Sub<Output = T>
        + std::ops::Mul<f64, Output = T>,
{
    let last = series.len() as isize - 1;
    let at = |i: isize| {
        let inside = |i: isize| series[i.clamp(0, last) as usize];
        if i < 0 {
            inside(0) * 2.0 - inside(-i)
        } else if i > last {
            inside(last) * 2.0 - inside(2 * last - i)
        } else {
            inside(i)
        }
    };
    let reach = (REACH * sigma).ceil() as isize;
    let weight = |k: isize| (-0.5 * (k as f64 / sigma).powi(2)).exp();
    let total: f64 = (-reach..=reach).map(weight).sum();
    (0..=last)
        .map(|i| {
            let terms = (1..=reach).map(|k| (at(i - k) + at(i + k)) * (weight(k) / total));
            terms.fold(at(i) * (weight(0) / total), |sum, term| sum + term)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scenario() -> Scenario {
        gump_scene::fixture::scenario(
            "lane 1: 0,0 100,0\nego vehicle 0: 10,0 velocity 8,0\nagent pedestrian 1: 20,5 velocity 0,1",
        )
        .unwrap()
    }

    #[test]
    fn straight_motion_stays() {
        let before = scenario();
        let mut after = before.clone();
        smooth_motion(&mut after);
        for (a, b) in before.log.iter().zip(&after.log) {
            for (a, b) in a.agents().iter().zip(b.agents()) {
                assert!(a.state.pose.position.distance(b.state.pose.position) < 1e-9);
                assert!((a.state.velocity - b.state.velocity).length() < 1e-9);
            }
        }
    }

    #[test]
    fn a_corner_becomes_a_curve() {
        let mut scenario = scenario();
        let turn = |scenario: &Scenario| {
            let heading = |frame: &Frame| frame.agents()[0].state.pose.heading;
            let pairs = scenario.log.windows(2);
            pairs
                .map(|pair| angle_difference(heading(&pair[1]), heading(&pair[0])).abs())
                .fold(0.0, f64::max)
        };
        for frame in &mut scenario.log[50..] {
            let mut agents = frame.agents().to_vec();
            agents[0].state.pose.heading = 1.0;
            *frame = Frame::new(agents, Vec::new());
        }
        assert_eq!(turn(&scenario), 1.0);
        smooth_motion(&mut scenario);
        assert!(turn(&scenario) < 0.12, "{}", turn(&scenario));
    }
}
