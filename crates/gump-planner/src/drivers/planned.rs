//! Any planner as a driver.

use gump_geometry::dvec2;
use gump_nuplan::closed_loop::{Driver, Mission, Moment};
use gump_nuplan::tracking::Trajectory;
use gump_rollout::BoxError;
use gump_scene::{EgoState, VehicleParameters};

use crate::considered::{Considered, Explain};
use crate::{Plan, PlanError, Planner, Proposal};

/// Seconds between the states that the vehicle is given.
const DT: f64 = 0.1;

/// Lets a [`Planner`] drive a vehicle: its box centres become rear axles.
///
/// It plans afresh every so many iterations and follows its choice in between.
#[derive(Clone, Debug)]
pub struct Planned<P> {
    planner: P,
    every: usize,
    vehicle: Option<VehicleParameters>,
    plan: Option<Plan>,
    following: Option<Trajectory>,
}

impl<P: Planner> Planned<P> {
    /// Plans at every `every`-th iteration, at least at each one in `every` = 1.
    pub fn new(planner: P, every: usize) -> Self {
        Self {
            planner,
            every: every.max(1),
            vehicle: None,
            plan: None,
            following: None,
        }
    }
}

impl<P: Planner> Driver for Planned<P> {
    fn name(&self) -> &str {
        self.planner.name()
    }

    fn start(&mut self, mission: &Mission<'_>) -> Result<(), BoxError> {
        self.vehicle = Some(mission.vehicle);
        self.plan = None;
        self.following = None;
        Ok(())
    }

    fn drive(&mut self, moment: &Moment<'_>) -> Result<Trajectory, BoxError> {
        let vehicle = self.vehicle.ok_or(PlanError::NoMission)?;
        if let Some(known) = &self.following
            && !moment.iteration.is_multiple_of(self.every)
        {
            return Ok(known.clone());
        }
        let plan = self.planner.plan(&moment.scene)?;
        let following = follow(&plan.choice().proposal, moment, &vehicle)?;
        self.plan = Some(plan);
        self.following = Some(following.clone());
        Ok(following)
    }
}

/// A proposal as the trajectory that a vehicle follows from its present state on.
pub(super) fn follow(
    proposal: &Proposal,
    moment: &Moment<'_>,
    vehicle: &VehicleParameters,
) -> Result<Trajectory, BoxError> {
    let now = moment.scene.ego_now().state;
    let mut states = vec![*moment.ego];
    for (i, state) in proposal.resampled(&now, DT).iter().enumerate() {
        states.push(EgoState {
            time_us: moment.ego.time_us + (i as i64 + 1) * (DT * 1e6) as i64,
            rear_axle: vehicle.rear_axle_of(state.pose),
            velocity: dvec2(state.velocity.dot(state.pose.direction()), 0.0),
            ..EgoState::default()
        });
    }
    Ok(Trajectory::new(states)?)
}

impl<P: Planner> Explain for Planned<P> {
    fn considered(&self) -> Vec<Considered> {
        let Some(plan) = &self.plan else {
            return Vec::new();
        };
        let all = plan.candidates.iter().enumerate().map(|(i, candidate)| {
            let futures = candidate
                .score
                .iter()
                .flat_map(|score| score.futures.first());
            let gates = futures
                .clone()
                .flat_map(|f| f.gates.iter().map(|g| (g.name, g.factor)));
            let terms = futures.flat_map(|f| f.terms.iter().map(|t| (t.name, t.contribution())));
            Considered {
                name: candidate.proposal.kind.to_string(),
                chosen: i == plan.chosen,
                score: candidate.score.as_ref().map(|score| score.mean),
                parts: gates.clone().chain(terms).collect(),
                poses: candidate
                    .proposal
                    .states
                    .iter()
                    .map(|state| state.pose)
                    .collect(),
            }
        });
        all.collect()
    }
}
