//! The simplest world: every agent keeps its velocity.

use gump_scene::{Agent, AgentId, AgentState, Frame, Light};

use super::independent::{Future, Independent};
use crate::{BoxError, Session, Start, WorldModel};

/// Every agent keeps its velocity and heading; lights stay unchanged unless they are set. All
/// futures of a scene are equal.
#[derive(Clone, Copy, Debug, Default)]
pub struct ConstantVelocity;

impl WorldModel for ConstantVelocity {
    fn name(&self) -> &str {
        "constant-velocity"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let open = |start: &Start<'_>| {
            let future = Coasting {
                frame: start.scene.now().clone(),
                ego: start.scene.ego,
                dt: start.scene.dt,
            };
            Ok(vec![future; start.n_futures])
        };
        Ok(Box::new(Independent::new(starts, Box::new(open))?))
    }
}

#[derive(Clone)]
struct Coasting {
    frame: Frame,
    ego: AgentId,
    dt: f64,
}

impl Future for Coasting {
    fn show(&mut self, lights: &[Light]) -> bool {
        self.frame = Frame::new(self.frame.agents().to_vec(), lights.to_vec());
        true
    }

    fn exchange(&mut self, leave: &[AgentId], come: &[Agent]) -> bool {
        let agents = self.frame.agents().iter();
        let stay = agents.filter(|agent| agent.id == self.ego || !leave.contains(&agent.id));
        let all = stay.chain(come).copied().collect();
        self.frame = Frame::new(all, self.frame.lights().to_vec());
        true
    }

    fn step(&mut self, ego: Option<AgentState>) -> Frame {
        let agents = self.frame.agents().iter().map(|agent| match ego {
            Some(state) if agent.id == self.ego => agent.with_state(state),
            _ => coast(agent, self.dt),
        });
        self.frame = Frame::new(agents.collect(), self.frame.lights().to_vec());
        self.frame.clone()
    }
}

/// The agent `dt` seconds later at the same velocity.
pub(crate) fn coast(agent: &Agent, dt: f64) -> Agent {
    let mut state = agent.state;
    state.pose.position += state.velocity * dt;
    agent.with_state(state)
}
