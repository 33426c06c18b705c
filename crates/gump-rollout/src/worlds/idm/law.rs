//! The car-following law.

use super::IdmConfig;

/// Acceleration of a vehicle behind another, metres per second squared, before any limit.
///
/// `gap` is the clear distance to the vehicle ahead, metres; gaps below the standstill gap count as
/// that gap, and an infinite gap is a free road. `lead_speed` is the speed of the vehicle ahead
/// along the follower's path. The desired gap is not floored: behind a vehicle that pulls away very
/// fast it may turn negative, and its square brakes. The IDM world avoids that; nuPlan does not.
///
/// Units: metres, metres per second.
/// Source: Treiber, Hennecke and Helbing 2000; agrees with nuPlan's policy to rounding.
pub fn idm_acceleration(
    config: &IdmConfig,
    speed: f64,
    desired_speed: f64,
    gap: f64,
    lead_speed: f64,
) -> f64 {
    let free = (speed / desired_speed).powf(config.exponent);
    let interaction = desired_gap(config, speed, lead_speed) / gap.max(config.min_gap);
    config.max_acceleration * (1.0 - free - interaction * interaction)
}

/// Progress and speed after one forward Euler step of `dt` seconds behind a lead `gap` metres
/// ahead, the acceleration limited to what the law calls comfortable; the speed may turn negative.
///
/// Source: the policy of nuPlan's reactive agents and planners, and PDM's with another exponent.
pub fn idm_euler_step(
    config: &IdmConfig,
    (progress, speed): (f64, f64),
    desired_speed: f64,
    gap: f64,
    lead_speed: f64,
    dt: f64,
) -> (f64, f64) {
    let acceleration = idm_acceleration(config, speed, desired_speed, gap, lead_speed)
        .clamp(-config.max_deceleration, config.max_acceleration);
    (progress + speed * dt, speed + acceleration * dt)
}

/// The desired gap, metres.
pub(super) fn desired_gap(config: &IdmConfig, speed: f64, lead_speed: f64) -> f64 {
    config.min_gap
        + speed * config.headway
        + speed * (speed - lead_speed) / (2.0 * braking_scale(config))
}

/// The lead speed beyond which the desired gap would fall below the standstill gap.
pub(super) fn harmless_speed(config: &IdmConfig, speed: f64) -> f64 {
    speed + 2.0 * braking_scale(config) * config.headway
}

/// The lowest desired speed at which the free road alone requires no more than comfortable
/// braking.
pub(super) fn gentle_speed(config: &IdmConfig, speed: f64) -> f64 {
    let ratio = 1.0 + config.max_deceleration / config.max_acceleration;
    speed / ratio.powf(1.0 / config.exponent)
}

fn braking_scale(config: &IdmConfig) -> f64 {
    (config.max_acceleration * config.max_deceleration).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    fn check(speed: f64, gap: f64, lead_speed: f64, expected: f64) {
        let config = IdmConfig {
            max_deceleration: 4.0,
            ..IdmConfig::default()
        };
        let found = idm_acceleration(&config, speed, 10.0, gap, lead_speed);
        assert_abs_diff_eq!(found, expected, epsilon = 1e-12);
    }

    #[test]
    fn the_law_by_hand() {
        // Standing on a free road, at half and at the full desired speed.
        check(0.0, f64::INFINITY, 0.0, 1.0);
        check(5.0, f64::INFINITY, 0.0, 1.0 - 1.0 / 16.0);
        check(10.0, f64::INFINITY, 0.0, 0.0);
        // s* = 1 + 7.5 + 5 * (5 - 3) / (2 * 2) = 11.
        check(5.0, 22.0, 3.0, 1.0 - 1.0 / 16.0 - 0.25);
        // Standing at the standstill gap, and closer: no acceleration.
        check(0.0, 1.0, 0.0, 0.0);
        check(0.0, 0.2, 0.0, 0.0);
    }

    #[test]
    fn harmless_and_gentle_are_where_they_claim() {
        let config = IdmConfig::default();
        let pulling_away = harmless_speed(&config, 7.0);
        assert_abs_diff_eq!(
            desired_gap(&config, 7.0, pulling_away),
            1.0,
            epsilon = 1e-12
        );
        let target = gentle_speed(&config, 20.0);
        let braking = idm_acceleration(&config, 20.0, target, f64::INFINITY, 0.0);
        assert_abs_diff_eq!(braking, -3.0, epsilon = 1e-12);
    }
}
