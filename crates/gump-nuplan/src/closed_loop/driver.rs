//! What drives the ego through a closed loop.

use std::sync::Arc;

use gump_geometry::Pose;
use gump_scene::{EgoState, MapGraph, Route, SceneState, VehicleParameters};

use crate::tracking::Trajectory;
use gump_rollout::BoxError;

/// Told once where to go, then asked for a trajectory at every step.
///
/// Unlike a [`gump_rollout::Policy`] it drives a car with a rear axle in one future, may remember what it
/// saw, and answers with seconds of trajectory of which a tenth of a second is driven.
pub trait Driver {
    /// A short name for tables and reports.
    fn name(&self) -> &str;

    /// Forgets everything and takes a new mission; a driver that remembers nothing need not say
    /// how.
    ///
    /// # Errors
    /// Whatever makes the mission impossible, a route that is not in the map for instance.
    fn start(&mut self, mission: &Mission<'_>) -> Result<(), BoxError> {
        let _ = mission;
        Ok(())
    }

    /// What to drive from now on: states of the rear axle, the first not later than now.
    ///
    /// # Errors
    /// Whatever keeps the driver from planning.
    fn drive(&mut self, moment: &Moment<'_>) -> Result<Trajectory, BoxError>;
}

/// Where to go, and in what.
#[derive(Clone, Copy, Debug)]
pub struct Mission<'a> {
    /// The road.
    pub map: &'a Arc<MapGraph>,
    /// The way to take, if one is known.
    pub route: Option<&'a Arc<Route>>,
    /// Where the way ends, if known: rear axle, world frame.
    pub goal: Option<Pose>,
    /// The ego's extents.
    pub vehicle: VehicleParameters,
}

/// One iteration of the loop as the driver sees it.
#[derive(Clone, Copy, Debug)]
pub struct Moment<'a> {
    /// Iterations driven so far.
    pub iteration: usize,
    /// Everyone up to now.
    pub scene: SceneState<'a>,
    /// The ego now.
    pub ego: &'a EgoState,
    /// The ego before, oldest first, now excluded.
    pub past: &'a [EgoState],
}
