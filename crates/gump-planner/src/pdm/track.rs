//! Simulation of proposals with tracker and vehicle model.

use gump_geometry::Pose;
use gump_nuplan::tracking::{
    Profile, ProfileFit, Smoothness, TRACKING_DT, TRACKING_HORIZON, Target, propagate_by,
    track_target,
};
use gump_scene::EgoState;

/// Drives references of one length.
#[derive(Clone, Debug)]
pub(crate) struct Tracker {
    fit: ProfileFit,
    profile: Profile,
}

impl Tracker {
    /// For references of `n` steps.
    pub(crate) fn new(n: usize) -> Self {
        Self {
            fit: ProfileFit::new(n, TRACKING_DT, Smoothness::Acceleration),
            profile: Profile::default(),
        }
    }

    /// The states of a vehicle that follows a reference from `ego` on, one per pose.
    pub(crate) fn drive(
        &mut self,
        ego: &EgoState,
        reference: &[Pose],
        wheel_base: f64,
        states: &mut Vec<EgoState>,
    ) {
        self.fit.fit(reference, &mut self.profile);
        let last = self.fit.n() - 1;
        states.clear();
        states.push(*ego);
        for k in 0..self.fit.n() {
            let mut curvatures = [0.0; TRACKING_HORIZON];
            for (i, curvature) in curvatures.iter_mut().enumerate() {
                *curvature = self.profile.curvatures[(k + i).min(last)];
            }
            let target = Target {
                pose: reference[k],
                speed: self.profile.speeds[(k + TRACKING_HORIZON).min(last)],
                curvatures,
            };
            let state = states[k];
            let controls = track_target(&state, &target, wheel_base);
            let time_us = ego.time_us + (k as i64 + 1) * 100_000;
            states.push(propagate_by(
                &state,
                &controls,
                wheel_base,
                TRACKING_DT,
                time_us,
            ));
        }
    }
}
