//! Drivers, which control the ego in a closed loop.

use std::sync::Arc;

use gump_geometry::Pose;
use gump_scene::{EgoState, MapGraph, Route, SceneState, VehicleParameters};

use crate::tracking::Trajectory;
use gump_rollout::BoxError;

/// Receives an initialization once, then plans a trajectory at every step.
///
/// Unlike a [`gump_rollout::Policy`] it drives a vehicle with a rear axle in one future, may keep
/// state, and returns seconds of trajectory of which a tenth of a second is driven.
pub trait Driver {
    /// A short name for tables and reports.
    fn name(&self) -> &str;

    /// Resets the driver and sets a new initialization; a driver without state need not implement this.
    ///
    /// # Errors
    /// Any reason for which the initialization is impossible, for instance a route that is not in the map.
    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        let _ = initialization;
        Ok(())
    }

    /// The trajectory from now on: states of the rear axle, the first not later than now.
    ///
    /// # Errors
    /// Any reason for which the driver cannot plan.
    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError>;
}

/// The route, the goal and the vehicle of a drive.
#[derive(Clone, Copy, Debug)]
pub struct PlannerInitialization<'a> {
    /// The map.
    pub map: &'a Arc<MapGraph>,
    /// The route, if one is known.
    pub route: Option<&'a Arc<Route>>,
    /// The goal, if known: rear axle, world frame.
    pub goal: Option<Pose>,
    /// The ego's extents.
    pub vehicle: VehicleParameters,
}

/// The input of a driver at one iteration.
#[derive(Clone, Copy, Debug)]
pub struct PlannerInput<'a> {
    /// Iterations completed so far.
    pub iteration: usize,
    /// The scene up to now.
    pub scene: SceneState<'a>,
    /// The ego now.
    pub ego: &'a EgoState,
    /// Previous states of the ego, oldest first, without the present.
    pub past: &'a [EgoState],
}
