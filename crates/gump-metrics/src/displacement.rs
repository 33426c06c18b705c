//! Displacement errors: distances of futures from the log.

use gump_scene::{AgentId, Rollout, Scenario};
use rayon::prelude::*;

/// Distance of one agent's futures from its logged track, metres.
///
/// A step counts if the agent is present both in the log and in the rollout. A world that drops
/// agents is therefore not penalised here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Displacement {
    /// The agent.
    pub agent: AgentId,
    /// Mean over steps, mean over futures.
    pub ade: f64,
    /// Mean over steps, of the best future.
    pub min_ade: f64,
    /// At the last step that counts, mean over futures.
    pub fde: f64,
    /// At the last step that counts, of the best future.
    pub min_fde: f64,
}

/// The displacement of `agents`, in their order, over all futures of one scenario.
///
/// Agents that share no step with the log in any future are left out, as are steps past the end of
/// the log.
///
/// # Panics
/// If a rollout has another time step than the log: it cannot have started from it.
pub fn average_displacement(
    rollouts: &[Rollout],
    scenario: &Scenario,
    agents: &[AgentId],
) -> Vec<Displacement> {
    for rollout in rollouts {
        assert!(
            (rollout.dt() - scenario.dt).abs() < 1e-9,
            "a rollout is compared with the log it started from"
        );
    }
    let all: Vec<Option<Displacement>> = agents
        .par_iter()
        .map(|&agent| {
            let futures: Vec<(f64, f64)> = rollouts
                .iter()
                .filter_map(|rollout| displacement(rollout, scenario, agent))
                .collect();
            let n = futures.len() as f64;
            let mean = |value: fn(&(f64, f64)) -> f64| futures.iter().map(value).sum::<f64>() / n;
            let least = |value: fn(&(f64, f64)) -> f64| {
                futures.iter().map(value).fold(f64::INFINITY, f64::min)
            };
            (!futures.is_empty()).then(|| Displacement {
                agent,
                ade: mean(|f| f.0),
                min_ade: least(|f| f.0),
                fde: mean(|f| f.1),
                min_fde: least(|f| f.1),
            })
        })
        .collect();
    all.into_iter().flatten().collect()
}

/// Mean and final distance of one future.
fn displacement(rollout: &Rollout, scenario: &Scenario, agent: AgentId) -> Option<(f64, f64)> {
    let (mut sum, mut n, mut last) = (0.0, 0, 0.0);
    for (imagined, logged) in rollout.imagined().iter().zip(scenario.future()) {
        if let (Some(a), Some(b)) = (imagined.agent(agent), logged.agent(agent)) {
            last = a.state.pose.position.distance(b.state.pose.position);
            sum += last;
            n += 1;
        }
    }
    (n > 0).then(|| (sum / f64::from(n), last))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::logged;
    use approx::assert_abs_diff_eq;
    use gump_geometry::dvec2;
    use gump_scene::{Agent, Frame, fixture};

    fn scenario() -> Scenario {
        let text = "ego vehicle 0: 0,0 velocity 5,0\nhistory 0.5 future 2 dt 0.5";
        fixture::scenario(text).unwrap()
    }

    /// The log with every agent moved sideways by `offset(step)` metres, step counting from 1.
    fn beside(scenario: &Scenario, offset: impl Fn(usize) -> f64) -> Rollout {
        let mut rollout = Rollout::begin(scenario.present());
        for (i, frame) in scenario.future().iter().enumerate() {
            let agents = frame.agents().iter().map(|agent| {
                let mut agent: Agent = *agent;
                agent.state.pose.position += dvec2(0.0, offset(i + 1));
                agent
            });
            rollout.push(Frame::new(agents.collect(), vec![]));
        }
        rollout
    }

    #[test]
    fn the_log_is_not_displaced() {
        let scenario = scenario();
        let found = average_displacement(&[logged(&scenario)], &scenario, &[AgentId(0)]);
        assert_eq!((found[0].ade, found[0].min_fde), (0.0, 0.0));
    }

    #[test]
    fn two_futures_by_hand() {
        let scenario = scenario();
        // Offsets 1 1 1 1 and 0 0 0 3: averages 1 and 0.75, ends 1 and 3.
        let rollouts = [
            beside(&scenario, |_| 1.0),
            beside(&scenario, |step| if step == 4 { 3.0 } else { 0.0 }),
        ];
        let found = average_displacement(&rollouts, &scenario, &[AgentId(0), AgentId(5)]);
        assert_eq!(found.len(), 1);
        assert_abs_diff_eq!(found[0].ade, 0.875);
        assert_abs_diff_eq!(found[0].min_ade, 0.75);
        assert_abs_diff_eq!(found[0].fde, 2.0);
        assert_abs_diff_eq!(found[0].min_fde, 1.0);
    }

    #[test]
    fn steps_without_a_logged_state_do_not_count() {
        let mut scenario = scenario();
        let rollout = beside(&scenario, |step| step as f64);
        for frame in &mut scenario.log[4..] {
            *frame = Frame::default();
        }
        let found = average_displacement(&[rollout], &scenario, &[AgentId(0)]);
        // Two of the four steps are logged.
        assert_eq!((found[0].ade, found[0].fde), (1.5, 2.0));
    }
}
