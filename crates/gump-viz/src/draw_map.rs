//! The road: everything that stays still over a film.

use std::sync::Arc;

use gump_geometry::{DVec2, Polygon};
use gump_scene::{AreaKind, Lane, LaneKind, MapGraph, RoadLineKind, Route};
use tiny_skia::{Color, Pixmap};

use crate::Camera;
use crate::pen::{Pen, Shape};
use crate::theme::{Colours, Rgb};

/// The ground and the road on it, as far as the camera sees.
///
/// # Panics
/// If the camera has no pixels or too many for memory: callers check its size.
pub(crate) fn draw_backdrop(
    map: &MapGraph,
    route: Option<&Arc<Route>>,
    camera: Camera,
    colours: &Colours,
) -> Pixmap {
    let mut pixmap =
        Pixmap::new(camera.width_px, camera.height_px).expect("a camera has a size in pixels");
    let [r, g, b] = colours.ground;
    pixmap.fill(Color::from_rgba8(r, g, b, 0xFF));
    let mut pen = Pen::new(&mut pixmap, camera);
    draw_surfaces(&mut pen, map, colours);
    draw_route(&mut pen, map, route, colours);
    draw_areas(&mut pen, map, colours);
    draw_directions(&mut pen, map, colours);
    draw_lines(&mut pen, map, colours);
    draw_edges(&mut pen, map, colours);
    draw_stop_signs(&mut pen, map, colours);
    pixmap
}

/// Drivable polygons and lanes in one colour: where a format knows only one of them the road is
/// still whole.
fn draw_surfaces(pen: &mut Pen<'_>, map: &MapGraph, colours: &Colours) {
    let mut surfaces = Shape::new(&pen.camera);
    for polygon in map.drivable().iter().filter(|p| sees(&pen.camera, p)) {
        surfaces.ring(polygon.ring().iter().copied());
    }
    pen.fill(surfaces, colours.road, 1.0);
    for lane in map.lanes().iter().filter(|lane| is_for_cars(lane)) {
        draw_ribbon(pen, lane, colours.road);
    }
    for area in map.areas() {
        if matches!(
            area.kind,
            AreaKind::Intersection | AreaKind::Driveway | AreaKind::Carpark
        ) && sees(&pen.camera, &area.polygon)
        {
            let mut shape = Shape::new(&pen.camera);
            shape.ring(area.polygon.ring().iter().copied());
            pen.fill(shape, colours.road, 1.0);
        }
    }
}

fn draw_route(pen: &mut Pen<'_>, map: &MapGraph, route: Option<&Arc<Route>>, colours: &Colours) {
    let Some(route) = route else { return };
    let lanes: Vec<&Lane> = route.lanes.iter().filter_map(|&id| map.lane(id)).collect();
    for lane in &lanes {
        draw_ribbon(pen, lane, colours.route);
    }
    if lanes.is_empty() {
        let mut shape = Shape::new(&pen.camera);
        shape.line(route.path.points().iter().copied());
        let width = pen.px(3.0, 2.0);
        pen.stroke(shape, colours.route, 1.0, width);
    }
}

/// A lane as a band of its width.
fn draw_ribbon(pen: &mut Pen<'_>, lane: &Lane, colour: Rgb) {
    if pen.may_see_line(&lane.centerline, lane.width) {
        let mut shape = Shape::new(&pen.camera);
        shape.line(lane.centerline.points().iter().copied());
        let width = pen.px(lane.width, 1.0);
        pen.stroke(shape, colour, 1.0, width);
    }
}

fn draw_areas(pen: &mut Pen<'_>, map: &MapGraph, colours: &Colours) {
    let camera = pen.camera;
    let in_view = map.areas().iter().filter(|a| sees(&camera, &a.polygon));
    for area in in_view {
        let mut shape = Shape::new(&pen.camera);
        shape.ring(area.polygon.ring().iter().copied());
        match area.kind {
            AreaKind::Crosswalk => draw_zebra(pen, &area.polygon, shape, colours),
            AreaKind::SpeedBump => pen.fill(shape, colours.yellow_line, 0.5),
            AreaKind::StopLine | AreaKind::TurnStop => pen.fill(shape, colours.white_line, 0.7),
            AreaKind::Driveway | AreaKind::Intersection | AreaKind::Walkway | AreaKind::Carpark => {
            }
        }
    }
}

/// A crosswalk: bars across the way people walk, which is its longest side.
fn draw_zebra(pen: &mut Pen<'_>, polygon: &Polygon, shape: Shape, colours: &Colours) {
    let longest = polygon
        .edges()
        .map(|(a, b)| b - a)
        .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))
        .unwrap_or(DVec2::X);
    let origin = pen.camera.world_from_camera.position;
    let along = pen.camera.pixel(origin + longest) - pen.camera.pixel(origin);
    let period = pen.px(1.2, 3.0);
    pen.hatch(shape, colours.crosswalk, along, period);
}

/// Chevrons that point the way lanes run; short lanes and turning paths would only be clutter.
fn draw_directions(pen: &mut Pen<'_>, map: &MapGraph, colours: &Colours) {
    let scale = pen.camera.scale();
    let (spacing, size) = ((60.0 / scale).max(18.0), (3.5 / scale).max(0.7));
    let mut shape = Shape::new(&pen.camera);
    for lane in map.lanes() {
        let line = &lane.centerline;
        if lane.in_intersection || !is_for_cars(lane) || !pen.may_see_line(line, 0.0) {
            continue;
        }
        let n = (line.length() / spacing).floor() as usize;
        for i in 0..n {
            let pose = line.pose_at((i as f64 + 0.5) * line.length() / n as f64);
            let wing = |side: f64| pose * DVec2::new(-size, side * size);
            shape.line([wing(1.0), pose.position, wing(-1.0)]);
        }
    }
    let width = pen.px(0.18, 1.0);
    pen.stroke(shape, colours.direction, 1.0, width);
}

/// Painted lines, one stroke per colour and style.
fn draw_lines(pen: &mut Pen<'_>, map: &MapGraph, colours: &Colours) {
    for (is_yellow, is_broken) in [(false, true), (false, false), (true, true), (true, false)] {
        let mut shape = Shape::new(&pen.camera);
        for line in map.road_lines() {
            if style(line.kind) == (is_yellow, is_broken) && pen.may_see_line(&line.line, 0.0) {
                shape.line(line.line.points().iter().copied());
            }
        }
        let colour = if is_yellow {
            colours.yellow_line
        } else {
            colours.white_line
        };
        let width = pen.px(0.16, 0.9);
        if is_broken {
            let dash = [pen.px(2.0, 4.0), pen.px(3.0, 5.0)];
            pen.dash(shape, colour, width, dash);
        } else {
            pen.stroke(shape, colour, 1.0, width);
        }
    }
}

/// Whether a marking is yellow, and whether it is broken. A double line is drawn as one.
pub(crate) fn style(kind: RoadLineKind) -> (bool, bool) {
    match kind {
        RoadLineKind::BrokenSingleWhite | RoadLineKind::Unknown => (false, true),
        RoadLineKind::SolidSingleWhite | RoadLineKind::SolidDoubleWhite => (false, false),
        RoadLineKind::BrokenSingleYellow | RoadLineKind::BrokenDoubleYellow => (true, true),
        RoadLineKind::SolidSingleYellow
        | RoadLineKind::SolidDoubleYellow
        | RoadLineKind::PassingDoubleYellow => (true, false),
    }
}

fn draw_edges(pen: &mut Pen<'_>, map: &MapGraph, colours: &Colours) {
    let mut shape = Shape::new(&pen.camera);
    for edge in map.road_edges() {
        if pen.may_see_line(&edge.line, 0.0) {
            shape.line(edge.line.points().iter().copied());
        }
    }
    let width = pen.px(0.22, 1.1);
    pen.stroke(shape, colours.edge, 1.0, width);
}

fn draw_stop_signs(pen: &mut Pen<'_>, map: &MapGraph, colours: &Colours) {
    let radius = pen.px(0.9, 3.0);
    let metres = f64::from(radius) / pen.camera.scale();
    for sign in map.stop_signs() {
        let centre = sign.position.truncate();
        let octagon = |r: f64| {
            (0..8).map(move |i| {
                centre + DVec2::from_angle((f64::from(i) + 0.5) * std::f64::consts::FRAC_PI_4) * r
            })
        };
        let mut border = Shape::new(&pen.camera);
        border.ring(octagon(metres * 1.35));
        pen.fill(border, colours.wedge, 1.0);
        let mut sign = Shape::new(&pen.camera);
        sign.ring(octagon(metres));
        pen.fill(sign, colours.red, 1.0);
    }
}

pub(crate) fn is_for_cars(lane: &Lane) -> bool {
    lane.kind != LaneKind::BikeLane
}

fn sees(camera: &Camera, polygon: &Polygon) -> bool {
    let (min, max) = polygon.bounds();
    camera.may_see((min + max) / 2.0, min.distance(max) / 2.0)
}
