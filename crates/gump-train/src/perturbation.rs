//! Perturbation: objects are displaced from their path in samples, so that the network learns to
//! return to it.
//!
//! In a log every vehicle is where its driver wants it to be. In its own rollouts a network is soon
//! slightly displaced, and one that never saw displacements continues straight on, off the road.
//! Here objects that move along a lane are pushed sideways and turned a little at every frame, with
//! targets that take back a share of the displacement. The displacement is visible from the lane,
//! so it is not noise to the network, unlike a displacement along the path, which is not visible.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, wrap_angle};
use gump_scene::{AgentId, AgentKind, Frame, Rng, Scenario};
use rand::Rng as _;

use crate::closed_loop_samples::DrivenScenario;

/// Share of the displacement that is left half a second later: about half after a second. Chosen by
/// hand; docs/results/0011-surroundings.md has the effect of the whole.
pub(crate) const SLACK: f64 = 0.7;
/// Slower objects are not displaced, metres per second: nothing moves sideways in place.
const SLOWEST: f64 = 2.0;
/// Turn per metre of displacement, radians: 7 degrees. Chosen by hand.
const TURN: f64 = 0.12;

/// The `frames` token frames of a log from index `start` on, perturbed after the first; a push is
/// up to `reach_m` metres to either side.
pub(crate) fn lateral_perturbation(
    scenario: &Scenario,
    start: usize,
    stride: usize,
    frames: usize,
    reach_m: f64,
    rng: &mut Rng,
) -> DrivenScenario {
    let mut offs: BTreeMap<AgentId, Off> = BTreeMap::new();
    let shown = (1..frames).filter_map(|k| scenario.log.get(start + k * stride));
    let frames = shown.map(|frame| {
        let agents = frame.agents().iter().map(|agent| {
            if !matches!(agent.kind, AgentKind::Vehicle | AgentKind::Bicycle) {
                return *agent;
            }
            let off = offs.entry(agent.id).or_insert_with(|| Off {
                reach_m: reach_m * rng.random::<f64>(),
                ..Off::default()
            });
            off.push(rng);
            if agent.state.speed() < SLOWEST {
                (off.left_m, off.turn) = (0.0, 0.0);
            }
            let mut state = agent.state;
            state.pose.position += state.pose.rotate(DVec2::new(0.0, off.left_m));
            state.pose.heading = wrap_angle(state.pose.heading + off.turn);
            state.velocity = DVec2::from_angle(off.turn).rotate(state.velocity);
            agent.with_state(state)
        });
        Frame::new(agents.collect(), frame.lights().to_vec())
    });
    DrivenScenario {
        scenario: 0,
        present: start,
        stride,
        frames: frames.collect(),
    }
}

/// Displacement of an object from its path.
#[derive(Clone, Copy, Debug, Default)]
struct Off {
    left_m: f64,
    turn: f64,
    /// Maximum push at one frame.
    reach_m: f64,
}

impl Off {
    /// Half a second later: part of the displacement is taken back, and another push is added.
    fn push(&mut self, rng: &mut Rng) {
        let mut within = |bound: f64| bound * (rng.random::<f64>() + rng.random::<f64>() - 1.0);
        self.left_m = SLACK * self.left_m + within(self.reach_m);
        self.turn = SLACK * self.turn + within(TURN * self.reach_m);
    }
}

#[cfg(test)]
mod tests {
    use gump_scene::{Seed, fixture};

    use super::*;

    #[test]
    fn drivers_are_displaced_from_their_path_and_who_stands_or_walks_is_not() {
        let scenario = fixture::scenario(
            "ego vehicle 0: 0,0 velocity 8,0
             agent vehicle 1: 20,0 velocity 0,0
             agent pedestrian 7: 30,3 velocity 0,-3",
        )
        .unwrap();
        let shown = |seed| lateral_perturbation(&scenario, 10, 5, 5, 1.0, &mut Seed(seed).rng());
        let mut farthest = 0.0_f64;
        for seed in 0..20 {
            let drive = shown(seed);
            assert_eq!(drive.frames.len(), 4);
            assert!(drive.frame(10).is_none());
            for k in 1..5 {
                let (index, logged) = (10 + 5 * k, &scenario.log[10 + 5 * k]);
                let frame = drive.frame(index).expect("it is shown");
                for (shown, logged) in frame.agents().iter().zip(logged.agents()) {
                    let off = shown.state.pose.position - logged.state.pose.position;
                    if logged.id != AgentId(0) {
                        assert_eq!(shown, logged);
                    }
                    assert!(off.x.abs() < 1e-9 && off.y.abs() < 1.0 / (1.0 - SLACK));
                    farthest = farthest.max(off.y.abs());
                }
            }
        }
        assert!(farthest > 0.5, "{farthest}");
        assert_eq!(format!("{:?}", shown(3)), format!("{:?}", shown(3)));
    }
}
