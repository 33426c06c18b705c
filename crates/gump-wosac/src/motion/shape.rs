//! The shape of a recorded path: standing, straight, a turn. Precision is averaged over shapes.

use std::f64::consts::FRAC_PI_6;

use gump_geometry::{DVec2, wrap_angle};
use gump_scene::{Agent, AgentId, Scenario};

use super::config::ShapeRules;

/// The shape of a recorded path. In ascending order of priority: agents predicted together count as
/// the highest among them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Shape {
    /// Hardly moves.
    Stationary,
    /// Keeps heading and lane.
    Straight,
    /// Keeps its heading, ends to the right.
    StraightRight,
    /// Keeps its heading, ends to the left.
    StraightLeft,
    /// Turns right.
    RightTurn,
    /// Turns left.
    LeftTurn,
    /// Turns left and comes back.
    LeftUTurn,
    /// Turns right and comes back.
    RightUTurn,
}

impl Shape {
    /// Every shape, in ascending order of priority.
    pub const ALL: [Self; 8] = [
        Self::Stationary,
        Self::Straight,
        Self::StraightRight,
        Self::StraightLeft,
        Self::RightTurn,
        Self::LeftTurn,
        Self::LeftUTurn,
        Self::RightUTurn,
    ];

    /// The lower-case English name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Stationary => "stationary",
            Self::Straight => "straight",
            Self::StraightRight => "straight-right",
            Self::StraightLeft => "straight-left",
            Self::RightTurn => "right-turn",
            Self::LeftTurn => "left-turn",
            Self::LeftUTurn => "left-u-turn",
            Self::RightUTurn => "right-u-turn",
        }
    }

    /// The shape that its precision counts towards: the challenge has no separate right U-turns, so
    /// seven of the eight shapes are averaged.
    pub fn counted_as(self) -> Self {
        match self {
            Self::RightUTurn => Self::RightTurn,
            other => other,
        }
    }
}

/// The shape of an agent's recorded path from the present to the last frame it is in.
///
/// `None` if it is absent now or in every later frame.
///
/// Source: the challenge's published metric code; it keeps most intermediate numbers as f32.
pub fn shape(scenario: &Scenario, agent: AgentId, rules: ShapeRules) -> Option<Shape> {
    let start = scenario.present().now().agent(agent)?;
    let end = scenario
        .future()
        .iter()
        .rev()
        .find_map(|f| f.agent(agent))?;
    let limits = Limits::of(rules);
    Some(limits.shape(start, end))
}

/// Thresholds between the shapes.
struct Limits {
    rules: ShapeRules,
    /// Farther than this is not standing, metres.
    standing_distance: f64,
    /// Farther aside than this is not straight, metres.
    straight_offset: f64,
    /// Farther behind than this is a U-turn, metres ahead of the start.
    u_turn_ahead: f32,
}

/// Faster than this at either end is not standing, metres per second.
///
/// Source, as of the other thresholds: the challenge's published metric code.
const STANDING_SPEED: f32 = 2.0;

impl Limits {
    fn of(rules: ShapeRules) -> Self {
        let (standing_distance, straight_offset, u_turn_ahead) = match rules {
            ShapeRules::Current => (3.0, 2.5, 0.0),
            ShapeRules::Until2023 => (5.0, 5.0, -5.0),
        };
        Self {
            rules,
            standing_distance,
            straight_offset,
            u_turn_ahead,
        }
    }

    fn shape(&self, start: &Agent, end: &Agent) -> Shape {
        let (from, to) = (start.state.pose, end.state.pose);
        let delta = to.position - from.position;
        let moved = DVec2::from_angle(-from.heading).rotate(delta);
        let (ahead, aside) = (moved.x as f32, moved.y as f32);
        let turn = match self.rules {
            ShapeRules::Current => wrap_angle(to.heading - from.heading),
            ShapeRules::Until2023 => to.heading - from.heading,
        } as f32;
        let speed = start.state.speed().max(end.state.speed()) as f32;
        if speed < STANDING_SPEED && delta.length() < self.standing_distance {
            return Shape::Stationary;
        }
        if f64::from(turn).abs() < FRAC_PI_6 {
            return if moved.y.abs() < self.straight_offset {
                Shape::Straight
            } else if aside < 0.0 {
                Shape::StraightRight
            } else {
                Shape::StraightLeft
            };
        }
        let right = match self.rules {
            ShapeRules::Current => aside < 0.0,
            ShapeRules::Until2023 => f64::from(turn) < -FRAC_PI_6 && aside < 0.0,
        };
        match (right, ahead < self.u_turn_ahead) {
            (true, false) => Shape::RightTurn,
            (true, true) => Shape::RightUTurn,
            (false, false) => Shape::LeftTurn,
            (false, true) => Shape::LeftUTurn,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::{Pose, dvec2};
    use gump_scene::fixture;

    /// The shape of a path from the origin, heading 0, to `end` at `speed`.
    fn check(end: (f64, f64, f64), speed: f64, current: Shape, until_2023: Shape) {
        let mut scenario =
            fixture::scenario("ego vehicle 0: 0,0\nhistory 0.1 future 0.2 dt 0.1").unwrap();
        let last = scenario.log.len() - 1;
        let mut agent = scenario.log[last].agents()[0];
        agent.state.pose = Pose::new(end.0, end.1, end.2);
        agent.state.velocity = dvec2(speed, 0.0);
        scenario.log[last] = gump_scene::Frame::new(vec![agent], vec![]);
        let found = [ShapeRules::Current, ShapeRules::Until2023]
            .map(|rules| shape(&scenario, AgentId(0), rules).unwrap());
        assert_eq!(found, [current, until_2023], "{end:?}");
    }

    #[test]
    fn standing_needs_both_low_speed_and_a_short_way() {
        use Shape::{Stationary, Straight};
        check((2.9, 0.0, 0.0), 1.9, Stationary, Stationary);
        check((3.1, 0.0, 0.0), 1.9, Straight, Stationary);
        check((5.1, 0.0, 0.0), 1.9, Straight, Straight);
        check((2.9, 0.0, 0.0), 2.1, Straight, Straight);
    }

    #[test]
    fn sides_and_turns() {
        use Shape::*;
        check((40.0, 2.4, 0.2), 5.0, Straight, Straight);
        check((40.0, 2.6, 0.2), 5.0, StraightLeft, Straight);
        check((40.0, -5.1, 0.2), 5.0, StraightRight, StraightRight);
        check((20.0, 15.0, 1.5), 5.0, LeftTurn, LeftTurn);
        check((20.0, -15.0, -1.5), 5.0, RightTurn, RightTurn);
        check((-4.0, 10.0, 3.0), 5.0, LeftUTurn, LeftTurn);
        check((-6.0, 10.0, 3.0), 5.0, LeftUTurn, LeftUTurn);
        check((-6.0, -10.0, -3.0), 5.0, RightUTurn, RightUTurn);
        check((-4.0, -10.0, -3.0), 5.0, RightUTurn, RightTurn);
        assert_eq!(RightUTurn.counted_as(), RightTurn);
        assert_eq!(LeftUTurn.counted_as(), LeftUTurn);
        // The old rules wanted the heading to turn right too.
        check((20.0, -15.0, 1.5), 5.0, RightTurn, LeftTurn);
    }

    #[test]
    fn who_is_absent_now_or_later_has_no_shape() {
        let mut scenario =
            fixture::scenario("ego vehicle 0: 0,0\nhistory 0.1 future 0.2 dt 0.1").unwrap();
        let shape_of = |scenario: &Scenario, id| shape(scenario, AgentId(id), ShapeRules::Current);
        assert_eq!(shape_of(&scenario, 0), Some(Shape::Stationary));
        assert_eq!(shape_of(&scenario, 1), None);
        for frame in &mut scenario.log[2..] {
            *frame = gump_scene::Frame::default();
        }
        assert_eq!(shape_of(&scenario, 0), None);
    }
}
