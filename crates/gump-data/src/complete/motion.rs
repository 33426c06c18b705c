//! Velocities and headings that a format lacks, and smoothing of noisy ones.
//!
//! Values up to the present are computed from states up to the present; smoothing, which is off by
//! default, uses later ones.

use std::f64::consts::PI;

use gump_geometry::{DVec2, angle_difference, interpolate_angle};

use super::track::{State, Track};
use crate::{ReadOptions, ReadReport};

/// A faster state is invalid, metres per second: beyond twice the speed record of cars.
const MAX_SPEED: f64 = 1000.0;
/// Below this speed, metres per second, the direction of motion does not determine the heading: a
/// step of 5 cm at 10 Hz, about what positions are off by. Chosen by hand.
const MIN_SPEED: f64 = 0.5;
/// States farther apart than this number of steps give no velocity: a second at 10 Hz, in which
/// much may happen. Chosen by hand.
const MAX_GAP: usize = 10;
/// Standard deviation of the smoothing window, seconds: passes 0.5 Hz, at which drivers act, by
/// 95 % and takes away what changes faster than once in half a second.
const SMOOTHING: f64 = 0.1;

/// Fills in velocities from positions, then headings from velocities; states without either are
/// dropped. `now` is the present step, `dt` the seconds between steps.
pub(crate) fn complete(
    track: &mut Track,
    now: usize,
    dt: f64,
    options: ReadOptions,
    report: &mut ReadReport,
) {
    let unsound = |v: DVec2| v.is_nan() || v.length() > MAX_SPEED;
    let moving = |state: &State| !unsound(state.velocity);
    let n = track.states.len();
    let without_velocity = n - track.states.iter().filter(|s| moving(s)).count();
    let turned = |state: &State| state.heading.abs() <= 1e6;
    let without_heading = n - track.states.iter().filter(|s| turned(s)).count();
    if without_velocity + without_heading == 0 {
        return;
    }
    if !options.infer_motion {
        track.states.retain(|state| moving(state) && turned(state));
        report.drop("state without velocity or heading", n - track.states.len());
        return;
    }
    report.infer("velocity from positions", without_velocity);
    let past = track.states.partition_point(|state| state.step <= now);
    let velocities = velocities(&track.states, past, dt);
    for (state, velocity) in track.states.iter_mut().zip(velocities) {
        if unsound(state.velocity) {
            state.velocity = velocity;
        }
    }
    report.infer("heading from motion", without_heading);
    if without_heading > 0 {
        let (past, future) = track.states.split_at_mut(past);
        let last = complete_headings(past, None);
        complete_headings(future, last);
    }
}

/// Differences over the steps before and after, over the step before alone for the last of the
/// first `past` states; 0 for a state alone.
fn velocities(states: &[State], past: usize, dt: f64) -> Vec<DVec2> {
    let near = |a: &State, b: &State| b.step - a.step <= MAX_GAP;
    let velocity = |i: usize| {
        let before = if i > 0 && near(&states[i - 1], &states[i]) {
            i - 1
        } else {
            i
        };
        let after = match states.get(i + 1) {
            Some(next) if near(&states[i], next) && i + 1 != past => i + 1,
            _ => i,
        };
        let (a, b) = (&states[before], &states[after]);
        let seconds = (b.step - a.step) as f64 * dt;
        let moved = (b.position - a.position).truncate();
        if seconds > 0.0 {
            moved / seconds
        } else {
            DVec2::ZERO
        }
    };
    (0..states.len()).map(velocity).collect()
}

/// Headings from the direction of motion; where there is little, the last one known, initially
/// `last` or else the first that is known. Returns the last one, if any is known.
fn complete_headings(states: &mut [State], last: Option<f64>) -> Option<f64> {
    let known: Vec<Option<f64>> = states
        .iter()
        .map(|state| {
            let stated = Some(state.heading).filter(|h| h.abs() <= 1e6);
            let fast = state.velocity.length() >= MIN_SPEED;
            stated.or_else(|| fast.then(|| state.velocity.to_angle()))
        })
        .collect();
    let mut last = last.or_else(|| known.iter().flatten().next().copied());
    for (state, known) in states.iter_mut().zip(known) {
        last = known.or(last);
        state.heading = last.unwrap_or(0.0);
    }
    last
}

/// Smooths positions with a Gaussian window within stretches without gaps, and derives velocity
/// and heading from the result; headings are kept where there is little motion.
pub(crate) fn smooth(track: &mut Track, dt: f64, report: &mut ReadReport) {
    let reach = (3.0 * SMOOTHING / dt).round() as usize;
    let original = track.states.clone();
    for (i, state) in track.states.iter_mut().enumerate() {
        // A window cut on one side would pull the ends inwards.
        let room = reach.min(i).min(original.len() - 1 - i);
        let room = (0..=room)
            .take_while(|&k| {
                original[i + k].step == state.step + k && original[i - k].step + k == state.step
            })
            .last()
            .unwrap_or(0);
        let weight = |k: usize| (-0.5 * (k as f64 * dt / SMOOTHING).powi(2)).exp();
        let window = (1..=room).map(|k| {
            let both = original[i - k].position + original[i + k].position;
            (both * weight(k), 2.0 * weight(k))
        });
        let (sum, total) =
            window.fold((original[i].position, 1.0), |(p, w), (q, v)| (p + q, w + v));
        state.position = sum / total;
    }
    let velocities = velocities(&track.states, track.states.len(), dt);
    for (state, velocity) in track.states.iter_mut().zip(velocities) {
        state.velocity = velocity;
        let direction = velocity.to_angle();
        // A car in reverse moves against its heading and must not be turned round.
        let deviation = angle_difference(direction, state.heading).abs();
        if velocity.length() >= 4.0 * MIN_SPEED && deviation < PI / 4.0 {
            state.heading = interpolate_angle(state.heading, direction, 0.5);
        }
    }
    report.infer("smoothed state", track.states.len());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::complete::track::UNSTATED;
    use gump_geometry::{dvec2, dvec3};
    use gump_scene::AgentKind;

    fn track(places: &[(usize, f64, f64)]) -> Track {
        let state = |&(step, x, y): &(usize, f64, f64)| State {
            step,
            position: dvec3(x, y, 0.0),
            heading: UNSTATED,
            velocity: DVec2::NAN,
            size: [4.0, 2.0, 1.5],
        };
        Track {
            id: 1,
            kind: AgentKind::Vehicle,
            usual_size: [4.0, 2.0, 1.5],
            states: places.iter().map(state).collect(),
        }
    }

    #[test]
    fn velocities_and_headings_come_from_positions() {
        let mut track = track(&[(0, 0.0, 0.0), (1, 0.0, 1.0), (2, 0.0, 2.0), (50, 9.0, 9.0)]);
        let mut report = ReadReport::default();
        complete(&mut track, 50, 0.1, ReadOptions::ALL, &mut report);
        let found: Vec<_> = track.states.iter().map(|s| s.velocity).collect();
        let up = dvec2(0.0, 10.0);
        assert_eq!(found, [up, up, up, DVec2::ZERO]);
        assert!(
            track
                .states
                .iter()
                .all(|s| (s.heading - PI / 2.0).abs() < 1e-9)
        );
        assert_eq!(report.inferred["velocity from positions"], 4);
        assert_eq!(report.inferred["heading from motion"], 4);
    }

    #[test]
    fn what_is_filled_in_up_to_the_present_does_not_depend_on_what_follows() {
        let past = [(0, 0.0, 0.0), (1, 0.0, 0.0), (2, 0.0, 0.01)];
        let filled = |after: &[(usize, f64, f64)]| {
            let mut track = track(&[&past, after].concat());
            let mut report = ReadReport::default();
            complete(&mut track, 2, 0.1, ReadOptions::ALL, &mut report);
            track.states
        };
        let [none, left, right] = [
            filled(&[]),
            filled(&[(3, 0.0, 2.0), (4, 0.0, 4.0)]),
            filled(&[(3, 2.0, 0.0), (4, 4.0, 0.0)]),
        ];
        assert_eq!((&left[..3], &right[..3]), (&none[..], &none[..]));
        assert!((left[2].velocity - dvec2(0.0, 0.1)).length() < 1e-9);
        // Who stood up to the present has the heading of what it does then.
        assert_eq!((left[2].heading, right[2].heading), (0.0, 0.0));
        assert!((left[3].heading - PI / 2.0).abs() < 1e-9);
        assert!((left[3].velocity - dvec2(0.0, 19.95)).length() < 1e-9);
    }

    #[test]
    fn without_inference_such_states_are_left_out() {
        let mut track = track(&[(0, 0.0, 0.0), (1, 0.0, 1.0)]);
        let mut report = ReadReport::default();
        complete(&mut track, 50, 0.1, ReadOptions::STATED, &mut report);
        assert!(track.states.is_empty());
        assert_eq!(report.dropped["state without velocity or heading"], 2);
    }

    #[test]
    fn smoothing_takes_noise_and_keeps_straight_lines() {
        let places: Vec<_> = (0..40)
            .map(|i| (i, i as f64, if i % 2 == 0 { 0.2 } else { -0.2 }))
            .collect();
        let mut track = track(&places);
        smooth(&mut track, 0.1, &mut ReadReport::default());
        for (i, state) in track.states.iter().enumerate().skip(4).take(32) {
            assert!((state.position.x - i as f64).abs() < 1e-9);
            assert!(state.position.y.abs() < 0.02, "{}", state.position.y);
            assert!((state.velocity - dvec2(10.0, 0.0)).length() < 0.2);
        }
        assert_eq!(track.states[0].position.y, 0.2, "ends stay where they are");
    }
}
