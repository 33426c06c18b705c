//! Conversion of rollouts in the challenge's messages to rollouts of a scene.

use gump_geometry::{DVec2, Pose, wrap_angle};
use gump_scene::{Agent, AgentState, Frame, Rollout, Scenario};

use crate::realism::{Rollouts, Trajectory};

impl Rollouts {
    /// The futures of the message in a scene. Agents keep their size and kind of the present, and
    /// lights are those of the log as long as it lasts. Paths of unknown agents are left out; equal
    /// copies occur once.
    pub fn in_scene(&self, scenario: &Scenario) -> Vec<Rollout> {
        let futures = self.futures.iter();
        futures.map(|paths| of_future(scenario, paths)).collect()
    }
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
