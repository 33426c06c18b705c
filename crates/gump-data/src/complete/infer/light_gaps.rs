//! Colours of lights while they are not observed.
//!
//! A recording car loses sight of a light for moments: a truck passes, the sun is low. A policy
//! that takes a missing light for permission would drive through red. A colour is held only between
//! two observations of the same colour; between different ones the time of the change is unknown,
//! and nothing is filled in.
//!
//! Frames up to the present are filled only from observations up to the present; later ones fill
//! gaps after it.

use std::collections::BTreeMap;

use gump_scene::{Frame, LaneId, Light, LightState};

use crate::ReadReport;

/// Maximum gap, seconds, in which a light cannot change and change back: the shortest green (2 s,
/// of a left turn) and the shortest yellow (3 s) take longer.
///
/// Source: minimum greens in table 5-3 of FHWA's Traffic Signal Timing Manual (2008); yellow
/// intervals of 3 to 6 s in the Manual on Uniform Traffic Control Devices.
const MAX_GAP_S: f64 = 4.0;

/// Fills gaps of unknown or absent lights; `now` is the index of the present, `dt` the seconds
/// between frames.
///
/// A second call changes nothing: only gaps between observations are filled.
pub(super) fn infer(log: &mut [Frame], now: usize, dt: f64, report: &mut ReadReport) {
    let longest = (MAX_GAP_S / dt).round() as usize;
    let mut seen: BTreeMap<LaneId, (usize, Light)> = BTreeMap::new();
    let mut held: BTreeMap<usize, Vec<Light>> = BTreeMap::new();
    for (step, frame) in log.iter().enumerate() {
        let known = |light: &&Light| light.state != LightState::Unknown;
        for light in frame.lights().iter().filter(known) {
            let Some((last, before)) = seen.insert(light.lane, (step, *light)) else {
                continue;
            };
            if before.state == light.state && step - last <= longest + 1 {
                let known_from = if step > now { now + 1 } else { 0 };
                for gap in known_from.max(last + 1)..step {
                    held.entry(gap).or_default().push(before);
                }
            }
        }
    }
    report.infer(
        "colour of a light between two sightings",
        held.values().map(Vec::len).sum(),
    );
    for (step, lights) in held {
        let frame = &log[step];
        // Of two lights of a lane the later one counts.
        let lights = [frame.lights(), &lights].concat();
        log[step] = Frame::new(frame.agents().to_vec(), lights);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One letter a step: `g`, `y`, `r`, `?` for an unknown light, `.` for none.
    fn log(states: &str) -> Vec<Frame> {
        let frame = |letter| {
            let state = match letter {
                'g' => Some(LightState::Green),
                'y' => Some(LightState::Yellow),
                'r' => Some(LightState::Red),
                '?' => Some(LightState::Unknown),
                _ => None,
            };
            let light = |state| Light {
                lane: LaneId(4),
                state,
                stop_point: Some(gump_geometry::dvec2(1.0, 2.0)),
            };
            Frame::new(Vec::new(), state.map(light).into_iter().collect())
        };
        states.chars().map(frame).collect()
    }

    /// Steps are a second apart; the present is the last one.
    fn check(states: &str, expected: &str) {
        check_at(states.len(), states, expected);
    }

    fn check_at(now: usize, states: &str, expected: &str) {
        let (mut filled, mut report) = (log(states), ReadReport::default());
        infer(&mut filled, now, 1.0, &mut report);
        assert_eq!(filled, log(expected), "{states}");
        let changed = states.chars().zip(expected.chars());
        let changed = changed.filter(|(a, b)| a != b).count();
        let counted = report.inferred.values().sum::<usize>();
        assert_eq!(counted, changed, "{states}");
        infer(&mut filled, now, 1.0, &mut report);
        assert_eq!(filled, log(expected), "{states} filled twice");
    }

    #[test]
    fn a_sighting_after_the_present_fills_nothing_up_to_it() {
        for (now, expected) in [(0, "rrrr"), (1, "r.rr"), (2, "r..r"), (3, "rrrr")] {
            check_at(now, "r..r", expected);
        }
        check_at(4, "r.r.?.r", "rrr.?rr");
    }

    #[test]
    fn a_colour_is_held_between_two_sightings_of_it() {
        check("r?r", "rrr");
        check("rr?..?rr?g", "rrrrrrrr?g");
        check("g.g?g", "ggggg");
    }

    #[test]
    fn longer_gaps_changes_and_ends_are_left_alone() {
        check("r?????r", "r?????r");
        check("r??g", "r??g");
        check("y.r", "y.r");
        check("??rr??", "??rr??");
        check("..r", "..r");
    }
}
