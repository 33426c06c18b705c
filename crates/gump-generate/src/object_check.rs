//! Check of a generated scene against the constraints on its objects.

use gump_engine::placement::object_spec::{Bounds, ObjectSpec, Relation};
use gump_geometry::angle_difference;
use gump_scene::{Agent, LaneId, MapGraph};
use gump_tokenizer::Field;

use crate::GeneratedScene;
use crate::check::Clause;

/// A gap is met to this, and so is the distance from the row, metres: what the draws allow, and
/// half the rounding of the ego's length.
const ROW_SLACK: f64 = 0.65;
/// Greatest angle to the direction of a lane, radians, as in the draws.
const LANE_SLACK: f64 = 0.3;
/// An object is on a lane up to this from its centre line, metres, or up to half the lane's width if
/// that is more: about the diagonal of a cell of the positions that are drawn.
const ON_LANE_M: f64 = 1.5;
/// Rounding of computations, which bounds of speed are met to.
const ROUNDING: f64 = 1e-6;

/// One clause per constraint on a scene as it was generated, in the order of the objects and of the
/// fields of [`ObjectSpec`].
///
/// Fixed values are met to the nearest value of the grid, so that values are allowed half a step of
/// it; speeds are met exactly, gaps to about half a metre. Undecided are the constraints of an object
/// that the scene lacks.
pub fn check_objects(
    scene: &GeneratedScene,
    map: &MapGraph,
    objects: &[ObjectSpec],
) -> Vec<Clause> {
    let mut clauses = Vec::new();
    for object in objects {
        let mut add = |what: String, holds: Option<bool>| {
            clauses.push(Clause::new(format!("{}: {what}", object.id), holds));
        };
        let agent = scene.named(&object.id);
        for (name, unit, bounds, value, slack) in numbers(object, scene, agent) {
            let holds = value.map(|value| {
                if name == "heading" {
                    bounds.admit_angle(value, slack)
                } else {
                    bounds.low - slack <= value && value <= bounds.high + slack
                }
            });
            add(format!("{name} {}{unit}", range(bounds)), holds);
        }
        if let Some(lane) = object.lane {
            let holds = agent.map(|agent| is_on_lane(agent, LaneId(lane), map));
            add(format!("on lane {lane}"), holds);
        }
        for (is_ahead, relation) in [(false, &object.behind), (true, &object.ahead_of)] {
            let Some(Relation {
                object: other,
                metres,
            }) = relation
            else {
                continue;
            };
            let pair = agent.zip(scene.named(other));
            let holds = pair.map(|(agent, other)| is_in_row(agent, other, is_ahead, *metres));
            let side = if is_ahead { "ahead of" } else { "behind" };
            add(format!("{metres} m {side} {other}"), holds);
        }
    }
    clauses
}

impl GeneratedScene {
    /// The object of this name.
    fn named(&self, name: &str) -> Option<&Agent> {
        self.frame.agent(*self.names.get(name)?)
    }
}

/// Name, unit, bounds, value and tolerance of a constraint on a number.
type Number = (&'static str, &'static str, Bounds, Option<f64>, f64);

/// The constraints on numbers; values are `None` without the agent.
fn numbers(object: &ObjectSpec, scene: &GeneratedScene, agent: Option<&Agent>) -> Vec<Number> {
    let ego = scene.frame.agent(scene.ego);
    let local = agent
        .zip(ego)
        .map(|(agent, ego)| ego.state.pose.inverse() * agent.state.pose);
    let x = local.map(|pose| pose.position.x);
    let y = local.map(|pose| pose.position.y);
    let heading = local.map(|pose| pose.heading);
    let speed = agent.map(|agent| agent.state.speed());
    let length = agent.map(|agent| agent.length);
    let width = agent.map(|agent| agent.width);
    let half = |field: Field| field.step() / 2.0 + ROUNDING;
    let all = [
        ("x", " m", object.x, x, half(Field::X)),
        ("y", " m", object.y, y, half(Field::Y)),
        (
            "heading",
            " rad",
            object.heading,
            heading,
            half(Field::Heading),
        ),
        ("speed", " m/s", object.speed, speed, ROUNDING),
        ("length", " m", object.length, length, half(Field::Length)),
        ("width", " m", object.width, width, half(Field::Width)),
    ];
    all.into_iter()
        .filter_map(|(name, unit, bounds, value, slack)| Some((name, unit, bounds?, value, slack)))
        .collect()
}

/// "2", or "0.5 to 2".
fn range(Bounds { low, high }: Bounds) -> String {
    if low < high {
        format!("{low} to {high}")
    } else {
        format!("{low}")
    }
}

fn is_on_lane(agent: &Agent, lane: LaneId, map: &MapGraph) -> bool {
    let Some(lane) = map.lane(lane) else {
        return false;
    };
    let pose = agent.state.pose;
    let nearest = lane.centerline.project(pose.position).arc_length;
    let nearest = lane.centerline.pose_at(nearest);
    let turn = angle_difference(pose.heading, nearest.heading);
    nearest.position.distance(pose.position) <= ON_LANE_M.max(lane.width / 2.0)
        && turn.abs() <= LANE_SLACK
}

/// Whether an object is in a row with another, with this gap from bumper to bumper.
fn is_in_row(agent: &Agent, other: &Agent, is_ahead: bool, metres: f64) -> bool {
    let local = other.state.pose.inverse() * agent.state.pose.position;
    let gap = local.x.abs() - (agent.length + other.length) / 2.0;
    (local.x > 0.0) == is_ahead && (gap - metres).abs() <= ROW_SLACK && local.y.abs() <= ROW_SLACK
}

#[cfg(test)]
mod tests {
    use gump_scene::{AgentId, fixture};

    use super::*;
    use crate::constraint::parse_constraints;

    #[test]
    fn every_constraint_has_a_verdict() {
        let scenario = fixture::scenario(
            "lane 1: -50,0 90,0\nlane 2: -50,4 90,4\nego vehicle 0: 0,0 velocity 7,0 size 4,2\n\
             agent vehicle 1: 18.5,0 heading 0 velocity 0,0.5 size 9,2",
        )
        .unwrap();
        let names = [("ego", 0), ("truck", 1)];
        let scene = GeneratedScene {
            frame: scenario.present().now().clone(),
            ego: AgentId(0),
            names: names
                .map(|(name, id)| (name.to_owned(), AgentId(id)))
                .into(),
            redraws: 0,
            restarts: 0,
        };
        let objects = parse_constraints(
            "[[object]]\nid = \"ego\"\nspeed = [6, 9]\n\
             [[object]]\nid = \"truck\"\nlength = 9.1\nspeed = [1, 2]\nx = 10\nlane = 1\n\
             ahead_of = { object = \"ego\", metres = 12 }\n\
             [[object]]\nid = \"bus\"\nlane = 2\nbehind = { object = \"truck\", metres = 12 }",
        )
        .unwrap();
        let clauses = check_objects(&scene, &scenario.map, &objects);
        let told: Vec<_> = clauses
            .iter()
            .map(|clause| (clause.clause.as_str(), clause.holds))
            .collect();
        let (yes, no) = (Some(true), Some(false));
        assert_eq!(
            told,
            [
                ("ego: speed 6 to 9 m/s", yes),
                ("truck: x 10 m", no),
                ("truck: speed 1 to 2 m/s", no),
                ("truck: length 9.1 m", yes),
                ("truck: on lane 1", yes),
                ("truck: 12 m ahead of ego", yes),
                ("bus: on lane 2", None),
                ("bus: 12 m behind truck", None),
            ]
        );
    }
}
