//! SUMO recordings: one made for these tests, and real city networks where they are at hand.

#[path = "../../../tests/shared.rs"]
mod shared_data;

use std::path::{Path, PathBuf};

use gump_data::sumo::{CutOptions, EdgeFunction, Network, Roads, open_recording};
use gump_data::{DataError, ReadOptions, open};
use gump_scene::{AgentKind, AreaKind, LightState, Scenario};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/sumo")
        .join(name)
}

/// Real networks and recordings; `None`, and a note, where they are not at hand.
fn shared(name: &str) -> Option<PathBuf> {
    shared_data::shared(&format!("data/sumo_epl/{name}"))
}

fn scenarios(path: &Path) -> Vec<Scenario> {
    let cut = CutOptions {
        egos: 2,
        ..CutOptions::standard()
    };
    let scenes = open_recording(path, cut, ReadOptions::ALL).expect("opens");
    scenes
        .map(|record| record.expect("sound").scenario)
        .collect()
}

#[test]
fn a_recording_beside_its_network_is_opened_by_content() {
    let reader = open(&fixture("small.fcd.xml.gz")).unwrap();
    assert!(reader.format().starts_with("SUMO"));
    let records: Vec<_> = reader.map(Result::unwrap).collect();
    assert!(!records.is_empty());
    for record in &records {
        let scenario = &record.scenario;
        assert_eq!(
            (scenario.log.len(), scenario.now, scenario.dt),
            (91, 10, 0.1)
        );
        assert!(scenario.route.is_some(), "{}", scenario.id);
        assert!(!scenario.present().now().lights().is_empty());
    }
}

#[test]
fn where_a_network_ends_no_edge_lies_across_the_road() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ends.net.xml");
    let text = r#"<net>
        <edge id="e" from="a" to="b">
            <lane id="e_0" index="0" speed="13" length="50" shape="0,0 50,0"/>
            <lane id="e_1" index="1" speed="13" length="50" shape="0,3.2 50,3.2"/>
        </edge>
        <junction id="a" type="dead_end" x="0" y="0" shape="0,4.8 0,1.6 0,-1.6"/>
        <junction id="b" type="dead_end" x="50" y="0" shape="50,-1.6 50,4.8 49.9,1.6"/>
    </net>"#;
    std::fs::write(&path, text).unwrap();
    let roads = Roads::new(&Network::read(&path).unwrap());
    let edges = &roads.parts().road_edges;
    let length: f64 = edges.iter().map(|edge| edge.line.length()).sum();
    assert_eq!((edges.len(), length), (2, 100.0), "only along the sides");
}

#[test]
fn all_classes_have_the_sizes_of_their_types() {
    let scenarios = scenarios(&fixture("small.fcd.xml.gz"));
    let agents = || {
        scenarios
            .iter()
            .flat_map(|s| s.present().now().agents().to_vec())
    };
    for (kind, length) in [
        (AgentKind::Vehicle, 4.6),
        (AgentKind::Bicycle, 1.8),
        (AgentKind::Pedestrian, 0.5),
    ] {
        let of_kind: Vec<_> = agents().filter(|agent| agent.kind == kind).collect();
        assert!(!of_kind.is_empty(), "{}", kind.name());
        assert!(
            of_kind
                .iter()
                .any(|agent| (agent.length - length).abs() < 1e-9),
            "{}",
            kind.name()
        );
    }
}

#[test]
fn boxes_are_centred_and_face_where_they_go() {
    for scenario in scenarios(&fixture("small.fcd.xml.gz")) {
        for agent in scenario.present().now().agents() {
            let velocity = agent.state.velocity;
            if agent.kind == AgentKind::Vehicle && velocity.length() > 3.0 {
                let off = velocity.normalize().dot(agent.state.pose.direction());
                assert!(off > 0.85, "agent {} of {}: {off}", agent.id, scenario.id);
                let lanes = scenario.map.lanes_near(agent.state.pose.position, 2.5);
                assert!(lanes.count() > 0, "agent {} of {}", agent.id, scenario.id);
            }
        }
    }
}

#[test]
fn lights_are_on_ways_through_junctions_and_change() {
    let mut seen = Vec::new();
    for scenario in scenarios(&fixture("small.fcd.xml.gz")) {
        for frame in &scenario.log {
            for light in frame.lights() {
                let lane = scenario.map.lane(light.lane).unwrap();
                assert!(lane.centerline.length() < 50.0, "a way, not a road");
                let start = lane.centerline.points()[0];
                assert!(light.stop_point.unwrap().distance(start) < 3.0);
                seen.push(light.state);
            }
        }
    }
    assert!(seen.contains(&LightState::Red) && seen.contains(&LightState::Green));
    assert!(!seen.contains(&LightState::Unknown));
}

#[test]
fn a_network_becomes_lanes_borders_and_crossings() {
    let network = Network::read(&fixture("small.net.xml.gz")).unwrap();
    let roads = Roads::new(&network);
    let parts = roads.parts();
    let drives = network
        .edges
        .iter()
        .filter(|e| e.function == EdgeFunction::Normal);
    let drives = drives
        .flat_map(|e| &e.lanes)
        .filter(|l| l.access.motor)
        .count();
    let normal = parts.lanes.iter().filter(|l| !l.in_intersection).count();
    assert!(drives > 0 && normal >= drives);
    let linked = parts.lanes.iter().filter(|l| l.in_intersection);
    for lane in linked {
        assert!(
            !lane.successors.is_empty() && !lane.predecessors.is_empty(),
            "{}",
            lane.id
        );
        assert!(lane.speed_limit.unwrap() > 10.0, "the law, not the curve");
    }
    assert!(
        parts
            .areas
            .iter()
            .any(|area| area.kind == AreaKind::Crosswalk)
    );
    assert!(!parts.road_edges.is_empty() && !parts.road_lines.is_empty());
    // The road lies to the left of its edges.
    let map = gump_scene::MapGraph::new(parts.clone()).unwrap();
    let mut sides = [0, 0];
    for edge in map.road_edges() {
        let pose = edge.line.pose_at(edge.line.length() / 2.0);
        for (side, sign) in sides.iter_mut().zip([1.0, -1.0]) {
            let point = pose.position + pose.direction().perp() * sign;
            *side += usize::from(map.is_drivable(point));
        }
    }
    assert!(sides[0] > 20 * sides[1].max(1), "{sides:?}");
}

#[test]
fn the_same_seed_cuts_the_same_scenes() {
    let ids = |seed| {
        let cut = CutOptions {
            seed: gump_scene::Seed(seed),
            ..CutOptions::standard()
        };
        let scenes = open_recording(&fixture("small.fcd.xml.gz"), cut, ReadOptions::STATED);
        scenes
            .unwrap()
            .map(|r| r.unwrap().scenario.id)
            .collect::<Vec<_>>()
    };
    assert_eq!(ids(1), ids(1));
    assert!((2..9).any(|seed| ids(seed) != ids(1)));
}

#[test]
fn damage_is_named_with_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let check = |network: &str, cars: &str| {
        std::fs::write(folder.path().join("a.net.xml"), network).unwrap();
        let path = folder.path().join("a.fcd.xml");
        std::fs::write(&path, cars).unwrap();
        let opened = open(&path);
        opened
            .and_then(|reader| reader.collect::<Result<Vec<_>, _>>())
            .unwrap_err()
            .to_string()
    };
    let network = "<net><edge id=\"e\" from=\"a\" to=\"b\">\
        <lane id=\"e_0\" index=\"0\" speed=\"13\" length=\"99\" shape=\"0,0 99,0\"/></edge></net>";
    let car = |attributes: &str| {
        format!("<fcd-export><timestep time=\"0\"><vehicle {attributes}/></timestep></fcd-export>")
    };
    let error = check(network, &car("id=\"v\" x=\"nan\" y=\"0\" angle=\"90\""));
    assert!(
        error.contains("expected a number in \"x\", found nan"),
        "{error}"
    );
    let error = check(network, &car("id=\"v\" x=\"1e300\" y=\"0\" angle=\"90\""));
    assert!(error.contains("expected coordinates within"), "{error}");
    let error = check(network, "<fcd-export><timestep time=\"0\"><vehicle id=\"v");
    assert!(error.contains("a.fcd.xml"), "{error}");
    let error = check(
        &network.replace(" 99,0", ""),
        &car("id=\"v\" x=\"1\" y=\"0\" angle=\"90\""),
    );
    assert!(
        error.contains("expected at least 2 points, found 1"),
        "{error}"
    );
    std::fs::remove_file(folder.path().join("a.net.xml")).unwrap();
    let error = open(&folder.path().join("a.fcd.xml")).err().unwrap();
    assert!(matches!(error, DataError::NoNetwork { .. }), "{error}");
}

#[test]
fn real_city_networks_are_understood() {
    for (name, least) in [
        ("bologna_acosta/acosta_buslanes.net.xml.gz", 500),
        ("bologna_pasubio/pasubio_buslanes.net.xml.gz", 400),
        ("tavf_hamburg/network.net.xml.gz", 2000),
        ("berlin_doerpfeldstr/net.net.xml.gz", 1500),
    ] {
        let Some(path) = shared(name) else { return };
        let roads = Roads::new(&Network::read(&path).unwrap());
        assert!(
            roads.parts().lanes.len() >= least,
            "{name}: {}",
            roads.parts().lanes.len()
        );
        gump_scene::MapGraph::new(roads.parts().clone()).unwrap();
    }
}

#[test]
fn a_sample_with_several_recordings_finds_the_right_network() {
    let Some(path) = shared("samples/grid_mixed_270_300.fcd.xml.gz") else {
        return;
    };
    assert_eq!(
        open(&path)
            .unwrap()
            .collect::<Result<Vec<_>, _>>()
            .unwrap()
            .len(),
        12
    );
    // The other recording's network is not there.
    let other = shared("samples/acosta_660_690.fcd.xml.gz").unwrap();
    let error = open(&other).unwrap().next().unwrap().unwrap_err();
    assert!(matches!(error, DataError::NoNetwork { .. }), "{error}");
}
