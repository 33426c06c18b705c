//! Properties of the road of every procedural scene.

use gump_geometry::{DVec2, angle_difference};
use gump_scene::{AreaKind, LaneKind, Scenario, Seed};
use gump_synthesis::{RoadFamily, SynthesisConfig, synthesize};

fn scenes() -> impl Iterator<Item = Scenario> {
    RoadFamily::ALL.into_iter().flat_map(|family| {
        let config = SynthesisConfig {
            family: Some(family),
            warmup_s: 1.0,
            ..SynthesisConfig::standard()
        };
        (0..6).map(move |k| synthesize(&config, Seed(31).fork(k)))
    })
}

#[test]
fn lanes_join_without_a_kink() {
    for scene in scenes() {
        for lane in scene.map.lanes() {
            let end = lane.centerline.pose_at(lane.centerline.length());
            for next in scene.map.successors(lane.id) {
                let start = next.centerline.pose_at(0.0);
                assert!(start.position.distance(end.position) < 0.05, "{}", scene.id);
                let turn = angle_difference(start.heading, end.heading).abs();
                assert!(turn < 0.06, "{}: {turn} rad at lane {}", scene.id, next.id);
                assert!(next.predecessors.contains(&lane.id));
            }
        }
    }
}

#[test]
fn lanes_can_be_driven() {
    for scene in scenes() {
        for lane in scene.map.lanes() {
            assert!((1.5..=5.5).contains(&lane.width));
            let line = lane.centerline.resample(2.0);
            for s in line.points().windows(3) {
                let turn = (s[1] - s[0]).angle_to(s[2] - s[1]).abs();
                let curvature = turn / s[0].distance(s[1]).max(1.0);
                assert!(curvature < 0.35, "{}: lane {}", scene.id, lane.id);
            }
        }
    }
}

#[test]
fn the_road_is_left_of_its_edges() {
    let (mut left, mut right, mut all) = (0.0, 0.0, 0.0);
    for scene in scenes() {
        for edge in scene.map.road_edges() {
            for (a, b) in edge.line.segments() {
                let aside = (b - a).normalize().perp() * 0.3;
                let at = |offset: DVec2| f64::from(scene.map.is_drivable(a.midpoint(b) + offset));
                all += 1.0;
                left += at(aside);
                right += at(-aside);
            }
        }
    }
    // Driveways of parking lots adjoin some edges on the right.
    assert!(
        left > 0.99 * all && right < 0.1 * all,
        "{left} and {right} of {all}"
    );
}

#[test]
fn every_lane_lies_on_a_drivable_surface() {
    let (mut on, mut all) = (0, 0);
    for scene in scenes() {
        for lane in scene.map.lanes() {
            for point in lane.centerline.points() {
                all += 1;
                on += usize::from(scene.map.is_drivable(*point));
            }
        }
    }
    assert!(on as f64 > 0.98 * f64::from(all), "{on} of {all}");
}

#[test]
fn roads_come_with_crosswalks_lights_signs_and_bicycle_lanes() {
    let scenes: Vec<Scenario> = scenes().collect();
    let with = |has: &dyn Fn(&Scenario) -> bool| scenes.iter().filter(|s| has(s)).count();
    let crosswalk = |s: &Scenario| s.map.areas().iter().any(|a| a.kind == AreaKind::Crosswalk);
    let bicycles = |s: &Scenario| s.map.lanes().iter().any(|l| l.kind == LaneKind::BikeLane);
    let neighbours = |s: &Scenario| s.map.lanes().iter().any(|l| !l.left_neighbors.is_empty());
    assert!(with(&crosswalk) >= 10 && with(&bicycles) >= 5 && with(&neighbours) >= 10);
    assert!(with(&|s| !s.map.stop_signs().is_empty()) >= 5);
    assert!(with(&|s| !s.present().now().lights().is_empty()) >= 6);
    for scene in &scenes {
        for light in scene.present().now().lights() {
            let lane = scene.map.lane(light.lane).unwrap();
            let stop = light.stop_point.unwrap();
            assert!(lane.in_intersection && lane.centerline.points()[0].distance(stop) < 0.05);
        }
    }
}
