//! The driver model: following, braking and accelerating.

use gump_scene::Rng;
use rand::Rng as _;

/// Strongest deceleration of any vehicle, m/s²: less than the 8 to 9 of dry tyres.
pub(crate) const HARDEST_BRAKING: f64 = 7.0;

/// Metres of gap per metre and second above [`DriverParameters::closer_from`], as a share of those below.
const GROWS: f64 = 0.1;

/// The leader: the free gap to it and its speed along the follower's path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Leader {
    /// Metres from front to rear.
    pub(crate) gap: f64,
    /// Metres per second.
    pub(crate) speed: f64,
}

/// Parameters of a driver, which vary between drivers. Their ranges are chosen by hand around the
/// usual ones of the model.
#[derive(Clone, Debug)]
pub(crate) struct DriverParameters {
    /// Desired speed as a multiple of the limit.
    pub(crate) speed_factor: f64,
    /// Cap on the desired speed, metres per second (bicycles, heavy vehicles).
    pub(crate) top_speed: f64,
    /// Seconds kept to the vehicle ahead.
    pub(crate) headway: f64,
    /// Speed above which the gap hardly grows any more, m/s.
    pub(crate) closer_from: f64,
    /// Metres kept to a standing vehicle.
    pub(crate) standstill: f64,
    /// Metres by which it may stop short at first, and move up later, at most.
    pub(crate) short: f64,
    /// Comfortable acceleration, m/s².
    pub(crate) acceleration: f64,
    /// Comfortable deceleration, m/s².
    pub(crate) braking: f64,
    /// Smallest time gap accepted when giving way, seconds.
    pub(crate) gap_time: f64,
    /// Stops for people who wait at a crosswalk without a light.
    pub(crate) is_polite: bool,
    /// Multiplies the speeds that are comfortable in bends.
    pub(crate) bend_factor: f64,
    /// Metres before a stop line at which the front comes to rest.
    pub(crate) line_gap: f64,
    /// Deceleration up to which the driver stops for yellow, m/s².
    pub(crate) yellow_braking: f64,
    /// Seconds into red for which the driver still crosses the line rather than brake hard.
    pub(crate) late: f64,
    /// Speed below which a stop sign counts as obeyed, m/s.
    pub(crate) rolling_stop: f64,
    /// Seconds between obeying a stop sign and going on.
    pub(crate) pause: f64,
    /// Speed over bumps, m/s.
    pub(crate) bump_speed: f64,
    /// Seconds to spare with which the driver passes before people who are still on their way to
    /// the vehicle's path; without a number people always go first.
    pub(crate) before_people: Option<f64>,
    /// Enters a junction to wait there for oncoming traffic or people before it turns.
    pub(crate) waits_inside: bool,
    /// Seconds to spare with which the driver enters a junction behind those who are still on their
    /// way out of the own path; without a number, when they are out of it.
    pub(crate) behind_others: Option<f64>,
    /// Metres kept to the side of parked vehicles where the road is wide enough.
    pub(crate) clearance: f64,
    /// Half the width within which the driver wanders in the lane, metres.
    pub(crate) wander: f64,
    /// Standard deviation of the random part of the acceleration, as a multiple of the usual one.
    pub(crate) unrest: f64,
}

impl DriverParameters {
    /// A car driver.
    pub(crate) fn of_car(rng: &mut Rng) -> Self {
        Self {
            speed_factor: rng.random_range(0.82..1.12),
            top_speed: 40.0,
            headway: rng.random_range(0.9..1.9),
            closer_from: f64::INFINITY,
            short: 0.0,
            standstill: rng.random_range(1.6..3.2),
            acceleration: rng.random_range(1.2..2.4),
            braking: rng.random_range(1.6..2.6),
            gap_time: rng.random_range(3.8..6.0),
            is_polite: rng.random_bool(0.75),
            bend_factor: rng.random_range(0.85..1.05),
            line_gap: rng.random_range(0.3..1.6),
            yellow_braking: 3.0,
            late: 0.0,
            rolling_stop: 0.3,
            pause: 0.6,
            bump_speed: 5.0,
            before_people: None,
            behind_others: None,
            waits_inside: false,
            clearance: 0.9,
            wander: 0.17,
            unrest: 1.0,
        }
    }

    /// A driver with a random driving style: from the timid to those who roll through stop signs
    /// and over the line when the light has just turned red.
    pub(crate) fn of_any_temper(rng: &mut Rng) -> Self {
        // One number for the hurry of the driver, and the rest around it.
        let hurry: f64 = f64::midpoint(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
        let mut around = |middle: f64, by_hurry: f64, spread: f64| {
            middle + by_hurry * hurry + rng.random_range(-spread..spread)
        };
        let driver = Self {
            speed_factor: around(0.96, 0.2, 0.1),
            top_speed: 40.0,
            // Recorded vehicles follow at 1.9 s at 5 to 12 m/s, 1.5 s at 12 to 20 and 1.1 s above (medians; a
            // tenth at less than 0.9, 0.75 and 0.43 s).
            headway: around(0.75, -0.45, 0.3).max(0.3),
            closer_from: 12.0,
            short: around(1.5, -0.8, 2.5).max(0.0),
            standstill: around(2.6, -0.8, 1.2).max(1.2),
            acceleration: around(1.4, 0.7, 0.5).max(0.8),
            braking: around(1.25, 0.4, 0.35).max(0.7),
            gap_time: around(4.8, -1.3, 0.8),
            bend_factor: around(0.95, 0.18, 0.12),
            line_gap: around(1.5, -0.7, 1.2).max(0.2),
            yellow_braking: around(3.2, -0.8, 0.6),
            late: 0.0,
            rolling_stop: 0.3,
            pause: 0.0,
            bump_speed: around(5.2, 1.3, 2.0).max(2.4),
            before_people: Some(around(1.0, -0.6, 0.6).max(0.2)),
            behind_others: Some(around(0.7, -0.3, 0.4).max(0.2)),
            clearance: around(1.2, -0.2, 0.4),
            wander: around(0.08, 0.0, 0.05),
            unrest: around(1.3, 0.4, 0.5).max(0.5),
            is_polite: true,
            waits_inside: true,
        };
        // Half of the recorded drivers stay above 0.5 m/s at stop lines, and most of the others stand
        // for less than two seconds.
        let (rolling_stop, pause) = match rng.random_bool(0.6) {
            true => (rng.random_range(0.6..2.4), rng.random_range(0.0..0.3)),
            false => (0.3, rng.random_range(0.1..1.3)),
        };
        // Recorded drivers pass bumps at 0.89 of their speed two seconds before (median), a tenth at less than
        // 0.6.
        let slows = rng.random_bool(0.5);
        Self {
            bump_speed: if slows {
                driver.bump_speed
            } else {
                f64::INFINITY
            },
            is_polite: rng.random_bool((0.35 - 0.3 * hurry).clamp(0.0, 1.0)),
            late: if rng.random_bool(0.06) {
                rng.random_range(0.0..0.9)
            } else {
                0.0
            },
            rolling_stop,
            pause,
            waits_inside: rng.random_bool(0.85),
            ..driver
        }
    }

    /// A driver of a bus or a truck.
    pub(crate) fn of_heavy_vehicle(rng: &mut Rng) -> Self {
        Self {
            speed_factor: rng.random_range(0.8..0.98),
            top_speed: 24.0,
            acceleration: rng.random_range(0.8..1.2),
            headway: rng.random_range(1.4..2.2),
            closer_from: f64::INFINITY,
            short: 0.0,
            ..Self::of_car(rng)
        }
    }

    /// A cyclist.
    pub(crate) fn of_bicycle(rng: &mut Rng) -> Self {
        Self {
            speed_factor: 1.0,
            top_speed: rng.random_range(3.6..6.4),
            headway: rng.random_range(0.8..1.3),
            closer_from: f64::INFINITY,
            short: 0.0,
            standstill: rng.random_range(1.0..1.8),
            acceleration: rng.random_range(0.7..1.2),
            braking: rng.random_range(1.5..2.2),
            ..Self::of_car(rng)
        }
    }

    /// Acceleration for a present and a desired speed, optionally with a leader and a distance at
    /// which to stop, m/s².
    ///
    /// Source: the improved intelligent driver model of Treiber and Kesting, *Traffic Flow
    /// Dynamics*, 2013, section 11.3.7.
    pub(crate) fn acceleration(
        &self,
        speed: f64,
        desired: f64,
        leader: Option<Leader>,
        stop: Option<f64>,
    ) -> f64 {
        let desired = desired.max(0.1);
        let free = if speed <= desired {
            self.acceleration * (1.0 - (speed / desired).powi(4))
        } else {
            let exponent = 4.0 * self.acceleration / self.braking;
            -self.braking * (1.0 - (desired / speed).powf(exponent))
        };
        let standing = stop.map(|distance| Leader {
            gap: distance + self.standstill,
            speed: 0.0,
        });
        let mut chosen = free;
        for leader in [leader, standing].into_iter().flatten() {
            // The model only approaches its gap; people come to rest.
            if leader.gap < self.standstill + 0.4 && speed < 0.5 && leader.speed < 0.3 {
                return -1.5;
            }
            let z = self.wanted_gap(speed, leader.speed) / leader.gap.max(0.05);
            let interaction = if z >= 1.0 {
                free.min(0.0) + self.acceleration * (1.0 - z * z)
            } else if speed <= desired && free > 1e-6 {
                free * (1.0 - z.powf(2.0 * self.acceleration / free))
            } else {
                free
            };
            chosen = chosen.min(interaction);
        }
        chosen.clamp(-HARDEST_BRAKING, self.acceleration)
    }

    /// The desired gap, metres.
    pub(crate) fn wanted_gap(&self, speed: f64, leader_speed: f64) -> f64 {
        let closing = speed * (speed - leader_speed);
        let dynamic = closing / (2.0 * (self.acceleration * self.braking).sqrt());
        let kept = if speed > self.closer_from {
            self.closer_from + GROWS * (speed - self.closer_from)
        } else {
            speed
        };
        self.standstill + (kept * self.headway + dynamic).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::Seed;

    /// Drives towards an obstacle `distance` metres ahead; returns the gap left at rest and the
    /// hardest braking.
    fn approach(driver: &DriverParameters, speed: f64, distance: f64) -> (f64, f64) {
        let (mut gap, mut speed, mut hardest) = (distance, speed, 0.0);
        for _ in 0..600 {
            let leader = Leader { gap, speed: 0.0 };
            let acceleration = driver.acceleration(speed, 15.0, Some(leader), None);
            hardest = f64::min(hardest, acceleration);
            let next = (speed + acceleration * 0.1).max(0.0);
            gap -= (speed + next) / 2.0 * 0.1;
            speed = next;
        }
        (gap, hardest)
    }

    #[test]
    fn drivers_come_to_rest_before_what_stands_ahead() {
        let mut rng = Seed(1).rng();
        for _ in 0..50 {
            for driver in [
                DriverParameters::of_car(&mut rng),
                DriverParameters::of_heavy_vehicle(&mut rng),
                DriverParameters::of_bicycle(&mut rng),
            ] {
                let (gap, hardest) = approach(&driver, 12.0, 80.0);
                assert!(gap > 0.8 && gap < driver.standstill + 1.0, "{gap} m left");
                assert!(hardest > -5.0, "{hardest} m/s2");
            }
        }
    }

    #[test]
    fn an_open_road_is_driven_at_the_desired_speed() {
        let driver = DriverParameters::of_car(&mut Seed(2).rng());
        let mut speed = 0.0;
        for _ in 0..600 {
            speed += driver.acceleration(speed, 10.0, None, None) * 0.1;
        }
        assert!((speed - 10.0).abs() < 0.1);
        assert!(driver.acceleration(14.0, 10.0, None, None) < -0.5);
    }
}
