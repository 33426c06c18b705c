//! Manoeuvres that the ego is about to begin: turns through intersections and lane changes,
//! determined from the log.

use gump_geometry::angle_difference;
use gump_scene::{Agent, Lane, MapGraph};

use super::situation::{View, is_on_intersection, lane_of};

// Chosen by hand, where nuPlan publishes no numbers.
/// Time window around the present in which entering an intersection counts, seconds.
const ENTRY_S: [f64; 2] = [0.5, 1.0];
/// A smaller change of heading is not a turn, radians (30 degrees).
const MIN_TURN: f64 = 0.52;
/// A larger one is a U-turn, radians (140 degrees).
const U_TURN: f64 = 2.44;
/// A lane change begins now if the ego is in the other lane within this time, seconds.
const CHANGE_S: f64 = 4.0;
/// And if it moves to that side by at least this in the next second, metres.
const MOVES: f64 = 0.2;

/// A path through an intersection that begins now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Turn {
    /// Change of the heading from entry to exit, radians, positive to the left.
    pub(super) angle: f64,
    /// Whether a light controls it.
    pub(super) is_lit: bool,
    /// Whether the ego drives, rather than waits.
    pub(super) speed: f64,
}

impl Turn {
    pub(super) fn is_left(&self) -> bool {
        self.angle > MIN_TURN && !self.is_around()
    }

    pub(super) fn is_right(&self) -> bool {
        self.angle < -MIN_TURN && !self.is_around()
    }

    pub(super) fn is_straight(&self) -> bool {
        self.angle.abs() <= MIN_TURN
    }

    pub(super) fn is_around(&self) -> bool {
        self.angle.abs() > U_TURN
    }
}

/// The turn (or straight path) that the ego begins at the present.
pub(super) fn turn(scenario: View<'_>) -> Option<Turn> {
    let map: &MapGraph = scenario.map;
    let ego = |step: usize| scenario.log.get(step)?.agent(scenario.ego);
    let steps = |seconds: f64| (seconds / scenario.dt).round() as usize;
    let first = scenario.now.saturating_sub(steps(ENTRY_S[0]));
    let inside = |step: usize| ego(step).is_some_and(|ego| is_on_intersection(map, ego));
    let entry = (first..scenario.now + steps(ENTRY_S[1]))
        .find(|&step| ego(step).is_some() && !inside(step) && inside(step + 1))?;
    let exit = (entry + 1..scenario.log.len())
        .find(|&step| ego(step).is_some() && !inside(step))
        .unwrap_or(scenario.log.len() - 1);
    let (before, after) = (ego(entry)?, last_there(scenario, exit)?);
    let lit = lane_of(map, ego(entry + 1)?);
    let frame = scenario.at(scenario.now).now();
    Some(Turn {
        angle: turned(scenario, entry, exit).unwrap_or_else(|| {
            angle_difference(after.state.pose.heading, before.state.pose.heading)
        }),
        is_lit: lit.is_some_and(|lane| frame.light(lane.id).is_some()),
        speed: ego(scenario.now)?.state.speed(),
    })
}

/// The sum of the changes of heading, which distinguishes a U-turn to the left from one to the
/// right.
fn turned(scenario: View<'_>, from: usize, to: usize) -> Option<f64> {
    let headings: Option<Vec<f64>> = (from..=to)
        .map(|step| Some(scenario.log[step].agent(scenario.ego)?.state.pose.heading))
        .collect();
    let headings = headings?;
    let changes = headings
        .windows(2)
        .map(|pair| angle_difference(pair[1], pair[0]));
    Some(changes.sum())
}

fn last_there(scenario: View<'_>, until: usize) -> Option<&Agent> {
    (0..=until)
        .rev()
        .find_map(|step| scenario.log[step].agent(scenario.ego))
}

/// The side of the lane change that begins at the present, positive to the left, with the metres
/// moved in the next second.
pub(super) fn lane_change(scenario: View<'_>, lane: Option<&Lane>) -> Option<f64> {
    let lane = lane.filter(|lane| !lane.in_intersection)?;
    let map: &MapGraph = scenario.map;
    let n = (CHANGE_S / scenario.dt).round() as usize;
    let ego = |step: usize| scenario.log.get(step)?.agent(scenario.ego);
    let side = (1..=n).find_map(|k| {
        let there = lane_of(map, ego(scenario.now + k)?)?;
        side_of(map, lane, there)
    })?;
    let second = (1.0 / scenario.dt).round() as usize;
    let now = ego(scenario.now)?.state.pose;
    let then = ego(scenario.now + second)?.state.pose;
    let lateral = |position| lane.centerline.project(position).lateral;
    let moved = lateral(then.position) - lateral(now.position);
    (moved * side >= MOVES).then_some(moved)
}

/// 1 if `there` is left of `lane` (or of what follows it), -1 if right, none otherwise.
fn side_of(map: &MapGraph, lane: &Lane, there: &Lane) -> Option<f64> {
    if there.id == lane.id || lane.successors.contains(&there.id) {
        return None;
    }
    let mut own = vec![lane];
    own.extend(map.successors(lane.id));
    if own
        .iter()
        .any(|lane| lane.left_neighbors.contains(&there.id))
    {
        Some(1.0)
    } else if own
        .iter()
        .any(|lane| lane.right_neighbors.contains(&there.id))
    {
        Some(-1.0)
    } else {
        None
    }
}
