//! Rigid transforms of the plane and the arithmetic of angles.

use std::f64::consts::{PI, TAU};
use std::ops::Mul;

use glam::DVec2;

/// A position and a heading; also the transform from its own frame to the frame it lives in.
///
/// Units: metres, radians (counter-clockwise from +x).
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Pose {
    /// Origin of the pose's frame, metres.
    pub position: DVec2,
    /// Direction of the pose's +x axis, radians.
    pub heading: f64,
}

impl Pose {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self {
        position: DVec2::ZERO,
        heading: 0.0,
    };

    /// Builds a pose from coordinates in metres and a heading in radians.
    pub fn new(x: f64, y: f64, heading: f64) -> Self {
        Self {
            position: DVec2::new(x, y),
            heading,
        }
    }

    /// The unit vector of the heading.
    pub fn direction(self) -> DVec2 {
        DVec2::from_angle(self.heading)
    }

    /// The transform in the other direction: `pose.inverse() * pose` is the identity.
    pub fn inverse(self) -> Self {
        Self {
            position: DVec2::from_angle(-self.heading).rotate(-self.position),
            heading: wrap_angle(-self.heading),
        }
    }

    /// Rotates a vector (a velocity, for example) without translating it.
    pub fn rotate(self, vector: DVec2) -> DVec2 {
        self.direction().rotate(vector)
    }

    /// True if all three numbers are finite.
    pub fn is_finite(self) -> bool {
        self.position.is_finite() && self.heading.is_finite()
    }

    /// The pose a fraction `t` of the way to `other`, heading by the short way round.
    pub fn interpolate(self, other: Self, t: f64) -> Self {
        Self {
            position: self.position.lerp(other.position, t),
            heading: interpolate_angle(self.heading, other.heading, t),
        }
    }
}

impl Mul<DVec2> for Pose {
    type Output = DVec2;

    #[allow(
        clippy::suspicious_arithmetic_impl,
        reason = "a rigid transform applied to a point turns it and then moves it"
    )]
    fn mul(self, point: DVec2) -> DVec2 {
        self.rotate(point) + self.position
    }
}

impl Mul for Pose {
    type Output = Self;

    fn mul(self, inner: Self) -> Self {
        Self {
            position: self * inner.position,
            heading: wrap_angle(self.heading + inner.heading),
        }
    }
}

/// Wraps an angle to [-π, π).
pub fn wrap_angle(angle: f64) -> f64 {
    if (-PI..PI).contains(&angle) {
        return angle;
    }
    let wrapped = (angle + PI).rem_euclid(TAU) - PI;
    // rem_euclid may round up to TAU itself for tiny negative inputs.
    if wrapped >= PI { -PI } else { wrapped }
}

/// The signed turn from `from` to `to` by the short way, in [-π, π).
pub fn angle_difference(to: f64, from: f64) -> f64 {
    wrap_angle(to - from)
}

/// The angle a fraction `t` of the way from `a` to `b` by the short way, wrapped to [-π, π).
pub fn interpolate_angle(a: f64, b: f64, t: f64) -> f64 {
    wrap_angle(a + t * angle_difference(b, a))
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use glam::dvec2;

    #[test]
    fn composing_with_the_inverse_is_the_identity() {
        let pose = Pose::new(12.0, -7.5, 2.3);
        let identity = pose.inverse() * pose;
        assert_abs_diff_eq!(identity.position.length(), 0.0, epsilon = 1e-12);
        assert_abs_diff_eq!(identity.heading, 0.0, epsilon = 1e-12);
    }

    #[test]
    fn a_transform_reads_backwards() {
        let world_from_car = Pose::new(10.0, 5.0, PI / 2.0);
        let nose = world_from_car * dvec2(2.0, 0.0);
        assert_abs_diff_eq!(nose.x, 10.0, epsilon = 1e-12);
        assert_abs_diff_eq!(nose.y, 7.0, epsilon = 1e-12);
    }

    #[test]
    fn angles_wrap_to_the_half_open_interval() {
        for (input, expected) in [
            (PI, -PI),
            (-PI, -PI),
            (3.0 * PI, -PI),
            (0.5, 0.5),
            (-1e-17, -1e-17),
        ] {
            assert_abs_diff_eq!(wrap_angle(input), expected, epsilon = 1e-12);
            assert!((-PI..PI).contains(&wrap_angle(input)));
        }
    }

    #[test]
    fn headings_interpolate_by_the_short_way() {
        let middle = interpolate_angle(PI - 0.1, -PI + 0.1, 0.5);
        assert_abs_diff_eq!(wrap_angle(middle - PI), 0.0, epsilon = 1e-12);
    }
}
