//! A car that continues straight on.

use gump_geometry::DVec2;
use gump_nuplan::closed_loop::{Driver, PlannerInitialization, PlannerInput};
use gump_nuplan::tracking::{Controls, Trajectory, propagate_by};
use gump_rollout::BoxError;
use gump_scene::{EgoState, VehicleParameters};

use crate::PlanError;
use crate::candidates::{Candidate, Explain};

/// Seconds between the states of a plan.
const DT: f64 = 0.25;
/// States of a plan besides the present: 10 s.
const STATES: usize = 40;

/// Continues straight on at its speed, slowing down to 5 m/s: a baseline.
///
/// Source: nuPlan's simple planner with its default parameters.
#[derive(Clone, Debug)]
pub struct SimpleDriver {
    max_speed: f64,
    vehicle: Option<VehicleParameters>,
}

impl Default for SimpleDriver {
    fn default() -> Self {
        Self {
            max_speed: 5.0,
            vehicle: None,
        }
    }
}

impl Driver for SimpleDriver {
    fn name(&self) -> &str {
        "simple"
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        self.vehicle = Some(initialization.vehicle);
        Ok(())
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let vehicle = self.vehicle.ok_or(PlanError::NotInitialized)?;
        let mut state = EgoState {
            time_us: input.ego.time_us,
            rear_axle: input.ego.rear_axle,
            velocity: input.ego.velocity,
            ..EgoState::default()
        };
        let mut plan = vec![state];
        for _ in 0..STATES {
            if state.speed() > self.max_speed {
                state.acceleration = DVec2::new(self.max_speed - state.speed(), 0.0);
            }
            // Asking for what already is keeps the lags of the vehicle out of the plan.
            let controls = Controls {
                acceleration: state.acceleration.x,
                steering_rate: 0.0,
            };
            let time_us = state.time_us + (DT * 1e6) as i64;
            state = propagate_by(&state, &controls, vehicle.wheel_base, DT, time_us);
            plan.push(state);
        }
        Ok(Trajectory::new(plan)?)
    }
}

impl Explain for SimpleDriver {
    fn candidates(&self) -> Vec<Candidate> {
        vec![Candidate::alone("straight on", Vec::new())]
    }
}
