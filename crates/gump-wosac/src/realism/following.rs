//! Time to collision with the vehicle ahead.

use super::assemble::SimulatedAgents;
use super::box_distance::FAR;
use super::input::State;
use super::kinematics::Differences;

// All of these are from the challenge's published metric code.
/// The maximum value, seconds.
const MAX_TIME: f32 = 5.0;
/// A vehicle whose heading differs by more than this is not followed: 75 degrees.
const MAX_HEADING_DIFFERENCE: f32 = (75.0 * std::f64::consts::PI / 180.0) as f32;
/// A vehicle whose heading differs by less than this is followed whatever the overlap: 10 degrees.
const SMALL_HEADING_DIFFERENCE: f32 = (10.0 * std::f64::consts::PI / 180.0) as f32;
/// Lateral overlap that is sufficient where headings differ more, metres.
const ENOUGH_OVERLAP: f32 = 0.5;

/// Seconds until agent `agent` hits the one it follows, at most 5, at the steps from `first`.
pub(crate) fn times(
    simulated: &SimulatedAgents,
    agent: usize,
    first: usize,
    differences: Differences,
) -> Vec<f32> {
    let tracks: Vec<_> = (0..simulated.n_agents())
        .map(|i| simulated.states(i))
        .collect();
    (first..tracks[agent].len())
        .map(|step| time_to_collision(&tracks, agent, step, differences))
        .collect()
}

/// Seconds until track `agent` hits the one it follows at `step`, at most 5; 5 if it follows none
/// or falls behind.
///
/// The followed agent is the valid one with the smallest gap ahead that points roughly the same way
/// and overlaps sideways. Heading differences are not wrapped, as in the reference: headings are
/// expected in [-π, π].
pub(crate) fn time_to_collision(
    tracks: &[&[State]],
    agent: usize,
    step: usize,
    differences: Differences,
) -> f32 {
    let own = &tracks[agent][step];
    let (s, c) = ((-own.heading).sin(), (-own.heading).cos());
    let mut followed = None;
    let mut smallest = FAR;
    for (other, states) in tracks.iter().enumerate() {
        if let Some(gap) = gap(own, &states[step], [c, s])
            && gap < smallest
            && other != agent
        {
            (followed, smallest) = (Some(other), gap);
        }
    }
    let Some(other) = followed else {
        return MAX_TIME;
    };
    let speed = |track: usize| differences.ground_speed(tracks[track], step);
    let closing = speed(agent) - speed(other);
    if closing > 0.0 {
        (smallest / closing).min(MAX_TIME)
    } else {
        MAX_TIME
    }
}

/// Gap between an agent and one it follows, metres; `None` if it does not follow it.
fn gap(own: &State, other: &State, [c, s]: [f32; 2]) -> Option<f32> {
    if !other.valid {
        return None;
    }
    let turn = (other.heading - own.heading).abs();
    if turn > MAX_HEADING_DIFFERENCE {
        return None;
    }
    let x = other.position[0] - own.position[0];
    let y = other.position[1] - own.position[1];
    let ahead = (c * x - s * y) - own.size[0] / 2.0;
    // Whatever is subtracted below is not negative; most others are behind.
    if ahead <= 0.0 {
        return None;
    }
    let beside = (s * x + c * y).abs() - own.size[1] / 2.0;
    let [length, width, _] = other.size;
    if beside > (length + width) * 0.51 {
        return None;
    }
    let (sin, cos) = (turn.sin().abs(), turn.cos().abs());
    let gap = ahead - (length / 2.0 * cos + width / 2.0 * sin);
    let overlap = beside - (length / 2.0 * sin + width / 2.0 * cos);
    let follows = overlap < 0.0 && (overlap < -ENOUGH_OVERLAP || turn <= SMALL_HEADING_DIFFERENCE);
    (gap > 0.0 && follows).then_some(gap)
}
