//! The proposals: five desired speeds on each of three lines, each driven by a car-following law in
//! the forecast.

use gump_geometry::{DVec2, LineIndex, Polygon, Pose, Quad, widen};
use gump_nuplan::path::Path;
use gump_rollout::worlds::{IdmConfig, idm_euler_step};
use gump_scene::VehicleParameters;

use super::forecast::{Forecast, Object};

/// Seconds between the states of a proposal.
pub(crate) const DT: f64 = 0.1;
/// Length over which a line is examined, seconds at the highest desired speed, as in tuPlan Garage.
const CORRIDOR_SECONDS: f64 = 8.0;
/// Distance between points of a line beyond which a corridor does not begin and end at points but
/// at the ends of its range, metres; nuPlan's lines have a point every metre.
const SPARSE: f64 = 1.0 + 1e-6;
/// Length that PDM assumes behind the position of a lead that does not exist, metres.
///
/// It is half the length of nuPlan's car; PDM has it as a constant of the vehicle.
const END_REAR: f64 = 2.588;

/// A line to follow, with frequently used values.
#[derive(Clone, Debug)]
pub(crate) struct Line {
    pub(crate) path: Path,
    index: LineIndex,
}

impl Line {
    pub(crate) fn new(path: Path) -> Self {
        Self {
            index: LineIndex::new(path.line()),
            path,
        }
    }

    /// Arc length of the nearest point, metres.
    pub(crate) fn project(&self, point: DVec2) -> f64 {
        self.index.project(self.path.line(), point).arc_length
    }

    /// PDM never uses the very start of a line.
    fn pose_at(&self, s: f64) -> Pose {
        self.path.pose_at(s.max(1e-5))
    }

    /// The strip that a vehicle sweeps between two arc lengths: the points in between, with square
    /// ends.
    ///
    /// As in the original it begins at the first point within the range and ends at the last, unless
    /// points are [`SPARSE`]: there an obstacle may stand between the range's end and the next point.
    fn corridor(&self, from: f64, to: f64, half_width: f64) -> Vec<Quad> {
        let line = self.path.line();
        let arc = line.arc_lengths();
        let (from, to) = (from.clamp(0.0, line.length()), to.clamp(0.0, line.length()));
        let first = arc.partition_point(|&s| s < from);
        let end = arc.partition_point(|&s| s <= to);
        let points = if end > first + 1 {
            let mut points = line.points()[first..end].to_vec();
            if arc[first] - from > SPARSE {
                points.insert(0, line.pose_at(from).position);
            }
            if to - arc[end - 1] > SPARSE {
                points.push(line.pose_at(to).position);
            }
            points
        } else {
            line.slice(from, to).points().to_vec()
        };
        widen(&straightened(&points), half_width, half_width)
    }
}

/// Without the points between equal directions: fewer pieces of the same shape.
fn straightened(points: &[DVec2]) -> Vec<DVec2> {
    let mut kept: Vec<DVec2> = Vec::with_capacity(points.len());
    for &point in points {
        if let [.., a, b] = kept[..] {
            let (before, after) = (b - a, point - b);
            let bend = before.perp_dot(after);
            let straight = bend.abs() <= 1e-9 * before.length() * after.length();
            if straight && before.dot(after) >= 0.0 {
                kept.pop();
            }
        }
        kept.push(point);
    }
    kept
}

/// Progress along the line and speed, metres and metres per second.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct LongitudinalState {
    pub(crate) progress: f64,
    pub(crate) speed: f64,
}

/// The leader on the line.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Lead {
    pub(crate) progress: f64,
    pub(crate) speed: f64,
    pub(crate) rear: f64,
}

/// One proposal: its line, speed and path.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Proposal {
    /// Index of the line.
    pub(crate) line: usize,
    /// Metres per second.
    pub(crate) desired_speed: f64,
    pub(crate) states: Vec<LongitudinalState>,
    pub(crate) leads: Vec<Lead>,
    /// Rear-axle poses.
    pub(crate) poses: Vec<Pose>,
}

impl Proposal {
    /// Drops all steps after the first `n`.
    pub(crate) fn truncate(&mut self, n: usize) {
        self.states.truncate(n + 1);
        self.leads.truncate(n + 1);
        self.poses.truncate(n + 1);
    }
}

/// Values that are the same for all proposals.
pub(crate) struct Proposer<'a> {
    pub(crate) law: &'a IdmConfig,
    pub(crate) vehicle: &'a VehicleParameters,
    pub(crate) forecast: &'a Forecast,
    pub(crate) lines: &'a [Line],
    pub(crate) desired_speeds: &'a [f64],
}

impl Proposer<'_> {
    /// Proposals of `n` steps, all speeds of a line after one another.
    pub(crate) fn propose(&self, rear_axle: Pose, speed: f64, n: usize) -> Vec<Proposal> {
        let mut all = Vec::with_capacity(self.lines.len() * self.desired_speeds.len());
        for line in 0..self.lines.len() {
            let from = all.len();
            let begun = self.begin(line, rear_axle, speed);
            all.extend(self.desired_speeds.iter().map(|&desired_speed| Proposal {
                desired_speed,
                ..begun.clone()
            }));
            self.drive(&mut all[from..], 1..=n);
        }
        all
    }

    /// A proposal along a line that has not driven yet, for the first of the speeds.
    pub(crate) fn begin(&self, line: usize, rear_axle: Pose, speed: f64) -> Proposal {
        let way = &self.lines[line];
        let progress = way.project(rear_axle.position);
        Proposal {
            line,
            desired_speed: self.desired_speeds[0],
            states: vec![LongitudinalState { progress, speed }],
            leads: vec![Lead::default()],
            poses: vec![way.pose_at(progress)],
        }
    }

    /// Drives proposals of one line on over further steps.
    pub(crate) fn drive(&self, batch: &mut [Proposal], steps: std::ops::RangeInclusive<usize>) {
        let Some(first) = batch.first() else { return };
        let corridor = self.corridor(first.line, first.states[0].progress);
        self.drive_within(&corridor, batch, steps);
    }

    /// The strip that a vehicle sweeps from some progress along a line on.
    pub(crate) fn corridor(&self, line: usize, progress: f64) -> Corridor {
        let fastest = self.desired_speeds.iter().copied().fold(0.0, f64::max);
        let end = progress + fastest * CORRIDOR_SECONDS;
        let half_width = self.vehicle.width / 2.0;
        Corridor::new(self.lines[line].corridor(progress, end, half_width))
    }

    /// [`Proposer::drive`] with a precomputed corridor.
    pub(crate) fn drive_within(
        &self,
        corridor: &Corridor,
        batch: &mut [Proposal],
        steps: std::ops::RangeInclusive<usize>,
    ) {
        let Some(first) = batch.first() else { return };
        let line = &self.lines[first.line];
        let surroundings = Surroundings::new(self, line, corridor, steps.clone());
        for k in steps {
            if k.is_multiple_of(2) {
                self.look(line, &surroundings, batch, k);
            } else {
                // Of the very first step nothing is known but zeros: a lead at the path's start.
                for proposal in batch.iter_mut() {
                    proposal.leads.push(proposal.leads[k - 1]);
                }
            }
            for proposal in batch.iter_mut() {
                let next = self.follow(proposal, k);
                proposal.poses.push(line.pose_at(next.progress));
                proposal.states.push(next);
            }
        }
    }

    fn follow(&self, proposal: &Proposal, k: usize) -> LongitudinalState {
        let (law, now, lead) = (self.law, proposal.states[k - 1], proposal.leads[k]);
        let gap = lead.progress - now.progress - lead.rear;
        let before = (now.progress, now.speed);
        let (progress, speed) =
            idm_euler_step(law, before, proposal.desired_speed, gap, lead.speed, DT);
        LongitudinalState { progress, speed }
    }

    /// Finds the leader of every proposal at step `k`.
    ///
    /// One leader is written to proposal after proposal and only its known parts are renewed, so a
    /// speed found for one is kept for the next; PDM's results depend on it.
    fn look(&self, line: &Line, around: &Surroundings<'_>, batch: &mut [Proposal], k: usize) {
        let mut lead = Lead::default();
        for proposal in batch {
            let progress = proposal.states[k - 1].progress;
            let pose = proposal.poses[k - 1];
            let own = Quad::from(&self.vehicle.footprint(pose));
            match around.nearest(k, progress, &own) {
                Some((distance, obstacle)) => {
                    lead.progress = progress + distance;
                    if let Some(object) = obstacle {
                        lead.speed = object.speed_along(pose.heading, k / 2);
                    }
                }
                None => {
                    lead.progress = line.path.length();
                    lead.rear = END_REAR;
                }
            }
            proposal.leads.push(lead);
        }
    }
}

/// Obstacles that reach into the corridor of a line, by instant.
struct Surroundings<'a> {
    /// From the first moment looked at, `[moment][obstacle]`.
    moments: Vec<Vec<Obstacle<'a>>>,
    first: usize,
    lights: Vec<(f64, &'a Polygon)>,
}

struct Obstacle<'a> {
    progress: f64,
    quad: Quad,
    object: &'a Object,
}

impl<'a> Surroundings<'a> {
    fn new(
        proposer: &Proposer<'a>,
        line: &Line,
        corridor: &Corridor,
        steps: std::ops::RangeInclusive<usize>,
    ) -> Self {
        let (first, last) = (steps.start() / 2, steps.end() / 2);
        let mut moments: Vec<Vec<Obstacle<'_>>> = (first..=last).map(|_| Vec::new()).collect();
        for object in proposer.forecast.relevant() {
            if !corridor.may_reach(object.swept()) {
                continue;
            }
            let mut standing: Option<Option<f64>> = None;
            for moment in first..=last {
                let sees = || {
                    let inside = corridor.may_reach(object.bounds(moment))
                        && corridor.intersects(&object.quad(moment));
                    inside.then(|| line.project(object.center(moment)))
                };
                let seen = match standing {
                    Some(seen) => seen,
                    None => sees(),
                };
                if object.is_still() {
                    standing = Some(seen);
                }
                if let Some(progress) = seen {
                    moments[moment - first].push(Obstacle {
                        progress,
                        quad: object.quad(moment),
                        object,
                    });
                }
            }
        }
        let lights = proposer
            .forecast
            .relevant_lights()
            .filter(|polygon| corridor.intersects_polygon(polygon))
            .map(|polygon| (line.project(centroid(polygon)), polygon))
            .collect();
        Self {
            moments,
            first,
            lights,
        }
    }

    /// The nearest obstacle ahead and its distance; no object for a red light.
    fn nearest(&self, k: usize, progress: f64, own: &Quad) -> Option<(f64, Option<&'a Object>)> {
        let mut nearest: Option<(f64, Option<&'a Object>)> = None;
        for obstacle in &self.moments[k / 2 - self.first] {
            let least = nearest.map_or(f64::INFINITY, |(least, _)| least);
            if obstacle.progress > progress && own.gap_at_least(&obstacle.quad) < least {
                let distance = own.distance(&obstacle.quad);
                if distance < least {
                    nearest = Some((distance, Some(obstacle.object)));
                }
            }
        }
        for &(place, polygon) in &self.lights {
            let least = nearest.map_or(f64::INFINITY, |(least, _)| least);
            if place > progress && own.gap_to_polygon_at_least(polygon) < least {
                let distance = own.distance_to_polygon(polygon);
                if distance < least {
                    nearest = Some((distance, None));
                }
            }
        }
        nearest
    }
}

/// Pieces of a corridor that share bounds. Saves time, changes no result; not tuned.
const CHUNK: usize = 8;

/// Convex pieces of road, with the bounds of all and of every few.
#[derive(Debug)]
pub(crate) struct Corridor {
    pieces: Vec<Quad>,
    chunks: Vec<(DVec2, DVec2)>,
    whole: (DVec2, DVec2),
}

impl Corridor {
    fn new(pieces: Vec<Quad>) -> Self {
        let around = |pieces: &[Quad]| {
            let none = (DVec2::INFINITY, DVec2::NEG_INFINITY);
            pieces
                .iter()
                .map(Quad::bounds)
                .fold(none, |all, (min, max)| (all.0.min(min), all.1.max(max)))
        };
        Self {
            chunks: pieces.chunks(CHUNK).map(around).collect(),
            whole: around(&pieces),
            pieces,
        }
    }

    fn may_reach(&self, bounds: (DVec2, DVec2)) -> bool {
        overlap(self.whole, bounds)
    }

    fn intersects(&self, quad: &Quad) -> bool {
        let bounds = quad.bounds();
        let chunks = self.pieces.chunks(CHUNK).zip(&self.chunks);
        chunks
            .filter(|(_, around)| overlap(**around, bounds))
            .any(|(pieces, _)| pieces.iter().any(|piece| piece.intersects(quad)))
    }

    fn intersects_polygon(&self, polygon: &Polygon) -> bool {
        self.may_reach(polygon.bounds())
            && self
                .pieces
                .iter()
                .any(|piece| piece.intersects_polygon(polygon))
    }
}

fn overlap(a: (DVec2, DVec2), b: (DVec2, DVec2)) -> bool {
    a.0.cmple(b.1).all() && b.0.cmple(a.1).all()
}

/// Centre of the area of a polygon's outer ring.
fn centroid(polygon: &Polygon) -> DVec2 {
    let ring = polygon.ring();
    let origin = ring[0];
    let (mut doubled, mut sum) = (0.0, DVec2::ZERO);
    for i in 0..ring.len() {
        let (a, b) = (ring[i] - origin, ring[(i + 1) % ring.len()] - origin);
        let cross = a.perp_dot(b);
        doubled += cross;
        sum += (a + b) * cross;
    }
    if doubled == 0.0 {
        return origin;
    }
    origin + sum / (3.0 * doubled)
}
