//! The planners of the command line, ours and those in other processes.

use std::time::Duration;

use gump_eval::closed_loop::{EvaluatedPlanner, PlannerFactory};
use gump_eval::recordings::Case;
use gump_planner::Explain;
use gump_rollout::BoxError;
use gump_scene::Seed;

use crate::planners::Chosen;

/// A planner in another process.
pub(super) struct Remote {
    address: String,
    #[cfg_attr(
        not(feature = "grpc"),
        expect(dead_code, reason = "a build without the feature calls nobody")
    )]
    limit: Option<Duration>,
}

impl Remote {
    /// Those among some planners, in their order; `limit` is how long a step may take.
    pub(super) fn of(planners: &[Chosen], limit: Option<Duration>) -> Vec<Self> {
        let remote = |chosen: &Chosen| match chosen {
            Chosen::Ours(_) => None,
            Chosen::Remote(address) => Some(Self {
                address: address.clone(),
                limit,
            }),
        };
        planners.iter().filter_map(remote).collect()
    }
}

/// Planners as they are evaluated; `remotes` are those of [`Remote::of`].
pub(super) fn evaluated<'a>(
    planners: &[Chosen],
    remotes: &'a [Remote],
) -> Vec<EvaluatedPlanner<'a>> {
    let mut remotes = remotes.iter();
    let evaluated = planners.iter().filter_map(|chosen| match chosen {
        Chosen::Ours(planner) => Some(EvaluatedPlanner::Named(*planner)),
        Chosen::Remote(_) => Some(EvaluatedPlanner::Custom(remotes.next()?)),
    });
    evaluated.collect()
}

impl PlannerFactory for Remote {
    fn name(&self) -> String {
        Chosen::Remote(self.address.clone()).to_string()
    }

    #[cfg(feature = "grpc")]
    fn build(&self, case: &Case, _: Seed) -> Result<Box<dyn Explain + '_>, BoxError> {
        let driver = gump_grpc::RemoteDriver::new(&self.address, &case.map_name, self.limit);
        Ok(Box::new(driver))
    }

    #[cfg(not(feature = "grpc"))]
    fn build(&self, _: &Case, _: Seed) -> Result<Box<dyn Explain + '_>, BoxError> {
        Chosen::Remote(self.address.clone()).check()?;
        Err(format!("this build cannot call {}", self.address).into())
    }

    /// It plans for one drive at a time.
    fn is_parallel(&self) -> bool {
        false
    }
}
