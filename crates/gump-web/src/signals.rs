//! Traffic lights over a drive: as recorded, then the phases that were seen, in turn.
//!
//! A recording lasts some seconds, a drive a minute. Every phase that is shown was seen in the
//! recording, so no two streams are ever green together that were not so there; a recording with
//! one phase alone holds it.

use gump_scene::{Frame, Light, LightState, Scenario};

/// Frames that a phase is green after the recording.
const GREEN: usize = 120;
/// Frames of yellow for those who lose their green. Source: what German towns have at 50 km/h.
const YELLOW: usize = 30;
/// Frames in which all who lost their green and all who will get it are red.
const CLEARANCE: usize = 20;

/// What the lights of a scene show, frame by frame of the drive.
#[derive(Clone, Debug)]
pub(crate) struct Signals {
    /// From the present to the end of the recording.
    recorded: Vec<Vec<Light>>,
    /// The different states with a green light, in the order in which they were first seen.
    phases: Vec<Vec<Light>>,
}

impl Signals {
    pub(crate) fn of(scenario: &Scenario) -> Self {
        let recorded: Vec<_> = scenario.log[scenario.now..]
            .iter()
            .map(|frame| frame.lights().to_vec())
            .collect();
        let all = scenario.log.iter().map(Frame::lights);
        let mut phases: Vec<Vec<Light>> = Vec::new();
        for lights in all {
            let is_phase = has(lights, LightState::Green) && !has(lights, LightState::Yellow);
            let known = phases.iter().any(|phase| same(phase, lights));
            let fits = phases.first().is_none_or(|p| lanes(p).eq(lanes(lights)));
            if is_phase && !known && fits {
                phases.push(lights.to_vec());
            }
        }
        Self { recorded, phases }
    }

    /// The lights so many frames after the present.
    pub(crate) fn at(&self, frame: usize) -> Vec<Light> {
        let last = self.recorded.len() - 1;
        if frame <= last {
            return self.recorded[frame].clone();
        }
        let end = &self.recorded[last];
        if self.phases.len() < 2 || !lanes(&self.phases[0]).eq(lanes(end)) {
            return end.clone();
        }
        // The phase that the recording ends in or comes nearest to.
        let agreeing = |phase: &Vec<Light>| {
            let pairs = phase.iter().zip(end);
            pairs.filter(|(a, b)| a.state == b.state).count()
        };
        let n = self.phases.len();
        let first = (0..n).rev().max_by_key(|&i| agreeing(&self.phases[i]));
        let cycle = GREEN + YELLOW + CLEARANCE;
        let since = frame - last - 1;
        let turn = first.unwrap_or(0) + since / cycle;
        let (now, next) = (&self.phases[turn % n], &self.phases[(turn + 1) % n]);
        let into = since % cycle;
        let shown = now.iter().zip(next).map(|(now, next)| {
            let state = match (now.state, next.state) {
                (state, _) if into < GREEN => state,
                (a, b) if a == b => a,
                (LightState::Green, _) if into < GREEN + YELLOW => LightState::Yellow,
                _ => LightState::Red,
            };
            Light { state, ..*now }
        });
        shown.collect()
    }
}

fn has(lights: &[Light], state: LightState) -> bool {
    lights.iter().any(|light| light.state == state)
}

fn lanes(lights: &[Light]) -> impl Iterator<Item = gump_scene::LaneId> + '_ {
    lights.iter().map(|light| light.lane)
}

fn same(a: &[Light], b: &[Light]) -> bool {
    a.len() == b.len()
        && a.iter()
            .zip(b)
            .all(|(a, b)| (a.lane, a.state) == (b.lane, b.state))
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::{LaneId, fixture};

    fn scenario(states: &[[LightState; 2]]) -> Scenario {
        let mut scenario =
            fixture::scenario("lane 1: 0,0 9,0\nlane 2: 0,4 9,4\nego vehicle 0: 0,0").unwrap();
        let light = |(lane, &state): (i64, &LightState)| Light {
            lane: LaneId(lane),
            state,
            stop_point: None,
        };
        scenario.log.truncate(scenario.now + states.len());
        for (frame, states) in scenario.log[scenario.now..].iter_mut().zip(states) {
            let lights = (1..).zip(states).map(light).collect();
            *frame = Frame::new(frame.agents().to_vec(), lights);
        }
        scenario
    }

    fn shown(signals: &Signals, frame: usize) -> Vec<LightState> {
        signals.at(frame).iter().map(|light| light.state).collect()
    }

    use LightState::{Green, Red, Yellow};

    #[test]
    fn phases_that_were_seen_take_turns() {
        let signals = Signals::of(&scenario(&[[Green, Red], [Yellow, Red], [Red, Green]]));
        assert_eq!(shown(&signals, 1), [Yellow, Red]);
        assert_eq!(shown(&signals, 2 + GREEN), [Red, Green]);
        assert_eq!(shown(&signals, 3 + GREEN), [Red, Yellow]);
        assert_eq!(shown(&signals, 3 + GREEN + YELLOW), [Red, Red]);
        assert_eq!(
            shown(&signals, 3 + GREEN + YELLOW + CLEARANCE),
            [Green, Red]
        );
    }

    #[test]
    fn one_phase_alone_stays() {
        let signals = Signals::of(&scenario(&[[Green, Red], [Green, Red]]));
        assert_eq!(shown(&signals, 900), [Green, Red]);
    }
}
