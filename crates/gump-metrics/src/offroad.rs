//! Leaving the road.

use gump_scene::{Agent, AgentKind, SceneState};

use crate::{DistanceToRoadEdge, Metric, Reduce};

/// 1 if a corner of the vehicle's box is off the road, else 0; `None` for anything but vehicles
/// and on maps that know no border.
///
/// Where the map has road edges, a corner is off the road if it lies on the right of the nearest
/// edge ([`DistanceToRoadEdge`] above 0; a corner on the edge is on the road). Where it has none,
/// a corner is off the road if no drivable surface contains it.
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
        if let Some(distance) = DistanceToRoadEdge.at(scene, agent) {
            return Some(f64::from(distance > 0.0));
        }
        if scene.map.drivable().is_empty() {
            return None;
        }
        let mut corners = agent.oriented_box().corners().into_iter();
        Some(f64::from(
            corners.any(|corner| !scene.map.is_drivable(corner)),
        ))
    }

    fn reduce(&self) -> Reduce {
        Reduce::Any
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
