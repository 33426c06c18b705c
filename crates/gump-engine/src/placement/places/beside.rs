//! Places beside lanes, where vehicles park.

use std::f64::consts::FRAC_PI_2;

use gump_geometry::{DVec2, Pose, dvec2};
use gump_scene::{Lane, MapGraph};

use super::{Place, PlaceKind};

/// Half the side of the square, metres: recorded vehicles that park are seen up to there, and more
/// places take more time.
const REACH: f64 = 60.0;
/// Side of a cell, metres: vehicles park at least as far apart, and a smaller one would take more
/// time.
pub const CELL: f64 = 2.0;
/// Cells along each side.
const CELLS: usize = (2.0 * REACH / CELL) as usize;
/// Distances from the centres of lanes, metres: from a vehicle that parks partly in the lane to the
/// far rows of a car park whose aisles are no lanes.
const BESIDE: [f64; 2] = [1.6, 20.0];
/// Least distance of a vehicle's centre from a road edge for it to be on the road, metres: a narrow
/// car that touches it.
const INSIDE: f64 = 0.7;
/// Distances to road edges are known up to this, metres.
pub(super) const EDGE_REACH: f64 = 5.0;
/// Spacing of the points by which lines are entered into cells, metres.
const SPACING: f64 = 1.0;

/// The nearest point of a line to a cell.
#[derive(Clone, Copy)]
struct Nearest {
    squared: f64,
    pose: Pose,
    lane: u32,
    along: f64,
}

/// Places beside these lanes.
pub(super) fn places(map: &MapGraph, world_from_scene: Pose, lanes: &[&Lane]) -> Vec<Place> {
    if map.road_edges().is_empty() && map.drivable().is_empty() {
        return Vec::new();
    }
    let scene_from_world = world_from_scene.inverse();
    let mut nearest: Vec<Option<Nearest>> = vec![None; CELLS * CELLS];
    for (lane, index) in lanes.iter().zip(0..) {
        let line = &lane.centerline;
        let n = (line.length() / SPACING).ceil() as usize;
        for k in 0..=n {
            let along = (k as f64 * SPACING).min(line.length());
            enter(
                &mut nearest,
                BESIDE[1],
                scene_from_world * line.pose_at(along),
                index,
                along,
            );
        }
    }
    let mut edges: Vec<Option<Nearest>> = vec![None; CELLS * CELLS];
    for edge in map.road_edges() {
        let n = (edge.line.length() / SPACING).ceil() as usize;
        for k in 0..=n {
            let along = (k as f64 * SPACING).min(edge.line.length());
            let pose = scene_from_world * edge.line.pose_at(along);
            enter(&mut edges, EDGE_REACH, pose, 0, along);
        }
    }
    // The road is on the left of its edges.
    let is_inside = |cell: usize| {
        edges[cell].is_none_or(|edge| (edge.pose.inverse() * centre(cell)).y >= INSIDE)
    };
    // Whether no edge lies between it and the lane.
    let is_open = |cell: usize, lane: &Nearest| {
        if map.road_edges().is_empty() {
            return map.is_drivable(world_from_scene * centre(cell));
        }
        let (from, to) = (centre(cell), lane.pose.position);
        let n = (from.distance(to) / CELL).ceil() as usize;
        (0..n).all(|k| {
            let between = from.lerp(to, k as f64 / n as f64);
            cell_of(between).is_none_or(&is_inside)
        })
    };
    let mut places = Vec::new();
    for (cell, lane) in nearest.iter().enumerate() {
        let Some(lane) = lane.filter(|lane| lane.squared >= BESIDE[0] * BESIDE[0]) else {
            continue;
        };
        let is_open = is_open(cell, &lane);
        if !is_open && map.road_edges().is_empty() {
            continue;
        }
        let at = centre(cell);
        let edge = edges[cell].map_or(EDGE_REACH, |edge| (edge.pose.inverse() * at).y);
        let kinds = [(PlaceKind::Along, 0.0), (PlaceKind::Across, FRAC_PI_2)];
        places.extend(kinds.map(|(kind, turn)| Place {
            pose: Pose::new(at.x, at.y, lane.pose.heading + turn),
            kind,
            lane: lane.lane,
            along: lane.along as f32,
            edge: edge as f32,
            is_open,
        }));
    }
    places
}

/// Makes a point the nearest of the cells within `reach` to which it is.
fn enter(cells: &mut [Option<Nearest>], reach: f64, pose: Pose, lane: u32, along: f64) {
    let cells_at = |corner: DVec2| (corner + REACH) / CELL;
    let low = cells_at(pose.position - reach).floor().max(DVec2::ZERO);
    let high = cells_at(pose.position + reach).ceil();
    let high = high.min(DVec2::splat(CELLS as f64));
    for x in low.x as usize..high.x.max(0.0) as usize {
        for y in low.y as usize..high.y.max(0.0) as usize {
            let cell = x * CELLS + y;
            let squared = centre(cell).distance_squared(pose.position);
            if squared <= reach * reach && cells[cell].is_none_or(|best| squared < best.squared) {
                cells[cell] = Some(Nearest {
                    squared,
                    pose,
                    lane,
                    along,
                });
            }
        }
    }
}

/// The centre of a cell, scene frame.
fn centre(cell: usize) -> DVec2 {
    (dvec2((cell / CELLS) as f64, (cell % CELLS) as f64) + 0.5) * CELL - REACH
}

/// The cell around a point.
fn cell_of(point: DVec2) -> Option<usize> {
    let cell = ((point + REACH) / CELL).floor();
    let inside = 0.0 <= cell.min_element() && cell.max_element() < CELLS as f64;
    inside.then(|| cell.x as usize * CELLS + cell.y as usize)
}
