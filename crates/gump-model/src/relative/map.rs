//! The map as short pieces of lanes, road edges and areas, each with numbers in its own frame.
//!
//! Nothing here depends on the position or direction of the scene. Agents attend to the pieces of
//! the lanes that they may follow and to other pieces nearby.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, Pose, angle_difference};
use gump_scene::{AreaKind, LaneId, LaneKind, MapGraph, RoadEdgeKind};

use crate::relative::driveway::Driveways;
use crate::relative::graph::Axes;

// What the network sees of a map: chosen by hand, not tuned, and fixed by its weights.

/// Maximum length of a piece of a lane, metres.
const LANE_PIECE_M: f64 = 8.0;
/// Maximum length of a piece of a road edge, metres.
const EDGE_PIECE_M: f64 = 10.0;
/// Points that describe the shape of a piece, about 2 m apart.
pub(super) const SHAPE: usize = 5;
/// Side of a cell of the grid, metres. Affects time only.
const CELL_M: f64 = 16.0;
// The next four as in `local_context`.

/// An agent may follow a lane whose centre is at most this far away, metres.
const LANE_REACH_M: f64 = 4.0;
/// And whose direction differs at most this much, radians.
const LANE_TURN: f64 = 1.05;
/// Weight of a radian, in metres, in choosing the followed lane.
const METRES_PER_RADIAN: f64 = 3.0;
/// A lane this much worse than the best is not an alternative, metres.
const ALTERNATIVE_M: f64 = 1.0;
/// Length of a path ahead, metres: about three seconds at 20 m/s.
pub(super) const PATH_M: f64 = 64.0;
/// Number of distinct paths ahead: left, straight on, right.
pub(super) const PATHS: usize = 3;
/// Maximum number of paths from which the most different ones are chosen; bounds the time at forks.
const MOST_PATHS: usize = 8;

/// Numbers of a piece.
pub const PIECE_NUMBERS: usize = 2 * SHAPE + 4 + 3 + 6 + 11;

/// The type of feature that a piece belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PieceKind {
    Lane,
    Edge,
    Area,
}

/// A short part of the map.
#[derive(Clone, Debug)]
pub struct Piece {
    /// The middle, along the direction of travel; of an area its centre, along its longer side.
    pub pose: Pose,
    pub(super) kind: PieceKind,
    /// The same as axes.
    pub(super) axes: Axes,
    /// Its line in its own frame, from the first point to the last.
    pub(super) shape: [DVec2; SHAPE],
    /// The same in the world.
    pub(super) line: [DVec2; SHAPE],
    /// The lane it belongs to.
    pub(super) lane: Option<LaneId>,
    pub(super) starts_lane: bool,
    /// Length along the line, metres.
    pub(super) length: f64,
    /// The pieces of lanes that follow.
    next: Vec<u32>,
}

impl Piece {
    /// Distance of a point to the line of the piece, metres, and how far the point lies to its left.
    pub(super) fn offset(&self, point: DVec2) -> (f64, f64) {
        let local = self.axes.see(point);
        let mut best = (f64::INFINITY, 0.0);
        for pair in self.shape.windows(2) {
            let (a, along) = (pair[0], pair[1] - pair[0]);
            let length = along.length_squared().max(1e-9);
            let t = ((local - a).dot(along) / length).clamp(0.0, 1.0);
            let away = local - (a + along * t);
            let distance = away.length();
            if distance < best.0 {
                best = (distance, along.perp_dot(local - a) / length.sqrt());
            }
        }
        best
    }
}

/// Information of a map to withhold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Hidden {
    pub(super) limits: bool,
    pub(super) stop_signs: bool,
}

/// Whether a point is within `reach` metres of one of these.
fn is_near(point: DVec2, centres: &[DVec2], reach: f64) -> bool {
    let mut centres = centres.iter();
    centres.any(|centre| point.distance_squared(*centre) < reach * reach)
}

/// A map in pieces.
#[derive(Debug, Default)]
pub struct VectorMap {
    /// The pieces, by index.
    pub pieces: Vec<Piece>,
    /// `[pieces, PIECE_NUMBERS]`
    pub numbers: Vec<f32>,
    cells: BTreeMap<(i64, i64), Vec<u32>>,
    /// The pieces of each lane, in order.
    by_lane: BTreeMap<LaneId, Vec<u32>>,
}

impl VectorMap {
    /// The pieces of a map within `reach` metres of `centre`.
    pub fn new(map: &MapGraph, centre: DVec2, reach: f64, hidden: Hidden) -> Self {
        Self::around(map, &[centre], reach, hidden)
    }

    /// The pieces of a map within `reach` metres of one of these points.
    pub fn around(map: &MapGraph, centres: &[DVec2], reach: f64, hidden: Hidden) -> Self {
        let mut this = Self::default();
        let near = |p: DVec2| is_near(p, centres, reach);
        this.add_lanes(map, near, hidden);
        for edge in map.road_edges() {
            let kind = match edge.kind {
                RoadEdgeKind::Boundary => 0,
                RoadEdgeKind::Median => 1,
                RoadEdgeKind::Unknown => 2,
            };
            let n = (edge.line.length() / EDGE_PIECE_M).ceil().max(1.0) as usize;
            for i in 0..n {
                let piece = piece(&edge.line, i, n, PieceKind::Edge, None);
                if near(piece.pose.position) {
                    let mut rest = [0.0; REST];
                    rest[4 + kind] = 1.0;
                    this.push(piece, rest);
                }
            }
        }
        for area in map.areas() {
            let Some(kind) = area_index(area.kind) else {
                continue;
            };
            let piece = area_piece(area.polygon.ring());
            if let Some(piece) = piece.filter(|piece| near(piece.pose.position)) {
                let mut rest = [0.0; REST];
                rest[7 + kind] = 1.0;
                this.push(piece, rest);
            }
        }
        this.index();
        this
    }

    fn add_lanes(&mut self, map: &MapGraph, near: impl Fn(DVec2) -> bool, hidden: Hidden) {
        // Some formats have no stop signs: a map without any does not show which lanes lack one.
        let tells_stops = !hidden.stop_signs && !map.stop_signs().is_empty();
        let mut firsts: BTreeMap<LaneId, u32> = BTreeMap::new();
        let mut lasts: Vec<(u32, LaneId)> = Vec::new();
        for lane in map.lanes() {
            let line = &lane.centerline;
            let n = (line.length() / LANE_PIECE_M).ceil().max(1.0) as usize;
            let stops = tells_stops && map.stop_signs_of(lane.id).next().is_some();
            let mut before: Option<u32> = None;
            for i in 0..n {
                let mut piece = piece(line, i, n, PieceKind::Lane, Some(lane.id));
                if !near(piece.pose.position) {
                    before = None;
                    continue;
                }
                piece.starts_lane = i == 0;
                let mut rest = [0.0; REST];
                rest[lane_index(lane.kind)] = 1.0;
                let limit = lane.speed_limit.filter(|_| !hidden.limits);
                rest[13] = limit.map_or(0.0, |limit| (limit / 15.0) as f32);
                rest[14] = f32::from(u8::from(limit.is_none()));
                rest[15] = f32::from(u8::from(stops));
                rest[16] = f32::from(u8::from(!tells_stops));
                rest[17] = f32::from(u8::from(lane.in_intersection));
                rest[18] = (lane.width / 4.0) as f32;
                rest[19] = lane.successors.len().min(4) as f32 / 2.0;
                rest[20] = lane.predecessors.len().min(4) as f32 / 2.0;
                rest[21] = f32::from(u8::from(!lane.left_neighbors.is_empty()));
                rest[22] = f32::from(u8::from(!lane.right_neighbors.is_empty()));
                rest[23] = f32::from(u8::from(i == 0));
                let index = self.push(piece, rest);
                if let Some(before) = before {
                    self.pieces[before as usize].next.push(index);
                }
                if i == 0 {
                    firsts.insert(lane.id, index);
                }
                if i + 1 == n {
                    lasts.push((index, lane.id));
                }
                before = Some(index);
            }
        }
        for (last, id) in lasts {
            let next = map.successors(id).filter_map(|lane| firsts.get(&lane.id));
            self.pieces[last as usize].next.extend(next);
        }
    }

    /// Adds the lanes of these ways within `reach` metres of one of these points, out of view of all but
    /// those whose route they are.
    pub fn add_driveways(&mut self, driveways: &Driveways, centres: &[DVec2], reach: f64) {
        for lane in driveways.map.lanes() {
            let line = &lane.centerline;
            if !is_near(line.point_at(0.5 * line.length()), centres, reach) {
                continue;
            }
            let n = (line.length() / LANE_PIECE_M).ceil().max(1.0) as usize;
            for i in 0..n {
                let mut piece = piece(line, i, n, PieceKind::Lane, Some(lane.id));
                piece.starts_lane = i == 0;
                let mut rest = [0.0; REST];
                rest[lane_index(lane.kind)] = 1.0;
                rest[13] = lane.speed_limit.map_or(0.0, |limit| (limit / 15.0) as f32);
                rest[14] = f32::from(u8::from(lane.speed_limit.is_none()));
                rest[18] = (lane.width / 4.0) as f32;
                rest[23] = f32::from(u8::from(i == 0));
                let index = self.push(piece, rest);
                self.by_lane.entry(lane.id).or_default().push(index);
            }
        }
    }

    fn push(&mut self, piece: Piece, rest: [f32; REST]) -> u32 {
        for point in piece.shape {
            self.numbers.push((point.x / 10.0) as f32);
            self.numbers.push((point.y / 10.0) as f32);
        }
        self.numbers.extend(rest);
        self.pieces.push(piece);
        self.pieces.len() as u32 - 1
    }

    fn index(&mut self) {
        for (i, piece) in self.pieces.iter().enumerate() {
            let cell = cell(piece.pose.position);
            self.cells.entry(cell).or_default().push(i as u32);
            if let Some(lane) = piece.lane {
                self.by_lane.entry(lane).or_default().push(i as u32);
            }
        }
    }

    /// The pieces of a lane, from its start to its end.
    pub(super) fn pieces_of(&self, lane: LaneId) -> &[u32] {
        self.by_lane.get(&lane).map_or(&[], Vec::as_slice)
    }

    /// Pieces whose middle lies in a cell within `reach` metres of `point`.
    pub(super) fn near(&self, point: DVec2, reach: f64) -> impl Iterator<Item = u32> + '_ {
        let (low, high) = (cell(point - reach), cell(point + reach));
        let columns =
            (low.0..=high.0).flat_map(move |x| self.cells.range((x, low.1)..=(x, high.1)));
        columns.flat_map(|(_, pieces)| pieces.iter().copied())
    }

    /// Possible paths of an agent: up to [`PATHS`] paths of pieces ahead, with the metres from the
    /// agent to the middle of each piece, from the leftmost path to the rightmost.
    pub(super) fn paths(&self, from: Pose) -> Vec<Vec<(u32, f64)>> {
        let mut starts: Vec<(f64, u32)> = Vec::new();
        for i in self.near(from.position, LANE_REACH_M + LANE_PIECE_M) {
            let piece = &self.pieces[i as usize];
            let turn = angle_difference(piece.pose.heading, from.heading).abs();
            if piece.kind != PieceKind::Lane || turn > LANE_TURN {
                continue;
            }
            let (away, _) = piece.offset(from.position);
            if away > LANE_REACH_M {
                continue;
            }
            let cost = away + METRES_PER_RADIAN * turn;
            let same = |start: &&mut (f64, u32)| self.pieces[start.1 as usize].lane == piece.lane;
            match starts.iter_mut().find(same) {
                Some(start) if start.0 > cost => *start = (cost, i),
                Some(_) => {}
                None => starts.push((cost, i)),
            }
        }
        starts.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let best = starts.first().map_or(0.0, |start| start.0);
        let mut paths = Vec::new();
        for &(_, start) in starts.iter().take_while(|s| s.0 <= best + ALTERNATIVE_M) {
            let piece = &self.pieces[start as usize];
            let along = piece.axes.see(from.position).x;
            self.follow(&mut Vec::new(), start, -along, &mut paths);
        }
        self.most_different(paths, from)
    }

    fn follow(
        &self,
        path: &mut Vec<(u32, f64)>,
        piece: u32,
        away: f64,
        paths: &mut Vec<Vec<(u32, f64)>>,
    ) {
        if paths.len() >= MOST_PATHS {
            return;
        }
        path.push((piece, away));
        let here = &self.pieces[piece as usize];
        if away > PATH_M || here.next.is_empty() {
            paths.push(path.clone());
        } else {
            for &next in &here.next {
                let on = 0.5 * (here.length + self.pieces[next as usize].length);
                self.follow(path, next, away + on, paths);
            }
        }
        path.pop();
    }

    /// Of many paths the leftmost, the rightmost and the middle one, without those that end within
    /// three metres of another.
    fn most_different(&self, paths: Vec<Vec<(u32, f64)>>, from: Pose) -> Vec<Vec<(u32, f64)>> {
        let end = |path: &Vec<(u32, f64)>| {
            let last = path.last().map(|&(i, _)| self.pieces[i as usize].pose);
            last.map_or(from.position, |pose| pose.position)
        };
        let mut kept: Vec<Vec<(u32, f64)>> = Vec::new();
        for path in paths {
            if kept
                .iter()
                .all(|other| end(other).distance(end(&path)) > 3.0)
            {
                kept.push(path);
            }
        }
        let bearing = |path: &Vec<(u32, f64)>| {
            let local = from.inverse() * end(path);
            local.y.atan2(local.x.max(0.0) + 1.0)
        };
        kept.sort_by(|a, b| bearing(b).total_cmp(&bearing(a)));
        if kept.len() > PATHS {
            let (middle, last) = (kept.len() / 2, kept.len() - 1);
            kept.swap(1, middle);
            kept.swap(2, last);
            kept.truncate(PATHS);
        }
        kept
    }
}

/// Numbers of a piece beside its shape.
const REST: usize = PIECE_NUMBERS - 2 * SHAPE;

fn cell(point: DVec2) -> (i64, i64) {
    (
        (point.x / CELL_M).floor() as i64,
        (point.y / CELL_M).floor() as i64,
    )
}

/// Piece `i` of the `n` of a line.
fn piece(
    line: &gump_geometry::Polyline,
    i: usize,
    n: usize,
    kind: PieceKind,
    lane: Option<LaneId>,
) -> Piece {
    let step = line.length() / n as f64;
    let at = |share: f64| line.pose_at(step * (i as f64 + share));
    let points: [DVec2; SHAPE] =
        std::array::from_fn(|k| at(k as f64 / (SHAPE - 1) as f64).position);
    let chord = points[SHAPE - 1] - points[0];
    let heading = match chord.length() > 1e-3 {
        true => chord.y.atan2(chord.x),
        false => at(0.5).heading,
    };
    let pose = Pose {
        position: points[SHAPE / 2],
        heading,
    };
    let axes = Axes::of(pose);
    Piece {
        pose,
        axes,
        kind,
        shape: points.map(|p| axes.see(p)),
        line: points,
        lane,
        starts_lane: false,
        length: step,
        next: Vec::new(),
    }
}

/// An area as the line through its middle along its longest edge, half as long as that.
fn area_piece(ring: &[DVec2]) -> Option<Piece> {
    let n = ring.len();
    let edges = (0..n).map(|i| ring[(i + 1) % n] - ring[i]);
    let longest = edges.max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))?;
    let centre = ring.iter().copied().sum::<DVec2>() / n as f64;
    let pose = Pose {
        position: centre,
        heading: longest.y.atan2(longest.x),
    };
    let local = pose.inverse();
    let (mut low, mut high) = (DVec2::ZERO, DVec2::ZERO);
    for point in ring {
        let point = local * *point;
        low = low.min(point);
        high = high.max(point);
    }
    // The corners of the box around it, and its centre.
    let shape = [
        low,
        DVec2::new(low.x, high.y),
        DVec2::ZERO,
        high,
        DVec2::new(high.x, low.y),
    ];
    Some(Piece {
        pose,
        axes: Axes::of(pose),
        kind: PieceKind::Area,
        line: shape.map(|point| pose * point),
        shape,
        lane: None,
        starts_lane: false,
        length: high.x - low.x,
        next: Vec::new(),
    })
}

fn lane_index(kind: LaneKind) -> usize {
    match kind {
        LaneKind::Freeway => 0,
        LaneKind::SurfaceStreet => 1,
        LaneKind::BikeLane => 2,
        LaneKind::Undefined => 3,
    }
}

/// The areas that are used.
fn area_index(kind: AreaKind) -> Option<usize> {
    match kind {
        AreaKind::Crosswalk => Some(0),
        AreaKind::SpeedBump => Some(1),
        AreaKind::Driveway => Some(2),
        AreaKind::Walkway => Some(3),
        AreaKind::Carpark => Some(4),
        AreaKind::StopLine | AreaKind::TurnStop => Some(5),
        AreaKind::Intersection => None,
    }
}
