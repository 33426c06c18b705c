//! Local contexts of small hand-made scenes.

use gump_geometry::dvec2;
use gump_scene::{Scenario, fixture};

use super::*;
use crate::testing::{scenario, slots};

fn seen(scenario: &Scenario) -> Vec<(usize, LocalContext)> {
    let lane_map = LaneMap::new(&scenario.map, scenario.present().ego_now().state.pose);
    encode_local_context(&lane_map, &slots(scenario), 0)
}

/// The part of the first path in what the ego sees last.
fn ego_path(scenario: &Scenario) -> Vec<f32> {
    let slots = slots(scenario);
    let is_ego = |i: usize| matches!(slots[i].slot, Slot::Key(key) if key.is_ego());
    let last = seen(scenario).into_iter().rfind(|(i, _)| is_ego(*i));
    last.expect("the ego is in every frame").1[OWN_NUMBERS..][..PATH_NUMBERS].to_vec()
}

#[test]
fn the_first_frame_sees_nothing_and_later_ones_the_frame_before() {
    let (scenario, slots) = (scenario(), slots(&scenario()));
    let keys = slots
        .iter()
        .filter(|p| matches!(p.slot, Slot::Key(_)) && p.last.is_some());
    let seen = seen(&scenario);
    assert_eq!(seen.len(), keys.count());
    assert!(seen.iter().all(|(i, _)| slots[*i].frame > 0));
    // Looking from later on gives the same numbers.
    let lane_map = LaneMap::new(&scenario.map, scenario.present().ego_now().state.pose);
    let from = seen[seen.len() / 2].0;
    assert_eq!(
        encode_local_context(&lane_map, &slots, from),
        seen[seen.len() / 2..]
    );
}

#[test]
fn a_straight_lane_lies_straight_ahead_with_who_drives_on_it() {
    let path = ego_path(&scenario());
    assert_eq!(path[0], 1.0);
    // 44 m on: as far ahead as the last point but the two metres the point abeam may be off.
    let last = &path[1 + 4 * 6..][..4];
    assert!(
        (last[0] - 2.2).abs() < 0.11 && last[1].abs() < 0.05,
        "{last:?}"
    );
    assert!((last[2] - 1.0).abs() < 1e-3);
    // The lane's limit of 15 m/s, and the vehicle 20 m ahead at 5 m/s.
    assert_eq!(path[29], 1.0);
    let ahead = &path[36..];
    assert!(ahead[0] > 0.5 && (ahead[2] - 0.5).abs() < 0.05, "{ahead:?}");
}

#[test]
fn turning_and_moving_the_scene_changes_what_is_seen_by_no_more_than_rounding() {
    let straight = "lane 1: -100,0 100,0
         edge: -100,-2 100,-2
         ego vehicle 0: 0,0 velocity 8,0
         agent vehicle 1: 20,0 velocity 5,0";
    let turned = "lane 1: 0,-100 0,100
         edge: 2,-100 2,100
         ego vehicle 0: 0,0 heading 1.5707963 velocity 0,8
         agent vehicle 1: 0,20 heading 1.5707963 velocity 0,5";
    let (a, b) = [straight, turned]
        .map(|text| ego_path(&fixture::scenario(text).unwrap()))
        .into();
    let off = a
        .iter()
        .zip(&b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    assert!(off < 0.02, "{off}");
}

#[test]
fn a_fork_shows_both_branches_from_left_to_right() {
    let fork = fixture::scenario(
        "lane 1: -50,0 10,0 next 2,3
         lane 2: 10,0 30,0 50,20
         lane 3: 10,0 30,0 50,-20
         ego vehicle 0: 0,0 velocity 8,0",
    )
    .unwrap();
    let lane_map = LaneMap::new(&fork.map, Pose::default());
    let ends: Vec<f64> = lane_map
        .paths(Pose::default())
        .iter()
        .map(|path| {
            lane_map
                .point(*path.last().expect("points"))
                .pose
                .position
                .y
        })
        .collect();
    assert_eq!(ends.len(), 2);
    assert!(ends[0] > 5.0 && ends[1] < -5.0, "{ends:?}");
}

#[test]
fn points_are_found_where_they_are() {
    let scenario = scenario();
    let lane_map = LaneMap::new(&scenario.map, Pose::default());
    let near = lane_map
        .edges_near(dvec2(0.0, 0.0), 10.0)
        .filter(|edge| edge.from.length() < 10.0)
        .count();
    // The edge passes two metres to the right.
    assert!((12..=15).contains(&near), "{near}");
    assert_eq!(lane_map.edges_near(dvec2(500.0, 0.0), 10.0).count(), 0);
    assert_eq!(lane_map.edges_near(dvec2(-500.0, 900.0), 10.0).count(), 0);
}

#[test]
fn edges_are_found_wherever_the_map_is() {
    for far in [
        dvec2(0.0, 0.0),
        dvec2(300.0, -200.0),
        dvec2(-8000.0, 6000.0),
    ] {
        let line =
            [(-20.0, -2.0), (20.0, -2.0)].map(|(x, y)| format!(" {},{}", x + far.x, y + far.y));
        let text = format!("edge:{}\nego vehicle 0: {},{}", line.concat(), far.x, far.y);
        let map = fixture::scenario(&text).unwrap().map;
        let edges = LaneMap::of_edges(&map, &[far], 50.0);
        let found = edges
            .edges_near(far, 10.0)
            .filter(|edge| edge.from.distance(far) < 10.0);
        // 19.6 m of them, in stretches of at most 1.5 m.
        let found = found.count();
        assert!((12..=15).contains(&found), "{found} at {far}");
    }
}

#[test]
fn the_mouth_of_a_driveway_is_no_curb() {
    let scenario = scenario();
    let mut parts = scenario.map.parts().clone();
    // Behind the edge, which passes two metres to the right, and drawn a little apart from it.
    let corners = [(-3.0, -2.6), (3.0, -2.6), (3.0, -8.0), (-3.0, -8.0)];
    let ring = corners.map(|(x, y)| dvec2(x, y)).to_vec();
    let polygon = gump_geometry::Polygon::new(ring).unwrap();
    let area = gump_scene::Area::new(99, gump_scene::AreaKind::Driveway, polygon);
    parts.areas.push(area);
    let map = gump_scene::MapGraph::new(parts).unwrap();
    let ahead = |lane_map: &LaneMap| {
        let near = lane_map.edges_near(dvec2(0.0, 0.0), 10.0);
        let middles = near.map(|edge| edge.from.midpoint(edge.to).x);
        middles.filter(|x| x.abs() < 8.0).collect::<Vec<_>>()
    };
    let all = ahead(&LaneMap::of_edges(&map, &[dvec2(0.0, 0.0)], 50.0));
    let curbs = ahead(&LaneMap::of_curbs(&map, &[dvec2(0.0, 0.0)], 50.0));
    assert!(all.iter().any(|x| x.abs() < 2.0), "{all:?}");
    assert!(curbs.iter().all(|x| x.abs() > 3.0), "{curbs:?}");
    assert!(curbs.len() >= 3, "{curbs:?}");
}

/// Everything the ego sees last.
fn ego_sees(scenario: &Scenario) -> LocalContext {
    let slots = slots(scenario);
    let is_ego = |i: usize| matches!(slots[i].slot, Slot::Key(key) if key.is_ego());
    let last = seen(scenario).into_iter().rfind(|(i, _)| is_ego(*i));
    last.expect("the ego is in every frame").1
}

#[test]
fn an_unknown_limit_is_a_mark_and_no_zero() {
    let text = |speed: &str| {
        format!(
            "lane 1: -100,0 100,0 {speed}
             ego vehicle 0: 0,0 velocity 8,0
             agent vehicle 1: 20,0 velocity 5,0"
        )
    };
    let known = ego_sees(&fixture::scenario(&text("speed 13.4")).unwrap());
    let unknown = ego_sees(&fixture::scenario(&text("")).unwrap());
    // Without marks an unstated limit has the usual value.
    assert_eq!(known[..N_PLAIN], unknown[..N_PLAIN]);
    let marks = |seen: LocalContext| seen[N_PLAIN..N_PLAIN + N_PATHS].to_vec();
    assert_eq!(marks(known), [0.0; N_PATHS]);
    assert_eq!(marks(unknown), [1.0, 0.0, 0.0], "there is one path");
}

#[test]
fn what_the_source_has_no_word_for_is_marked() {
    let mut scenario = scenario();
    let rest = |scenario: &Scenario| ego_sees(scenario)[N_PLAIN + N_PATHS..].to_vec();
    assert_eq!(rest(&scenario), [0.0; N_MARKS - N_PATHS]);
    let mut parts = scenario.map.parts().clone();
    parts.unstated.lights = true;
    scenario.map = std::sync::Arc::new(gump_scene::MapGraph::new(parts).unwrap());
    // The first neighbour has the usual size, as in sources that could not measure it.
    for frame in &mut scenario.log {
        let agents = frame.agents().iter().map(|agent| {
            let mut agent = *agent;
            if agent.id.0 == 4 {
                [agent.length, agent.width, _] = agent.kind.usual_size();
            }
            agent
        });
        *frame = gump_scene::Frame::new(agents.collect(), frame.lights().to_vec());
    }
    let mut expected = [0.0; N_MARKS - N_PATHS];
    (expected[1], expected[3]) = (1.0, 1.0);
    assert_eq!(rest(&scenario), expected);
}
