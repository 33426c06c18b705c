//! Traffic lights over a drive: as recorded, then continued by the signal plans of such junctions.

use std::sync::Arc;

use gump_scene::{Light, Scenario, Seed};
use gump_traffic::{SignalPlan, Signals as Course};

/// Seconds after the recording for which the lights are worked out; then they hold. Three times the
/// longest drive.
const LONGEST_S: f64 = 900.0;
/// Frames in which they may change, seconds: the step of the network.
const STEP_S: f64 = 0.5;

/// States of the lights of a scene by frame of the drive, in any order, since a drive can be
/// rewound.
#[derive(Clone, Debug)]
pub(crate) struct Signals {
    /// From the present to the end of the recording.
    recorded: Vec<Vec<Light>>,
    /// After it, every [`STEP_S`].
    planned: Vec<Vec<Light>>,
    /// Frames of the drive for each of them.
    stride: usize,
}

impl Signals {
    pub(crate) fn of(scenario: &Scenario) -> Self {
        let recorded: Vec<_> = scenario.log[scenario.now..]
            .iter()
            .map(|frame| frame.lights().to_vec())
            .collect();
        let plan = Arc::new(SignalPlan::of(&scenario.map, &scenario.log, scenario.dt));
        let mut course = Course::begin(&plan, Seed(0));
        let n = match plan.is_empty() {
            true => 0,
            false => (LONGEST_S / STEP_S) as usize,
        };
        let planned = (0..n).map(|_| {
            course.advance(STEP_S, None);
            course.lights().to_vec()
        });
        Self {
            recorded,
            planned: planned.collect(),
            stride: (STEP_S / scenario.dt).round().max(1.0) as usize,
        }
    }

    /// The lights so many frames after the present.
    pub(crate) fn at(&self, frame: usize) -> Vec<Light> {
        let last = self.recorded.len() - 1;
        if frame <= last || self.planned.is_empty() {
            return self.recorded[frame.min(last)].clone();
        }
        let i = (frame - last - 1) / self.stride;
        self.planned[i.min(self.planned.len() - 1)].clone()
    }
}

#[cfg(test)]
mod tests {
    use gump_scene::{Frame, LightState, fixture};

    use super::*;
    use LightState::{Green, Red, Yellow};

    #[test]
    fn the_recording_comes_first_and_then_lights_take_turns() {
        let mut scenario = fixture::scenario(
            "lane 1: -60,0 -8,0 next 3
             lane 2: 0,-60 0,-8 next 4
             lane 3: -8,0 60,0
             lane 4: 0,-8 0,60
             light 1 green:
             light 2 red:
             ego vehicle 0: -30,0",
        )
        .unwrap();
        let end = scenario.now + 3;
        scenario.log.truncate(end);
        let last = &mut scenario.log[end - 1];
        let mut lights = last.lights().to_vec();
        lights[0].state = Yellow;
        *last = Frame::new(last.agents().to_vec(), lights);
        let signals = Signals::of(&scenario);
        let shown = |frame| -> Vec<LightState> {
            signals.at(frame).iter().map(|light| light.state).collect()
        };
        assert_eq!(shown(0), [Green, Red]);
        assert_eq!(shown(2), [Yellow, Red]);
        let course: Vec<_> = (3..2000).map(shown).collect();
        let both = course.iter().position(|shown| shown[..] == [Green, Green]);
        assert_eq!(both, None, "{:?}", &course[..both.unwrap_or(0) + 1]);
        assert!(course.iter().any(|shown| shown[..] == [Red, Green]));
        assert!(course.iter().any(|shown| shown[..] == [Green, Red]));
        assert_eq!(shown(usize::MAX / 2), shown(usize::MAX / 2 - 1));
    }
}
