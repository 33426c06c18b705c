//! Painted lines, road edges and areas.

use gump_scene::{AreaKind, MapGraph};

use super::Plane;
use super::lanes::LaneSurfaces;

/// Value of crosswalks, stop lines and bumps on the road channel; from the paper's code.
const MARKED: f32 = 0.5;

pub(crate) fn draw_road_lines(plane: &mut Plane<'_>, map: &MapGraph) {
    for line in map.road_lines() {
        plane.line(&line.line, 1.0);
    }
}

pub(crate) fn draw_road_edges(plane: &mut Plane<'_>, map: &MapGraph) {
    for edge in map.road_edges() {
        plane.line(&edge.line, 1.0);
    }
}

pub(crate) fn draw_areas(plane: &mut Plane<'_>, map: &MapGraph, kind: AreaKind, value: f32) {
    for area in map.areas().iter().filter(|area| area.kind == kind) {
        plane.polygon(&area.polygon, value);
    }
}

pub(crate) fn draw_drivable(plane: &mut Plane<'_>, map: &MapGraph) {
    for polygon in map.drivable() {
        plane.polygon(polygon, 1.0);
    }
}

/// Stop lines as areas, where a format has them, otherwise as lines across the lanes that stop
/// signs apply to: the sign itself is beside the road.
pub(crate) fn draw_stop_lines(plane: &mut Plane<'_>, map: &MapGraph) {
    draw_areas(plane, map, AreaKind::StopLine, 1.0);
    for sign in map.stop_signs() {
        for lane in sign.lanes.iter().filter_map(|&id| map.lane(id)) {
            let line = &lane.centerline;
            let at = line.pose_at(line.project(sign.position.truncate()).arc_length);
            let side = at.direction().perp() * lane.width / 2.0;
            plane.stroke([at.position + side, at.position - side], 1.0);
        }
    }
}

pub(crate) fn draw_roadmap(plane: &mut Plane<'_>, map: &MapGraph, surfaces: &LaneSurfaces) {
    surfaces.draw(plane, |_| 1.0);
    draw_areas(plane, map, AreaKind::Intersection, 1.0);
    draw_areas(plane, map, AreaKind::StopLine, MARKED);
    draw_areas(plane, map, AreaKind::Crosswalk, MARKED);
    draw_areas(plane, map, AreaKind::SpeedBump, MARKED);
}
