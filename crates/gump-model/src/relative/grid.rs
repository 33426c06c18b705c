//! Bins for an agent's motion in the next half second, in the frame of its present pose.
//!
//! Four fields, one after another: whether the agent stands, then how far it moves ahead, to the
//! left, and how far it turns. A standing agent keeps its exact pose. Bins of sideways moves and
//! turns are fine around zero, where nearly all values are, and coarse far out.

use gump_geometry::{DVec2, Pose, angle_difference};

/// Fields of a move, in the order in which they are drawn.
pub const FIELDS: usize = 4;
/// Bins of each field.
pub const BINS: [usize; FIELDS] = [2, AHEAD, SIDE, TURN];
/// Bins of all fields.
pub const ALL_BINS: usize = 2 + AHEAD + SIDE + TURN;
/// The bin of the first field for a standing agent.
pub const STANDS: u16 = 1;

/// From -4 m to 21.5 m, 43 m/s; wider than any limit.
const AHEAD: usize = 512;
/// Odd, so that one bin is exactly 0.
const SIDE: usize = 255;
const TURN: usize = 255;

/// Width of a bin ahead, metres: 0.1 m/s of mean speed. Not tuned.
const AHEAD_STEP_M: f64 = 0.05;
/// Bins ahead that have negative values: 4 m, 8 m/s in reverse.
const BEHIND: f64 = 80.0;
/// The maximum sideways move, metres: 7 m/s across its heading. Not tuned.
const SIDE_REACH_M: f64 = 3.5;
/// Stretching of sideways moves around zero: bins are 4 mm wide there. Not tuned.
const SIDE_FOCUS: f64 = 4.0;
/// Stretching of turns around zero: bins are 1.7 mrad wide there. Not tuned.
const TURN_FOCUS: f64 = 5.0;

/// An agent that moves less than this in half a second, metres, stands: the jitter of recorded
/// boxes is smaller.
pub(crate) const STILL_M: f64 = 0.08;

/// First bin of a field among the bins of all.
pub fn first_bin(field: usize) -> usize {
    BINS[..field].iter().sum()
}

/// The bins of a move of `step`, the next pose in the frame of the present one.
pub(crate) fn quantize(step: Pose) -> [u16; FIELDS] {
    let p = step.position;
    if p.length() < STILL_M {
        return [STANDS, quantize_ahead(0.0), middle(SIDE), middle(TURN)];
    }
    [
        0,
        quantize_ahead(p.x),
        to_focused(p.y / SIDE_REACH_M, SIDE_FOCUS, SIDE),
        to_focused(
            angle_difference(step.heading, 0.0) / std::f64::consts::PI,
            TURN_FOCUS,
            TURN,
        ),
    ]
}

/// The next pose, in the frame of the present one, of these bins.
pub fn dequantize(bins: [u16; FIELDS]) -> Pose {
    if bins[0] == STANDS {
        return Pose::IDENTITY;
    }
    Pose {
        position: DVec2::new(
            (f64::from(bins[1]) - BEHIND) * AHEAD_STEP_M,
            SIDE_REACH_M * from_focused(bins[2], SIDE_FOCUS, SIDE),
        ),
        heading: std::f64::consts::PI * from_focused(bins[3], TURN_FOCUS, TURN),
    }
}

/// The bin of a distance ahead, metres; the first or last one beyond the grid.
pub fn quantize_ahead(x: f64) -> u16 {
    let bin = (x / AHEAD_STEP_M + BEHIND).round();
    bin.clamp(0.0, (AHEAD - 1) as f64) as u16
}

fn middle(n: usize) -> u16 {
    (n / 2) as u16
}

/// The bin of a share in -1..1 of the reach.
fn to_focused(share: f64, focus: f64, n: usize) -> u16 {
    let half = (n / 2) as f64;
    let place = (share.clamp(-1.0, 1.0) * focus.sinh()).asinh() / focus;
    (half + (place * half).round()) as u16
}

fn from_focused(bin: u16, focus: f64, n: usize) -> f64 {
    let half = (n / 2) as f64;
    let place = (f64::from(bin) - half) / half;
    (place * focus).sinh() / focus.sinh()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moves_come_back_within_their_bins() {
        for x in [-3.0, 0.1, 1.234, 8.0, 21.0] {
            for y in [-1.0, -0.01, 0.0, 0.3] {
                for turn in [-1.5, -0.1, 0.0, 0.004, 0.3] {
                    let back = dequantize(quantize(Pose::new(x, y, turn)));
                    assert!((back.position.x - x).abs() <= 0.5 * AHEAD_STEP_M + 1e-9);
                    let near = |found: f64, is: f64, fine: f64| {
                        (found - is).abs() <= fine + 0.03 * is.abs()
                    };
                    assert!(near(back.position.y, y, 0.003), "{back:?} {y}");
                    assert!(near(back.heading, turn, 0.001), "{back:?} {turn}");
                }
            }
        }
    }

    #[test]
    fn who_stands_stays_exactly() {
        let bins = quantize(Pose::new(0.03, -0.04, 0.002));
        assert_eq!(bins[0], STANDS);
        assert_eq!(dequantize(bins), Pose::IDENTITY);
        // Straight on is exact, too.
        let straight = dequantize(quantize(Pose::new(5.0, 0.0, 0.0)));
        assert_eq!((straight.position.y, straight.heading), (0.0, 0.0));
    }

    #[test]
    fn what_is_out_of_reach_is_held_at_the_border() {
        let far = dequantize(quantize(Pose::new(90.0, -20.0, 3.0)));
        assert!((far.position.x - 21.55).abs() < 1e-9);
        assert!((far.position.y + SIDE_REACH_M).abs() < 1e-9);
        assert_eq!(first_bin(3) + BINS[3], ALL_BINS);
    }
}
