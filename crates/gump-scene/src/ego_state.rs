//! The ego's state at its rear axle, as nuPlan records it and controllers use it.
//!
//! All other poses in this crate are box centres. The rear axle appears only here, because a car
//! turns about it: readers that record it and vehicle dynamics share these two types and convert
//! with [`EgoState::agent_state`].

use gump_geometry::{DVec2, OrientedBox, Pose, dvec2};

use crate::AgentState;

/// The extents of a vehicle and where its axles are, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VehicleParameters {
    /// Full width.
    pub width: f64,
    /// From the rear axle to the front bumper.
    pub front_length: f64,
    /// From the rear axle to the rear bumper.
    pub rear_length: f64,
    /// From the rear axle to the front axle.
    pub wheel_base: f64,
    /// From the rear axle to the centre of gravity.
    pub center_of_gravity: f64,
    /// Full height.
    pub height: f64,
}

impl VehicleParameters {
    /// The car that recorded nuPlan, a Chrysler Pacifica.
    ///
    /// Source: the vehicle parameters of nuplan-devkit.
    pub const PACIFICA: Self = Self {
        width: 2.297,
        front_length: 4.049,
        rear_length: 1.127,
        wheel_base: 3.089,
        center_of_gravity: 1.67,
        height: 1.777,
    };

    /// From bumper to bumper, metres.
    pub fn length(&self) -> f64 {
        self.front_length + self.rear_length
    }

    /// From the rear axle forward to the box centre, metres.
    pub fn rear_axle_to_center(&self) -> f64 {
        self.length() / 2.0 - self.rear_length
    }

    /// The box centre of a vehicle whose rear axle is at `rear_axle`.
    pub fn center_of(&self, rear_axle: Pose) -> Pose {
        Pose {
            position: rear_axle * dvec2(self.rear_axle_to_center(), 0.0),
            ..rear_axle
        }
    }

    /// The rear axle of a vehicle whose box centre is at `center`.
    pub fn rear_axle_of(&self, center: Pose) -> Pose {
        Pose {
            position: center * dvec2(-self.rear_axle_to_center(), 0.0),
            ..center
        }
    }

    /// The footprint of a vehicle whose rear axle is at `rear_axle`.
    pub fn footprint(&self, rear_axle: Pose) -> OrientedBox {
        OrientedBox {
            pose: self.center_of(rear_axle),
            length: self.length(),
            width: self.width,
        }
    }
}

/// State of the ego at its rear axle.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct EgoState {
    /// Time stamp, microseconds; of a log, since 1970.
    pub time_us: i64,
    /// Middle of the rear axle and heading, world frame, metres and radians.
    pub rear_axle: Pose,
    /// Velocity of the rear axle in the **vehicle's** frame (x ahead, y left), metres per second.
    pub velocity: DVec2,
    /// Acceleration of the rear axle in the vehicle's frame, metres per second squared.
    pub acceleration: DVec2,
    /// Angle of the front wheels, radians, positive to the left.
    pub steering_angle: f64,
    /// Its change, radians per second.
    pub steering_rate: f64,
    /// Change of the heading, radians per second.
    pub yaw_rate: f64,
    /// Change of the yaw rate, radians per second squared.
    pub yaw_acceleration: f64,
}

impl EgoState {
    /// Magnitude of the rear axle's velocity, metres per second: nuPlan's speed of the ego.
    pub fn speed(&self) -> f64 {
        self.velocity.length()
    }

    /// Pose and velocity of the box centre, the velocity in the world frame, for a vehicle that
    /// turns as a rigid body.
    pub fn agent_state(&self, vehicle: &VehicleParameters) -> AgentState {
        let swing = dvec2(0.0, self.yaw_rate * vehicle.rear_axle_to_center());
        AgentState {
            pose: vehicle.center_of(self.rear_axle),
            velocity: self.rear_axle.rotate(self.velocity + swing),
        }
    }

    /// True if every number is finite.
    pub fn is_finite(&self) -> bool {
        self.rear_axle.is_finite()
            && self.velocity.is_finite()
            && self.acceleration.is_finite()
            && self.steering_angle.is_finite()
            && self.steering_rate.is_finite()
            && self.yaw_rate.is_finite()
            && self.yaw_acceleration.is_finite()
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    #[test]
    fn the_centre_is_ahead_of_the_rear_axle() {
        let car = VehicleParameters::PACIFICA;
        assert!((car.rear_axle_to_center() - 1.461).abs() < 1e-12);
        let rear_axle = Pose::new(10.0, 5.0, FRAC_PI_2);
        let center = car.center_of(rear_axle);
        assert!(center.position.distance(dvec2(10.0, 6.461)) < 1e-12);
        let back = car.rear_axle_of(center).position;
        assert!(back.distance(rear_axle.position) < 1e-12);
        let front = car.footprint(rear_axle).corners()[0];
        assert!((front.y - 9.049).abs() < 1e-12);
    }

    #[test]
    fn the_centre_swings_out_in_a_turn() {
        let state = EgoState {
            rear_axle: Pose::new(0.0, 0.0, FRAC_PI_2),
            velocity: dvec2(4.0, 0.0),
            yaw_rate: 0.5,
            ..EgoState::default()
        };
        let center = state.agent_state(&VehicleParameters::PACIFICA);
        assert!(center.velocity.distance(dvec2(-0.5 * 1.461, 4.0)) < 1e-12);
        assert_eq!(state.speed(), 4.0);
    }
}
