//! Paths, as the Waymo Sim Agents Challenge exchanges them, as futures to be counted.

use gump_geometry::{DVec2, Pose, wrap_angle};
use gump_scene::{Agent, AgentState, Frame, Rollout, Scenario};

use crate::wosac::{Rollouts, Trajectory};

/// Rollouts of the challenge as rollouts of the scenario: agents keep what they are in the present,
/// lights are those of the log as long as it lasts. Paths of unknown agents are left out; equal
/// copies come once.
pub fn of_paths(scenario: &Scenario, rollouts: &Rollouts) -> Vec<Rollout> {
    let futures = rollouts.futures.iter();
    futures.map(|paths| of_future(scenario, paths)).collect()
}

fn of_future(scenario: &Scenario, paths: &[Trajectory]) -> Rollout {
    let present = scenario.present();
    let known: Vec<(&Agent, &Trajectory)> = paths
        .iter()
        .filter_map(|path| Some((present.now().agent(path.id)?, path)))
        .collect();
    let n_steps = known
        .iter()
        .map(|(_, path)| path.x.len())
        .max()
        .unwrap_or(0);
    let mut rollout = Rollout::begin(present);
    for step in 0..n_steps {
        let before = rollout.last().now();
        let agents = known.iter().filter_map(|(agent, path)| {
            let pose = pose(path, step)?;
            let from = before.agent(agent.id)?.state.pose.position;
            let velocity = (pose.position - from) / scenario.dt;
            Some(agent.with_state(AgentState { pose, velocity }))
        });
        let logged = scenario.future().get(step).unwrap_or(before);
        let frame = Frame::new(agents.collect(), logged.lights().to_vec());
        rollout.push(frame);
    }
    rollout
}

fn pose(path: &Trajectory, step: usize) -> Option<Pose> {
    let (x, y) = (*path.x.get(step)?, *path.y.get(step)?);
    Some(Pose {
        position: DVec2::new(x.into(), y.into()),
        heading: wrap_angle(f64::from(*path.heading.get(step)?)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::behaviour::{Behaviour, Class, Measure};
    use crate::{logged, wosac};
    use gump_scene::fixture;

    #[test]
    fn paths_show_what_their_rollouts_show() {
        let text = "lane 1: -100,0 500,0\nego vehicle 0: 0,0 velocity 5,0\n\
                    agent vehicle 1: 30,0\nagent pedestrian 2: 9,9 velocity 1,0";
        let scenario = fixture::scenario(text).unwrap();
        let log = logged(&scenario);
        let mode = wosac::Mode::SimAgents;
        let paths = Rollouts::of("fixture", std::slice::from_ref(&log), mode).unwrap();
        let found = of_paths(&scenario, &paths);
        assert_eq!(found.len(), 1);
        let behaviour = Behaviour::new(&scenario, 8);
        let tally = behaviour.of(&found[0]).tally;
        assert_eq!(tally.count(Measure::NewOverlap, Class::All, 8).events, 1.0);
        assert_eq!(tally, behaviour.of(&log).tally);
    }
}
