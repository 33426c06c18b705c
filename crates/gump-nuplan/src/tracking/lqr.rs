//! The linear-quadratic tracker: from a reference to an acceleration and a steering rate.
//!
//! Speed and steering are decoupled. Each is steered towards the reference's state one second ahead
//! by one constant input, which is optimal for its quadratic cost in closed form.
//!
//! Source: nuPlan's LQR tracker with its default parameters (agrees with its goldens to rounding).

use gump_geometry::{Pose, angle_difference, wrap_angle};
use gump_scene::EgoState;

use super::profile::{Profile, ProfileFit, Smoothness};
use super::{Controls, Trajectory};
use gump_rollout::RolloutError;

// All numbers of this file are defaults of nuPlan's LQR tracker.
/// Seconds between the steps that the tracker looks ahead, and between poses of its reference.
pub const TRACKING_DT: f64 = 0.1;
/// Steps that the tracker looks ahead.
pub const TRACKING_HORIZON: usize = 10;

const DT_US: i64 = 100_000;
/// Cost of the speed error over that of the acceleration.
const SPEED_COST: f64 = 10.0;
/// Costs of lateral error, heading error and steering angle over that of the steering rate.
const LATERAL_COSTS: [f64; 3] = [1.0, 10.0, 0.0];
/// Below this speed, metres per second, of ego and reference the ego is brought to rest ...
const STOPPING_SPEED: f64 = 0.2;
/// ... by this deceleration per metre per second too fast.
const STOPPING_GAIN: f64 = 0.5;

/// The reference from now on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// The reference's present pose.
    pub pose: Pose,
    /// Its speed at the end of the horizon, metres per second.
    pub speed: f64,
    /// Its curvature at every step of the horizon, radians per metre.
    pub curvatures: [f64; TRACKING_HORIZON],
}

/// The inputs that bring `ego` towards `target`.
///
/// `wheel_base` in metres. Inputs are not limited; the vehicle limits its steering angle itself.
pub fn track_target(ego: &EgoState, target: &Target, wheel_base: f64) -> Controls {
    let speed = ego.velocity.x;
    let excess = speed - target.speed;
    if target.speed <= STOPPING_SPEED && speed <= STOPPING_SPEED {
        return Controls {
            acceleration: -STOPPING_GAIN * excess,
            steering_rate: 0.0,
        };
    }
    let reach = TRACKING_DT * TRACKING_HORIZON as f64;
    let acceleration = -SPEED_COST * reach / (SPEED_COST * reach * reach + 1.0) * excess;
    Controls {
        acceleration,
        steering_rate: steering_rate(ego, target, acceleration, wheel_base),
    }
}

/// Linearises the bicycle along the coming speeds and corrects the error at the horizon's end.
fn steering_rate(ego: &EgoState, target: &Target, acceleration: f64, wheel_base: f64) -> f64 {
    let away = ego.rear_axle.position - target.pose.position;
    let lateral = target.pose.direction().perp_dot(away);
    let turned = angle_difference(ego.rear_axle.heading, target.pose.heading);
    // The error without input, with one unit of input added, component by component.
    let mut free = [lateral, turned, ego.steering_angle];
    let mut input = [0.0; 3];
    for (step, curvature) in target.curvatures.iter().enumerate() {
        let speed = ego.velocity.x + acceleration * TRACKING_DT * step as f64;
        let driven = speed * TRACKING_DT;
        free[0] += driven * free[1];
        free[1] += driven / wheel_base * free[2] - driven * curvature;
        input[0] += driven * input[1];
        input[1] += driven / wheel_base * input[2];
        input[2] += TRACKING_DT;
    }
    let error = [free[0], wrap_angle(free[1]), wrap_angle(free[2])];
    let mut gain = 0.0;
    let mut stiffness = 1.0;
    for i in 0..3 {
        gain += input[i] * LATERAL_COSTS[i] * error[i];
        stiffness += input[i] * LATERAL_COSTS[i] * input[i];
    }
    -gain / stiffness
}

/// Tracks trajectories; caches what depends only on their length.
#[derive(Clone, Debug, Default)]
pub struct LqrTracker {
    fit: Option<ProfileFit>,
    poses: Vec<Pose>,
    profile: Profile,
}

impl LqrTracker {
    /// The inputs for the step that begins at `ego.time_us`.
    ///
    /// # Errors
    /// [`RolloutError::OutsideTrajectory`] if the trajectory does not cover that time,
    /// [`RolloutError::TooFewStates`] if it is shorter than one step of the tracker.
    pub fn track(
        &mut self,
        ego: &EgoState,
        trajectory: &Trajectory,
        wheel_base: f64,
    ) -> Result<Controls, RolloutError> {
        let pose = trajectory.pose_at(ego.time_us)?;
        self.resample(trajectory)?;
        let start = (ego.time_us - trajectory.start_us()) as f64 / DT_US as f64;
        let mut curvatures = [0.0; TRACKING_HORIZON];
        for (step, curvature) in curvatures.iter_mut().enumerate() {
            *curvature = sample(&self.profile.curvatures, start + step as f64);
        }
        let target = Target {
            pose,
            speed: sample(&self.profile.speeds, start + TRACKING_HORIZON as f64),
            curvatures,
        };
        Ok(track_target(ego, &target, wheel_base))
    }

    /// The profile of the trajectory tracked last.
    pub fn profile(&self) -> &Profile {
        &self.profile
    }

    fn resample(&mut self, trajectory: &Trajectory) -> Result<(), RolloutError> {
        let n = ((trajectory.end_us() - trajectory.start_us()) / DT_US) as usize;
        if n == 0 {
            return Err(RolloutError::TooFewStates(1));
        }
        self.poses.clear();
        for i in 0..=n {
            let time = trajectory.start_us() + i as i64 * DT_US;
            self.poses.push(trajectory.pose_at(time)?);
        }
        if self.fit.as_ref().is_none_or(|fit| fit.n() != n) {
            self.fit = Some(ProfileFit::new(n, TRACKING_DT, Smoothness::Jerk));
        }
        let fit = self.fit.as_mut().expect("the fit was just prepared");
        fit.fit(&self.poses, &mut self.profile);
        Ok(())
    }
}

/// A profile between its knots, constant beyond its ends.
fn sample(values: &[f64], place: f64) -> f64 {
    let last = values.len() - 1;
    let place = place.clamp(0.0, last as f64);
    let i = place.floor() as usize;
    if i == last {
        return values[last];
    }
    values[i] + (place - i as f64) * (values[i + 1] - values[i])
}
