//! Durations of signal states.
//!
//! Sources: the Institute of Transportation Engineers' formula for yellow (1 s of reaction, then
//! braking at 3.05 m/s²), between the 3 and 6 s of the US Manual on Uniform Traffic Control Devices
//! (2009, 4D.26); a second and a half of clearance, as the Signal Timing Manual (2nd edition, NCHRP
//! 812) has for junctions of two roads; green between its usual least and most, 10 to 40 s for a
//! road and 5 to 14 s for a protected left turn.

use gump_scene::{Rng, Seed};
use rand::Rng as _;

/// Seconds of all-red between phases, for the groups that lose green and those that get it.
pub(super) const CLEARANCE_S: f64 = 1.5;
/// Minimum and maximum green of a phase, seconds.
const GREEN_S: (f64, f64) = (10.0, 40.0);
/// The same for a phase in which traffic only turns left.
const LEFT_S: (f64, f64) = (5.0, 14.0);
/// Number of draws of a duration consistent with the observations before the maximum is used; most
/// ages need a few. Not tuned.
const TRIES: usize = 64;

/// The time that a phase has been green already, seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Age {
    Exactly(f64),
    AtLeast(f64),
}

/// Seconds of yellow at this speed limit, metres per second; 6.1 is twice the braking above.
pub(super) fn yellow_s(limit: f64) -> f64 {
    (1.0 + limit / 6.1).clamp(3.0, 6.0)
}

/// Seconds of green of a phase that begins.
pub(super) fn green_s(is_left: bool, seed: Seed) -> f64 {
    draw(is_left, &mut seed.rng())
}

fn draw(is_left: bool, rng: &mut Rng) -> f64 {
    let (least, most) = if is_left { LEFT_S } else { GREEN_S };
    rng.random_range(least..most)
}

/// Least seconds of green of a phase, however little traffic it has.
pub(super) fn least_green_s(is_left: bool) -> f64 {
    if is_left { LEFT_S.0 } else { GREEN_S.0 }
}

/// Seconds of green so far, and left, of a phase that is observed at a random time.
///
/// A long phase is more likely to be observed than a short one, at each of its instants equally;
/// durations that contradict the observations are excluded.
pub(super) fn met_s(is_left: bool, age: Age, seed: Seed) -> (f64, f64) {
    let mut rng = seed.rng();
    let most = if is_left { LEFT_S.1 } else { GREEN_S.1 };
    for _ in 0..TRIES {
        let whole = draw(is_left, &mut rng);
        let (is_met, share): (f64, f64) = (rng.random(), rng.random());
        match age {
            Age::Exactly(age) if age < whole => return (age, whole - age),
            Age::AtLeast(least) if is_met * most < whole && share * whole >= least => {
                return (share * whole, (1.0 - share) * whole);
            }
            _ => {}
        }
    }
    // It has been green for longer than is usual: it ends soon.
    (most, rng.random_range(0.0..LEFT_S.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_agrees_with_what_was_seen() {
        let mean = |age: Age| {
            let rests = (0..4000).map(|k| met_s(false, age, Seed(k)).1);
            rests
                .inspect(|rest| assert!((0.0..=40.0).contains(rest)))
                .sum::<f64>()
                / 4000.0
        };
        // A phase of 10 to 40 s that is met somewhere: E[D²] / 2 E[D] = 14 s are left.
        assert!((mean(Age::AtLeast(0.0)) - 14.0).abs() < 0.5);
        // One that began just now has its whole mean of 25 s ahead.
        assert!((mean(Age::Exactly(0.0)) - 25.0).abs() < 0.5);
        assert!(mean(Age::Exactly(39.0)) < 3.0);
        assert!(mean(Age::AtLeast(8.0)) < mean(Age::AtLeast(0.0)));
        assert!((yellow_s(13.4) - 3.2).abs() < 0.01 && yellow_s(3.0) == 3.0);
    }
}
