//! Places beside and across the road: for cones and barriers, for pedestrians on crosswalks, and
//! lanes that cross ahead.

use gump_engine::placement::object_spec::agent_of;
use gump_geometry::{DVec2, OrientedBox, Pose, angle_difference, dvec2};
use gump_scene::{Agent, AgentId, AgentKind, AgentState, AreaKind, Lane, LaneKind, MapGraph};

use crate::EgoStart;
use crate::drive::PlannedDrive;
use crate::prompt::WorkZone;

// Within the distances of the tags (`gump_metrics::tags`): 8 m to cones, barriers and people, 20 m
// to signs and to who crosses. The rest is chosen by hand.

/// Distance of the first roadside object from the ego's front, and spacing, metres.
const WORKS_M: [f64; 2] = [2.5, 3.0];
/// Distance to the centre of every lane that stays clear, metres: half of a car and 0.4 m.
const CLEAR_M: f64 = 1.35;
/// Maximum distance of a crosswalk with a pedestrian from the ego's centre along either axis,
/// metres: 7 m from its box, and half of its length.
const WALK_M: f64 = 9.0;
/// Range ahead of the ego's front in which its line may be crossed, metres: not so near that who
/// crosses would hit it.
const CROSSED_M: [f64; 2] = [4.0, 15.0];

/// Cones or barriers along the edge of the lane that is driven, ahead of the ego and clear of the
/// middle of every lane; `None` if there is no room for three.
pub(super) fn put(
    map: &MapGraph,
    lane: &Lane,
    drive: &PlannedDrive,
    ego_length: f64,
    works: WorkZone,
) -> Option<Vec<Agent>> {
    let (kind, size) = match works {
        WorkZone::Barriers => (AgentKind::Barrier, [2.0, 0.4]),
        WorkZone::Cones | WorkZone::Sign => (AgentKind::TrafficCone, [0.35, 0.35]),
    };
    let edge = (lane.width / 2.0 - 0.1).max(CLEAR_M + size[1] / 2.0);
    // On the right, where the kerb is; on the left if that is no road.
    [-edge, edge].into_iter().find_map(|offset| {
        let mut row: Vec<Agent> = (0..5)
            .map(|i| ego_length / 2.0 + WORKS_M[0] + WORKS_M[1] * f64::from(i))
            .map(|metres| drive.pose_ahead(metres) * Pose::new(0.0, offset, 0.0))
            .take_while(|pose| map.is_drivable(pose.position) && is_clear(map, pose.position))
            .zip(0..)
            .map(|(pose, i)| fixture(map, kind, size, pose, i))
            .collect();
        if row.len() < 3 {
            return None;
        }
        if works == WorkZone::Sign {
            // It announces the works to approaching traffic.
            let first = row[0].state.pose;
            row[0] = fixture(map, AgentKind::Sign, [0.2, 0.7], first, 0);
        }
        Some(row)
    })
}

/// Requested positions on crosswalks around the ego, in its frame, each with whether the ego is on
/// the same crosswalk. At least a metre from the ego's box and up to 7 m.
pub(super) fn on_crosswalk(
    map: &MapGraph,
    ego: &EgoStart,
    wanted: impl Fn(DVec2, bool) -> bool,
) -> Vec<DVec2> {
    let own = OrientedBox {
        pose: ego.pose,
        length: ego.length,
        width: ego.width,
    };
    let footprint = gump_geometry::Polygon::new(own.corners().to_vec());
    let footprint = footprint.expect("a box has four corners");
    let mut spots = Vec::new();
    for area in map.areas_in_square(ego.pose.position, WALK_M, AreaKind::Crosswalk) {
        let is_shared = area.polygon.intersects(&footprint);
        let n = (2.0 * WALK_M / 0.5) as usize;
        for i in 0..n * n {
            let step = |i: usize| i as f64 * 0.5 - WALK_M;
            let local = dvec2(step(i / n), step(i % n));
            let beyond = (local.abs() - dvec2(ego.length, ego.width) / 2.0).max(DVec2::ZERO);
            let is_near = (1.0..7.0).contains(&beyond.length());
            if is_near && wanted(local, is_shared) && area.polygon.contains(ego.pose * local) {
                spots.push(local);
            }
        }
    }
    spots
}

/// Lanes that cross the line ahead of the ego, each with the metres along it at which it does.
pub(super) fn crossings<'a>(map: &'a MapGraph, ego: &EgoStart) -> Vec<(&'a Lane, f64)> {
    let ego_from_world = ego.pose.inverse();
    let front = ego.length / 2.0;
    let middle = front + (CROSSED_M[0] + CROSSED_M[1]) / 2.0;
    let ahead = (ego.pose * Pose::new(middle, 0.0, 0.0)).position;
    let lanes = map.lanes_near(ahead, CROSSED_M[1] / 2.0);
    let mut crossings = Vec::new();
    for (lane, _) in lanes.filter(|(lane, _)| lane.kind != LaneKind::BikeLane) {
        let mut along = 0.0;
        for (a, b) in lane.centerline.segments() {
            let (from, to) = (ego_from_world * a, ego_from_world * b);
            let share = from.y / (from.y - to.y);
            let x = from.x + (to.x - from.x) * share;
            let turn = angle_difference((to - from).to_angle(), 0.0);
            // At more than 53 degrees.
            let is_across = from.y * to.y < 0.0 && turn.sin().abs() > 0.8;
            if is_across && (CROSSED_M[0]..CROSSED_M[1]).contains(&(x - front)) {
                crossings.push((lane, along + share * a.distance(b)));
            }
            along += a.distance(b);
        }
    }
    crossings
}

/// Whether a place is clear of the middle of every lane.
fn is_clear(map: &MapGraph, point: DVec2) -> bool {
    map.lanes_near(point, CLEAR_M).next().is_none()
}

fn fixture(map: &MapGraph, kind: AgentKind, size: [f64; 2], pose: Pose, number: i64) -> Agent {
    let state = AgentState {
        pose,
        velocity: DVec2::ZERO,
    };
    // Away from the ids of what was recorded; the scene numbers all of them anew.
    agent_of(AgentId(i64::MIN + number), kind, size, state, map)
}

#[cfg(test)]
mod tests {
    use gump_scene::{Scenario, Seed, fixture};

    use super::*;
    use crate::drive::Maneuver;

    fn ego(x: f64) -> EgoStart {
        EgoStart {
            pose: Pose::new(x, 0.0, 0.0),
            length: 4.8,
            width: 2.0,
            velocity: None,
        }
    }

    fn road() -> Scenario {
        fixture::scenario(
            "lane 1: 0,0 100,0 width 3.6\nlane 2: 0,3.6 100,3.6 width 3.6\n\
             lane 3: 40,-30 40,30\ndrivable: 0,-1.9 100,-1.9 100,5.4 0,5.4\n\
             crosswalk: 60,-2 63,-2 63,6 60,6\nego vehicle 0: 0,0",
        )
        .unwrap()
    }

    fn works(works: WorkZone) -> Vec<Agent> {
        let scenario = road();
        let map = &scenario.map;
        let lane = &map.lanes()[0];
        let rng = &mut Seed(1).rng();
        let drive =
            PlannedDrive::along(map, (lane, 10.0), 0.0, 5.0, Maneuver::default(), rng).unwrap();
        put(map, lane, &drive, 4.8, works).unwrap()
    }

    #[test]
    fn works_stand_at_the_edge_of_the_lane() {
        let row = works(WorkZone::Cones);
        assert_eq!(row.len(), 5);
        for (agent, i) in row.iter().zip(0..) {
            let place = agent.state.pose.position;
            assert!(
                (place.x - (14.9 + 3.0 * f64::from(i))).abs() < 1e-6,
                "{place}"
            );
            assert!((-1.8..-1.5).contains(&place.y), "{place}");
            assert_eq!(agent.kind, AgentKind::TrafficCone);
        }
        assert!(
            works(WorkZone::Barriers)
                .iter()
                .all(|a| a.kind == AgentKind::Barrier)
        );
        let signs = works(WorkZone::Sign)
            .iter()
            .filter(|a| a.kind == AgentKind::Sign)
            .count();
        assert_eq!(signs, 1);
    }

    #[test]
    fn crossings_are_ahead_and_across() {
        let scenario = road();
        let crossings = |x: f64| crossings(&scenario.map, &ego(x));
        let found = crossings(28.0);
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].0.id.0, found[0].1), (3, 30.0));
        assert!(crossings(50.0).is_empty() && crossings(5.0).is_empty());
    }

    #[test]
    fn spots_on_crosswalks_are_near_but_not_under_the_ego() {
        let scenario = road();
        let spots = |x: f64| on_crosswalk(&scenario.map, &ego(x), |_, is_shared| is_shared);
        assert!(spots(52.0).is_empty());
        let on = spots(61.0);
        assert!(!on.is_empty());
        for local in on {
            assert!(
                local.y.abs() >= 2.0 && (59.0..64.0).contains(&(61.0 + local.x)),
                "{local}"
            );
        }
        assert!(!on_crosswalk(&scenario.map, &ego(55.0), |_, _| true).is_empty());
    }
}
