//! Conversion of a city's GeoPackage to a [`MapGraph`]: lanes, connectors, roadblocks, areas,
//! surfaces.
//!
//! Lane connectors are lanes with `in_intersection`, roadblock connectors roadblocks with it. The
//! widths of lanes are their areas divided by their lengths; heights are 0, because the format has
//! none. `maps` finds map files. Start with [`read_map`].

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use gump_geometry::{DVec2, Polygon, Polyline, segments_intersect};
use gump_scene::{
    Area, AreaKind, Lane, LaneId, LaneKind, MapGraph, MapParts, RoadLine, RoadLineKind, Roadblock,
    RoadblockId, Unstated,
};
use rusqlite::Row;

use super::geopackage::{Feature, GeoPackage};
use crate::{DataError, Problem, ReadReport};

/// The map of a city.
#[derive(Clone, Debug)]
pub struct CityMap {
    /// The map, in the plane of the projection.
    pub graph: Arc<MapGraph>,
    /// EPSG code of the projection.
    pub epsg: i64,
    /// Dropped and inferred items.
    pub report: ReadReport,
}

/// Layers of surfaces a vehicle may be on, nuPlan's drivable area; only the first two are in every
/// map.
const DRIVABLE: [&str; 4] = [
    "road_segments",
    "intersections",
    "generic_drivable_areas",
    "carpark_areas",
];

/// Value of `stop_polygon_type_fid` for places to wait before a turn.
const TURN_STOP: i64 = 3;

/// Reads a map.
///
/// A damaged feature is dropped, counted and listed in the report; links to it are dropped.
///
/// # Errors
/// [`DataError::Missing`], [`DataError::Io`], [`DataError::Sqlite`]; [`DataError::Table`] for a
/// file that is not a map, a missing layer or column, an unknown projection, and parts that are not
/// a valid map.
pub fn read_map(path: &Path) -> Result<CityMap, DataError> {
    let package = GeoPackage::open(path)?;
    let mut report = ReadReport::default();
    let report_mut = &mut report;
    let baselines = baselines(&package, report_mut)?;
    let mut lanes = lanes(&package, &baselines, report_mut)?;
    let (connectors, stop_line_ids) = connectors(&package, &baselines, report_mut)?;
    lanes.extend(connectors);
    link(&mut lanes);
    let mut parts = MapParts {
        roadblocks: roadblocks(&package, report_mut)?,
        areas: areas(&package, report_mut)?,
        drivable: drivable(&package, report_mut)?,
        road_lines: boundaries(&package, report_mut)?,
        lanes,
        unstated: Unstated {
            stop_signs: true,
            lights: false,
        },
        ..MapParts::default()
    };
    attach_stop_lines(&mut parts, &stop_line_ids);
    let graph = MapGraph::new(parts).map_err(|error| DataError::Table {
        expected: "layers that make a map".into(),
        found: Problem::Map(error).to_string(),
        path: path.into(),
    })?;
    Ok(CityMap {
        graph: Arc::new(graph),
        epsg: package.epsg(),
        report,
    })
}

/// Centre lines by lane and by connector; ids of both share one space.
fn baselines(
    package: &GeoPackage,
    report: &mut ReadReport,
) -> Result<BTreeMap<i64, Polyline>, DataError> {
    let columns = ["lane_fid", "lane_connector_fid"];
    let read = |row: &Row<'_>| Ok([row.get::<_, Option<i64>>(0)?, row.get(1)?]);
    let mut lines = BTreeMap::new();
    for feature in package.layer("baseline_paths", &columns, report, read)? {
        let line = feature
            .line()
            .and_then(|points| Polyline::new(points.to_vec()));
        let owner = feature.columns.into_iter().flatten().next();
        match owner.zip(line) {
            // The first counts, as in the devkit, where there are several.
            Some((owner, line)) => {
                lines.entry(owner).or_insert(line);
            }
            None => report.drop("centre line of no lane or without points", 1),
        }
    }
    Ok(lines)
}

struct LaneColumns {
    group: Option<i64>,
    index: Option<i64>,
    speed_limit: Option<f64>,
}

fn lanes(
    package: &GeoPackage,
    baselines: &BTreeMap<i64, Polyline>,
    report: &mut ReadReport,
) -> Result<Vec<Lane>, DataError> {
    let columns = ["lane_group_fid", "lane_index", "speed_limit_mps"];
    let read = |row: &Row<'_>| {
        Ok(LaneColumns {
            group: row.get(0)?,
            index: row.get(1)?,
            speed_limit: row.get(2)?,
        })
    };
    let features = package.layer("lanes_polygons", &columns, report, read)?;
    let at: BTreeMap<_, _> = features
        .iter()
        .filter_map(|f| Some(((f.columns.group?, f.columns.index?), LaneId(f.fid))))
        .collect();
    let beside = |columns: &LaneColumns, step: i64| {
        let indices = std::iter::successors(columns.index, |index| index.checked_add(step)).skip(1);
        let neighbors = indices.map_while(|index| at.get(&(columns.group?, index)).copied());
        neighbors.collect::<Vec<_>>()
    };
    let mut lanes = Vec::with_capacity(features.len());
    for feature in &features {
        let Some(lane) = lane(feature, feature.fid, baselines, report) else {
            continue;
        };
        let columns = &feature.columns;
        lanes.push(Lane {
            speed_limit: limit(columns.speed_limit),
            roadblock: columns.group.map(RoadblockId),
            has_lights: Some(false),
            left_neighbors: beside(columns, -1),
            right_neighbors: beside(columns, 1),
            ..lane
        });
    }
    Ok(lanes)
}

struct ConnectorColumns {
    exit_lane: Option<i64>,
    entry_lane: Option<i64>,
    group: Option<i64>,
    stop_lines: Option<String>,
    speed_limit: Option<f64>,
}

/// The stop lines that connectors list.
type StopLines = BTreeMap<LaneId, Vec<i64>>;

/// The connectors, and the stop lines each of them lists.
fn connectors(
    package: &GeoPackage,
    baselines: &BTreeMap<i64, Polyline>,
    report: &mut ReadReport,
) -> Result<(Vec<Lane>, StopLines), DataError> {
    let read = |row: &Row<'_>| row.get::<_, Option<i64>>(0);
    let layer = "gen_lane_connectors_scaled_width_polygons";
    let outlines = package.layer(layer, &["lane_connector_fid"], report, read)?;
    let outlines: BTreeMap<i64, &Feature<_>> = outlines
        .iter()
        .filter_map(|feature| Some((feature.columns?, feature)))
        .collect();
    let columns = [
        "exit_lane_fid",
        "entry_lane_fid",
        "lane_group_connector_fid",
        "traffic_light_stop_line_fids",
        "speed_limit_mps",
    ];
    let read = |row: &Row<'_>| {
        Ok(ConnectorColumns {
            exit_lane: row.get(0)?,
            entry_lane: row.get(1)?,
            group: row.get(2)?,
            stop_lines: row.get(3)?,
            speed_limit: row.get(4)?,
        })
    };
    let (mut lanes, mut stop_lines) = (Vec::new(), BTreeMap::new());
    for feature in package.layer("lane_connectors", &columns, report, read)? {
        let Some(outline) = outlines.get(&feature.fid) else {
            report.drop_damaged("lane connector without a polygon", || {
                format!("lane connector {}", feature.fid)
            });
            continue;
        };
        let Some(lane) = lane(outline, feature.fid, baselines, report) else {
            continue;
        };
        let columns = feature.columns;
        let listed = numbers(columns.stop_lines.as_deref().unwrap_or_default());
        lanes.push(Lane {
            speed_limit: limit(columns.speed_limit),
            in_intersection: true,
            roadblock: columns.group.map(RoadblockId),
            has_lights: Some(!listed.is_empty()),
            predecessors: columns.exit_lane.map(LaneId).into_iter().collect(),
            successors: columns.entry_lane.map(LaneId).into_iter().collect(),
            ..lane
        });
        stop_lines.insert(LaneId(feature.fid), listed);
    }
    Ok((lanes, stop_lines))
}

/// Builds the part common to lanes and connectors; `None` without a centre line or an outline.
fn lane<T>(
    outline: &Feature<T>,
    id: i64,
    baselines: &BTreeMap<i64, Polyline>,
    report: &mut ReadReport,
) -> Option<Lane> {
    let Some((polygon, centerline)) = outline.polygon().zip(baselines.get(&id)) else {
        let detail = || format!("lane or lane connector {id}");
        report.drop_damaged("lane without a centre line or an outline", detail);
        return None;
    };
    let elevation = vec![0.0; centerline.points().len()];
    let lane = Lane::new(LaneId(id), centerline.clone(), elevation);
    report.infer("width of a lane from its area", 1);
    let width = polygon.signed_area().abs() / centerline.length();
    Some(Lane {
        kind: LaneKind::SurfaceStreet,
        width: if width.is_finite() { width } else { lane.width },
        outline: Some(polygon.clone()),
        ..lane
    })
}

/// Comma-separated ids.
fn numbers(text: &str) -> Vec<i64> {
    let parts = text.split(',').map(str::trim);
    parts.filter_map(|part| part.parse().ok()).collect()
}

fn limit(speed_limit: Option<f64>) -> Option<f64> {
    speed_limit.filter(|&limit| limit > 0.0 && limit.is_finite())
}

/// Links lanes to the connectors that name them, in the order of the connectors.
fn link(lanes: &mut [Lane]) {
    let (mut leaving, mut entering) = (BTreeMap::new(), BTreeMap::new());
    for connector in lanes.iter().filter(|lane| lane.in_intersection) {
        for (ends, links) in [
            (&connector.predecessors, &mut leaving),
            (&connector.successors, &mut entering),
        ] {
            for &end in ends {
                links.entry(end).or_insert_with(Vec::new).push(connector.id);
            }
        }
    }
    for lane in lanes.iter_mut().filter(|lane| !lane.in_intersection) {
        lane.successors = leaving.remove(&lane.id).unwrap_or_default();
        lane.predecessors = entering.remove(&lane.id).unwrap_or_default();
    }
}

fn roadblocks(package: &GeoPackage, report: &mut ReadReport) -> Result<Vec<Roadblock>, DataError> {
    let groups = package.layer("lane_groups_polygons", &[], report, |_| Ok(()))?;
    let columns = ["from_lane_group_fid", "to_lane_group_fid"];
    let read = |row: &Row<'_>| Ok([row.get::<_, Option<i64>>(0)?, row.get(1)?]);
    let connectors = package.layer("lane_group_connectors", &columns, report, read)?;
    let ids = |id: Option<i64>| id.map(RoadblockId).into_iter().collect::<Vec<_>>();
    let of_group = |group: i64, side: usize| {
        let linked = connectors
            .iter()
            .filter(move |c| c.columns[side] == Some(group));
        linked.map(|c| RoadblockId(c.fid)).collect::<Vec<_>>()
    };
    let mut blocks = Vec::new();
    for group in &groups {
        blocks.extend(group.polygon().map(|outline| Roadblock {
            id: RoadblockId(group.fid),
            outline: outline.clone(),
            in_intersection: false,
            predecessors: of_group(group.fid, 1),
            successors: of_group(group.fid, 0),
        }));
    }
    for connector in &connectors {
        let [from, to] = connector.columns;
        blocks.extend(connector.polygon().map(|outline| Roadblock {
            id: RoadblockId(connector.fid),
            outline: outline.clone(),
            in_intersection: true,
            predecessors: ids(from),
            successors: ids(to),
        }));
    }
    let without = groups.len() + connectors.len() - blocks.len();
    report.drop("roadblock without an outline", without);
    Ok(blocks)
}

fn areas(package: &GeoPackage, report: &mut ReadReport) -> Result<Vec<Area>, DataError> {
    let mut areas = Vec::new();
    let read = |row: &Row<'_>| row.get::<_, Option<i64>>(0);
    let stops = package.layer("stop_polygons", &["stop_polygon_type_fid"], report, read)?;
    for stop in &stops {
        let kind = match stop.columns {
            Some(TURN_STOP) => AreaKind::TurnStop,
            _ => AreaKind::StopLine,
        };
        let polygons = stop.polygons().iter().cloned();
        areas.extend(polygons.map(|polygon| Area::new(stop.fid, kind, polygon)));
    }
    for (layer, kind) in [
        ("intersections", AreaKind::Intersection),
        ("crosswalks", AreaKind::Crosswalk),
        ("walkways", AreaKind::Walkway),
        ("carpark_areas", AreaKind::Carpark),
    ] {
        if kind != AreaKind::Intersection && !package.has(layer)? {
            continue;
        }
        for feature in package.layer(layer, &[], report, |_| Ok(()))? {
            let polygons = feature.polygons().iter().cloned();
            areas.extend(polygons.map(|polygon| Area::new(feature.fid, kind, polygon)));
        }
    }
    Ok(areas)
}

fn drivable(package: &GeoPackage, report: &mut ReadReport) -> Result<Vec<Polygon>, DataError> {
    let mut surfaces = Vec::new();
    for (i, layer) in DRIVABLE.into_iter().enumerate() {
        if i < 2 || package.has(layer)? {
            for feature in package.layer(layer, &[], report, |_| Ok(()))? {
                surfaces.extend(feature.polygons().iter().cloned());
            }
        }
    }
    Ok(surfaces)
}

/// The borders of lanes, as lines of no stated paint.
fn boundaries(package: &GeoPackage, report: &mut ReadReport) -> Result<Vec<RoadLine>, DataError> {
    if !package.has("boundaries")? {
        return Ok(Vec::new());
    }
    let features = package.layer("boundaries", &[], report, |_| Ok(()))?;
    let lines = features.iter().filter_map(|feature| {
        let line = Polyline::new(feature.line()?.to_vec())?;
        Some(RoadLine {
            id: feature.fid,
            kind: RoadLineKind::Unknown,
            elevation: vec![0.0; line.points().len()],
            line,
        })
    });
    Ok(lines.collect())
}

/// Tells every stop polygon which connectors wait at it: of those a connector lists, the ones its
/// centre line crosses, and if it crosses none, the one nearest to its start.
fn attach_stop_lines(parts: &mut MapParts, listed: &StopLines) {
    let is_stop = |area: &Area| matches!(area.kind, AreaKind::StopLine | AreaKind::TurnStop);
    let stops: Vec<usize> = (0..parts.areas.len())
        .filter(|&i| is_stop(&parts.areas[i]))
        .collect();
    for lane in &parts.lanes {
        let Some(ids) = listed.get(&lane.id) else {
            continue;
        };
        let of_lane = |&&i: &&usize| ids.contains(&parts.areas[i].id);
        let candidates: Vec<usize> = stops.iter().filter(of_lane).copied().collect();
        let crosses = |&&i: &&usize| crosses(&parts.areas[i].polygon, &lane.centerline);
        let mut chosen: Vec<usize> = candidates.iter().filter(crosses).copied().collect();
        if chosen.is_empty() {
            let start = lane.centerline.points()[0];
            let distance = |i: &usize| parts.areas[*i].polygon.signed_distance(start).max(0.0);
            let nearest = candidates
                .iter()
                .min_by(|a, b| distance(a).total_cmp(&distance(b)));
            chosen.extend(nearest);
        }
        for i in chosen {
            parts.areas[i].lanes.push(lane.id);
        }
    }
}

/// True if the line shares a point with the polygon.
fn crosses(polygon: &Polygon, line: &Polyline) -> bool {
    let edge =
        |(a, b): (DVec2, DVec2)| polygon.edges().any(|(c, d)| segments_intersect(a, b, c, d));
    polygon.contains(line.points()[0]) || line.segments().any(edge)
}
