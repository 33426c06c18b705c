//! The world's own ego as a driver.

use gump_geometry::{DVec2, Pose, dvec2};
use gump_nuplan::closed_loop::{Driver, PlannerInitialization, PlannerInput};
use gump_nuplan::tracking::Trajectory;
use gump_rollout::{BoxError, RolloutError, Start, WorldModel};
use gump_scene::{EgoState, Seed, VehicleParameters};

use crate::candidates::{Candidate, Explain};
use crate::{PlanError, Proposal, ProposalKind};

/// Horizon of a plan, seconds: that of nuPlan's open loop.
const SECONDS: f64 = 8.0;
/// Seconds between the states of a plan: those between nuPlan's iterations.
const DT: f64 = 0.1;

/// Plans the mean of the ego's motion in several futures of a world.
///
/// The world sees the whole scene and drives all agents. Source: the open-loop use of the GUMP
/// paper.
pub struct ImitationDriver<'w> {
    world: &'w dyn WorldModel,
    n_futures: usize,
    every: usize,
    seed: Seed,
    vehicle: Option<VehicleParameters>,
    plan: Option<Trajectory>,
}

impl<'w> ImitationDriver<'w> {
    /// A driver that simulates `n_futures` futures at every `every`-th iteration.
    ///
    /// # Errors
    /// [`PlanError::Parameter`] if either is 0.
    pub fn new(
        world: &'w dyn WorldModel,
        n_futures: usize,
        every: usize,
        seed: Seed,
    ) -> Result<Self, PlanError> {
        for (name, n) in [("n_futures", n_futures), ("every", every)] {
            if n == 0 {
                let expected = "at least 1";
                return Err(PlanError::Parameter {
                    name,
                    value: 0.0,
                    expected,
                });
            }
        }
        Ok(Self {
            world,
            n_futures,
            every,
            seed,
            vehicle: None,
            plan: None,
        })
    }

    /// The ego's mean poses over all futures, now first; and the seconds in between.
    fn imagine(&self, input: &PlannerInput<'_>) -> Result<(Vec<Pose>, f64), BoxError> {
        let scene = input.scene;
        let mut session = self.world.open(&[Start {
            scene,
            n_futures: self.n_futures,
            seed: self.seed.fork(input.iteration as u64),
        }])?;
        let dt = session.dt();
        let mut places = vec![scene.ego_now().state.pose];
        for step in 0..(SECONDS / dt).ceil() as usize {
            let (mut sum, mut ahead) = (DVec2::ZERO, DVec2::ZERO);
            let frames = session.step(None)?;
            for (future, frame) in frames.iter().enumerate() {
                let ego = scene.ego;
                let own =
                    frame
                        .agent(ego)
                        .ok_or(RolloutError::EgoVanished { ego, future, step })?;
                sum += own.state.pose.position;
                ahead += own.state.pose.direction();
            }
            places.push(Pose {
                position: sum / frames.len() as f64,
                heading: ahead.to_angle(),
            });
        }
        Ok((places, dt))
    }
}

impl Driver for ImitationDriver<'_> {
    fn name(&self) -> &str {
        "imitation"
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        self.vehicle = Some(initialization.vehicle);
        self.plan = None;
        Ok(())
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let vehicle = self.vehicle.ok_or(PlanError::NotInitialized)?;
        if let Some(plan) = &self.plan
            && !input.iteration.is_multiple_of(self.every)
        {
            return Ok(plan.clone());
        }
        let (places, dt) = self.imagine(input)?;
        let proposal = Proposal::through(ProposalKind::Imitation, &places, dt);
        let plan = follow(&proposal, input, &vehicle)?;
        self.plan = Some(plan.clone());
        Ok(plan)
    }
}

impl Explain for ImitationDriver<'_> {
    fn candidates(&self) -> Vec<Candidate> {
        let poses = |plan: &Trajectory| plan.states().iter().map(|s| s.rear_axle).collect();
        self.plan
            .iter()
            .map(|plan| Candidate::alone("the mean of what is imagined", poses(plan)))
            .collect()
    }
}

/// A proposal as the trajectory that a vehicle follows from its present state on.
fn follow(
    proposal: &Proposal,
    input: &PlannerInput<'_>,
    vehicle: &VehicleParameters,
) -> Result<Trajectory, BoxError> {
    let now = input.scene.ego_now().state;
    let mut states = vec![*input.ego];
    for (i, state) in proposal.resampled(&now, DT).iter().enumerate() {
        states.push(EgoState {
            time_us: input.ego.time_us + (i as i64 + 1) * (DT * 1e6) as i64,
            rear_axle: vehicle.rear_axle_of(state.pose),
            velocity: dvec2(state.velocity.dot(state.pose.direction()), 0.0),
            ..EgoState::default()
        });
    }
    Ok(Trajectory::new(states)?)
}
