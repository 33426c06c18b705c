//! Driving off the road.

use gump_geometry::DVec2;
use gump_scene::{Agent, AgentKind, MapGraph, SceneState};

use crate::road_edge::metres_beyond_road_edge;
use crate::{Metric, Reduce};

/// 1 if a corner of the vehicle's box is off the road, else 0; `None` for other kinds and on maps
/// without a border. See [`metres_off_road`].
#[derive(Clone, Copy, Debug)]
pub struct OffRoad;

impl Metric for OffRoad {
    fn name(&self) -> &'static str {
        "off_road"
    }

    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        if agent.kind != AgentKind::Vehicle {
            return None;
        }
        let z = agent.elevation - agent.height / 2.0;
        let mut off = false;
        for corner in agent.oriented_box().corners() {
            off |= metres_off_road(scene.map, corner, z)? > 0.0;
        }
        Some(f64::from(off))
    }

    fn reduce(&self) -> Reduce {
        Reduce::Any
    }
}

/// Distance of `point` at height `z` outside the road, metres, 0 on it; `None` on maps without a
/// border.
///
/// Where the map has road edges, a point is off the road if it lies on the right of the nearest
/// edge. It is on the road if it lies on the edge, or past the open end of an edge: a vehicle that
/// drives out of the map has not left the road. ([`crate::DistanceToRoadEdge`] makes no such
/// exception.) Where the map has no edges, a point is off the road if no drivable surface contains
/// it.
pub fn metres_off_road(map: &MapGraph, point: DVec2, z: f64) -> Option<f64> {
    if !map.road_edges().is_empty() {
        metres_beyond_road_edge(map, point, z)
    } else if map.drivable().is_empty() {
        None
    } else if map.is_drivable(point) {
        Some(0.0)
    } else {
        map.drivable_distance(point)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::fixture;

    fn check(map: &str, agent: &str, expected: Option<f64>) {
        let text = format!("{map}\nego vehicle 0: 50,0\nagent {agent}");
        let scenario = fixture::scenario(&text).unwrap();
        let scene = scenario.present();
        let agent = scene.now().agent(gump_scene::AgentId(1)).unwrap();
        assert_eq!(OffRoad.at(&scene, agent), expected);
    }

    #[test]
    fn road_edges_decide_where_there_are_any() {
        let map = "edge: 0,-2 100,-2\ndrivable: 0,-9 100,-9 100,9 0,9";
        check(map, "vehicle 1: 20,0 size 4,2", Some(0.0));
        check(map, "vehicle 1: 20,-1 size 4,2", Some(0.0));
        check(map, "vehicle 1: 20,-1.1 size 4,2", Some(1.0));
        // Turned, a corner reaches over the edge.
        check(map, "vehicle 1: 20,-0.5 size 4,2 heading 0.6", Some(1.0));
    }

    #[test]
    fn driving_out_of_the_map_is_not_leaving_the_road() {
        let map = "edge: 0,-2 100,-2\nedge: 100,2 0,2";
        check(map, "vehicle 1: 120,-3 size 4,2", Some(0.0));
        check(map, "vehicle 1: 90,-3 size 4,2", Some(1.0));
    }

    #[test]
    fn surfaces_decide_elsewhere() {
        let map = "drivable: 0,-2 100,-2 100,2 0,2\ndrivable: 100,-2 200,-2 200,2 100,2";
        check(map, "vehicle 1: 99,0.5 size 4,2", Some(0.0));
        check(map, "vehicle 1: 99,1.5 size 4,2", Some(1.0));
        check("", "vehicle 1: 99,1.5 size 4,2", None);
    }

    #[test]
    fn only_vehicles_belong_on_the_road() {
        check("edge: 0,-2 100,-2", "pedestrian 1: 20,-5", None);
    }
}
