//! Conversion of a network to a map: lanes with their graph, borders and paint, crossings, signals.
//!
//! The whole network is converted once; a scenario gets the part around it ([`Roads::around`]),
//! because a city is larger than any field of view.

use std::collections::{BTreeMap, BTreeSet};

use gump_geometry::{DVec2, DVec3, Polygon, Polyline, distance_to_segment, dvec2, simplify};
use gump_scene::{
    Area, AreaKind, Lane, LaneId, LaneKind, MapParts, RoadEdge, RoadEdgeKind, RoadLine,
    RoadLineKind, StopSign,
};

use super::network::{Connection, Edge, EdgeFunction, Junction, Network, NetworkLane};
use super::surfaces::{Beyond, Surfaces};
use crate::ReadReport;

/// Metres between points of lines at most: what looks at points only must find some.
const SPACING: f64 = 3.0;
/// Roads at least this fast without a stated type are grade-separated, metres per second
/// (90 km/h: streets with junctions are slower).
const FREEWAY_SPEED: f64 = 25.0;
/// Height of a stop sign, metres: a usual one.
const SIGN_HEIGHT: f64 = 2.0;

/// A converted network, from which maps of scenarios are cut.
#[derive(Debug)]
pub struct Roads {
    parts: MapParts,
    signals: BTreeMap<(String, usize), Vec<(LaneId, DVec2)>>,
    report: ReadReport,
}

impl Roads {
    /// Interprets a network. Lanes for pedestrians or rails only are dropped and counted.
    pub fn new(network: &Network) -> Self {
        let mut report = ReadReport::default();
        let draft = Draft::new(network, &mut report);
        let mut parts = MapParts {
            lanes: draft.lanes(network),
            ..MapParts::default()
        };
        draft.borders(network, &mut parts);
        draft.areas(network, &mut parts);
        draft.stop_signs(network, &mut parts);
        Self {
            signals: draft.signals(network),
            parts,
            report,
        }
    }

    /// The corners of the box around all lanes, metres; `None` for a network without any.
    pub(super) fn bounds(&self) -> Option<(DVec2, DVec2)> {
        let points = || {
            let lanes = self.parts.lanes.iter();
            lanes.flat_map(|lane| lane.centerline.points().iter().copied())
        };
        Some((points().reduce(DVec2::min)?, points().reduce(DVec2::max)?))
    }

    /// Items dropped in the conversion.
    pub fn report(&self) -> &ReadReport {
        &self.report
    }

    /// All of it.
    pub fn parts(&self) -> &MapParts {
        &self.parts
    }

    /// The lanes a signal controls with the point where vehicles stop for it.
    pub(super) fn controlled(&self, system: &str, index: usize) -> &[(LaneId, DVec2)] {
        let signal = self.signals.get(&(system.to_owned(), index));
        signal.map_or(&[], Vec::as_slice)
    }

    /// The features within `radius` metres of any point of `path`: lanes and areas whole, borders
    /// and paint cut to fit.
    pub(super) fn around(&self, path: &[DVec2], radius: f64) -> MapParts {
        let near = Near::new(path, radius);
        let all = &self.parts;
        MapParts {
            roadblocks: Vec::new(),
            lanes: pick(&all.lanes, |lane| near.touches(lane.centerline.points())),
            road_lines: all
                .road_lines
                .iter()
                .flat_map(|line| {
                    near.cut(&line.line).into_iter().map(|cut| RoadLine {
                        elevation: vec![line.elevation[0]; cut.points().len()],
                        line: cut,
                        ..*line
                    })
                })
                .collect(),
            road_edges: all
                .road_edges
                .iter()
                .flat_map(|edge| {
                    near.cut(&edge.line).into_iter().map(|cut| RoadEdge {
                        elevation: vec![edge.elevation[0]; cut.points().len()],
                        line: cut,
                        ..*edge
                    })
                })
                .collect(),
            areas: pick(&all.areas, |area| near.touches(area.polygon.ring())),
            stop_signs: pick(&all.stop_signs, |sign| {
                near.touches(&[sign.position.truncate()])
            }),
            drivable: pick(&all.drivable, |polygon| near.touches(polygon.ring())),
            unstated: all.unstated,
        }
    }
}

fn pick<T: Clone>(all: &[T], wanted: impl Fn(&T) -> bool) -> Vec<T> {
    all.iter().filter(|item| wanted(item)).cloned().collect()
}

/// The surroundings of a path.
struct Near<'a> {
    path: &'a [DVec2],
    radius: f64,
    min: DVec2,
    max: DVec2,
}

impl<'a> Near<'a> {
    fn new(path: &'a [DVec2], radius: f64) -> Self {
        let min = path.iter().copied().fold(DVec2::INFINITY, DVec2::min);
        let max = path.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
        let (min, max) = (min - radius, max + radius);
        Self {
            path,
            radius,
            min,
            max,
        }
    }

    fn segment(&self, a: DVec2, b: DVec2) -> bool {
        let apart = a.max(b).cmplt(self.min).any() || a.min(b).cmpgt(self.max).any();
        !apart
            && self
                .path
                .iter()
                .any(|&p| distance_to_segment(p, a, b) <= self.radius)
    }

    fn touches(&self, points: &[DVec2]) -> bool {
        match points {
            [only] => self.segment(*only, *only),
            _ => points.windows(2).any(|pair| self.segment(pair[0], pair[1])),
        }
    }

    /// The parts of a line that are near, in order.
    fn cut(&self, line: &Polyline) -> Vec<Polyline> {
        let mut cuts: Vec<Vec<DVec2>> = Vec::new();
        let mut was_near = false;
        for (a, b) in line.segments() {
            let is_near = self.segment(a, b);
            match cuts.last_mut() {
                Some(cut) if is_near && was_near => cut.push(b),
                _ if is_near => cuts.push(vec![a, b]),
                _ => {}
            }
            was_near = is_near;
        }
        cuts.into_iter().filter_map(Polyline::new).collect()
    }
}

/// The lanes that become lanes of the map, and what is needed to link them.
struct Draft<'a> {
    /// Edges with the lanes that vehicles may use, from right to left.
    kept: Vec<(&'a Edge, Vec<&'a NetworkLane>)>,
    ids: BTreeMap<&'a str, LaneId>,
    successors: BTreeMap<&'a str, BTreeSet<&'a str>>,
    predecessors: BTreeMap<&'a str, BTreeSet<&'a str>>,
    crossroads: BTreeSet<&'a str>,
}

impl<'a> Draft<'a> {
    fn new(network: &'a Network, report: &mut ReadReport) -> Self {
        let mut draft = Self {
            kept: Vec::new(),
            ids: BTreeMap::new(),
            successors: BTreeMap::new(),
            predecessors: BTreeMap::new(),
            crossroads: crossroads(network),
        };
        let drives = |lane: &&NetworkLane| lane.access.motor || lane.access.bicycles;
        for edge in &network.edges {
            let is_road = matches!(edge.function, EdgeFunction::Normal | EdgeFunction::Internal);
            let lanes: Vec<_> = if is_road {
                edge.lanes.iter().filter(drives).collect()
            } else {
                Vec::new()
            };
            match edge.function {
                EdgeFunction::WalkingArea | EdgeFunction::Crossing => {}
                _ => report.drop(
                    "lane for people or rails only",
                    edge.lanes.len() - lanes.len(),
                ),
            }
            for lane in &lanes {
                draft
                    .ids
                    .insert(&lane.id, LaneId(draft.ids.len() as i64 + 1));
            }
            if !lanes.is_empty() {
                draft.kept.push((edge, lanes));
            }
        }
        for connection in &network.connections {
            let (from, to) = (connection.from.as_str(), connection.to.as_str());
            draft.link(from, connection.via.as_deref().unwrap_or(to));
        }
        draft
    }

    fn link(&mut self, from: &'a str, to: &'a str) {
        if self.ids.contains_key(from) && self.ids.contains_key(to) {
            self.successors.entry(from).or_default().insert(to);
            self.predecessors.entry(to).or_default().insert(from);
        }
    }

    fn lanes(&self, network: &Network) -> Vec<Lane> {
        let by_name = network.lanes();
        let signalized = network.connections.iter().filter(|c| c.signal.is_some());
        let lit: BTreeSet<&str> = signalized.map(controlled_lane).collect();
        let mut lanes = Vec::new();
        for (edge, of_edge) in &self.kept {
            for (i, lane) in of_edge.iter().enumerate() {
                let (centerline, elevation) = dense(&lane.shape);
                let beside = |other: &&&NetworkLane| other.access.motor == lane.access.motor;
                let ids = |lanes: Vec<&&NetworkLane>| {
                    lanes
                        .into_iter()
                        .map(|lane| self.ids[lane.id.as_str()])
                        .collect()
                };
                let links = |links: &BTreeMap<&str, BTreeSet<&str>>| {
                    let names = links.get(lane.id.as_str()).into_iter().flatten();
                    names.map(|name| self.ids[name]).collect()
                };
                lanes.push(Lane {
                    kind: lane_kind(edge, lane),
                    width: lane.width,
                    speed_limit: Some(self.speed_limit(edge, lane, &by_name)),
                    in_intersection: edge.function == EdgeFunction::Internal
                        && self.crossroads.contains(junction_of(&edge.id)),
                    has_lights: Some(lit.contains(lane.id.as_str())),
                    predecessors: links(&self.predecessors),
                    successors: links(&self.successors),
                    left_neighbors: ids(of_edge[i + 1..].iter().filter(beside).collect()),
                    right_neighbors: ids(of_edge[..i].iter().rev().filter(beside).collect()),
                    ..Lane::new(self.ids[lane.id.as_str()], centerline, elevation)
                });
            }
        }
        lanes
    }

    /// Inside a junction SUMO states how fast a curve can be driven; the law is that of the road
    /// before it.
    fn speed_limit(
        &self,
        edge: &Edge,
        lane: &NetworkLane,
        by_name: &BTreeMap<&str, &NetworkLane>,
    ) -> f64 {
        let mut limit = lane.speed;
        let (mut name, mut internal) = (lane.id.as_str(), edge.function == EdgeFunction::Internal);
        // A way through a junction has two or three parts at most.
        for _ in 0..3 {
            let before = self.predecessors.get(name).and_then(|names| names.first());
            let Some(before) = before.filter(|_| internal) else {
                break;
            };
            (name, internal) = (before, before.starts_with(':'));
            limit = by_name[name].speed;
        }
        limit
    }

    /// Surfaces, road edges and road lines.
    fn borders(&self, network: &Network, parts: &mut MapParts) {
        let mut polygons = Vec::new();
        let mut sides: Vec<(Polyline, usize, bool)> = Vec::new();
        let mut dividers = Vec::new();
        for (edge, lanes) in &self.kept {
            for (i, lane) in lanes.iter().enumerate() {
                let line = plan_line(&lane.shape);
                let Some(polygon) = line.ribbon(lane.width) else {
                    continue;
                };
                let own = polygons.len();
                polygons.push(polygon);
                if edge.function == EdgeFunction::Internal {
                    continue;
                }
                let half = lane.width / 2.0;
                if i == 0 {
                    sides.push((line.offset(-half), own, false));
                }
                match lanes.get(i + 1) {
                    None => sides.push((reversed(&line.offset(half)), own, true)),
                    Some(left) => {
                        let mixed = left.access.motor != lane.access.motor;
                        dividers.push((line.offset(half), mixed));
                    }
                }
            }
        }
        let n_lanes = polygons.len();
        // Where the network ends the road does not: traffic comes and goes there, and an edge
        // across would put it off the road.
        let joined = |junction: &&Junction| junction.kind != "dead_end";
        for junction in network.junctions.iter().filter(joined) {
            if let Some(ring) = self.carriageway(network, junction) {
                let mut closed = ring.ring().to_vec();
                closed.push(closed[0]);
                let own = polygons.len();
                polygons.push(ring);
                sides.extend(Polyline::new(closed).map(|line| (line, own, false)));
            }
        }
        let surfaces = Surfaces::new(polygons);
        let mut id = self.ids.len() as i64;
        for (line, own, is_middle) in &sides {
            for (beyond, stretch) in surfaces.stretches(line, *own) {
                match beyond {
                    Beyond::Nothing => {
                        id += 1;
                        let (line, elevation) = flat(&stretch);
                        let kind = RoadEdgeKind::Boundary;
                        parts.road_edges.push(RoadEdge {
                            id,
                            kind,
                            line,
                            elevation,
                        });
                    }
                    // Both directions see the line between them; the first one paints it.
                    Beyond::Surface(other) if *is_middle && *own < other && other < n_lanes => {
                        id += 1;
                        parts.road_lines.push(paint(
                            id,
                            RoadLineKind::SolidDoubleYellow,
                            &reversed(&stretch),
                        ));
                    }
                    Beyond::Surface(_) => {}
                }
            }
        }
        for (line, mixed) in &dividers {
            id += 1;
            let kind = if *mixed {
                RoadLineKind::SolidSingleWhite
            } else {
                RoadLineKind::BrokenSingleWhite
            };
            parts.road_lines.push(paint(id, kind, line));
        }
        parts.drivable = surfaces.into_polygons();
    }

    /// The area of a junction that vehicles use, counter-clockwise.
    ///
    /// A junction's own shape includes the corners where people walk. Where there are any, the
    /// ends of the carriageways are joined instead.
    fn carriageway(&self, network: &Network, junction: &Junction) -> Option<Polygon> {
        let shape = || {
            junction
                .shape
                .iter()
                .map(|p| dvec2(p[0], p[1]))
                .collect::<Vec<_>>()
        };
        let walked = format!(":{}_w", junction.id);
        let has_walkers = network
            .edges
            .iter()
            .any(|edge| edge.function == EdgeFunction::WalkingArea && edge.id.starts_with(&walked));
        let mut ring = if has_walkers {
            self.ends(&junction.id)
        } else {
            shape()
        };
        if has_walkers && ring.len() >= 3 {
            let middle = ring.iter().copied().sum::<DVec2>() / ring.len() as f64;
            ring.sort_by(|a, b| {
                (*a - middle)
                    .to_angle()
                    .total_cmp(&(*b - middle).to_angle())
            });
        }
        let polygon = Polygon::new(ring)?;
        if polygon.signed_area() < 0.0 {
            return Polygon::new(polygon.ring().iter().rev().copied().collect());
        }
        Some(polygon)
    }

    /// The outer corners of all carriageways at a junction.
    fn ends(&self, junction: &str) -> Vec<DVec2> {
        let mut corners = Vec::new();
        let roads = self
            .kept
            .iter()
            .filter(|(e, _)| e.function == EdgeFunction::Normal);
        for (edge, lanes) in roads {
            let (Some(right), Some(left)) = (lanes.first(), lanes.last()) else {
                continue;
            };
            for (lane, side) in [(right, -0.5), (left, 0.5)] {
                let border = plan_line(&lane.shape).offset(side * lane.width);
                let points = border.points();
                corners.extend((edge.from == junction).then(|| points[0]));
                corners.extend((edge.to == junction).then(|| points[points.len() - 1]));
            }
        }
        corners
    }

    fn areas(&self, network: &Network, parts: &mut MapParts) {
        let mut id = 1_000_000;
        let mut add = |kind, polygon: Polygon| {
            id += 1;
            parts.areas.push(Area::new(id, kind, polygon));
        };
        let crossings = network
            .edges
            .iter()
            .filter(|e| e.function == EdgeFunction::Crossing);
        for lane in crossings.flat_map(|edge| &edge.lanes) {
            if let Some(polygon) = plan_line(&lane.shape).ribbon(lane.width) {
                add(AreaKind::Crosswalk, polygon);
            }
        }
        let walked = |e: &&Edge| e.function == EdgeFunction::WalkingArea;
        for lane in network.edges.iter().filter(walked).flat_map(|e| &e.lanes) {
            // The shape of a walking area is its border.
            if let Some(polygon) = Polygon::new(plan_line(&lane.shape).points().to_vec()) {
                add(AreaKind::Walkway, polygon);
            }
        }
        for junction in &network.junctions {
            if self.crossroads.contains(junction.id.as_str())
                && let Some(polygon) = self.carriageway(network, junction)
            {
                add(AreaKind::Intersection, polygon);
            }
        }
    }

    fn stop_signs(&self, network: &Network, parts: &mut MapParts) {
        let by_name = network.lanes();
        let stops = |state| matches!(state, 's' | 'w');
        let lanes: BTreeSet<&str> = network
            .connections
            .iter()
            .filter(|c| stops(c.state) && c.signal.is_none() && self.ids.contains_key(&*c.from))
            .map(|c| c.from.as_str())
            .collect();
        for (i, name) in lanes.into_iter().enumerate() {
            let lane = by_name[name];
            if let (true, Some([x, y, z])) = (lane.access.motor, lane.shape.last()) {
                parts.stop_signs.push(StopSign {
                    id: 2_000_000 + i as i64,
                    position: DVec3::new(*x, *y, z + SIGN_HEIGHT),
                    lanes: vec![self.ids[name]],
                });
            }
        }
    }

    /// The lanes that signals control: inside the junction where there are such, as in Waymo's
    /// data, else the lane before it.
    fn signals(&self, network: &Network) -> BTreeMap<(String, usize), Vec<(LaneId, DVec2)>> {
        let by_name = network.lanes();
        let mut signals: BTreeMap<_, Vec<_>> = BTreeMap::new();
        for connection in &network.connections {
            let Some(signal) = &connection.signal else {
                continue;
            };
            let lane = controlled_lane(connection);
            let stop = by_name
                .get(&*connection.from)
                .and_then(|lane| lane.shape.last());
            if let (Some(id), Some([x, y, _])) = (self.ids.get(lane), stop) {
                let controlled = signals.entry(signal.clone()).or_default();
                controlled.push((*id, dvec2(*x, *y)));
            }
        }
        signals
    }
}

/// The lane that a connection's signal controls.
fn controlled_lane(connection: &Connection) -> &str {
    connection.via.as_deref().unwrap_or(&connection.from)
}

/// Junctions where roads of at least three directions meet; others only join two roads.
fn crossroads(network: &Network) -> BTreeSet<&str> {
    let mut neighbors: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for edge in &network.edges {
        let drives = edge.lanes.iter().any(|lane| lane.access.motor);
        if edge.function == EdgeFunction::Normal && drives {
            neighbors.entry(&edge.from).or_default().insert(&edge.to);
            neighbors.entry(&edge.to).or_default().insert(&edge.from);
        }
    }
    let many = neighbors
        .into_iter()
        .filter(|(_, others)| others.len() >= 3);
    many.map(|(junction, _)| junction).collect()
}

/// The junction an internal edge lies in: `:J_3` is in `J`.
fn junction_of(internal: &str) -> &str {
    let name = internal.strip_prefix(':').unwrap_or(internal);
    name.rsplit_once('_').map_or(name, |(junction, _)| junction)
}

fn lane_kind(edge: &Edge, lane: &NetworkLane) -> LaneKind {
    let fast = edge.kind.is_empty() && lane.speed >= FREEWAY_SPEED;
    if !lane.access.motor {
        LaneKind::BikeLane
    } else if edge.kind.contains("motorway") || fast {
        LaneKind::Freeway
    } else {
        LaneKind::SurfaceStreet
    }
}

fn plan_line(shape: &[[f64; 3]]) -> Polyline {
    let points = shape.iter().map(|p| dvec2(p[0], p[1])).collect();
    Polyline::new(points).expect("a lane's shape has at least two points")
}

/// A line with points no further apart than [`SPACING`], and their elevations.
fn dense(shape: &[[f64; 3]]) -> (Polyline, Vec<f64>) {
    let mut points = vec![shape[0]];
    for pair in shape.windows(2) {
        let [a, b] = [DVec3::from_array(pair[0]), DVec3::from_array(pair[1])];
        let n = (a.distance(b) / SPACING).ceil().max(1.0) as usize;
        points.extend((1..=n).map(|i| a.lerp(b, i as f64 / n as f64).to_array()));
    }
    (plan_line(&points), points.iter().map(|p| p[2]).collect())
}

/// A line on the ground of a flat network, with points that are neither many nor far apart.
fn flat(line: &Polyline) -> (Polyline, Vec<f64>) {
    let kept = simplify(line.points(), 0.03);
    let corners: Vec<_> = kept
        .iter()
        .map(|&i| [line.points()[i].x, line.points()[i].y, 0.0])
        .collect();
    dense(&corners)
}

fn paint(id: i64, kind: RoadLineKind, line: &Polyline) -> RoadLine {
    let (line, elevation) = flat(line);
    RoadLine {
        id,
        kind,
        line,
        elevation,
    }
}

fn reversed(line: &Polyline) -> Polyline {
    Polyline::new(line.points().iter().rev().copied().collect()).expect("as many points as before")
}
