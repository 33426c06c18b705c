//! Movements: the line at which a light stops traffic, the paths of that traffic, and the other
//! paths that these cross.

use gump_geometry::{DVec2, Polyline, Pose, angle_difference};
use gump_scene::{
    Lane, LaneKind, Light, MapGraph, TYPICAL_SPEED_LIMIT, stop_line, ways_beyond, ways_cross,
    ways_join,
};

// Chosen by hand; none was tuned. Angles are 30 and 135 degrees.

/// Lights whose traffic comes from the same direction differ by less than this, radians.
const SAME_APPROACH: f64 = 0.52;
/// Roads count as opposite if their directions differ by more than this, radians.
const OPPOSITE: f64 = 2.36;
/// A path that turns by more than this is a turn, radians.
const TURN: f64 = 0.52;
/// Stop lines of one approach lie within this, metres: seven lanes.
const APPROACH_M: f64 = 25.0;
/// Stop lines of one junction lie within this, metres, the largest junctions of arterials, ...
const JUNCTION_M: f64 = 70.0;
/// ... and its paths come as near to one another as this, metres.
const NEAR_M: f64 = 8.0;
/// Sampling distance when paths are compared, metres: half of that.
const STEP_M: f64 = 4.0;
/// Distance before the line within which a vehicle counts as waiting or approaching, metres: about
/// three seconds at 50 km/h.
const WAITING_M: f64 = 45.0;
/// The maximum number of lanes searched for approaching vehicles; bounds the time on maps of short
/// ones.
const MOST_LANES: usize = 32;
/// A piece behind a line that is shorter than this, on a lane that leads up to a junction, is not
/// the path through it, metres, but leads from the line to the junction.
const STUB_M: f64 = 15.0;
/// Maximum distance of a waiting or approaching vehicle from the centre of a lane, metres: beside
/// the centre, but not in the next lane.
const BESIDE_M: f64 = 2.5;

/// The relation of two movements.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Relation {
    /// They never meet.
    Free,
    /// They come from opposite roads and cross: a turn that gives way to oncoming traffic.
    Opposing,
    /// They come from roads that cross, and their paths cross or join.
    Across,
}

/// One path, or several from one line, that a light controls.
#[derive(Clone, Debug)]
pub(super) struct Movement {
    /// The middle of the stop line.
    pub(super) line: Pose,
    /// Beyond the line.
    ways: Vec<Polyline>,
    /// Up to the line.
    approaches: Vec<Polyline>,
    /// Whether all of its paths turn left, from lanes that lead nowhere else.
    pub(super) is_left_only: bool,
    /// Speed limit, metres per second.
    pub(super) limit: f64,
    /// Whether it is for bicycles alone.
    is_for_bicycles: bool,
}

impl Movement {
    /// The movement that the light of this lane controls.
    pub(super) fn of(map: &MapGraph, lane: &Lane, light: &Light) -> Self {
        let line = stop_line(lane, light);
        let ways = ways(map, lane, line);
        let turns_left = |way: &Polyline| turn_of(way) > TURN;
        let shares = |lane: &Lane| {
            let before = map.predecessors(lane.id);
            let mut beside = before.flat_map(|lane| map.successors(lane.id));
            beside.any(|lane| !turns_left(&lane.centerline))
        };
        // A light of a lane that leads up to the junction controls all of its paths.
        let starts_there = lane.centerline.project(line.position).arc_length < 2.0;
        let is_left = !ways.is_empty() && ways.iter().all(turns_left);
        Self {
            line,
            approaches: approaches(map, lane, line),
            is_left_only: is_left && !(starts_there && shares(lane)),
            limit: lane.speed_limit.unwrap_or(TYPICAL_SPEED_LIMIT),
            is_for_bicycles: lane.kind == LaneKind::BikeLane,
            ways,
        }
    }

    /// Its relation to another movement.
    pub(super) fn relation(&self, other: &Self) -> Relation {
        let between = angle_difference(self.line.heading, other.line.heading).abs();
        let meets = |meet: fn(&Polyline, &Polyline) -> bool| {
            let all = |one: &Polyline| other.ways.iter().any(|other| meet(one, other));
            self.ways.iter().any(all)
        };
        if between < SAME_APPROACH {
            Relation::Free
        } else if between > OPPOSITE {
            match meets(ways_cross) {
                true => Relation::Opposing,
                false => Relation::Free,
            }
        } else if meets(ways_cross) || meets(ways_join) {
            Relation::Across
        } else {
            Relation::Free
        }
    }

    /// Whether the map has a path beyond the line.
    pub(super) fn leads_on(&self) -> bool {
        !self.ways.is_empty()
    }

    /// Whether both come to their lines from the same road.
    pub(super) fn shares_approach(&self, other: &Self) -> bool {
        let between = angle_difference(self.line.heading, other.line.heading).abs();
        let apart = self.line.position.distance(other.line.position);
        between < SAME_APPROACH
            && apart < APPROACH_M
            && self.is_for_bicycles == other.is_for_bicycles
    }

    /// Whether both belong to one junction.
    pub(super) fn shares_junction(&self, other: &Self) -> bool {
        let apart = self.line.position.distance(other.line.position);
        if apart > JUNCTION_M {
            return false;
        }
        let near = |p: &DVec2, line: &Polyline| line.project(*p).distance < NEAR_M;
        let meets = |one: &Polyline| {
            let near = |other: &Polyline| {
                let (one, other) = (one.resample(STEP_M), other.resample(STEP_M));
                one.points().iter().any(|p| near(p, &other))
            };
            other.ways.iter().any(near)
        };
        self.shares_approach(other)
            || self.relation(other) != Relation::Free
            || self.ways.iter().any(meets)
    }

    /// Whether a vehicle at this position waits for the light or approaches it.
    pub(super) fn has_demand_from(&self, at: Pose) -> bool {
        let is_far = at.position.distance(self.line.position) > WAITING_M + BESIDE_M;
        if is_far && !self.approaches.is_empty() {
            return false;
        }
        let comes = |way: &Polyline| {
            let foot = way.project(at.position);
            let along = way.pose_at(foot.arc_length).heading;
            foot.distance < BESIDE_M && angle_difference(at.heading, along).abs() < 1.0
        };
        // Without approaches, waiting vehicles are off the map.
        self.approaches.is_empty() || self.approaches.iter().any(comes)
    }
}

/// By how much a path turns to the left, radians.
fn turn_of(way: &Polyline) -> f64 {
    let end = way.pose_at(way.length()).heading;
    angle_difference(end, way.pose_at(0.0).heading)
}

/// The lanes up to a line, from [`WAITING_M`] before it.
fn approaches(map: &MapGraph, lane: &Lane, line: Pose) -> Vec<Polyline> {
    let centre = &lane.centerline;
    let at = centre.project(line.position).arc_length;
    let mut all = Vec::new();
    if at > 1.0 {
        all.push(centre.slice((at - WAITING_M).max(0.0), at));
    }
    let mut open = vec![(lane, WAITING_M - at)];
    for _ in 0..MOST_LANES {
        let Some((lane, missing)) = open.pop() else {
            break;
        };
        if missing <= 1.0 {
            continue;
        }
        for before in map.predecessors(lane.id) {
            let end = before.centerline.length();
            let from = (end - missing).max(0.0);
            if end - from > 0.1 {
                all.push(before.centerline.slice(from, end));
            }
            open.push((before, missing - end));
        }
    }
    all
}

/// The path of traffic that has passed a line; through the junction, where the line is some metres
/// before the end of a lane that leads up to it.
fn ways(map: &MapGraph, lane: &Lane, line: Pose) -> Vec<Polyline> {
    let ways = ways_beyond(map, lane, line);
    let is_stub = |way: &Polyline| way.length() < STUB_M && !lane.in_intersection;
    let [rest] = ways.as_slice() else {
        return ways;
    };
    if !is_stub(rest) || map.successors(lane.id).next().is_none() {
        return ways;
    }
    let longer = map.successors(lane.id).filter_map(|next| {
        let points = rest.points().iter().chain(next.centerline.points());
        Polyline::new(points.copied().collect())
    });
    longer.collect()
}
