//! Encoding of the parts of a map.
//!
//! The writer and reader of each type are next to each other; their order defines the format.

use gump_geometry::dvec3;
use gump_scene::{
    Area, AreaKind, Lane, LaneId, LaneKind, MapParts, RoadEdge, RoadEdgeKind, RoadLine,
    RoadLineKind, Roadblock, RoadblockId, StopSign, Unstated,
};

use super::bytes::{Decoded, Decoder, Encoder};

const LANE_KINDS: [LaneKind; 4] = [
    LaneKind::Freeway,
    LaneKind::SurfaceStreet,
    LaneKind::BikeLane,
    LaneKind::Undefined,
];

const ROAD_LINE_KINDS: [RoadLineKind; 9] = [
    RoadLineKind::Unknown,
    RoadLineKind::BrokenSingleWhite,
    RoadLineKind::SolidSingleWhite,
    RoadLineKind::SolidDoubleWhite,
    RoadLineKind::BrokenSingleYellow,
    RoadLineKind::BrokenDoubleYellow,
    RoadLineKind::SolidSingleYellow,
    RoadLineKind::SolidDoubleYellow,
    RoadLineKind::PassingDoubleYellow,
];

const ROAD_EDGE_KINDS: [RoadEdgeKind; 3] = [
    RoadEdgeKind::Unknown,
    RoadEdgeKind::Boundary,
    RoadEdgeKind::Median,
];

const AREA_KINDS: [AreaKind; 8] = [
    AreaKind::Crosswalk,
    AreaKind::SpeedBump,
    AreaKind::Driveway,
    AreaKind::StopLine,
    AreaKind::TurnStop,
    AreaKind::Intersection,
    AreaKind::Walkway,
    AreaKind::Carpark,
];

/// Writes every part.
pub(super) fn write(to: &mut Encoder, parts: &MapParts) {
    let MapParts {
        lanes,
        roadblocks,
        road_lines,
        road_edges,
        areas,
        stop_signs,
        drivable,
        unstated,
    } = parts;
    each(to, lanes, write_lane);
    each(to, roadblocks, write_roadblock);
    each(to, road_lines, write_road_line);
    each(to, road_edges, write_road_edge);
    each(to, areas, write_area);
    each(to, stop_signs, write_stop_sign);
    each(to, drivable, Encoder::polygon);
    // The end of a record: where everything is stated there is nothing, as in older files.
    let Unstated { stop_signs, lights } = *unstated;
    if stop_signs || lights {
        to.byte(u8::from(stop_signs) | u8::from(lights) << 1);
    }
}

/// Reads what [`write`] wrote.
pub(super) fn read(from: &mut Decoder<'_>) -> Decoded<MapParts> {
    // No part takes fewer than a dozen bytes: an id, a kind, a count.
    const LEAST: usize = 12;
    Ok(MapParts {
        lanes: from.list(LEAST, read_lane)?,
        roadblocks: from.list(LEAST, read_roadblock)?,
        road_lines: from.list(LEAST, read_road_line)?,
        road_edges: from.list(LEAST, read_road_edge)?,
        areas: from.list(LEAST, read_area)?,
        stop_signs: from.list(LEAST, read_stop_sign)?,
        drivable: from.list(LEAST, Decoder::polygon)?,
        unstated: read_unstated(from)?,
    })
}

fn read_unstated(from: &mut Decoder<'_>) -> Decoded<Unstated> {
    let bits = match from.is_at_end() {
        true => 0,
        false => from.byte()?,
    };
    if bits > 3 {
        return Err(from.damage("marks of what is not stated, 0 to 3", &bits));
    }
    Ok(Unstated {
        stop_signs: bits & 1 > 0,
        lights: bits & 2 > 0,
    })
}

fn each<T>(to: &mut Encoder, all: &[T], write: fn(&mut Encoder, &T)) {
    to.count(all.len());
    all.iter().for_each(|one| write(to, one));
}

fn write_lane(to: &mut Encoder, lane: &Lane) {
    let Lane {
        id,
        kind,
        centerline,
        elevation,
        width,
        speed_limit,
        in_intersection,
        outline,
        roadblock,
        has_lights,
        predecessors,
        successors,
        left_neighbors,
        right_neighbors,
    } = lane;
    to.id(id.0);
    to.variant(&LANE_KINDS, kind);
    to.points(centerline.points());
    to.numbers(elevation.iter().copied());
    to.number(*width);
    to.option(*speed_limit, Encoder::number);
    to.flag(*in_intersection);
    to.option(outline.as_ref(), Encoder::polygon);
    to.option(*roadblock, |to, id| to.id(id.0));
    to.option(*has_lights, Encoder::flag);
    for links in [predecessors, successors, left_neighbors, right_neighbors] {
        to.ids(links.iter().map(|id| id.0));
    }
}

fn read_lane(from: &mut Decoder<'_>) -> Decoded<Lane> {
    let id = LaneId(from.id()?);
    let kind = from.variant(&LANE_KINDS)?;
    let centerline = from.polyline()?;
    Ok(Lane {
        id,
        kind,
        elevation: from.numbers(centerline.points().len())?,
        centerline,
        width: from.number()?,
        speed_limit: from.option(Decoder::number)?,
        in_intersection: from.flag()?,
        outline: from.option(Decoder::polygon)?,
        roadblock: from.option(|from| Ok(RoadblockId(from.id()?)))?,
        has_lights: from.option(Decoder::flag)?,
        predecessors: from.ids(LaneId)?,
        successors: from.ids(LaneId)?,
        left_neighbors: from.ids(LaneId)?,
        right_neighbors: from.ids(LaneId)?,
    })
}

fn write_roadblock(to: &mut Encoder, block: &Roadblock) {
    to.id(block.id.0);
    to.polygon(&block.outline);
    to.flag(block.in_intersection);
    to.ids(block.predecessors.iter().map(|id| id.0));
    to.ids(block.successors.iter().map(|id| id.0));
}

fn read_roadblock(from: &mut Decoder<'_>) -> Decoded<Roadblock> {
    Ok(Roadblock {
        id: RoadblockId(from.id()?),
        outline: from.polygon()?,
        in_intersection: from.flag()?,
        predecessors: from.ids(RoadblockId)?,
        successors: from.ids(RoadblockId)?,
    })
}

fn write_road_line(to: &mut Encoder, line: &RoadLine) {
    to.id(line.id);
    to.variant(&ROAD_LINE_KINDS, &line.kind);
    to.points(line.line.points());
    to.numbers(line.elevation.iter().copied());
}

fn read_road_line(from: &mut Decoder<'_>) -> Decoded<RoadLine> {
    let (id, kind) = (from.id()?, from.variant(&ROAD_LINE_KINDS)?);
    let line = from.polyline()?;
    Ok(RoadLine {
        id,
        kind,
        elevation: from.numbers(line.points().len())?,
        line,
    })
}

fn write_road_edge(to: &mut Encoder, edge: &RoadEdge) {
    to.id(edge.id);
    to.variant(&ROAD_EDGE_KINDS, &edge.kind);
    to.points(edge.line.points());
    to.numbers(edge.elevation.iter().copied());
}

fn read_road_edge(from: &mut Decoder<'_>) -> Decoded<RoadEdge> {
    let (id, kind) = (from.id()?, from.variant(&ROAD_EDGE_KINDS)?);
    let line = from.polyline()?;
    Ok(RoadEdge {
        id,
        kind,
        elevation: from.numbers(line.points().len())?,
        line,
    })
}

fn write_area(to: &mut Encoder, area: &Area) {
    to.id(area.id);
    to.variant(&AREA_KINDS, &area.kind);
    to.polygon(&area.polygon);
    to.numbers(area.elevation.iter().copied());
    to.ids(area.lanes.iter().map(|id| id.0));
}

fn read_area(from: &mut Decoder<'_>) -> Decoded<Area> {
    let (id, kind) = (from.id()?, from.variant(&AREA_KINDS)?);
    let polygon = from.polygon()?;
    Ok(Area {
        id,
        kind,
        elevation: from.numbers(polygon.ring().len())?,
        polygon,
        lanes: from.ids(LaneId)?,
    })
}

fn write_stop_sign(to: &mut Encoder, sign: &StopSign) {
    to.id(sign.id);
    sign.position
        .to_array()
        .into_iter()
        .for_each(|value| to.number(value));
    to.ids(sign.lanes.iter().map(|id| id.0));
}

fn read_stop_sign(from: &mut Decoder<'_>) -> Decoded<StopSign> {
    Ok(StopSign {
        id: from.id()?,
        position: dvec3(from.number()?, from.number()?, from.number()?),
        lanes: from.ids(LaneId)?,
    })
}
