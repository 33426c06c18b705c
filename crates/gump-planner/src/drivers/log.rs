//! The recorded driver, an oracle.

use gump_nuplan::closed_loop::{Driver, PlannerInput, Recording};
use gump_nuplan::tracking::Trajectory;
use gump_rollout::{BoxError, RolloutError};
use gump_scene::EgoState;

use crate::candidates::{Candidate, Explain};

/// Iterations between the states of a plan: half a second.
const STRIDE: usize = 5;
/// States of a plan besides the present: 8 s.
const STATES: usize = 16;

/// Plans the logged drive: the present and the next 8 s of the log, as far as it goes.
///
/// It knows the future; its score is that of the recorded driver, or of the controller that follows
/// it. Source: nuPlan's log-future planner.
#[derive(Clone, Debug)]
pub struct LogDriver {
    states: Vec<EgoState>,
}

impl LogDriver {
    /// Takes the logged drive from the present on, and the drive after the recording's end if it is
    /// known.
    pub fn new(recording: &Recording, after: &[EgoState]) -> Self {
        let mut states = recording.expert().to_vec();
        states.extend_from_slice(after);
        Self { states }
    }
}

impl Driver for LogDriver {
    fn name(&self) -> &str {
        "log"
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let rest = self.states.get(input.iteration..).unwrap_or_default();
        let mut plan: Vec<EgoState> = rest
            .iter()
            .step_by(STRIDE)
            .take(STATES + 1)
            .copied()
            .collect();
        // Near the end of the log a last, shorter step reaches it.
        match (plan.last(), rest.last()) {
            (Some(planned), Some(last)) if plan.len() <= STATES && planned != last => {
                plan.push(*last);
            }
            _ => {}
        }
        if plan.len() < 2 {
            return Err(RolloutError::TooFewStates(plan.len()).into());
        }
        Ok(Trajectory::new(plan)?)
    }
}

impl Explain for LogDriver {
    fn candidates(&self) -> Vec<Candidate> {
        vec![Candidate::alone("what was driven", Vec::new())]
    }
}
