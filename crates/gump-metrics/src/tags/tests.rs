//! Each tag on a scene to which it applies and one to which it does not.

use gump_scene::{Frame, Scenario, StopSign, fixture};

use super::*;

/// A straight road of two lanes, a crosswalk, and nothing else.
const ROAD: &str = "
    lane 1: -100,0 0,0 100,0 width 3.5 left 2
    lane 2: -100,3.5 100,3.5 width 3.5 right 1
    drivable: -100,-2 100,-2 100,6 -100,6\n";

fn scene(text: &str) -> Scenario {
    fixture::scenario(text).unwrap()
}

fn names(scenario: &Scenario) -> Vec<&'static str> {
    extract_tags(scenario)
        .into_iter()
        .map(ScenarioTag::name)
        .collect()
}

/// The tags of agents on the road; those in `expected` hold, those in `not` do not.
fn check(text: &str, expected: &[&str], not: &[&str]) {
    check_scene(&scene(&format!("{ROAD}{text}")), expected, not);
}

fn check_scene(scenario: &Scenario, expected: &[&str], not: &[&str]) {
    let found = names(scenario);
    for tag in expected {
        assert!(found.contains(tag), "{tag} is not among {found:?}");
        assert_eq!(holds(tag.parse().unwrap(), scenario), Some(true));
    }
    for tag in not {
        assert!(tag.parse::<ScenarioTag>().is_ok(), "{tag}");
        assert!(!found.contains(tag), "{tag} is among {found:?}");
    }
}

/// The ego of a scene moved along the frames by a function of the seconds from the present, which
/// gives x, y and heading.
fn driven(text: &str, way: impl Fn(f64) -> [f64; 3]) -> Scenario {
    let mut scenario = scene(text);
    let (now, dt, ego) = (scenario.now, scenario.dt, scenario.ego);
    let at = |t: f64| {
        let [x, y, heading] = way(t);
        gump_geometry::Pose::new(x, y, heading)
    };
    for (i, frame) in scenario.log.iter_mut().enumerate() {
        let t = (i as f64 - now as f64) * dt;
        let velocity = (at(t + 0.01).position - at(t - 0.01).position) / 0.02;
        let moved = frame.agents().iter().map(|agent| {
            if agent.id != ego {
                return *agent;
            }
            let state = gump_scene::AgentState {
                pose: at(t),
                velocity,
            };
            agent.with_state(state)
        });
        *frame = Frame::new(moved.collect(), frame.lights().to_vec());
    }
    scenario
}

/// Brakes with 2 m/s² to a stop at x = 0, from `t0` seconds before the present on.
fn braking(t: f64) -> [f64; 3] {
    // At the present 2 m/s are left.
    let left = (1.0 - t).max(0.0);
    [-left * left, 0.0, 0.0]
}

/// Stands at x = 0 until half a second before the present, then accelerates with 2 m/s².
fn starting(t: f64) -> [f64; 3] {
    let since = (t + 0.5).max(0.0);
    [since * since, 0.0, 0.0]
}

#[test]
fn every_tag_has_a_rule_at_its_place() {
    for (rule, tag) in rules().iter().zip(ScenarioTag::all()) {
        assert_eq!(rule.tag(), tag);
        assert!(!rule.meaning().is_empty());
        let is_zone = tag.name().contains("pickup");
        assert_eq!(rule.is_decidable(), !is_zone, "{tag}");
    }
}

#[test]
fn speeds() {
    let speeds = [
        "stationary",
        "low_magnitude_speed",
        "medium_magnitude_speed",
        "high_magnitude_speed",
    ];
    for (speed, expected) in [(0.0, 0), (0.8, 1), (6.0, 2), (12.0, 3)] {
        let text = format!("{ROAD}ego vehicle 0: 0,0 velocity {speed},0");
        let found = names(&scene(&text));
        for (i, name) in speeds.iter().enumerate() {
            assert_eq!(found.contains(name), i == expected, "{name} at {speed} m/s");
        }
    }
}

#[test]
fn following() {
    check(
        "ego vehicle 0: 0,0 velocity 8,0\nagent vehicle 1: 10,0 velocity 8,0",
        &["following_lane_with_lead"],
        &[
            "following_lane_without_lead",
            "following_lane_with_slow_lead",
        ],
    );
    check(
        "ego vehicle 0: 0,0 velocity 3,0\nagent vehicle 1: 10,0 velocity 2,0",
        &["following_lane_with_slow_lead"],
        &["following_lane_with_lead"],
    );
    check(
        "ego vehicle 0: 0,0 velocity 8,0\nagent vehicle 1: 10,3.5 velocity 8,0",
        &["following_lane_without_lead"],
        &["following_lane_with_lead"],
    );
}

#[test]
fn behind() {
    check(
        "ego vehicle 0: 0,0 velocity 4,0\nagent bicycle 1: 9,0.5 velocity 4,0",
        &["behind_bike"],
        &["behind_long_vehicle", "behind_pedestrian_on_driveable"],
    );
    check(
        "ego vehicle 0: 0,0 velocity 4,0\nagent bicycle 1: 9,3.5 velocity 4,0",
        &[],
        &["behind_bike"],
    );
    check(
        "ego vehicle 0: 0,0 velocity 4,0\nagent vehicle 1: 14,0 velocity 4,0 size 12,2.5",
        &["behind_long_vehicle"],
        &["behind_bike", "near_long_vehicle"],
    );
    check(
        "ego vehicle 0: 0,0 velocity 1,0\nagent pedestrian 1: 8,0.5 velocity 1,0",
        &["behind_pedestrian_on_driveable"],
        &[],
    );
}

#[test]
fn near() {
    let around = |n: usize, what: &str| {
        (0..n)
            .map(|i| {
                let x = 5.5 * (i / 2) as f64 - 5.5;
                let y = if i % 2 == 0 { 3.5 } else { -3.5 };
                format!("\nagent {} {}: {x},{y} velocity 7,0", what, i + 1)
            })
            .collect::<String>()
    };
    let fast = "ego vehicle 0: 0,0 velocity 7,0";
    check(
        &format!("{fast}{}", around(7, "vehicle")),
        &["near_multiple_vehicles"],
        &[],
    );
    check(
        &format!("{fast}{}", around(6, "vehicle")),
        &[],
        &["near_multiple_vehicles"],
    );
    check(
        &format!("{fast}{}", around(3, "bicycle")),
        &["near_multiple_bikes"],
        &[],
    );
    check(
        &format!("{fast}{}", around(2, "bicycle")),
        &[],
        &["near_multiple_bikes"],
    );
    check(
        &format!("{fast}{}", around(4, "pedestrian")),
        &["near_multiple_pedestrians"],
        &[],
    );
    check(
        &format!("{fast}{}", around(3, "pedestrian")),
        &[],
        &["near_multiple_pedestrians"],
    );
    let standing = around(7, "vehicle").replace("velocity 7,0", "velocity 0,0");
    check(
        &format!("ego vehicle 0: 0,0{standing}"),
        &["stationary_in_traffic", "stationary"],
        &["near_multiple_vehicles"],
    );
    check(
        "ego vehicle 0: 0,0\nagent vehicle 1: 0,3.5 velocity 14,0\nagent vehicle 2: 4,-4 size 10,2.5",
        &["near_high_speed_vehicle", "near_long_vehicle"],
        &["stationary_in_traffic"],
    );
    check(
        "ego vehicle 0: 0,0\nagent cone 1: 6,1",
        &["near_trafficcone_on_driveable"],
        &["near_barrier_on_driveable", "near_construction_zone_sign"],
    );
    check(
        "ego vehicle 0: 0,0\nagent cone 1: 6,-9",
        &[],
        &["near_trafficcone_on_driveable"],
    );
}

#[test]
fn barriers_and_signs() {
    let mut scenario = scene(&format!(
        "{ROAD}ego vehicle 0: 0,0\nagent cone 1: 6,1\nagent cone 2: 9,1"
    ));
    for frame in &mut scenario.log {
        let kinds = [AgentKind::Vehicle, AgentKind::Barrier, AgentKind::Sign];
        let agents = frame.agents().iter().zip(kinds);
        let agents = agents.map(|(agent, kind)| gump_scene::Agent { kind, ..*agent });
        *frame = Frame::new(agents.collect(), Vec::new());
    }
    check_scene(
        &scenario,
        &["near_barrier_on_driveable", "near_construction_zone_sign"],
        &["near_trafficcone_on_driveable"],
    );
}

#[test]
fn crossed() {
    check(
        "ego vehicle 0: 0,0 velocity 1,0\nagent vehicle 1: 15,-6 velocity 0,5",
        &["crossed_by_vehicle"],
        &["crossed_by_bike"],
    );
    check(
        "ego vehicle 0: 0,0 velocity 1,0\nagent bicycle 1: 15,6 velocity 0,-4",
        &["crossed_by_bike"],
        &["crossed_by_vehicle"],
    );
    check(
        "ego vehicle 0: 0,0 velocity 1,0\nagent vehicle 1: -15,-6 velocity 0,5",
        &[],
        &["crossed_by_vehicle"],
    );
}

#[test]
fn crosswalks() {
    let walk = "crosswalk: 5,-3 8,-3 8,6 5,6\n";
    check(
        &format!("{walk}ego vehicle 0: 0,0\nagent pedestrian 1: 6,1.5 velocity 0,-1"),
        &[
            "waiting_for_pedestrian_to_cross",
            "stationary_at_crosswalk",
            "near_pedestrian_on_crosswalk",
        ],
        &[
            "near_pedestrian_on_crosswalk_with_ego",
            "traversing_crosswalk",
            "on_stopline_crosswalk",
        ],
    );
    check(
        &format!("{walk}ego vehicle 0: 0,0\nagent pedestrian 1: 6,4 velocity 0,1"),
        &["near_pedestrian_on_crosswalk"],
        &["waiting_for_pedestrian_to_cross"],
    );
    check(
        &format!("{walk}ego vehicle 0: 6,0 velocity 4,0\nagent pedestrian 1: 6,4 velocity 0,1"),
        &[
            "traversing_crosswalk",
            "near_pedestrian_on_crosswalk_with_ego",
        ],
        &["stationary_at_crosswalk"],
    );
    check(
        &format!("{walk}ego vehicle 0: 1.5,0"),
        &["on_stopline_crosswalk"],
        &[],
    );
    let text = format!("{ROAD}{walk}ego vehicle 0: 0,0");
    check_scene(
        &driven(&text, braking),
        &["stopping_at_crosswalk"],
        &["accelerating_at_crosswalk"],
    );
    check_scene(
        &driven(&text, starting),
        &["accelerating_at_crosswalk"],
        &["stopping_at_crosswalk"],
    );
}

/// An intersection 6 m ahead of x = 0: straight on, left, right and around, all under one light.
fn crossing(light: &str) -> String {
    format!(
        "lane 1: -100,0 6,0 speed 14 next 10,11,12,13
         lane 10: 6,0 30,0 next 20
         lane 11: 6,0 12,1 17,6 18,12 next 21
         lane 12: 6,0 9,-1 11,-3 12,-6 next 22
         lane 13: 6,0 12,0 14,3 12,6 6,6 next 23
         lane 20: 30,0 99,0
         lane 21: 18,12 18,99
         lane 22: 12,-6 12,-99
         lane 23: 6,6 -99,6
         {light}
         ego vehicle 0: 0,0"
    )
}

/// The crossing, with lanes 10 to 13 inside of the intersection.
fn at_crossing(light: &str, lane: u32, speed: f64) -> Scenario {
    let text = crossing(light);
    let line = scene(&text)
        .map
        .lane(gump_scene::LaneId(i64::from(lane)))
        .unwrap()
        .centerline
        .clone();
    let exit = line.length();
    let way = move |t: f64| {
        let s = speed * t - 3.0;
        if s < 0.0 {
            return [6.0 + s, 0.0, 0.0];
        }
        let pose = line.pose_at(s.min(exit + 40.0));
        [pose.position.x, pose.position.y, pose.heading]
    };
    let mut scenario = driven(&text, way);
    let mut parts = scenario.map.parts().clone();
    for lane in &mut parts.lanes {
        lane.in_intersection = (10..20).contains(&lane.id.0);
    }
    scenario.map = std::sync::Arc::new(gump_scene::MapGraph::new(parts).unwrap());
    scenario.route = Some(std::sync::Arc::new(gump_scene::Route {
        lanes: [1, lane.into(), i64::from(lane) + 10]
            .map(gump_scene::LaneId)
            .to_vec(),
        roadblocks: Vec::new(),
        path: scenario.map.lanes()[0].centerline.clone(),
    }));
    scenario
}

#[test]
fn turns() {
    let green =
        "light 10 green: 6,0\nlight 11 green: 6,0\nlight 12 green: 6,0\nlight 13 green: 6,0";
    check_scene(
        &at_crossing(green, 11, 5.0),
        &["starting_left_turn", "starting_protected_cross_turn"],
        &[
            "starting_right_turn",
            "starting_unprotected_cross_turn",
            "starting_low_speed_turn",
        ],
    );
    check_scene(
        &at_crossing("", 11, 3.5),
        &[
            "starting_left_turn",
            "starting_unprotected_cross_turn",
            "starting_low_speed_turn",
        ],
        &["starting_protected_cross_turn", "starting_u_turn"],
    );
    check_scene(
        &at_crossing("", 12, 6.5),
        &[
            "starting_right_turn",
            "starting_unprotected_noncross_turn",
            "starting_high_speed_turn",
        ],
        &["starting_left_turn"],
    );
    check_scene(
        &at_crossing(green, 12, 5.0),
        &["starting_right_turn", "starting_protected_noncross_turn"],
        &["starting_unprotected_noncross_turn"],
    );
    check_scene(
        &at_crossing("", 13, 5.0),
        &["starting_u_turn"],
        &["starting_left_turn"],
    );
    check_scene(
        &at_crossing(green, 10, 8.0),
        &["starting_straight_traffic_light_intersection_traversal"],
        &["starting_left_turn", "starting_right_turn"],
    );
}

#[test]
fn on_an_intersection() {
    let green = "light 10 green: 6,0";
    let mut scenario = at_crossing(green, 10, 8.0);
    // Two seconds on, the ego is in the middle.
    scenario.now += 15;
    check_scene(
        &scenario,
        &[
            "on_intersection",
            "on_traffic_light_intersection",
            "traversing_intersection",
            "traversing_traffic_light_intersection",
        ],
        &["starting_left_turn", "on_all_way_stop_intersection"],
    );
    let mut dark = at_crossing("", 10, 8.0);
    dark.now += 15;
    check_scene(
        &dark,
        &["on_intersection", "traversing_intersection"],
        &[
            "on_traffic_light_intersection",
            "traversing_traffic_light_intersection",
        ],
    );
}

fn with_stop_signs(mut scenario: Scenario, lanes: &[i64]) -> Scenario {
    let mut parts = scenario.map.parts().clone();
    parts.stop_signs = lanes
        .iter()
        .map(|&lane| StopSign {
            id: 900 + lane,
            position: gump_geometry::dvec3(6.0, -3.0, 2.0),
            lanes: vec![gump_scene::LaneId(lane)],
        })
        .collect();
    scenario.map = std::sync::Arc::new(gump_scene::MapGraph::new(parts).unwrap());
    scenario
}

#[test]
fn stop_signs() {
    let text = crossing("");
    let stopped = with_stop_signs(driven(&text, |t| [braking(t)[0] + 1.0, 0.0, 0.0]), &[1]);
    check_scene(
        &stopped,
        &[
            "stopping_at_stop_sign_without_lead",
            "stopping_at_stop_sign_no_crosswalk",
        ],
        &[
            "stopping_at_stop_sign_with_lead",
            "accelerating_at_stop_sign",
        ],
    );
    let second = with_stop_signs(
        driven(&format!("{text}\nagent vehicle 1: 6.5,0"), braking),
        &[1],
    );
    check_scene(
        &second,
        &["stopping_at_stop_sign_with_lead", "stopping_with_lead"],
        &["stopping_at_stop_sign_without_lead"],
    );
    let off = with_stop_signs(driven(&text, |t| [starting(t)[0] + 2.5, 0.0, 0.0]), &[1]);
    check_scene(
        &off,
        &[
            "accelerating_at_stop_sign",
            "accelerating_at_stop_sign_no_crosswalk",
            "on_stopline_stop_sign",
        ],
        &["accelerating_at_traffic_light"],
    );
    check_scene(
        &with_stop_signs(at_crossing("", 10, 8.0), &[1]),
        &["starting_straight_stop_sign_intersection_traversal"],
        &["starting_straight_traffic_light_intersection_traversal"],
    );
}

#[test]
fn an_all_way_stop() {
    let text = "lane 1: -50,0 -8,0 next 10\nlane 2: 50,3 8,3 next 11\nlane 3: 0,-50 0,-8 next 12
        lane 10: -8,0 8,0\nlane 11: 8,3 -8,3\nlane 12: 0,-8 0,8\nego vehicle 0: 0,0 velocity 3,0";
    let mut scenario = scene(text);
    let mut parts = scenario.map.parts().clone();
    for lane in &mut parts.lanes {
        lane.in_intersection = lane.id.0 >= 10;
    }
    scenario.map = std::sync::Arc::new(gump_scene::MapGraph::new(parts).unwrap());
    let tag = "on_all_way_stop_intersection";
    check_scene(&with_stop_signs(scenario.clone(), &[1, 2, 3]), &[tag], &[]);
    check_scene(&with_stop_signs(scenario, &[1, 2]), &[], &[tag]);
}

#[test]
fn lights() {
    let red = crossing("light 10 red: 6,0");
    check_scene(
        &driven(&red, |t| [braking(t)[0] + 1.0, 0.0, 0.0]),
        &["stopping_at_traffic_light_without_lead"],
        &["stopping_at_traffic_light_with_lead"],
    );
    let queue = format!("{red}\nagent vehicle 1: 6.5,0");
    check_scene(
        &driven(&queue, braking),
        &["stopping_at_traffic_light_with_lead", "stopping_with_lead"],
        &["stopping_at_traffic_light_without_lead"],
    );
    check_scene(
        &scene(&red),
        &["stationary_at_traffic_light_without_lead"],
        &[
            "stationary_at_traffic_light_with_lead",
            "on_stopline_traffic_light",
        ],
    );
    let first = driven(&red, |_| [3.0, 0.0, 0.0]);
    check_scene(
        &first,
        &["on_stopline_traffic_light"],
        &["on_stopline_stop_sign"],
    );
    check_scene(
        &scene(&queue),
        &["stationary_at_traffic_light_with_lead"],
        &["stationary_at_traffic_light_without_lead"],
    );
    let green = crossing("light 10 green: 6,0");
    check_scene(
        &driven(&green, starting),
        &[
            "accelerating_at_traffic_light",
            "accelerating_at_traffic_light_without_lead",
        ],
        &[
            "accelerating_at_traffic_light_with_lead",
            "stationary_at_traffic_light_without_lead",
        ],
    );
    check_scene(
        &driven(&format!("{green}\nagent vehicle 1: 9,0"), starting),
        &["accelerating_at_traffic_light_with_lead"],
        &["accelerating_at_traffic_light_without_lead"],
    );
}

#[test]
fn lane_changes() {
    let change = |t: f64| [8.0 * t, 3.5 * ((t - 0.2) / 3.0).clamp(0.0, 1.0), 0.0];
    let text = format!("{ROAD}ego vehicle 0: 0,0\nagent vehicle 1: 20,0 velocity 8,0");
    check_scene(
        &driven(&text, change),
        &[
            "changing_lane",
            "changing_lane_to_left",
            "changing_lane_with_lead",
        ],
        &[
            "changing_lane_to_right",
            "changing_lane_with_trail",
            "following_lane_with_lead",
        ],
    );
    let back = |t: f64| [8.0 * t, 3.5 - change(t)[1], 0.0];
    let text = format!("{ROAD}ego vehicle 0: 0,0\nagent vehicle 1: -12,0 velocity 8,0");
    check_scene(
        &driven(&text, back),
        &[
            "changing_lane",
            "changing_lane_to_right",
            "changing_lane_with_trail",
        ],
        &["changing_lane_to_left", "changing_lane_with_lead"],
    );
    check("ego vehicle 0: 0,0 velocity 8,0", &[], &["changing_lane"]);
}

#[test]
fn dynamics() {
    // A circle of 40 m at 9 m/s: 2 m/s² to the side.
    let curve = |t: f64| {
        let angle = 9.0 * t / 40.0;
        [40.0 * angle.sin(), 40.0 - 40.0 * angle.cos(), angle]
    };
    let text = "ego vehicle 0: 0,0";
    check_scene(
        &driven(text, curve),
        &["high_lateral_acceleration"],
        &["high_magnitude_jerk"],
    );
    // Full braking out of constant speed.
    let jolt = |t: f64| [8.0 * t - 3.5 * t.max(0.0).powi(2), 0.0, 0.0];
    check_scene(
        &driven(text, jolt),
        &["high_magnitude_jerk"],
        &["high_lateral_acceleration"],
    );
}

#[test]
fn places() {
    check(
        "lane 3: -50,-20 50,-20 width 2.6\nego vehicle 0: 0,-20 velocity 3,0",
        &["traversing_narrow_lane"],
        &["on_carpark", "on_intersection"],
    );
    let mut scenario = scene(&format!("{ROAD}ego vehicle 0: 0,0"));
    let mut parts = scenario.map.parts().clone();
    let ring = [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)];
    let ring = ring.map(|(x, y)| gump_geometry::dvec2(x, y)).to_vec();
    let polygon = gump_geometry::Polygon::new(ring).unwrap();
    parts
        .areas
        .push(gump_scene::Area::new(7, AreaKind::Carpark, polygon));
    scenario.map = std::sync::Arc::new(gump_scene::MapGraph::new(parts).unwrap());
    check_scene(&scenario, &["on_carpark"], &["traversing_narrow_lane"]);
}

#[test]
fn another_agent_at_another_time_has_the_tags_of_a_scenario_retold() {
    let scenario = fixture::scenario(
        "lane 1: -50,0 250,0\nego vehicle 0: 0,0 velocity 8,0\n\
         agent vehicle 1: -15,0 velocity 8,0\nagent vehicle 2: 20,0 velocity 6,0\n\
         history 1 future 6 dt 0.1",
    )
    .unwrap();
    for (agent, now) in [(1, 4), (2, 30), (0, scenario.now)] {
        let retold = Scenario {
            now,
            ego: AgentId(agent),
            route: None,
            ..scenario.clone()
        };
        assert_eq!(
            around(&scenario, AgentId(agent), now),
            extract_tags(&retold)
        );
    }
}
