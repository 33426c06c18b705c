//! The graph of the relative network: agents at frames as nodes, and edges to what each of them
//! attends to.
//!
//! A node is an agent at one frame. Its edges lead to its own past, to its nearest neighbours at
//! that frame and to pieces of the map; the numbers of an edge are in the frame of the node.
//! Training and rollouts build nodes and edges with this module, so that both use the same inputs.

use gump_geometry::{DVec2, Pose};
use gump_scene::{AgentKind, LightState};
use gump_tokenizer::class_index;

use crate::relative::grid::STILL_M;
use crate::relative::map::{PATHS, PieceKind, VectorMap};
use crate::relative::route::Route;
use crate::steps::TOKEN_DT;

// How much a node sees was chosen by hand, with the time of a frame in mind, and not varied except
// where it says so; weights are trained with it and need the same values. The divisors of all
// numbers below are typical values, chosen by hand, so that inputs stay within a few units.

/// Numbers of a node.
pub const NODE_NUMBERS: usize = 28;
/// Numbers of an edge.
pub const EDGE_NUMBERS: usize = 46;

/// Number of past frames of the agent that a node attends to, besides itself: 3 s.
pub const PAST: usize = 6;
/// Number of neighbours of a node: the nearest ones now and soon. Twenty did not help (result 25).
const NEIGHBOURS: usize = 16;
/// Time ahead that counts as soon, seconds.
const SOON_S: f64 = 2.0;
/// Maximum distance of a neighbour, metres. 140 m for oncoming ones did not help (result 25).
const NEIGHBOUR_REACH_M: f64 = 60.0;
/// Number of lane pieces beside the paths ahead, the nearest ones.
const LANES: usize = 10;
/// Number of road edge pieces, the nearest ones.
const EDGES: usize = 8;
/// Number of areas, the nearest ones.
const AREAS: usize = 4;
/// Maximum distance of those, metres.
const MAP_REACH_M: f64 = 40.0;

/// Constant properties of an agent.
#[derive(Clone, Copy, Debug)]
pub struct Body {
    /// Its kind.
    pub kind: AgentKind,
    /// Metres.
    pub length: f64,
    /// Metres.
    pub width: f64,
    /// False marks the size as unknown.
    pub sized: bool,
}

/// An agent at a frame, as input of the network.
#[derive(Clone, Copy, Debug)]
pub struct Shown {
    /// Its class and size.
    pub body: Body,
    /// Its pose, world frame.
    pub pose: Pose,
    /// Motion in the last half second: this pose in the frame of the previous one; from the stated
    /// velocity for an agent not seen before.
    pub(super) step: Pose,
    /// The same for the half second before that, if it was observed.
    pub(super) earlier: Option<Pose>,
    /// Whether `step` was observed.
    pub(super) tracked: bool,
    /// Time that it has stood, seconds.
    pub(super) stood: f64,
}

impl Shown {
    /// The known standing time, seconds.
    pub fn stood(&self) -> f64 {
        self.stood
    }

    /// The same agent with a limited standing time, seconds.
    #[must_use]
    pub fn stood_at_most(self, seconds: f64) -> Self {
        Self {
            stood: self.stood.min(seconds),
            ..self
        }
    }

    /// An agent in its first frame, with its stated velocity.
    pub fn first(body: Body, pose: Pose, velocity: DVec2) -> Self {
        let local = pose.inverse().rotate(velocity) * TOKEN_DT;
        Self {
            body,
            pose,
            step: still_or(Pose {
                position: local,
                heading: 0.0,
            }),
            earlier: None,
            tracked: false,
            stood: 0.0,
        }
    }

    /// The same agent half a second later.
    pub fn then(&self, pose: Pose) -> Self {
        let step = still_or(self.pose.inverse() * pose);
        let stands = step.position == DVec2::ZERO;
        Self {
            body: self.body,
            pose,
            step,
            earlier: Some(self.step).filter(|_| self.tracked),
            tracked: true,
            stood: if stands { self.stood + TOKEN_DT } else { 0.0 },
        }
    }

    /// World frame, metres per second: the mean over the last half second.
    pub fn velocity(&self) -> DVec2 {
        // The step is in the frame of its start, whose heading is the present one less the turn.
        let began = self.pose.heading - self.step.heading;
        DVec2::from_angle(began).rotate(self.step.position) / TOKEN_DT
    }

    /// Change of its speed, metres per second squared; 0 where too little was observed.
    pub fn acceleration(&self) -> f64 {
        let faster = |earlier: Pose| self.step.position.length() - earlier.position.length();
        self.earlier.map_or(0.0, faster) / (TOKEN_DT * TOKEN_DT)
    }

    fn stands(&self) -> bool {
        self.step.position == DVec2::ZERO
    }

    /// The numbers of its node.
    pub fn numbers(&self) -> [f32; NODE_NUMBERS] {
        let mut out = [0.0; NODE_NUMBERS];
        let mut writer = Writer(&mut out);
        let body = self.body;
        let class = class_index(body.kind);
        writer.put((0..3).map(|i| mark(class == i)));
        writer.put([
            mark(!body.sized),
            if body.sized { body.length / 5.0 } else { 0.0 },
            if body.sized { body.width / 2.0 } else { 0.0 },
        ]);
        writer.put([mark(self.tracked), mark(self.stands())]);
        put_step(&mut writer, self.step);
        writer.put([mark(self.earlier.is_some())]);
        let earlier = self.earlier.unwrap_or(Pose::IDENTITY);
        put_step(&mut writer, earlier);
        let faster = self.step.position.x - earlier.position.x;
        let change = if self.earlier.is_some() { faster } else { 0.0 };
        writer.put([
            change,
            bend(change * 5.0),
            (self.stood / 5.0).min(2.0),
            bend(self.stood),
            self.velocity().length() / 10.0,
        ]);
        out
    }
}

/// A step within jitter counts as none.
fn still_or(step: Pose) -> Pose {
    match step.position.length() < STILL_M {
        true => Pose::IDENTITY,
        false => step,
    }
}

fn put_step(writer: &mut Writer<'_>, step: Pose) {
    let p = step.position;
    writer.put([
        p.x / 5.0,
        bend(p.x / 0.5),
        p.y,
        bend(p.y * 10.0),
        step.heading * 2.0,
        bend(step.heading * 20.0),
        bend(step.heading * 100.0),
    ]);
}

/// The lights of a frame, by piece of the map, and how long they have shown their colour.
#[derive(Clone, Debug, Default)]
pub struct Lights {
    /// Sorted by lane: the colour, and seconds since it changed where that was observed.
    pub by_lane: Vec<(gump_scene::LaneId, LightState, Option<f64>)>,
}

impl Lights {
    /// The colour of the light of a lane, if it has one.
    pub fn colour(&self, lane: gump_scene::LaneId) -> Option<LightState> {
        Some(self.of(Some(lane))?.0)
    }

    fn of(&self, lane: Option<gump_scene::LaneId>) -> Option<(LightState, Option<f64>)> {
        let lane = lane?;
        let at = self.by_lane.binary_search_by_key(&lane, |light| light.0);
        at.ok().map(|i| (self.by_lane[i].1, self.by_lane[i].2))
    }
}

/// The numbers of an edge.
pub(super) type EdgeRow = [f32; EDGE_NUMBERS];

/// Relative pose, in numbers with high resolution near zero.
const RELATIVE: usize = 10;
/// Marks of the kind of an edge.
const KINDS: usize = 5;
const OF_PAST: usize = KINDS + RELATIVE;
const OF_NEIGHBOUR: usize = OF_PAST + 1;
const OF_PATH: usize = OF_NEIGHBOUR + 12;
const OF_LANE: usize = OF_PATH + 6;
/// Marks of green, yellow, red and unknown.
const OF_LIGHT: usize = OF_LANE + 3;
const OF_GAP: usize = OF_LANE + 10;
/// The time at which the predicted gap to a neighbour is evaluated, with constant velocities,
/// seconds: up to [`SOON_S`], as rules look 1.5 s ahead.
const GAPS_S: [f64; 4] = [0.5, 1.0, 1.5, 2.0];

/// A place and a direction, whose sine and cosine are taken once for many edges.
#[derive(Clone, Copy, Debug)]
pub(super) struct Axes {
    pub(super) origin: DVec2,
    pub(super) direction: DVec2,
}

impl Axes {
    pub(super) fn of(pose: Pose) -> Self {
        Self {
            origin: pose.position,
            direction: pose.direction(),
        }
    }

    /// A vector along these axes.
    pub(super) fn turn(self, vector: DVec2) -> DVec2 {
        let (ahead, left) = (self.direction.dot(vector), self.direction.perp_dot(vector));
        DVec2::new(ahead, left)
    }

    /// A point in these axes.
    pub(super) fn see(self, point: DVec2) -> DVec2 {
        self.turn(point - self.origin)
    }
}

/// An edge of this kind to something at `to`, from `from`.
fn relative(kind: usize, from: Axes, to: Axes) -> EdgeRow {
    let mut out = [0.0; EDGE_NUMBERS];
    out[kind] = 1.0;
    let (p, direction) = (from.see(to.origin), from.turn(to.direction));
    let away = p.length();
    // Fine where directions are nearly equal; the same at both ends of a turn of half a circle.
    let bent = 10.0 * direction.y;
    let near = fast_exp(-away / 12.0);
    Writer(&mut out[KINDS..]).put([
        p.x / 30.0,
        p.y / 30.0,
        bend(p.x / 6.0),
        bend(p.y / 2.0),
        direction.x,
        direction.y,
        bend(bent),
        away / 30.0,
        near * near * near * near,
        near,
    ]);
    out
}

/// From -1 to 1, steep around 0.
fn bend(x: f64) -> f64 {
    x / (1.0 + x.abs())
}

/// e to a number that is not above 0.
fn fast_exp(x: f64) -> f64 {
    f64::from((x as f32).exp())
}

/// The edge to the node's own state `ago` frames before; 0 is the node itself.
pub fn past_edge(now: &Shown, then: &Shown, ago: usize) -> EdgeRow {
    let mut out = relative(0, Axes::of(now.pose), Axes::of(then.pose));
    out[OF_PAST] = ago as f32 / PAST as f32;
    out
}

/// Edges of a node besides those to its past.
#[derive(Debug, Default)]
pub struct View {
    /// Index among the agents of the frame.
    pub neighbours: Vec<(usize, EdgeRow)>,
    /// Indices of pieces of the map, with their edges.
    pub pieces: Vec<(u32, EdgeRow)>,
}

// The limits of a free road were chosen by hand. On recorded/tune, from the first step on, vehicles
// stop on a free road 0.038 times a minute with them, 0.041 times with 2 and 4 s and no gap, 0.060
// times with 4 and 6 s and 1 m.

/// Agents on the paths ahead within this and as many seconds are reasons to slow down, ...
const ROOM_M: f64 = 10.0;
const HEADWAY_S: f64 = 3.0;
/// ... lights that are not green within this many seconds, ...
const LIGHT_S: f64 = 5.0;
/// ... and agents whose gap falls below this within [`SOON_S`], metres.
const GAP_M: f64 = 0.5;

impl View {
    /// Whether an agent moves and sees nothing to slow down for: no agent on the paths ahead or
    /// about to come near, and no light that is not green. Bends and the end of the road do not
    /// count.
    pub fn is_free(&self, own: &Shown) -> bool {
        !own.stands() && self.has_room(own)
    }

    /// The same of an agent that may stand: whether it has room to drive on.
    pub fn has_room(&self, own: &Shown) -> bool {
        let speed = own.velocity().length();
        let away = |row: &EdgeRow| 30.0 * f64::from(row[OF_PATH + 3]);
        let is_on_path = |row: &EdgeRow| row[OF_PATH..][..PATHS].iter().any(|on| *on > 0.0);
        let holds = |(_, row): &(usize, EdgeRow)| {
            let is_near = f64::from(row[OF_GAP + 1]) < bend(GAP_M / 0.5);
            is_near || is_on_path(row) && away(row) < ROOM_M + HEADWAY_S * speed
        };
        let shuts = |(_, row): &(u32, EdgeRow)| {
            let is_shut = row[OF_LIGHT + 1] + row[OF_LIGHT + 2] > 0.0;
            is_shut && is_on_path(row) && away(row) < ROOM_M + LIGHT_S * speed
        };
        !self.neighbours.iter().any(holds) && !self.pieces.iter().any(shuts)
    }
}

/// The edges of agent `i` of those of a frame. With a route there is one path ahead, along it.
pub fn look(
    map: &VectorMap,
    lights: &Lights,
    agents: &[Shown],
    i: usize,
    route: Option<&Route>,
) -> View {
    let own = &agents[i];
    let mut view = View::default();
    let possible = match own.body.kind {
        AgentKind::Pedestrian => Vec::new(),
        _ => map.paths(own.pose),
    };
    // A route is the only path ahead, and the lanes of the others are out of view.
    let (paths, passed_by) = match route {
        Some(route) => (vec![route.path(map, own.pose)], possible.concat()),
        None => (possible, Vec::new()),
    };
    neighbours(map, agents, i, &paths, &mut view);
    pieces(map, lights, own, (&paths, &passed_by), &mut view);
    view
}

type Paths = [Vec<(u32, f64)>];

fn neighbours(map: &VectorMap, agents: &[Shown], i: usize, paths: &Paths, view: &mut View) {
    let own = &agents[i];
    let (from, own_velocity) = (Axes::of(own.pose), own.velocity());
    // A few of a row of parked cars suffice.
    let others = agents.iter().enumerate().filter(|(j, _)| *j != i);
    let mut near: Vec<(f64, usize)> = others
        .filter_map(|(j, other)| Some((distance_to_soon(own, other)?, j)))
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    near.truncate(NEIGHBOURS);
    view.neighbours.reserve(near.len());
    for (_, j) in near {
        let other = &agents[j];
        let mut row = relative(1, from, Axes::of(other.pose));
        let place = from.see(other.pose.position);
        let velocity = from.turn(other.velocity() - own_velocity);
        let (body, class) = (other.body, class_index(other.body.kind));
        // When they are nearest if both keep their velocities, and how near.
        let speed = velocity.length_squared();
        let soon = match speed > 0.01 {
            true => (-place.dot(velocity) / speed).clamp(0.0, 8.0),
            false => 0.0,
        };
        let nearest = (place + velocity * soon).length();
        let ahead = place.x.abs() - 0.5 * (own.body.length + body.length);
        let aside = place.y.abs() - 0.5 * (own.body.width + body.width);
        Writer(&mut row[OF_NEIGHBOUR..]).put([
            velocity.x / 10.0,
            velocity.y / 5.0,
            body.length / 5.0,
            body.width / 2.0,
            mark(class == 1),
            mark(class == 2),
            mark(other.stands()),
            bend(ahead / 3.0),
            bend(aside),
            fast_exp(-soon / 2.0),
            bend(nearest / 2.0),
            mark(other.tracked),
        ]);
        let direction = from.turn(other.pose.direction());
        let gap = |seconds: f64| gap(own.body, body, place + velocity * seconds, direction);
        let soon = GAPS_S.map(gap).into_iter().fold(f64::INFINITY, f64::min);
        Writer(&mut row[OF_GAP..]).put([bend(gap(0.0) / 0.5), bend(soon / 0.5)]);
        on_paths(map, other, paths, &mut row);
        view.neighbours.push((j, row));
    }
}

/// Metres between the boxes of an agent and of another one at `place`, which faces `direction`, both
/// seen from the first: along the axis on which they are farthest apart; below 0 if they overlap.
fn gap(own: Body, other: Body, place: DVec2, direction: DVec2) -> f64 {
    let half = |body: Body| 0.5 * DVec2::new(body.length, body.width);
    let (mine, theirs, turn) = (half(own), half(other), direction.abs());
    // How far a box reaches along the axes of the other.
    let reach = |half: DVec2| DVec2::new(half.dot(turn), half.y * turn.x + half.x * turn.y);
    let seen = DVec2::new(direction.dot(place), direction.perp_dot(place));
    let here = place.abs() - mine - reach(theirs);
    let there = seen.abs() - theirs - reach(mine);
    here.max(there).max_element()
}

/// How far away another agent is now and soon, metres, if it is near enough to be a neighbour; approaching
/// agents count as nearer.
fn distance_to_soon(own: &Shown, other: &Shown) -> Option<f64> {
    let place = other.pose.position - own.pose.position;
    let away = place.length();
    let soon = place + (other.velocity() - own.velocity()) * SOON_S;
    (away < NEIGHBOUR_REACH_M).then(|| away + soon.length())
}

/// Whether agent `i` of those of a frame would have one of `others`, too, as a neighbour if it were shown.
pub(super) fn misses_any(agents: &[Shown], i: usize, others: &[Shown]) -> bool {
    let own = &agents[i];
    let nearest = |other: &Shown| distance_to_soon(own, other);
    let Some(missed) = others.iter().filter_map(nearest).min_by(f64::total_cmp) else {
        return false;
    };
    let shown = agents.iter().enumerate().filter(|(j, _)| *j != i);
    let nearer = shown.filter_map(|(_, other)| nearest(other));
    nearer.filter(|away| *away < missed).count() < NEIGHBOURS
}

/// Marks the paths that an agent is on, and how far ahead.
fn on_paths(map: &VectorMap, other: &Shown, paths: &Paths, row: &mut EdgeRow) {
    for (k, path) in paths.iter().enumerate().take(PATHS) {
        let at = path.iter().find_map(|&(i, away)| {
            let piece = &map.pieces[i as usize];
            let local = piece.axes.see(other.pose.position);
            // A piece is 8 m long, so this is not on it; the exact offset takes longer.
            if local.x.abs() > 6.0 || local.y.abs() > 8.0 {
                return None;
            }
            let (distance, _) = piece.offset(other.pose.position);
            // Its side is within 1.2 m of the line: about half of a car. Chosen by hand.
            (distance < 0.5 * other.body.width + 1.2).then_some(away + local.x)
        });
        if let Some(away) = at.filter(|away| *away > 0.0) {
            row[OF_PATH + k] = 1.0;
            row[OF_PATH + 3] = (away / 30.0) as f32;
            row[OF_PATH + 4] = bend(away / 6.0) as f32;
        }
    }
}

/// Pieces on the paths ahead and the nearest others but those passed by.
fn pieces(
    map: &VectorMap,
    lights: &Lights,
    own: &Shown,
    (paths, passed_by): (&Paths, &[(u32, f64)]),
    view: &mut View,
) {
    let axes = Axes::of(own.pose);
    // Of a piece on several paths the first distance, which all share.
    let mut ahead: Vec<(u32, f64, [bool; PATHS])> = Vec::new();
    for (k, path) in paths.iter().enumerate().take(PATHS) {
        for &(piece, away) in path {
            match ahead.iter_mut().find(|known| known.0 == piece) {
                Some(known) => known.2[k] = true,
                None => ahead.push((piece, away, std::array::from_fn(|i| i == k))),
            }
        }
    }
    view.pieces.reserve(ahead.len() + LANES + EDGES + AREAS);
    for &(i, away, on) in &ahead {
        let mut row = map_edge(map, lights, axes, i);
        for (k, on) in on.into_iter().enumerate() {
            row[OF_PATH + k] = f32::from(u8::from(on));
        }
        row[OF_PATH + 3] = (away / 30.0) as f32;
        row[OF_PATH + 4] = bend(away / 6.0) as f32;
        row[OF_PATH + 5] = 1.0;
        view.pieces.push((i, row));
    }
    let from = own.pose.position;
    let mut near: [Vec<(f64, u32)>; 3] = Default::default();
    for i in map.near(from, MAP_REACH_M) {
        let is_known = ahead.iter().any(|known| known.0 == i);
        if is_known || passed_by.iter().any(|passed| passed.0 == i) {
            continue;
        }
        let piece = &map.pieces[i as usize];
        let end = |k: usize| piece.line[k].distance_squared(from);
        let away = end(0).min(end(2)).min(end(4));
        if away < MAP_REACH_M * MAP_REACH_M {
            let kind = match piece.kind {
                PieceKind::Lane => 0,
                PieceKind::Edge => 1,
                PieceKind::Area => 2,
            };
            near[kind].push((away, i));
        }
    }
    for (near, most) in near.iter_mut().zip([LANES, EDGES, AREAS]) {
        if near.len() > most {
            near.select_nth_unstable_by(most, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            near.truncate(most);
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for &(_, i) in near.iter() {
            view.pieces.push((i, map_edge(map, lights, axes, i)));
        }
    }
}

fn map_edge(map: &VectorMap, lights: &Lights, from: Axes, i: u32) -> EdgeRow {
    let piece = &map.pieces[i as usize];
    let kind = match piece.kind {
        PieceKind::Lane => 2,
        PieceKind::Edge => 3,
        PieceKind::Area => 4,
    };
    let mut row = relative(kind, from, piece.axes);
    let (distance, left) = piece.offset(from.origin);
    let (light, elapsed) = match lights.of(piece.lane) {
        Some((state, elapsed)) => (Some(state), elapsed),
        None => (None, None),
    };
    Writer(&mut row[OF_LANE..]).put([
        bend(distance / 3.0),
        bend(left),
        bend(left * 4.0),
        mark(light == Some(LightState::Green)),
        mark(light == Some(LightState::Yellow)),
        mark(light == Some(LightState::Red)),
        mark(light == Some(LightState::Unknown)),
        elapsed.map_or(0.0, |s| bend(s / 8.0)),
        mark(light.is_some() && elapsed.is_none()),
        mark(piece.starts_lane),
    ]);
    row
}

fn mark(is: bool) -> f64 {
    f64::from(u8::from(is))
}

/// Writes numbers one after another, held within a few units of zero.
struct Writer<'a>(&'a mut [f32]);

impl Writer<'_> {
    fn put(&mut self, numbers: impl IntoIterator<Item = f64>) {
        for number in numbers {
            let (first, rest) = std::mem::take(&mut self.0).split_at_mut(1);
            first[0] = number.clamp(-6.0, 6.0) as f32;
            self.0 = rest;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relative::route::Traveller;

    const CAR: Body = Body {
        kind: AgentKind::Vehicle,
        length: 4.5,
        width: 2.0,
        sized: true,
    };

    #[test]
    fn what_is_seen_does_not_depend_on_the_place() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 100,0 speed 15 next 2
             lane 2: 100,0 180,30
             ego vehicle 0: 10,0 velocity 8,0",
        )
        .unwrap();
        let turned = |pose: Pose| {
            let line = |points: &gump_geometry::Polyline| {
                let moved = points.points().iter().map(|&p| pose * p).collect();
                gump_geometry::Polyline::new(moved).unwrap()
            };
            let mut parts = scenario.map.parts().clone();
            for lane in &mut parts.lanes {
                lane.centerline = line(&lane.centerline);
            }
            let map = gump_scene::MapGraph::new(parts).unwrap();
            let map = VectorMap::new(&map, pose.position, 300.0, Default::default());
            let agents = [(10.0, 0.4), (40.0, 0.0), (55.0, -1.0)].map(|(x, y)| {
                let was = Shown::first(CAR, pose * Pose::new(x, y, 0.05), pose.rotate(DVec2::X));
                was.then(pose * Pose::new(x + 2.0, y, 0.0))
            });
            let view = look(&map, &Lights::default(), &agents, 0, None);
            (agents[0].numbers(), view)
        };
        let (own, here) = turned(Pose::IDENTITY);
        let (own_there, there) = turned(Pose::new(4000.0, -700.0, 2.0));
        let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4);
        assert!(close(&own, &own_there), "{own:?} {own_there:?}");
        assert_eq!(
            (here.neighbours.len(), here.pieces.len()),
            (2, there.pieces.len())
        );
        assert!(here.pieces.len() > 8, "{}", here.pieces.len());
        for (a, b) in here.neighbours.iter().zip(&there.neighbours) {
            assert!(close(&a.1, &b.1), "{:?} {:?}", a.1, b.1);
        }
        for (a, b) in here.pieces.iter().zip(&there.pieces) {
            assert!(close(&a.1, &b.1), "{:?} {:?}", a.1, b.1);
        }
        // The car 30 m ahead in the lane is on the path.
        assert_eq!(here.neighbours[0].1[OF_PATH], 1.0);
    }

    #[test]
    fn a_route_is_the_only_path_ahead() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 60,0 speed 15 next 2,3
             lane 2: 60,0 140,0
             lane 3: 60,0 68,-2 70,-10 70,-80
             ego vehicle 0: 40,0 velocity 8,0",
        )
        .unwrap();
        let map = VectorMap::new(&scenario.map, DVec2::ZERO, 300.0, Default::default());
        let pose = Pose::new(40.0, 0.0, 0.0);
        let car = Shown::first(CAR, pose, DVec2::new(8.0, 0.0));
        let lanes = |route: Option<&Route>| {
            let view = look(&map, &Lights::default(), &[car], 0, route);
            let lane = |(i, row): &(u32, EdgeRow)| {
                let is_ahead = row[OF_PATH..][..PATHS].iter().any(|on| *on > 0.0);
                (map.pieces[*i as usize].lane.map(|lane| lane.0), is_ahead)
            };
            let lanes = view.pieces.iter().map(lane);
            lanes.collect::<std::collections::BTreeSet<_>>()
        };
        let without = lanes(None);
        assert!(
            [1, 2, 3]
                .iter()
                .all(|lane| without.contains(&(Some(*lane), true)))
        );
        for seed in (0..8).map(gump_scene::Seed) {
            let speed = 8.0;
            let route = Route::from_here(
                &scenario.map,
                Traveller {
                    pose,
                    speed,
                    seed,
                    remains: false,
                },
            )
            .unwrap();
            let (on, off) = match route.lanes()[1].0 {
                2 => (2, 3),
                _ => (3, 2),
            };
            let seen = lanes(Some(&route));
            assert!(seen.contains(&(Some(1), true)) && seen.contains(&(Some(on), true)));
            assert!(seen.iter().all(|(lane, _)| *lane != Some(off)), "{seen:?}");
        }
    }

    #[test]
    fn gaps_are_those_between_boxes() {
        let beside = |x, y, turn: f64| gap(CAR, CAR, DVec2::new(x, y), DVec2::from_angle(turn));
        assert!((beside(6.0, 0.3, 0.0) - 1.5).abs() < 1e-9);
        assert!((beside(0.5, -3.0, std::f64::consts::PI) - 1.0).abs() < 1e-9);
        // Across the lane, the extent of a box is its length.
        assert!((beside(1.0, 4.0, std::f64::consts::FRAC_PI_2) - 0.75).abs() < 1e-9);
        for (x, y, turn) in [(3.0, 1.0, 0.4), (4.6, 1.9, 0.8), (-4.0, 2.6, 2.3)] {
            let shape = |pose| gump_geometry::OrientedBox {
                pose,
                length: CAR.length,
                width: CAR.width,
            };
            let touch = shape(Pose::IDENTITY).overlaps(&shape(Pose::new(x, y, turn)));
            assert_eq!(beside(x, y, turn) < 0.0, touch, "{x} {y} {turn}");
        }
    }

    #[test]
    fn jitter_is_standing_and_velocity_is_displacement() {
        let was = Shown::first(CAR, Pose::new(5.0, 5.0, 1.0), DVec2::ZERO);
        let is = was.then(Pose::new(5.03, 4.98, 1.01));
        assert!(is.stands() && is.stood == TOKEN_DT);
        assert_eq!(is.velocity(), DVec2::ZERO);
        let moved = is.then(Pose::new(7.03, 4.98, 1.2));
        assert!((moved.velocity() - DVec2::new(4.0, 0.0)).length() < 1e-9);
        assert_eq!(moved.stood, 0.0);
    }

    #[test]
    fn a_road_is_free_without_leaders_lights_and_crossing_agents() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 60,0 speed 15 next 2
             lane 2: 60,0 200,0
             ego vehicle 0: 10,0 velocity 8,0",
        )
        .unwrap();
        let map = VectorMap::new(&scenario.map, DVec2::ZERO, 300.0, Default::default());
        let car = |x: f64, y: f64, heading: f64, speed: f64| {
            let at = Pose::new(x, y, heading);
            Shown::first(CAR, at, DVec2::from_angle(heading) * speed)
        };
        let is_free = |speed: f64, others: &[Shown], light: LightState| {
            let agents: Vec<Shown> = std::iter::once(car(10.0, 0.0, 0.0, speed))
                .chain(others.iter().copied())
                .collect();
            let lights = Lights {
                by_lane: vec![(gump_scene::LaneId(2), light, None)],
            };
            look(&map, &lights, &agents, 0, None).is_free(&agents[0])
        };
        let green = LightState::Green;
        assert!(is_free(8.0, &[], green));
        // An agent that stands is not on its way.
        assert!(!is_free(0.0, &[], green));
        // A leader 20 m ahead, within 34 m; one beside the lane; one far ahead.
        assert!(!is_free(8.0, &[car(30.0, 0.0, 0.0, 8.0)], green));
        assert!(is_free(8.0, &[car(30.0, 6.0, 0.0, 0.0)], green));
        assert!(is_free(4.0, &[car(45.0, 0.0, 0.0, 4.0)], green));
        // A light 50 m ahead matters at 10 m/s, not at 4.
        assert!(!is_free(10.0, &[], LightState::Red));
        assert!(!is_free(10.0, &[], LightState::Yellow));
        assert!(is_free(4.0, &[], LightState::Red));
        // A car that crosses in two seconds.
        let crossing = std::f64::consts::FRAC_PI_2;
        assert!(!is_free(8.0, &[car(26.0, -16.0, crossing, 8.0)], green));
        assert!(is_free(8.0, &[car(26.0, 16.0, crossing, 8.0)], green));
    }
}
