//! An ego that follows a given trajectory.

use gump_scene::{AgentState, SceneState};

use crate::{BoxError, Command, Policy, dynamics};

/// Drives the ego through given states regardless of other agents, in order to examine their
/// reactions.
///
/// The world receives one of its own steps at a time and never later ones. The ego drives the same
/// way in all futures of a session; past the last state it keeps its velocity. A value serves one
/// simulation only, because it counts the steps.
#[derive(Clone, Debug)]
pub struct Scripted<'a> {
    states: &'a [AgentState],
    dt: f64,
    elapsed_s: f64,
}

impl<'a> Scripted<'a> {
    /// Drives through `states`: box centres in the world frame, the first of which is the present;
    /// the others follow `dt` seconds apart.
    pub fn new(states: &'a [AgentState], dt: f64) -> Self {
        Self {
            states,
            dt,
            elapsed_s: 0.0,
        }
    }
}

impl Policy for Scripted<'_> {
    fn name(&self) -> &str {
        "scripted"
    }

    /// # Errors
    /// [`crate::RolloutError::Trajectory`] without at least two states.
    fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError> {
        let step = scenes.first().map_or(0.0, |scene| scene.dt);
        self.elapsed_s += step;
        let (now, rest) = match self.states.split_first() {
            Some((now, rest)) => (*now, rest),
            None => (AgentState::default(), &[][..]),
        };
        let next = dynamics::track(&now, rest, self.dt, self.elapsed_s)?;
        let command = Command::Follow {
            dt: step,
            states: vec![next],
        };
        Ok(vec![command; scenes.len()])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::worlds::{ConstantVelocity, Idm};
    use crate::{SimulateConfig, Start, WorldModel, simulate};
    use gump_geometry::{Pose, dvec2};
    use gump_scene::{Rollout, Scenario, Seed, fixture};

    fn drive(world: &dyn WorldModel, scenario: &Scenario, states: &[AgentState]) -> Vec<Rollout> {
        let start = Start {
            scene: scenario.present(),
            n_futures: 2,
            seed: Seed(0),
        };
        let config = SimulateConfig {
            seconds: 6.0,
            ..SimulateConfig::default()
        };
        let mut ego = Scripted::new(states, 0.1);
        simulate(world, &[start], Some(&mut ego), &config).unwrap()
    }

    #[test]
    fn the_ego_is_where_it_was_told_and_the_others_are_the_worlds() {
        let scenario = fixture::scenario(
            "lane 1: -100,0 200,0 speed 15
             ego vehicle 0: 0,0 velocity 10,0
             agent vehicle 1: -20,0 velocity 10,0",
        )
        .unwrap();
        // Braking with 5 m/s² to a stop after 10 m.
        let at = |k: usize| {
            let t = (k as f64 / 10.0).min(2.0);
            AgentState {
                pose: Pose::new(10.0 * t - 2.5 * t * t, 0.0, 0.0),
                velocity: dvec2(10.0 - 5.0 * t, 0.0),
            }
        };
        let states: Vec<AgentState> = (0..=60).map(at).collect();
        let follower = |world: &dyn WorldModel| {
            let rollouts = drive(world, &scenario, &states);
            assert_eq!(rollouts.len(), 2);
            for (frame, state) in rollouts[1].imagined().iter().zip(&states[1..]) {
                assert_eq!(frame.agent(scenario.ego).unwrap().state, *state);
            }
            let last = rollouts[0].last().now().agents()[1];
            last.state.pose.position.x
        };
        // Constant velocity drives on; IDM stops behind the ego's box, 4.8 m long.
        assert!((follower(&ConstantVelocity) - 40.0).abs() < 1e-9);
        assert!(follower(&Idm::default()) < 10.0 - 4.8);
    }

    #[test]
    fn past_its_last_state_it_goes_on_and_without_two_it_fails() {
        let scenario = fixture::scenario("ego vehicle 0: 0,0 velocity 10,0").unwrap();
        let state = scenario.present().ego_now().state;
        let mut next = state;
        next.pose.position.x = 1.0;
        let rollouts = drive(&ConstantVelocity, &scenario, &[state, next]);
        let end = rollouts[0].last().ego_now().state.pose.position.x;
        assert!((end - 60.0).abs() < 1e-9, "{end}");
        for too_few in [&[][..], &[state]] {
            let scene = scenario.present();
            assert!(Scripted::new(too_few, 0.1).act(&[scene]).is_err());
        }
    }
}
