//! The road border prepared for many queries: the values of [`metres_off_road`], faster.

use std::sync::{Arc, OnceLock};

use gump_geometry::{DVec2, distance_to_segment, dvec2};
use gump_scene::MapGraph;

use crate::metres_off_road;
use crate::road_edge::{distance_in_space, is_beyond, nearest};

// `metres_off_road` does not depend on these, which trade memory and preparation for time;
// `clearance` interpolates between cells. They were chosen by hand and not varied.
/// Side of a cell, metres.
const CELL: f64 = 1.0;
/// Cells along the side of a tile, which is prepared at once.
const TILE: usize = 8;
/// Difference in height, relative to the plane, beyond which the cells are not used, metres.
const RISE: f64 = 0.5;

/// A square of the map with fast queries for the road border.
///
/// Each cell of a grid stores the segments of road edges that can be nearest to a point in it.
/// Cells are prepared on first use; their content depends only on the map, so results do not depend
/// on the number of threads.
#[derive(Debug)]
pub struct Border {
    map: Arc<MapGraph>,
    /// Height at which [`Border::clearance`] is taken, metres.
    z: f64,
    /// Lower left corner of the square, world frame, metres.
    corner: DVec2,
    tiles_per_side: usize,
    tiles: Vec<OnceLock<Tile>>,
}

#[derive(Debug)]
struct Tile {
    cells: [Cell; TILE * TILE],
    /// (edge, segment), cell by cell.
    segments: Vec<(u32, u32)>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Cell {
    /// All segments up to this distance of the centre are listed, metres.
    reach: f32,
    /// From the centre to the nearest edge, metres, negative off the road.
    clearance: f32,
    /// The range of its segments.
    from: u32,
    to: u32,
}

impl Border {
    /// The square of side `2 * half` metres around `center`, at height `z`; cells are prepared on
    /// first use.
    pub fn new(map: &Arc<MapGraph>, center: DVec2, z: f64, half: f64) -> Self {
        let tile = CELL * TILE as f64;
        let tiles_per_side = (2.0 * half / tile).ceil().max(1.0) as usize;
        Self {
            map: Arc::clone(map),
            z,
            corner: center - tiles_per_side as f64 * tile / 2.0,
            tiles_per_side,
            tiles: (0..tiles_per_side * tiles_per_side)
                .map(|_| OnceLock::new())
                .collect(),
        }
    }

    /// The value of [`metres_off_road`], anywhere on the map and at any height.
    pub fn metres_off_road(&self, point: DVec2, z: f64) -> Option<f64> {
        self.known(point, z)
            .or_else(|| metres_off_road(&self.map, point, z))
    }

    /// Metres from `point` to the nearest road edge, negative off the road, interpolated between
    /// cells of 1 m; `None` outside the square and on a map without road edges.
    pub fn clearance(&self, point: DVec2) -> Option<f64> {
        // Between the centres of four cells.
        let p = (point - self.corner) / CELL - 0.5;
        let low = p.floor();
        let t = p - low;
        let at = |dx: f64, dy: f64| {
            let (tile, cell) = self.cell(low.x + dx, low.y + dy)?;
            Some(f64::from(tile.cells[cell].clearance))
        };
        let below = at(0.0, 0.0)? * (1.0 - t.x) + at(1.0, 0.0)? * t.x;
        let above = at(0.0, 1.0)? * (1.0 - t.x) + at(1.0, 1.0)? * t.x;
        Some(below * (1.0 - t.y) + above * t.y)
    }

    /// The value, where the cell of `point` has it.
    fn known(&self, point: DVec2, z: f64) -> Option<f64> {
        let p = (point - self.corner) / CELL;
        let (tile, cell) = self.cell(p.x.floor(), p.y.floor())?;
        let cell = tile.cells[cell];
        let mut best: Option<(f64, f64, usize, usize)> = None;
        for &(edge, segment) in &tile.segments[cell.from as usize..cell.to as usize] {
            let (edge, segment) = (edge as usize, segment as usize);
            let points = self.map.road_edges()[edge].line.points();
            let distance = distance_to_segment(point, points[segment], points[segment + 1]);
            let Some(in_space) = distance_in_space(&self.map, edge, segment, point, z, distance)
            else {
                continue;
            };
            if best.is_none_or(|(least, ..)| in_space < least) {
                best = Some((in_space, distance, edge, segment));
            }
        }
        let (in_space, distance, edge, segment) = best?;
        // Segments that are not listed are farther from the centre than its reach.
        let center = (p.floor() + 0.5) * CELL + self.corner;
        if in_space > f64::from(cell.reach) - center.distance(point) {
            return None;
        }
        let beyond = is_beyond(&self.map, edge, segment, point);
        Some(if beyond { distance } else { 0.0 })
    }

    /// The tile and the index of a cell in it, by the cell's column and row in the square; `None`
    /// outside it and on a map without road edges.
    fn cell(&self, column: f64, row: f64) -> Option<(&Tile, usize)> {
        let side = (self.tiles_per_side * TILE) as f64;
        let inside = |v: f64| (0.0..side).contains(&v);
        if !inside(column) || !inside(row) || self.map.road_edges().is_empty() {
            return None;
        }
        let (column, row) = (column as usize, row as usize);
        let (x, y) = (column / TILE, row / TILE);
        let tile = self.tiles[y * self.tiles_per_side + x].get_or_init(|| self.prepare(x, y));
        Some((tile, row % TILE * TILE + column % TILE))
    }

    fn prepare(&self, x: usize, y: usize) -> Tile {
        let mut tile = Tile {
            cells: [Cell::default(); TILE * TILE],
            segments: Vec::new(),
        };
        for (i, cell) in tile.cells.iter_mut().enumerate() {
            let (column, row) = (x * TILE + i % TILE, y * TILE + i / TILE);
            let center = self.corner + (dvec2(column as f64, row as f64) + 0.5) * CELL;
            let from = tile.segments.len() as u32;
            let mut reach = f64::INFINITY;
            for (edge, segment, distance) in self.map.nearest_road_edges(center) {
                if reach.is_infinite() {
                    // To the farthest point of the cell, and from there to the nearest edge.
                    reach = distance + CELL * std::f64::consts::SQRT_2 + RISE;
                } else if distance > reach {
                    break;
                }
                tile.segments.push((edge as u32, segment as u32));
            }
            let clearance = nearest(&self.map, center, self.z).map_or(0.0, |(d, edge, segment)| {
                let beyond = is_beyond(&self.map, edge, segment, center);
                if beyond { -d } else { d }
            });
            *cell = Cell {
                // Rounded down, so that it promises no more than is true.
                reach: (reach as f32).next_down(),
                clearance: clearance as f32,
                from,
                to: tile.segments.len() as u32,
            };
        }
        tile
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::{Seed, fixture};
    use rand::Rng as _;

    fn check(map: &str, half: f64) {
        let scenario = fixture::scenario(&format!("{map}\nego vehicle 0: 0,0")).unwrap();
        let border = Border::new(&scenario.map, dvec2(20.0, 5.0), 0.0, half);
        let mut rng = Seed(1).rng();
        for _ in 0..4000 {
            let point = dvec2(
                rng.random_range(-60.0..100.0),
                rng.random_range(-50.0..60.0),
            );
            for z in [0.0, 0.4, 6.0] {
                let expected = metres_off_road(&scenario.map, point, z);
                let found = border.metres_off_road(point, z);
                match (found, expected) {
                    (Some(found), Some(expected)) => {
                        assert!((found - expected).abs() < 1e-9, "{point} at {z}");
                    }
                    _ => assert_eq!(found, expected, "{point} at {z}"),
                }
            }
        }
    }

    const CORNER: &str = "edge: -40,-2 30,-2 30,-2 34,2 34,50\nedge: 26,50 26,6 -40,6\n
        edge: 10,1 10,3 14,3 14,1 10,1";

    #[test]
    fn a_prepared_border_answers_as_the_plain_one() {
        check(CORNER, 40.0);
        check(CORNER, 4.0);
        check("drivable: 0,-2 100,-2 100,2 0,2", 40.0);
        check("", 40.0);
    }

    #[test]
    fn clearance_is_the_distance_to_the_nearest_edge() {
        let text = format!("{CORNER}\nego vehicle 0: 0,0");
        let scenario = fixture::scenario(&text).unwrap();
        let border = Border::new(&scenario.map, dvec2(0.0, 0.0), 0.0, 60.0);
        let check = |x: f64, y: f64, expected: f64| {
            let found = border.clearance(dvec2(x, y)).unwrap();
            assert!((found - expected).abs() < 1e-6, "{found} at {x}, {y}");
        };
        check(0.0, 0.0, 2.0);
        check(-5.3, 4.9, 1.1);
        check(-5.3, -2.8, -0.8);
        check(29.0, 30.0, 3.0);
        assert_eq!(border.clearance(dvec2(200.0, 0.0)), None);
        let empty = fixture::scenario("ego vehicle 0: 0,0").unwrap();
        let border = Border::new(&empty.map, DVec2::ZERO, 0.0, 60.0);
        assert_eq!(border.clearance(DVec2::ZERO), None);
    }
}
