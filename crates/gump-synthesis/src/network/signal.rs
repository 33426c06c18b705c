//! Phases of lights: which groups are green when.

use gump_geometry::angle_difference;
use gump_scene::{LightState, Rng};
use rand::Rng as _;

use crate::network::leg::Leg;

/// Seconds of yellow: what the formula of the Institute of Transportation Engineers gives at 15.6
/// m/s (35 mph).
const YELLOW_S: f64 = 3.6;
/// Seconds of all-red between two phases. Chosen by hand: 20 m of junction at 12.5 m/s.
const ALL_RED_S: f64 = 1.6;

/// One phase: the groups that may go, and how long.
#[derive(Clone, Debug)]
pub(crate) struct Phase {
    /// Groups with green.
    pub(crate) green: Vec<usize>,
    /// Legs whose crosswalk may be walked.
    pub(crate) walk: Vec<usize>,
    /// Seconds of green.
    pub(crate) duration: f64,
}

/// Phases that repeat for ever. A group is a leg (twice its index, one more for left turns).
#[derive(Clone, Debug)]
pub(crate) struct Cycle {
    phases: Vec<Phase>,
    offset: f64,
}

impl Cycle {
    /// A cycle that is `offset` seconds in at time 0.
    pub(crate) fn new(phases: Vec<Phase>, offset: f64) -> Self {
        Self { phases, offset }
    }

    /// Seconds of a full cycle.
    pub(crate) fn period(&self) -> f64 {
        let each = |phase: &Phase| phase.duration + YELLOW_S + ALL_RED_S;
        self.phases.iter().map(each).sum()
    }

    /// The colour of a group at `time` seconds.
    pub(crate) fn state(&self, group: usize, time: f64) -> LightState {
        let (phase, into) = self.at(time);
        let next = &self.phases[(phase + 1) % self.phases.len()];
        let phase = &self.phases[phase];
        if !phase.green.contains(&group) {
            return LightState::Red;
        }
        if into < phase.duration || next.green.contains(&group) {
            LightState::Green
        } else if into < phase.duration + YELLOW_S {
            LightState::Yellow
        } else {
            LightState::Red
        }
    }

    /// Seconds for which pedestrians may still start across `leg` and finish before traffic starts.
    pub(crate) fn walk_time(&self, leg: usize, time: f64) -> f64 {
        let (phase, into) = self.at(time);
        let phase = &self.phases[phase];
        if phase.walk.contains(&leg) {
            (phase.duration + YELLOW_S - into).max(0.0)
        } else {
            0.0
        }
    }

    /// The phase at `time` and the seconds since it began.
    fn at(&self, time: f64) -> (usize, f64) {
        let mut into = (time + self.offset).rem_euclid(self.period());
        for (i, phase) in self.phases.iter().enumerate() {
            let whole = phase.duration + YELLOW_S + ALL_RED_S;
            if into < whole {
                return (i, into);
            }
            into -= whole;
        }
        (self.phases.len() - 1, f64::INFINITY)
    }
}

/// Phases for these legs: opposite legs share one, left turns with their own lane (`left_only`)
/// usually precede the others. Shares and durations are chosen by hand.
pub(crate) fn plan_cycle(legs: &[Leg], left_only: &[bool], rng: &mut Rng) -> Cycle {
    let mut phases = Vec::new();
    let mut seen = vec![false; legs.len()];
    for i in 0..legs.len() {
        if seen[i] {
            continue;
        }
        let opposite = (i + 1..legs.len()).find(|&j| {
            let turn = angle_difference(legs[j].mouth.heading, legs[i].mouth.heading);
            !seen[j] && turn.abs() > 2.4
        });
        let axis: Vec<usize> = std::iter::once(i).chain(opposite).collect();
        for &leg in &axis {
            seen[leg] = true;
        }
        let others = (0..legs.len()).filter(|leg| !axis.contains(leg)).collect();
        let left: Vec<usize> = axis.iter().map(|leg| 2 * leg + 1).collect();
        let through = axis.iter().map(|leg| 2 * leg);
        let turning = axis.iter().any(|&leg| left_only[leg]);
        let protected = turning && axis.len() == 2 && rng.random_bool(0.75);
        if protected {
            phases.push(Phase {
                green: left.clone(),
                walk: Vec::new(),
                duration: rng.random_range(5.0..9.0),
            });
        }
        let permissive = if protected { Vec::new() } else { left };
        phases.push(Phase {
            green: through.chain(permissive).collect(),
            walk: others,
            duration: rng.random_range(10.0..22.0),
        });
    }
    if phases.iter().all(|phase| phase.walk.is_empty()) {
        // A crossing away from any junction: pedestrians need a separate phase.
        phases.push(Phase {
            green: Vec::new(),
            walk: (0..legs.len()).collect(),
            duration: rng.random_range(9.0..13.0),
        });
    }
    let cycle = Cycle::new(phases, 0.0);
    let offset = rng.random_range(0.0..cycle.period());
    Cycle { offset, ..cycle }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_take_turns_through_yellow_and_red() {
        let phase = |green, walk| Phase {
            green: vec![green],
            walk: vec![walk],
            duration: 10.0,
        };
        let cycle = Cycle::new(vec![phase(0, 1), phase(2, 0)], 0.0);
        let colours = |time| (cycle.state(0, time), cycle.state(2, time));
        assert_eq!(colours(1.0), (LightState::Green, LightState::Red));
        assert_eq!(colours(11.0), (LightState::Yellow, LightState::Red));
        assert_eq!(colours(14.0), (LightState::Red, LightState::Red));
        assert_eq!(colours(16.0), (LightState::Red, LightState::Green));
        assert_eq!(colours(16.0 + cycle.period()), colours(16.0));
        assert!(cycle.walk_time(1, 4.0) > 9.0 && cycle.walk_time(0, 4.0) == 0.0);
    }
}
