//! Laws and snapshots of whole rasters; formulas of single layers are tested beside them.

use std::fmt::Write;
use std::sync::Arc;

use gump_geometry::{DVec2, DVec3, Polyline, Pose, dvec2};
use gump_scene::{
    AgentId, Area, AreaKind, LaneId, MapGraph, Route, Scenario, StopSign, fixture, light_indices,
};
use proptest::prelude::*;

use crate::{Layer, Raster, RasterSpec, rasterize};

/// A crossing that has something for every layer, placed anywhere in the world.
fn town(world_from_town: Pose) -> Scenario {
    let at = |points: &[(f64, f64)]| {
        points.iter().fold(String::new(), |mut text, &(x, y)| {
            let p = world_from_town * dvec2(x, y);
            write!(text, " {},{}", p.x, p.y).unwrap();
            text
        })
    };
    let toward = |x: f64, y: f64| {
        let v = world_from_town.rotate(dvec2(x, y));
        format!("{},{}", v.x, v.y)
    };
    let text = [
        format!(
            "lane 1:{} speed 12 width 4 next 2",
            at(&[(-9.3, -2.2), (0.4, -2.1)])
        ),
        format!(
            "lane 2:{} speed 30 width 3",
            at(&[(0.4, -2.1), (4.2, -0.3), (5.6, 7.4)])
        ),
        format!("lane 3:{} width 3", at(&[(8.4, 2.3), (-9.2, 2.6)])),
        format!("edge:{}", at(&[(-9.3, -5.1), (9.2, -5.2)])),
        format!("line:{}", at(&[(-9.3, 0.3), (3.2, 0.2)])),
        format!(
            "crosswalk:{}",
            at(&[(-3.1, -4.2), (-1.2, -4.2), (-1.2, 4.4), (-3.1, 4.4)])
        ),
        format!(
            "drivable:{}",
            at(&[(-9.4, -5.3), (7.8, -5.3), (7.8, 5.2), (-9.4, 5.2)])
        ),
        format!("light 1 red:{}", at(&[(-0.4, -2.1)])),
        format!("light 2 yellow:{}", at(&[(0.4, -2.1)])),
        format!("light 3 green:{}", at(&[(8.4, 2.3)])),
        "route 1,2".into(),
        format!(
            "ego vehicle 0:{} velocity {}",
            at(&[(-6.2, -2.2)]),
            toward(6.0, 0.0)
        ),
        format!(
            "agent bicycle 1:{} velocity {}",
            at(&[(4.3, 2.4)]),
            toward(-5.0, 0.2)
        ),
        format!(
            "agent pedestrian 2:{} velocity {}",
            at(&[(-2.2, 3.4)]),
            toward(0.0, -1.0)
        ),
        format!("agent other 3:{}", at(&[(6.6, -4.3)])),
    ];
    let mut scenario = fixture::scenario(&text.join("\n")).unwrap();
    scenario.map = with_more(&scenario.map, world_from_town);
    scenario
}

/// Adds what the text form of scenes has no words for: a speed bump, stop lines, an intersection.
fn with_more(map: &MapGraph, world_from_town: Pose) -> Arc<MapGraph> {
    let mut parts = map.parts().clone();
    let mut area = |kind, id, low: DVec2, high: DVec2| {
        let corners = [low, dvec2(high.x, low.y), high, dvec2(low.x, high.y)];
        let ring = corners.map(|corner| world_from_town * corner).to_vec();
        let polygon = gump_geometry::Polygon::new(ring).unwrap();
        parts.areas.push(Area::new(id, kind, polygon));
    };
    area(AreaKind::SpeedBump, 10, dvec2(-8.3, -4.2), dvec2(-7.4, 4.3));
    area(AreaKind::StopLine, 11, dvec2(5.1, 0.6), dvec2(5.9, 4.4));
    area(
        AreaKind::Intersection,
        12,
        dvec2(0.3, -4.2),
        dvec2(6.3, 4.4),
    );
    let sign = world_from_town * dvec2(-4.4, -6.0);
    let position = DVec3::new(sign.x, sign.y, 2.0);
    let lanes = vec![LaneId(1)];
    parts.stop_signs.push(StopSign {
        id: 13,
        position,
        lanes,
    });
    Arc::new(MapGraph::new(parts).unwrap())
}

/// One character per pixel: `.` for 0, `#` for 1, the first decimal otherwise; `a` to `j` are
/// the decimals of negative values, `@` is -1.
fn as_text(plane: &[f32], side: usize) -> String {
    let character = |&v: &f32| match v {
        0.0 => '.',
        v if v >= 1.0 => '#',
        v if v <= -1.0 => '@',
        v if v > 0.0 => char::from(b'0' + (v * 10.0) as u8),
        v => char::from(b'a' + (-v * 10.0) as u8),
    };
    let rows = plane
        .chunks(side)
        .map(|row| row.iter().map(character).collect());
    rows.collect::<Vec<String>>().join("\n")
}

fn all_layers(side_px: usize, metres_per_px: f64) -> RasterSpec {
    RasterSpec::new(side_px, metres_per_px, Layer::ALL.to_vec())
}

#[test]
fn every_layer_shows_its_part_of_a_crossing() {
    let scenario = town(Pose::IDENTITY);
    let raster = rasterize(&all_layers(20, 1.0), &scenario.present(), Pose::IDENTITY);
    let mut text = String::new();
    for layer in Layer::ALL {
        let plane = as_text(raster.get(layer).unwrap(), raster.side_px);
        write!(text, "{layer}\n{plane}\n\n").unwrap();
    }
    insta::assert_snapshot!(text);
}

#[test]
fn rows_run_backwards_and_columns_run_right() {
    let scenario = town(Pose::IDENTITY);
    // Centred on (5, 3) and facing +y: world +y is up and world -x is left.
    let facing_left = Pose::new(5.0, 3.0, std::f64::consts::FRAC_PI_2);
    let raster = rasterize(&all_layers(8, 0.5), &scenario.present(), facing_left);
    assert_eq!(raster.shape(), [Layer::ALL.len(), 8, 8]);
    assert_eq!(raster.pixel_of(dvec2(5.1, 3.1)), Some((3, 4)));
    assert_eq!(raster.pixel_of(dvec2(3.2, 4.9)), Some((0, 0)));
    assert_eq!(raster.pixel_of(dvec2(3.2, 5.1)), None);
    assert_eq!(raster.pixel_of(dvec2(f64::NAN, 3.0)), None);
    let corner = |layer| raster.get(layer).unwrap()[0];
    assert_eq!(corner(Layer::CoordinateX), 0.875);
    assert_eq!(corner(Layer::CoordinateY), 0.875);
}

#[test]
fn what_is_not_there_is_not_drawn() {
    let empty = fixture::scenario("ego vehicle 7: 5,5").unwrap();
    let raster = rasterize(&all_layers(16, 1.0), &empty.present(), Pose::IDENTITY);
    for layer in Layer::ALL {
        let drawn = raster.get(layer).unwrap().iter().any(|&v| v != 0.0);
        let expected = matches!(layer, Layer::Ego | Layer::CoordinateX | Layer::CoordinateY);
        assert_eq!(drawn, expected, "{layer}");
    }
    let nowhere = rasterize(
        &RasterSpec::paper(),
        &empty.present(),
        Pose::new(9e6, 0.0, 0.0),
    );
    assert!(nowhere.layer(0).iter().all(|&v| v == 0.0));
    assert!(RasterSpec::paper().layers.iter().all(|&l| l != Layer::Ego));
    assert_eq!(nowhere.get(Layer::Ego), None);
    let no_pixels = rasterize(&all_layers(0, 1.0), &empty.present(), Pose::IDENTITY);
    assert!(no_pixels.data.is_empty());
}

#[test]
fn a_route_off_the_map_is_drawn_as_its_path() {
    let mut scenario = town(Pose::IDENTITY);
    let path = Polyline::new(vec![dvec2(-9.0, 7.5), dvec2(9.0, 7.5)]).unwrap();
    let lanes = vec![LaneId(404)];
    scenario.route = Some(Arc::new(Route {
        lanes,
        roadblocks: Vec::new(),
        path,
    }));
    let spec = RasterSpec::new(20, 1.0, vec![Layer::Route]);
    let raster = rasterize(&spec, &scenario.present(), Pose::IDENTITY);
    assert_eq!(raster.data.iter().sum::<f32>(), 19.0);
    let (row, column) = raster.pixel_of(dvec2(0.0, 7.5)).unwrap();
    assert_eq!(raster.layer(0)[row * 20 + column], 1.0);
}

#[test]
fn painted_lights_carry_the_number_the_tokens_use() {
    let scenario = town(Pose::IDENTITY);
    let scene = scenario.present();
    let raster = rasterize(&all_layers(40, 0.5), &scene, Pose::new(1.0, 0.0, 0.3));
    for (index, light) in light_indices(&scene, dvec2(1.0, 0.0), 50.0) {
        let end = *scene
            .map
            .lane(light.lane)
            .unwrap()
            .centerline
            .points()
            .last()
            .unwrap();
        // Where a lane begins, several may begin; the end of each of these is its own.
        let painted = value(&raster, Layer::TrafficLightIndex, end);
        if light.lane != LaneId(1) {
            assert_eq!(painted, index as f32 / 64.0);
        }
    }
}

#[test]
fn a_lane_covers_what_is_within_half_its_width() {
    let bend: Vec<_> = (0..60)
        .map(|i| DVec2::from_angle(f64::from(i) * 0.025) * 12.0)
        .map(|p| format!("{},{}", p.x - 8.0, p.y - 8.0))
        .collect();
    let text = format!("lane 1: {} width 4\nego vehicle 0: 0,0", bend.join(" "));
    let scenario = fixture::scenario(&text).unwrap();
    let spec = RasterSpec::new(96, 0.25, vec![Layer::Roadmap]);
    let raster = rasterize(&spec, &scenario.present(), Pose::IDENTITY);
    let line = &scenario.map.lanes()[0].centerline;
    let mut n_inside = 0;
    for (i, &pixel) in raster.data.iter().enumerate() {
        let centre = |index: usize| 12.0 - (index as f64 + 0.5) * 0.25;
        let foot = line.project(dvec2(centre(i / 96), centre(i % 96)));
        if 0.3 < foot.arc_length && foot.arc_length < line.length() - 0.3 {
            n_inside += usize::from(foot.distance < 1.95);
            assert!(foot.distance > 1.95 || pixel == 1.0, "a hole at {foot:?}");
            assert!(foot.distance < 2.05 || pixel == 0.0, "a spill at {foot:?}");
        }
    }
    assert!(n_inside > 900, "the lane is on the canvas: {n_inside}");
}

/// The value of a layer under a world point, which must be on the image.
fn value(raster: &Raster, layer: Layer, point: DVec2) -> f32 {
    let (row, column) = raster.pixel_of(point).expect("a point on the image");
    raster.get(layer).unwrap()[row * raster.side_px + column]
}

proptest! {
    /// Map and agents meet on the same pixel, whatever the pose of the raster.
    #[test]
    fn map_and_agents_are_in_register(
        x in -3.0e6..4.0e6f64, y in -3.0e6..4.0e6f64, heading in -3.2..3.2f64,
        shift_x in -9.0..9.0f64, shift_y in -9.0..9.0f64, turn in -3.2..3.2f64,
        bend_x in -12.0..12.0f64, bend_y in -12.0..12.0f64,
    ) {
        let world = Pose::new(x, y, heading);
        let place = |x, y| { let p = world * dvec2(x, y); format!("{},{}", p.x, p.y) };
        let bend = place(bend_x, bend_y);
        let line = format!("{} {bend} {}", place(-30.0, 1.0), place(2.0, 40.0));
        let scenario = fixture::scenario(&format!(
            "lane 1: {line}
             line: {line}
             edge: {line}
             route 1
             ego vehicle 0: {}
             agent pedestrian 1: {bend} size 0.02,0.02
             agent other 2: {bend} size 0.02,0.02",
            place(0.0, 0.0),
        )).unwrap();
        let raster_pose = world * Pose::new(shift_x, shift_y, turn);
        // Wide enough for a bend in the far corner, seen across.
        let raster = rasterize(&all_layers(120, 0.5), &scenario.present(), raster_pose);

        let meeting = scenario.present().now().agent(AgentId(1)).unwrap().state.pose.position;
        for layer in [
            Layer::Agents, Layer::StaticAgents, Layer::AgentHistory, Layer::RoadLines,
            Layer::RoadEdge, Layer::BaselinePaths, Layer::Route, Layer::Roadmap,
        ] {
            prop_assert_eq!(value(&raster, layer, meeting), 1.0, "{}", layer);
        }
        prop_assert_eq!(raster.get(Layer::Agents).unwrap().iter().sum::<f32>(), 1.0);
        // The public transform leads to the same pixel, up to rounding at its border.
        let local = (dvec2(30.0, 30.0) - (raster.raster_from_world * meeting)) / 0.5;
        let (row, column) = raster.pixel_of(meeting).unwrap();
        prop_assert!((local - dvec2(row as f64 + 0.5, column as f64 + 0.5)).abs().max_element() < 0.5001);
    }

    /// Turning and moving the world together with the raster changes nothing but ties.
    #[test]
    fn a_moved_world_looks_the_same(
        x in -3.0e6..4.0e6f64, y in -3.0e6..4.0e6f64, heading in -3.2..3.2f64,
    ) {
        let spec = all_layers(48, 0.5);
        let view = Pose::new(0.3, -0.2, 0.1);
        let world = Pose::new(x, y, heading);
        let here = rasterize(&spec, &town(Pose::IDENTITY).present(), view);
        let there = rasterize(&spec, &town(world).present(), world * view);
        let differ = here.data.iter().zip(&there.data).filter(|(a, b)| (*a - *b).abs() > 1e-5);
        let n_differ = differ.count();
        prop_assert!(n_differ <= 8, "{} of {} pixels differ", n_differ, here.data.len());
    }

    #[test]
    fn values_stay_in_range(
        x in -20.0..20.0f64, y in -20.0..20.0f64, heading in -3.2..3.2f64, res in 0.1..4.0f64,
    ) {
        let scenario = town(Pose::IDENTITY);
        let pose = Pose::new(x, y, heading);
        let raster = rasterize(&all_layers(32, res), &scenario.present(), pose);
        for layer in Layer::ALL {
            let low = if layer.is_signed() { -1.0 } else { 0.0 };
            let plane = raster.get(layer).unwrap();
            prop_assert!(plane.iter().all(|v| (low..=1.0).contains(v)), "{}", layer);
        }
    }
}
