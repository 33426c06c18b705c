//! Expert demonstrations: the log's egos as transitions.

use std::sync::Arc;

use gump_scene::Seed;

use crate::sac::{ReplayBuffer, Transition};
use crate::{
    Autoreset, DrivingEnv, EnvConfig, EpisodeStart, PreparedScenario, RlError, TrafficSource,
    VectorEnv,
};

/// Drives every scenario once within its log, by the actions that come nearest to the log's, from the
/// present to the end of the episode.
///
/// The transitions are those of the environment, including rewards and ends. If the dynamics cannot
/// follow a log exactly, it is followed as closely as they allow.
///
/// # Errors
/// [`RlError::NoScenario`] and [`RlError::Parameter`].
pub fn demonstrations(
    prepared: &Arc<[PreparedScenario]>,
    config: &EnvConfig,
) -> Result<ReplayBuffer, RlError> {
    let n = prepared.len();
    let config = EnvConfig {
        n_envs: n,
        autoreset: Autoreset::SameStep,
        ..*config
    };
    let mut env = DrivingEnv::new(Arc::clone(prepared), TrafficSource::Log, config)?;
    let start = |scenario| EpisodeStart {
        scenario,
        seed: Seed(0),
    };
    env.reset_to(&(0..n).map(start).collect::<Vec<_>>())?;
    let (o, a) = (env.observation_len(), env.action_len());
    let longest = prepared
        .iter()
        .map(PreparedScenario::logged_steps)
        .max()
        .unwrap_or(0);
    let mut buffer = ReplayBuffer::new((n * longest).max(1), config.observation.form(), a)?;
    let mut actions = vec![0.0; n * a];
    let mut is_driving = vec![true; n];
    while is_driving.contains(&true) {
        let before = env.observations().to_vec();
        env.expert_actions(&mut actions)?;
        env.step(&actions)?;
        for i in (0..n).filter(|&i| is_driving[i]) {
            buffer.push(Transition {
                observation: before[i * o..][..o].into(),
                action: &actions[i * a..][..a],
                reward: env.rewards()[i],
                next: env.final_observations()[i * o..][..o].into(),
                terminated: env.terminated()[i],
            });
        }
        for (row, _) in env.finished() {
            is_driving[*row] = false;
        }
    }
    Ok(buffer)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use super::*;
    use gump_scene::fixture;

    #[test]
    fn the_log_is_driven_once() {
        let scene = |others: &str| {
            let text = format!(
                "lane 1: 0,0 400,0 speed 15\nroute 1\nego vehicle 0: 10,0 velocity 8,0\n{others}"
            );
            fixture::scenario(&text).unwrap()
        };
        // The second log drives into a parked car after 21 m.
        let scenes = [scene(""), scene("agent vehicle 1: 35.8,0")];
        let prepared = PreparedScenario::prepare(scenes, 0.5).unwrap();
        let buffer = demonstrations(&prepared, &EnvConfig::default()).unwrap();
        let ends: Vec<_> = buffer.iter().filter(|t| t.terminated).collect();
        assert_eq!(buffer.len(), 16 + 6);
        assert_eq!(ends.len(), 1);
        assert!(
            (ends[0].reward - (0.4 - 5.0)).abs() < 1e-3,
            "{}",
            ends[0].reward
        );
        for t in buffer.iter() {
            assert!(t.action.iter().all(|a| a.abs() < 1e-3), "{:?}", t.action);
            assert!(
                t.terminated || (t.reward - 0.4).abs() < 1e-3,
                "{}",
                t.reward
            );
        }
    }
}
