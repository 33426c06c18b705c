//! Reduces many futures of a world to the few modes of a prediction.

use gump_geometry::DVec2;
use gump_scene::{AgentId, PredictedMode, Prediction, Rollout, Scenario};

use super::config::MotionConfig;
use super::error::{MotionError, MotionProblem};
use super::evaluate::stride;

/// Turns futures into a prediction of every target, each agent separately.
///
/// Every future votes for the futures whose path ends near its own: within the lateral threshold of
/// the last horizon, scaled by the agent's speed now. The future with the most votes becomes a mode
/// with its share of the votes as confidence, and the futures that voted for it are removed; this
/// repeats until there are six modes or no futures are left. A mode is thus a simulated path, never
/// an average of paths. Ties go to the earlier future.
///
/// An agent that a world has removed stays at its last position.
///
/// # Errors
/// [`MotionProblem::AbsentNow`] if a target is absent at the start of the rollouts,
/// [`MotionProblem::ShortLog`] if a rollout is shorter than a path, [`MotionProblem::TimeStep`].
///
/// Source: greedy choice of endpoints by the probability mass within a radius is that of HOME
/// (Gilles et al. 2021, arXiv:2105.10968); equal votes of samples stand for its heat map.
pub fn forecast(
    scenario: &Scenario,
    rollouts: &[Rollout],
    config: &MotionConfig,
) -> Result<Vec<Prediction>, MotionError> {
    let of_target = |&agent: &AgentId| forecast_agent(scenario, rollouts, agent, config);
    let predictions: Result<_, MotionProblem> = scenario.targets.iter().map(of_target).collect();
    predictions.map_err(|problem| MotionError {
        scenario: scenario.id.clone(),
        problem,
    })
}

fn forecast_agent(
    scenario: &Scenario,
    rollouts: &[Rollout],
    agent: AgentId,
    config: &MotionConfig,
) -> Result<Prediction, MotionProblem> {
    let stride = stride(scenario, config)?;
    let paths = rollouts
        .iter()
        .map(|r| path(r, agent, stride, config.n_steps));
    let paths: Vec<Vec<DVec2>> = paths.collect::<Result<_, _>>()?;
    let now = scenario.present().now().agent(agent);
    let speed = now.map_or(0.0, |agent| agent.state.speed());
    let threshold = config.horizons.last().map_or(0.0, |h| h.lateral);
    let radius = threshold * config.speed_scale.at(speed);
    Ok(Prediction {
        agents: vec![agent],
        modes: modes(&paths, radius, config.max_modes),
    })
}

/// Positions of an agent at the times of a prediction.
fn path(
    rollout: &Rollout,
    agent: AgentId,
    stride: usize,
    n_steps: usize,
) -> Result<Vec<DVec2>, MotionProblem> {
    let start = rollout.start().agent(agent);
    let mut last = start
        .ok_or(MotionProblem::AbsentNow(agent))?
        .state
        .pose
        .position;
    let (expected, found) = (n_steps * stride, rollout.steps());
    if found < expected {
        return Err(MotionProblem::ShortLog { expected, found });
    }
    let mut path = Vec::with_capacity(n_steps);
    for (i, frame) in rollout.imagined().iter().take(expected).enumerate() {
        last = frame.agent(agent).map_or(last, |a| a.state.pose.position);
        if (i + 1) % stride == 0 {
            path.push(last);
        }
    }
    Ok(path)
}

/// At most `most` of the paths, chosen by votes within `radius` metres of their ends.
fn modes(paths: &[Vec<DVec2>], radius: f64, most: usize) -> Vec<PredictedMode> {
    let ends: Vec<DVec2> = paths.iter().filter_map(|p| p.last().copied()).collect();
    let mut left: Vec<usize> = (0..ends.len()).collect();
    let mut modes = Vec::new();
    while modes.len() < most && !left.is_empty() {
        let near = |i: usize, j: usize| ends[i].distance(ends[j]) <= radius;
        let votes = |i: usize| left.iter().filter(|&&j| near(i, j)).count();
        let mut best = (left[0], votes(left[0]));
        for &i in &left[1..] {
            let n = votes(i);
            if n > best.1 {
                best = (i, n);
            }
        }
        let (chosen, n) = best;
        modes.push(PredictedMode {
            confidence: n as f64 / ends.len() as f64,
            paths: vec![paths[chosen].clone()],
        });
        left.retain(|&j| !near(chosen, j));
    }
    modes
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec2;
    use gump_scene::{Frame, fixture};

    fn ends(modes: &[PredictedMode]) -> Vec<(f64, f64)> {
        let end = |mode: &PredictedMode| mode.paths[0].last().unwrap().x;
        modes.iter().map(|m| (end(m), m.confidence)).collect()
    }

    #[test]
    fn the_crowded_ends_become_modes_with_their_shares() {
        let paths: Vec<_> = [0.0, 10.0, 10.5, 11.0, 0.4, 50.0, 12.0, 11.5]
            .map(|x| vec![dvec2(-1.0, 0.0), dvec2(x, 0.0)])
            .into();
        // 11.0 is within 1 m of 10, 10.5, 12 and 11.5; then 0 of 0.4; then 50 is alone.
        let found = modes(&paths, 1.0, 6);
        assert_eq!(ends(&found), [(11.0, 0.625), (0.0, 0.25), (50.0, 0.125)]);
        assert_eq!(modes(&paths, 1.0, 1).len(), 1);
        assert!(modes(&[], 1.0, 6).is_empty());
        // With no tolerance only equal ends vote together, and six are kept.
        assert_eq!(modes(&paths, 0.0, 6).len(), 6);
    }

    fn scenario() -> Scenario {
        fixture::scenario(
            "ego vehicle 0: 0,0 velocity 5,0
             agent pedestrian 1: 9,9 velocity 0,1
             history 1 future 8 dt 0.1",
        )
        .unwrap()
    }

    #[test]
    fn a_path_has_a_position_every_half_second_and_absence_stands_still() {
        let mut scenario = scenario();
        scenario.targets = vec![AgentId(0), AgentId(1)];
        let mut rollout = Rollout::begin(scenario.present());
        for (i, frame) in scenario.future().iter().enumerate() {
            let agents = frame.agents().iter().copied();
            let stay = agents.filter(|agent| i < 40 || agent.id != AgentId(1));
            rollout.push(Frame::new(stay.collect(), vec![]));
        }
        let config = MotionConfig::challenge();
        let found = forecast(&scenario, &[rollout], &config).unwrap();
        let path = |i: usize| &found[i].modes[0].paths[0];
        assert_eq!(path(0).len(), 16);
        for (p, x) in path(0).iter().zip(1..) {
            assert!((p.x - 2.5 * f64::from(x)).abs() < 1e-9, "{p}");
        }
        assert!((path(1)[7].y - 13.0).abs() < 1e-9 && path(1)[15] == path(1)[7]);
        assert_eq!(found[0].modes[0].confidence, 1.0);
    }

    #[test]
    fn who_is_not_there_and_futures_that_end_early_are_errors() {
        let mut scenario = scenario();
        scenario.targets = vec![AgentId(7)];
        let config = MotionConfig::challenge();
        let check = |scenario: &Scenario, rollout: &Rollout, expected: &str| {
            let error = forecast(scenario, std::slice::from_ref(rollout), &config).unwrap_err();
            assert_eq!(error.to_string(), expected);
        };
        let short = Rollout::begin(scenario.present());
        check(
            &scenario,
            &short,
            "scenario fixture: agent 7 is to be predicted but is absent in the present frame",
        );
        scenario.targets = vec![AgentId(0)];
        check(
            &scenario,
            &short,
            "scenario fixture: expected 80 recorded frames after the present, found 0",
        );
    }
}
