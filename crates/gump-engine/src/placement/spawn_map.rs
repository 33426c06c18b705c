//! Positions on a map where agents may be placed, and the directions of motion there.
//!
//! The scene's square is divided into cells of a metre. Which cells are open to a class follows
//! simple rules: vehicles on centre lines of lanes, bicycles at their right-hand side and on
//! bicycle lanes, pedestrians on crosswalks, walkways and along the outer side of road edges.

use std::f64::consts::TAU;

use gump_geometry::{DVec2, Pose, angle_difference, dvec2};
use gump_model::config::KEEP_RANGE_M;
use gump_scene::{AgentKind, AreaKind, Lane, LaneId, LaneKind, MapGraph};
use gump_tokenizer::Field;

/// Cells along each side: a metre each.
pub(crate) const CELLS: usize = 200;
/// Half the side of the square, metres: that of the positions' grid ([`Field::X`]).
const REACH: f64 = 100.0;
/// Directions closer than this are equal, radians: 9 degrees, chosen by hand. Lanes that fork
/// differ by less near the fork, and one of them is enough there.
const SAME_WAY: f64 = 0.15;
/// An agent nearer than this to the border of the window along an axis may cross it, metres: a step
/// of half a second at 24 m/s. Not tuned.
const RIM: f64 = 12.0;
/// An agent nearer than this to the beginning or end of a lane at the end of the map may enter or
/// leave there, metres: a step of half a second at 16 m/s. Not tuned.
const GATE: f64 = 8.0;
/// Slower agents have no direction of motion, metres per second: below three bins, rounding alone
/// turns a velocity by more than [`SAME_WAY`].
pub(crate) const SLOW: f64 = 0.75;
/// Number of sectors of directions: 0.1 rad each, narrower than [`SAME_WAY`].
const SECTORS: usize = 64;

/// The open cells of one scene for one class.
#[derive(Clone, Debug)]
pub struct SpawnMap {
    cells: Vec<Cell>,
    /// By bin of the velocity along x, then along y: whether traffic moves in that direction
    /// anywhere. Empty where any direction is allowed.
    velocities: Vec<bool>,
}

/// A square metre.
#[derive(Clone, Debug, Default)]
pub(crate) struct Cell {
    pub(crate) is_open: bool,
    /// Headings of traffic in the cell, scene frame; none where any heading is allowed.
    pub(crate) ways: Vec<f32>,
    /// The way in which an agent may enter the window there.
    pub(crate) entry: Entry,
    /// Whether a lane ends there at the end of the map.
    pub(crate) is_end: bool,
}

/// The way in which an agent enters the window.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Entry {
    /// No entry.
    #[default]
    Closed,
    /// Over the border, nearing the ego.
    Border,
    /// From the end of the map.
    Gate,
}

impl SpawnMap {
    /// The open cells of a class.
    pub fn of_class(map: &MapGraph, world_from_scene: Pose, kind: AgentKind) -> Self {
        let mut ground = Self::closed();
        let scene_from_world = world_from_scene.inverse();
        let near = |lane: &&Lane| is_near(lane, world_from_scene.position);
        for lane in map.lanes().iter().filter(near) {
            let offset = match (kind, lane.kind) {
                (AgentKind::Vehicle, LaneKind::BikeLane) => continue,
                (AgentKind::Vehicle, _) | (AgentKind::Bicycle, LaneKind::BikeLane) => 0.0,
                // 0.8 m from the right edge: half a bicycle's width and some clearance.
                (AgentKind::Bicycle, LaneKind::SurfaceStreet | LaneKind::Undefined) => {
                    -(lane.width / 2.0 - 0.8).max(0.0)
                }
                _ => continue,
            };
            ground.open_lane(lane, offset, scene_from_world);
            ground.mark_gates(map, lane, offset, scene_from_world);
        }
        if kind == AgentKind::Pedestrian {
            ground.open_walks(map, scene_from_world);
        }
        ground.finish()
    }

    /// The open cells where agents may enter the window.
    pub(crate) fn entries(&self) -> Self {
        let cells = self.cells.iter().map(|cell| Cell {
            is_open: cell.is_open && cell.entry != Entry::Closed,
            ways: match cell.entry {
                Entry::Closed => Vec::new(),
                _ => cell.ways.clone(),
            },
            ..*cell
        });
        let ground = Self {
            cells: cells.collect(),
            velocities: Vec::new(),
        };
        ground.finish()
    }

    /// Whether a lane ends near a point at the end of the map.
    pub(crate) fn ends_at(&self, point: DVec2) -> bool {
        self.cell(point).is_some_and(|cell| cell.is_end)
    }

    /// The open cells of one lane; `None` if there is no such lane.
    pub fn of_lane(map: &MapGraph, world_from_scene: Pose, lane: LaneId) -> Option<Self> {
        let mut ground = Self::closed();
        ground.open_lane(map.lane(lane)?, 0.0, world_from_scene.inverse());
        Some(ground.finish())
    }

    /// True if no cell is open.
    pub fn is_closed(&self) -> bool {
        !self.cells.iter().any(|cell| cell.is_open)
    }

    /// The cell around a point of the scene frame.
    pub(crate) fn cell(&self, point: DVec2) -> Option<&Cell> {
        index(point).map(|i| &self.cells[i])
    }

    /// The open cells of a column, `x` counted from behind, with the y of their centres.
    pub(crate) fn column(&self, x: usize) -> impl Iterator<Item = (DVec2, &Cell)> {
        let cells = self.cells[x * CELLS..(x + 1) * CELLS].iter().enumerate();
        let open = cells.filter(|(_, cell)| cell.is_open);
        open.map(move |(y, cell)| (centre(x, y), cell))
    }

    /// True if traffic moves in the direction of this velocity anywhere.
    pub(crate) fn admits(&self, velocity: DVec2) -> bool {
        let x = usize::from(Field::VelocityX.quantize(velocity.x).bin);
        let y = usize::from(Field::VelocityY.quantize(velocity.y).bin);
        let index = x * Field::VelocityY.n_bins() + y;
        self.velocities.get(index).copied().unwrap_or(true)
    }

    fn closed() -> Self {
        Self {
            cells: vec![Cell::default(); CELLS * CELLS],
            velocities: Vec::new(),
        }
    }

    fn finish(mut self) -> Self {
        for (i, cell) in self.cells.iter_mut().enumerate() {
            if cell.entry == Entry::Closed && is_rim(centre(i / CELLS, i % CELLS)) {
                cell.entry = Entry::Border;
            }
        }
        let mut sectors: [Option<f32>; SECTORS] = [None; SECTORS];
        for way in self.cells.iter().flat_map(|cell| &cell.ways) {
            let sector = (f64::from(*way).rem_euclid(TAU) / TAU * SECTORS as f64) as usize;
            sectors[sector.min(SECTORS - 1)].get_or_insert(*way);
        }
        let ways: Vec<f32> = sectors.into_iter().flatten().collect();
        if !ways.is_empty() {
            let bins = |field: Field| (0..field.n_bins() as u16).map(move |b| field.dequantize(b));
            self.velocities = bins(Field::VelocityX)
                .flat_map(|x| bins(Field::VelocityY).map(move |y| dvec2(x, y)))
                .map(|v| v.length() < SLOW || goes(&ways, v.to_angle(), SAME_WAY))
                .collect();
        }
        self
    }

    fn open_lane(&mut self, lane: &Lane, offset: f64, scene_from_world: Pose) {
        let line = lane.centerline.offset(offset).resample(0.5);
        let n = (line.length() / 0.5).ceil() as usize;
        for i in 0..=n {
            let pose = scene_from_world * line.pose_at((i as f64 * 0.5).min(line.length()));
            let Some(i) = index(pose.position) else {
                continue;
            };
            let cell = &mut self.cells[i];
            cell.is_open = true;
            if cell.ways.is_empty() || !goes(&cell.ways, pose.heading, SAME_WAY) {
                cell.ways.push(pose.heading as f32);
            }
        }
    }

    /// Marks where a lane begins without one before it, or ends without one after it.
    fn mark_gates(&mut self, map: &MapGraph, lane: &Lane, offset: f64, scene_from_world: Pose) {
        let line = lane.centerline.offset(offset);
        let (begins, ends) = (
            map.predecessors(lane.id).next().is_none(),
            map.successors(lane.id).next().is_none(),
        );
        for i in 0..=GATE as usize {
            let along = (i as f64).min(line.length());
            let place = |along: f64| index(scene_from_world * line.pose_at(along).position);
            if let Some(i) = place(along).filter(|_| begins) {
                self.cells[i].entry = Entry::Gate;
            }
            if let Some(i) = place(line.length() - along).filter(|_| ends) {
                self.cells[i].is_end = true;
            }
        }
    }

    fn open_walks(&mut self, map: &MapGraph, scene_from_world: Pose) {
        let world_from_scene = scene_from_world.inverse();
        let walks = map.areas().iter();
        let walks = walks.filter(|a| matches!(a.kind, AreaKind::Crosswalk | AreaKind::Walkway));
        for area in walks {
            let corners = area.polygon.ring().iter().map(|p| scene_from_world * *p);
            let (mut low, mut high) = (DVec2::splat(f64::MAX), DVec2::splat(f64::MIN));
            for corner in corners {
                (low, high) = (low.min(corner), high.max(corner));
            }
            let range = |low: f64, high: f64| {
                let cell = |at: f64| (at + REACH).floor().clamp(0.0, CELLS as f64);
                cell(low) as usize..(cell(high) as usize + 1).min(CELLS)
            };
            for x in range(low.x, high.x) {
                for y in range(low.y, high.y) {
                    if area.polygon.contains(world_from_scene * centre(x, y)) {
                        self.cells[x * CELLS + y].is_open = true;
                    }
                }
            }
        }
        for edge in map.road_edges() {
            // The road is on the left of its edges. A sidewalk is taken to be 1 to 3 m beyond.
            for offset in [-1.5, -2.5] {
                let line = edge.line.offset(offset).resample(1.0);
                for point in line.points() {
                    let Some(i) = index(scene_from_world * *point) else {
                        continue;
                    };
                    if map.drivable().is_empty() || !map.is_drivable(*point) {
                        self.cells[i].is_open = true;
                    }
                }
            }
        }
    }
}

/// True if one of `ways` is within `slack` of `heading`, or there are none.
pub(crate) fn goes(ways: &[f32], heading: f64, slack: f64) -> bool {
    let mut ways = ways.iter();
    ways.len() == 0 || ways.any(|way| angle_difference(f64::from(*way), heading).abs() <= slack)
}

pub(crate) fn is_near(lane: &Lane, centre: DVec2) -> bool {
    let points = lane.centerline.points();
    let (mut low, mut high) = (points[0], points[0]);
    for point in points {
        (low, high) = (low.min(*point), high.max(*point));
    }
    let reach = REACH * std::f64::consts::SQRT_2;
    (low - reach).cmple(centre).all() && (high + reach).cmpge(centre).all()
}

/// Whether a point of the scene frame is near the border of the window.
fn is_rim(point: DVec2) -> bool {
    point.abs().max_element() >= KEEP_RANGE_M - RIM
}

fn index(point: DVec2) -> Option<usize> {
    let cell = (point + REACH).floor();
    let inside = 0.0 <= cell.min_element() && cell.max_element() < CELLS as f64;
    inside.then(|| cell.x as usize * CELLS + cell.y as usize)
}

fn centre(x: usize, y: usize) -> DVec2 {
    dvec2(x as f64, y as f64) + 0.5 - REACH
}

#[cfg(test)]
mod tests {
    use gump_scene::fixture;

    use super::*;

    #[test]
    fn lanes_are_open_their_way_and_edges_outside() {
        let scenario = fixture::scenario(
            "lane 1: -50,0 50,0\nlane 2: 50,4 -50,4\nedge: -50,-2 50,-2\nego vehicle 0: 0,0",
        )
        .unwrap();
        let ground = |kind| SpawnMap::of_class(&scenario.map, Pose::IDENTITY, kind);
        let road = ground(AgentKind::Vehicle);
        let there = road.cell(dvec2(10.2, 0.3)).unwrap();
        assert!(there.is_open && goes(&there.ways, 0.0, 0.1) && !goes(&there.ways, 3.1, 0.1));
        let back = road.cell(dvec2(10.2, 4.3)).unwrap();
        assert!(back.is_open && goes(&back.ways, -3.1, 0.1));
        assert!(road.admits(dvec2(9.0, 0.0)) && road.admits(dvec2(-9.0, 0.0)));
        assert!(!road.admits(dvec2(0.0, 9.0)) && road.admits(dvec2(0.0, 0.5)));
        assert!(!road.cell(dvec2(10.2, 8.3)).unwrap().is_open);
        let walk = ground(AgentKind::Pedestrian);
        assert!(walk.cell(dvec2(10.2, -3.7)).unwrap().is_open);
        assert!(!walk.cell(dvec2(10.2, 0.3)).unwrap().is_open);
    }

    #[test]
    fn things_come_over_the_border_and_from_where_the_map_ends() {
        // One lane goes on beyond the window, one begins and ends in it.
        let scenario =
            fixture::scenario("lane 1: -150,0 150,0\nlane 2: -40,30 40,30\nego vehicle 0: 0,0")
                .unwrap();
        let ground = SpawnMap::of_class(&scenario.map, Pose::IDENTITY, AgentKind::Vehicle);
        let entries = ground.entries();
        let open = |x: f64, y: f64| entries.cell(dvec2(x, y)).unwrap().is_open;
        assert!(open(-90.0, 0.3) && open(90.0, 0.3) && !open(0.0, 0.3));
        assert!(open(-38.0, 30.3) && !open(0.0, 30.3) && !open(38.0, 30.3));
        assert!(!ground.ends_at(dvec2(90.0, 0.3)) && ground.ends_at(dvec2(38.0, 30.3)));
        assert!(entries.admits(dvec2(9.0, 0.0)) && !entries.admits(dvec2(0.0, 9.0)));
    }

    #[test]
    fn a_lane_that_is_not_there_has_no_ground() {
        let scenario = fixture::scenario("lane 1: 500,0 600,0\nego vehicle 0: 0,0").unwrap();
        let lane = |id| SpawnMap::of_lane(&scenario.map, Pose::IDENTITY, LaneId(id));
        assert!(lane(7).is_none());
        assert!(lane(1).unwrap().is_closed());
    }
}
