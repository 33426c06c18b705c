//! The log as a world: an oracle.

use gump_scene::{AgentState, Frame, Scenario};

use super::constant_velocity::coast;
use super::independent::{Future, Independent};
use crate::{BoxError, RolloutError, Session, Start, WorldModel};

/// Replays a recorded scenario.
///
/// This world knows the future: use it as an upper bound or as a non-reactive background, not as a
/// model. The ego can be driven, but other agents do not react to it. **Past the end of the log
/// agents keep their last velocity** and lights their last colour; [`LogReplay::seconds_left`]
/// returns when that starts. The ego is always present: where its track ends before the log it
/// keeps its velocity.
#[derive(Clone, Debug)]
pub struct LogReplay {
    scenario: Scenario,
}

impl LogReplay {
    /// Keeps a copy of the scenario, including its future.
    pub fn new(scenario: &Scenario) -> Self {
        Self {
            scenario: scenario.clone(),
        }
    }

    /// Seconds of log after the scenario's present.
    pub fn seconds_left(&self) -> f64 {
        self.scenario.future().len() as f64 * self.scenario.dt
    }

    /// The frame of the log that shows `frame`: an equal one, else the one that shares the most
    /// agent states with it (a driven ego differs from its log). The present wins ties.
    fn locate(&self, frame: &Frame) -> Option<usize> {
        let log = &self.scenario.log;
        let now = self.scenario.now;
        let order = std::iter::once(now).chain((0..log.len()).filter(|&i| i != now));
        let shared = |i: usize| {
            let same =
                |a: &&gump_scene::Agent| log[i].agent(a.id).is_some_and(|b| b.state == a.state);
            frame.agents().iter().filter(same).count()
        };
        let mut best = (0, None);
        for i in order {
            let n = shared(i);
            if n > best.0 {
                best = (n, Some(i));
            }
        }
        best.1
    }
}

impl WorldModel for LogReplay {
    fn name(&self) -> &str {
        "log"
    }

    /// # Errors
    /// [`RolloutError::ForeignScene`] if a scene is not an instant of this log,
    /// [`RolloutError::MixedTimeSteps`] if it has another time step.
    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let open = |start: &Start<'_>| {
            let (first, other) = (self.scenario.dt, start.scene.dt);
            if (first - other).abs() > 1e-9 {
                return Err(RolloutError::MixedTimeSteps { first, other });
            }
            let index = self
                .locate(start.scene.now())
                .ok_or_else(|| RolloutError::ForeignScene(self.scenario.id.clone()))?;
            let future = Replaying {
                scenario: &self.scenario,
                index,
                frame: start.scene.now().clone(),
            };
            Ok(vec![future; start.n_futures])
        };
        Ok(Box::new(Independent::new(starts, Box::new(open))?))
    }
}

#[derive(Clone)]
struct Replaying<'a> {
    scenario: &'a Scenario,
    index: usize,
    frame: Frame,
}

impl Future for Replaying<'_> {
    fn step(&mut self, ego: Option<AgentState>) -> Frame {
        self.index += 1;
        let Scenario {
            log,
            dt,
            ego: ego_id,
            ..
        } = self.scenario;
        let logged = log.get(self.index);
        let lights = logged.unwrap_or(&self.frame).lights().to_vec();
        let mut agents: Vec<_> = match logged {
            Some(frame) => frame.agents().to_vec(),
            None => self.frame.agents().iter().map(|a| coast(a, *dt)).collect(),
        };
        // The ego as it was: driven, or kept where its track ends early.
        if let Some(before) = self.frame.agent(*ego_id) {
            let own = agents.iter_mut().find(|agent| agent.id == *ego_id);
            match (own, ego) {
                (Some(own), Some(state)) => *own = own.with_state(state),
                (Some(_), None) => {}
                (None, Some(state)) => agents.push(before.with_state(state)),
                (None, None) => agents.push(coast(before, *dt)),
            }
        }
        self.frame = Frame::new(agents, lights);
        self.frame.clone()
    }
}
