//! A map prepared for queries from many positions: lanes as points two metres apart and road edges
//! as short stretches, both in a grid, in the scene frame.

use std::collections::HashMap;

use gump_geometry::{DVec2, Pose, angle_difference};
use gump_scene::{AreaKind, LaneId, MapGraph, Unstated};

use super::edges::Edge;

// What the sequence network sees: chosen by hand, not tuned, and fixed by its weights.

/// Distance between the points of a lane, metres.
pub(super) const LANE_STEP_M: f64 = 2.0;
/// Points of a path ahead, the first abeam: 44 m, more than two seconds at 20 m/s.
pub(super) const PATH_POINTS: usize = 23;
/// Maximum number of paths of an object: left, straight on, right.
pub(super) const N_PATHS: usize = 3;
/// Half the side of the prepared area, metres: the window of tokens and the surroundings of its
/// outermost objects.
const HALF_SIDE_M: f64 = 128.0;
/// Side of a cell of the grid, metres. Affects time only.
const CELL_M: f64 = 8.0;
/// An edge this near to a driveway is its mouth, metres: the two are drawn apart from each other.
const DRIVEWAY_M: f64 = 1.0;
/// An object follows a lane whose centre is at most this far away, metres: bicycles at its edge,
/// too.
const LANE_REACH_M: f64 = 4.0;
/// And whose direction differs at most this much, radians (60 degrees).
const LANE_TURN: f64 = 1.05;
/// Weight of a radian, in metres, in choosing the followed lane.
const METRES_PER_RADIAN: f64 = 3.0;
/// A lane this much worse than the best is not an alternative, metres: branches of one lane are,
/// the next lane is not.
const ALTERNATIVE_M: f64 = 1.0;
/// Maximum number of lanes of a path after its first; bounds the time where lanes are short.
const MOST_LANES: usize = 12;
/// Maximum number of paths from which the most different ones are chosen; bounds the time at forks.
const MOST_PATHS: usize = 8;

/// A point of a lane.
#[derive(Clone, Copy, Debug)]
pub(super) struct LanePoint {
    pub(super) pose: Pose,
    pub(super) lane: u32,
}

/// A lane as a run of points.
#[derive(Debug)]
pub(super) struct LaneRun {
    first: u32,
    n: u32,
    successors: Vec<u32>,
    /// Metres per second.
    speed_limit: Option<f64>,
    /// Index of the point at which a stop sign requires a stop.
    stop: Option<u32>,
}

/// Points two metres apart along lanes that follow each other, from abeam of the object on.
pub(super) type Path = Vec<u32>;

/// A map in the scene frame.
#[derive(Debug, Default)]
pub struct LaneMap {
    points: Vec<LanePoint>,
    lanes: Vec<LaneRun>,
    lane_cells: Cells,
    edges: Vec<Edge>,
    edge_cells: Cells,
    /// Information that the source of the map cannot express.
    pub(super) unstated: Unstated,
}

impl LaneMap {
    /// Prepares the map around the origin of a scene.
    pub fn new(map: &MapGraph, world_from_scene: Pose) -> Self {
        let scene_from_world = world_from_scene.inverse();
        let mut lane_map = Self {
            unstated: map.unstated(),
            ..Self::default()
        };
        let known = map.lanes().iter().filter(|lane| {
            let local = |p: &DVec2| scene_from_world * *p;
            let within = |p: DVec2| p.abs().max_element() < HALF_SIDE_M;
            lane.centerline.points().iter().any(|p| within(local(p)))
        });
        let known: Vec<_> = known.collect();
        let index: HashMap<LaneId, u32> = known.iter().zip(0..).map(|(l, i)| (l.id, i)).collect();
        for (lane, number) in known.iter().zip(0..) {
            let first = lane_map.points.len() as u32;
            let line = lane.centerline.resample(LANE_STEP_M);
            let poses = line.arc_lengths().iter().map(|&s| LanePoint {
                pose: scene_from_world * line.pose_at(s),
                lane: number,
            });
            lane_map.points.extend(poses);
            let stands_at = map.stop_signs_of(lane.id).next();
            let stop = stands_at.map(|sign| {
                let s = line.project(sign.position.truncate()).arc_length;
                first + (s / LANE_STEP_M).round() as u32
            });
            let n = lane_map.points.len() as u32 - first;
            lane_map.lanes.push(LaneRun {
                first,
                n,
                successors: lane
                    .successors
                    .iter()
                    .filter_map(|id| index.get(id).copied())
                    .collect(),
                speed_limit: lane.speed_limit,
                // A lane's last point may belong to its successor.
                stop: stop.map(|at| at.min(first + n.saturating_sub(2))),
            });
        }
        for edge in map.road_edges() {
            let stretches = Edge::of(&edge.line, scene_from_world).into_iter();
            lane_map
                .edges
                .extend(stretches.filter(|edge| edge.from.abs().max_element() < HALF_SIDE_M));
        }
        lane_map.lane_cells = Cells::new(lane_map.points.iter().map(|point| point.pose.position));
        lane_map.edge_cells = Cells::new(lane_map.edges.iter().map(|edge| edge.from));
        lane_map
    }

    /// The road edges within `reach` metres of one of these places, in the frame of the map; no lanes.
    pub fn of_edges(map: &MapGraph, centres: &[DVec2], reach: f64) -> Self {
        let edges = map.road_edges().iter();
        let stretches = edges.flat_map(|edge| Edge::of(&edge.line, Pose::IDENTITY));
        let edges: Vec<Edge> = stretches
            .filter(|edge| {
                let mut centres = centres.iter();
                centres.any(|centre| edge.from.distance_squared(*centre) < reach * reach)
            })
            .collect();
        Self {
            edge_cells: Cells::new(edges.iter().map(|edge| edge.from)),
            edges,
            ..Self::default()
        }
    }

    /// As [`Self::of_edges`] without the edges in front of driveways, which vehicles cross: recorded
    /// maps draw the edge of a road on through the mouths of yards and car parks.
    pub fn of_curbs(map: &MapGraph, centres: &[DVec2], reach: f64) -> Self {
        let driveways = map.areas().iter();
        let driveways = driveways.filter(|area| area.kind == AreaKind::Driveway);
        let driveways: Vec<_> = driveways
            .map(|area| (&area.polygon, area.polygon.bounds()))
            .collect();
        let is_open = |edge: &Edge| {
            let middle = edge.from.midpoint(edge.to);
            driveways.iter().any(|(polygon, (low, high))| {
                let near =
                    middle.cmpge(*low - DRIVEWAY_M).all() && middle.cmple(*high + DRIVEWAY_M).all();
                near && polygon.signed_distance(middle) < DRIVEWAY_M
            })
        };
        let mut all = Self::of_edges(map, centres, reach);
        all.edges.retain(|edge| !is_open(edge));
        all.edge_cells = Cells::new(all.edges.iter().map(|edge| edge.from));
        all
    }

    pub(super) fn point(&self, index: u32) -> LanePoint {
        self.points[index as usize]
    }

    /// The speed limit at a point, if its lane states one, metres per second.
    pub(super) fn limit_at(&self, index: u32) -> Option<f64> {
        self.lane_of(index).speed_limit
    }

    fn lane_of(&self, index: u32) -> &LaneRun {
        &self.lanes[self.point(index).lane as usize]
    }

    /// True if a path through `index` has to stop there for a sign.
    pub(super) fn is_stop(&self, index: u32) -> bool {
        self.lane_of(index).stop == Some(index)
    }

    /// True if a lane begins at `index`.
    pub(super) fn is_start(&self, index: u32) -> bool {
        self.lane_of(index).first == index
    }

    /// Indices of all lane points in the cells within `radius` metres of `position`.
    pub(super) fn lanes_near(&self, position: DVec2, radius: f64) -> impl Iterator<Item = u32> {
        self.lane_cells.near(position, radius)
    }

    /// All stretches of road edges that start in the cells within `radius` metres of `position`.
    pub fn edges_near(&self, position: DVec2, radius: f64) -> impl Iterator<Item = Edge> {
        self.edge_cells
            .near(position, radius)
            .map(|i| self.edges[i as usize])
    }

    /// Possible paths of an object: up to [`N_PATHS`] paths along the lane it follows and its
    /// successors, as different as possible, from the leftmost to the rightmost end.
    pub(super) fn paths(&self, from: Pose) -> Vec<Path> {
        let mut starts: Vec<(f64, u32)> = Vec::new();
        for index in self.lanes_near(from.position, LANE_REACH_M) {
            let point = self.point(index);
            let away = point.pose.position.distance(from.position);
            let turn = angle_difference(point.pose.heading, from.heading).abs();
            if away > LANE_REACH_M || turn > LANE_TURN {
                continue;
            }
            let cost = away + METRES_PER_RADIAN * turn;
            match starts
                .iter_mut()
                .find(|start| self.point(start.1).lane == point.lane)
            {
                Some(start) if start.0 > cost => *start = (cost, index),
                Some(_) => {}
                None => starts.push((cost, index)),
            }
        }
        starts.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let best = starts.first().map_or(0.0, |start| start.0);
        let mut paths = Vec::new();
        for (_, start) in starts
            .iter()
            .take_while(|start| start.0 <= best + ALTERNATIVE_M)
        {
            self.extend(
                &mut Vec::with_capacity(PATH_POINTS),
                *start,
                MOST_LANES,
                &mut paths,
            );
        }
        self.most_different(paths, from)
    }

    /// Follows a lane from `index` to its end and on, into every successor, `more` lanes at most.
    fn extend(&self, path: &mut Path, index: u32, more: usize, paths: &mut Vec<Path>) {
        let lane = self.lane_of(index);
        let kept = path.len();
        let end = lane.first + lane.n;
        // A lane's last point is its successor's first.
        let end = if lane.successors.is_empty() {
            end
        } else {
            end - 1
        };
        path.extend((index..end).take(PATH_POINTS - kept));
        let ends = path.len() == PATH_POINTS || lane.successors.is_empty();
        if paths.len() < MOST_PATHS {
            if ends || more == 0 {
                paths.push(path.clone());
            } else {
                for &next in &lane.successors {
                    self.extend(path, self.lanes[next as usize].first, more - 1, paths);
                }
            }
        }
        path.truncate(kept);
    }

    /// Of many paths the leftmost, the rightmost and the middle one, without those that end within
    /// three metres of another.
    fn most_different(&self, paths: Vec<Path>, from: Pose) -> Vec<Path> {
        let end = |path: &Path| {
            path.last()
                .map_or(from.position, |&i| self.point(i).pose.position)
        };
        let mut kept: Vec<Path> = Vec::new();
        for path in paths.into_iter().filter(|path| !path.is_empty()) {
            if kept
                .iter()
                .all(|other| end(other).distance(end(&path)) > 3.0)
            {
                kept.push(path);
            }
        }
        let bearing = |path: &Path| {
            let local = from.inverse() * end(path);
            local.y.atan2(local.x.max(0.0) + 1.0)
        };
        kept.sort_by(|a, b| bearing(b).total_cmp(&bearing(a)));
        if kept.len() > N_PATHS {
            let (middle, last) = (kept.len() / 2, kept.len() - 1);
            kept.swap(1, middle);
            kept.swap(2, last);
            kept.truncate(N_PATHS);
        }
        kept
    }
}

/// Points by the cell of a grid that they are in, which is as large as they are far apart.
#[derive(Debug, Default)]
struct Cells {
    /// Column and row of each point, in order.
    cells: Vec<[i32; 2]>,
    /// The points, in the same order.
    items: Vec<u32>,
}

impl Cells {
    fn new(points: impl Iterator<Item = DVec2>) -> Self {
        let placed = points.map(|p| [p.x, p.y].map(cell));
        let mut placed: Vec<([i32; 2], u32)> = placed.zip(0..).collect();
        placed.sort_unstable();
        let (cells, items) = placed.into_iter().unzip();
        Self { cells, items }
    }

    fn near(&self, position: DVec2, radius: f64) -> impl Iterator<Item = u32> {
        let span = |x: f64| (cell(x - radius), cell(x + radius));
        let ((left, right), (bottom, top)) = (span(position.x), span(position.y));
        // Columns without points are left out, however far one looks.
        let ends = self.cells.first().zip(self.cells.last());
        let columns = ends.map(|([first, _], [last, _])| left.max(*first)..=right.min(*last));
        let runs = columns.into_iter().flatten().map(move |x| {
            let from = self.cells.partition_point(|at| *at < [x, bottom]);
            let to = self.cells.partition_point(|at| *at <= [x, top]);
            &self.items[from..to]
        });
        runs.flatten().copied()
    }
}

fn cell(x: f64) -> i32 {
    (x / CELL_M).floor() as i32
}
