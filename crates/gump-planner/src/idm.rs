//! The simplest planner: one driver, nothing imagined.

use gump_scene::SceneState;

use crate::{Candidate, Plan, PlanError, Planner, ProposalConfig, propose};

/// Drives along the centre of its way at the speed limit by the Intelligent Driver Model.
#[derive(Clone, Debug)]
pub struct IdmPlanner {
    config: ProposalConfig,
}

impl IdmPlanner {
    /// Takes the driver from `config`; its speeds and offsets are not used.
    ///
    /// # Errors
    /// [`PlanError::Parameter`] for a parameter out of range.
    pub fn new(config: ProposalConfig) -> Result<Self, PlanError> {
        let config = ProposalConfig {
            speed_fractions: vec![1.0],
            lateral_offsets: vec![0.0],
            ..config
        };
        config.check()?;
        Ok(Self { config })
    }
}

impl Planner for IdmPlanner {
    fn name(&self) -> &str {
        "idm"
    }

    fn plan(&mut self, scene: &SceneState<'_>) -> Result<Plan, PlanError> {
        let candidates = propose(scene, &self.config)?
            .proposals
            .into_iter()
            .map(|proposal| Candidate {
                proposal,
                score: None,
            })
            .collect();
        Ok(Plan {
            chosen: 0,
            candidates,
        })
    }
}
