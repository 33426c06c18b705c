//! Baselines for generated scenes: vehicles at random along lanes, and the traffic of another
//! recording moved onto this map.

use gump_engine::placement::object_spec::agent_of;
use gump_geometry::DVec2;
use gump_metrics::overlapping;
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Frame, Lane, LaneKind, MapGraph, SceneState, Seed,
};
use rand::Rng as _;

/// Draws per wanted vehicle before the rest is left out; they are cheap. Not tuned.
const TRIES: usize = 50;
/// Moving vehicles this near to a lane's centre line are compared with its direction, metres: half
/// of a wide lane. Chosen by hand.
const ON_LANE_M: f64 = 2.0;

/// The ego of a scene and `n` vehicles at random on lanes within `half_side` metres of it along
/// either axis: positions are uniform, headings are those of lanes, speeds are up to the limit (15
/// m/s where none is stated), sizes are those of cars.
pub fn random_along_lanes(scene: &SceneState<'_>, n: usize, half_side: f64, seed: Seed) -> Frame {
    let ego = *scene.ego_now();
    let map: &MapGraph = scene.map;
    let mut rng = seed.rng();
    let reach = half_side * std::f64::consts::SQRT_2;
    let mut lanes: Vec<&Lane> = map
        .lanes_near(ego.state.pose.position, reach)
        .map(|(lane, _)| lane)
        .filter(|lane| lane.kind != LaneKind::BikeLane)
        .collect();
    lanes.sort_by_key(|lane| lane.id);
    let total: f64 = lanes.iter().map(|lane| lane.centerline.length()).sum();
    let mut agents = vec![ego];
    let mut draws = 0;
    while agents.len() <= n && draws < TRIES * n && total > 0.0 {
        draws += 1;
        let mut along = rng.random::<f64>() * total;
        let Some(lane) = lanes.iter().find(|lane| {
            along -= lane.centerline.length();
            along < 0.0
        }) else {
            continue;
        };
        let pose = lane.centerline.pose_at(along + lane.centerline.length());
        let local = ego.state.pose.inverse() * pose.position;
        let speed = rng.random::<f64>() * lane.speed_limit.unwrap_or(15.0);
        let size = [rng.random_range(4.2..5.4), rng.random_range(1.8..2.2)];
        let state = AgentState {
            pose,
            velocity: pose.direction() * speed,
        };
        let id = AgentId(ego.id.0.saturating_add(agents.len() as i64));
        let agent = agent_of(id, AgentKind::Vehicle, size, state, map);
        let clear = agents
            .iter()
            .all(|other: &Agent| !agent.oriented_box().overlaps(&other.oriented_box()));
        if local.abs().max_element() <= half_side && clear {
            agents.push(agent);
        }
    }
    Frame::new(agents, Vec::new())
}

/// The ego of a scene, and the `n` vehicles nearest to the ego of another scene, at their positions
/// relative to it.
pub fn retrieved(scene: &SceneState<'_>, from: &SceneState<'_>, n: usize) -> Frame {
    let (ego, theirs) = (*scene.ego_now(), from.ego_now());
    let here_from_there = ego.state.pose * theirs.state.pose.inverse();
    let distance = |agent: &Agent| {
        let place: DVec2 = agent.state.pose.position;
        place.distance(theirs.state.pose.position)
    };
    let others = from.now().agents().iter();
    let mut others: Vec<&Agent> = others
        .filter(|agent| agent.kind == AgentKind::Vehicle && agent.id != theirs.id)
        .collect();
    others.sort_by(|a, b| distance(a).total_cmp(&distance(b)).then(a.id.cmp(&b.id)));
    let moved = others.iter().take(n).zip(1..).map(|(agent, i)| Agent {
        id: AgentId(ego.id.0.saturating_add(i)),
        state: AgentState {
            pose: here_from_there * agent.state.pose,
            velocity: here_from_there.rotate(agent.state.velocity),
        },
        ..**agent
    });
    Frame::new(std::iter::once(ego).chain(moved).collect(), Vec::new())
}

/// Vehicles of a frame that drive against their lane: moving, on a lane, and more than a right
/// angle off the direction of every lane there; and the number of vehicles examined.
pub fn wrong_way(map: &MapGraph, frame: &Frame) -> (usize, usize) {
    let (mut wrong, mut judged) = (0, 0);
    let vehicles = frame.agents().iter();
    for agent in vehicles.filter(|a| a.kind == AgentKind::Vehicle && a.state.speed() > 1.0) {
        let pose = agent.state.pose;
        let turns = map
            .lanes_near(pose.position, ON_LANE_M)
            .map(|(lane, _)| lane.foot(pose).turned)
            .reduce(f64::min);
        if let Some(turn) = turns {
            judged += 1;
            wrong += usize::from(turn > std::f64::consts::FRAC_PI_2);
        }
    }
    (wrong, judged)
}

/// The number of vehicles of a frame that overlap an agent, and the number of vehicles.
pub fn overlapping_vehicles(frame: &Frame) -> (usize, usize) {
    let vehicles = frame.agents().iter();
    let vehicles: Vec<&Agent> = vehicles.filter(|a| a.kind == AgentKind::Vehicle).collect();
    let hit = |agent: &&&Agent| overlapping(frame, agent).next().is_some();
    (vehicles.iter().filter(hit).count(), vehicles.len())
}

#[cfg(test)]
mod tests {
    use gump_scene::fixture;

    use super::*;

    #[test]
    fn random_vehicles_are_on_lanes_and_apart() {
        let scenario = fixture::scenario("lane 1: -60,0 60,0\nego vehicle 0: 0,0").unwrap();
        let frame = random_along_lanes(&scenario.present(), 5, 50.0, Seed(3));
        assert_eq!(frame.agents().len(), 6);
        assert_eq!(overlapping_vehicles(&frame), (0, 6));
        assert_eq!(wrong_way(&scenario.map, &frame).0, 0);
        let far = |agent: &Agent| agent.state.pose.position.x.abs() > 50.0;
        assert!(!frame.agents().iter().any(far));
    }

    #[test]
    fn retrieved_vehicles_stand_as_the_other_ego_sees_them() {
        let scene = |text: &str| fixture::scenario(text).unwrap();
        let here = scene("ego vehicle 0: 10,0 heading 1.5707963267948966");
        let there =
            scene("ego vehicle 0: 0,0\nagent vehicle 1: 7,0 velocity 3,0\nagent vehicle 2: 90,0");
        let frame = retrieved(&here.present(), &there.present(), 1);
        assert_eq!(frame.agents().len(), 2);
        let other = frame.agent(AgentId(1)).unwrap().state;
        assert!((other.pose.position - DVec2::new(10.0, 7.0)).length() < 1e-9);
        assert!((other.velocity - DVec2::new(0.0, 3.0)).length() < 1e-9);
    }

    #[test]
    fn going_against_the_lane_is_wrong() {
        let scenario = fixture::scenario(
            "lane 1: 0,0 50,0\nego vehicle 0: 5,0 velocity 5,0\n\
             agent vehicle 1: 20,0 velocity -5,0\nagent vehicle 2: 30,0 heading 3.1",
        )
        .unwrap();
        assert_eq!(wrong_way(&scenario.map, scenario.present().now()), (1, 2));
    }
}
