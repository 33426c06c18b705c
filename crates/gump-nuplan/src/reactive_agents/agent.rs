//! One vehicle of nuPlan's reactive traffic.

use std::collections::VecDeque;

use gump_geometry::{OrientedBox, Polygon, Pose, Quad};
use gump_scene::{Agent, AgentState, Lane, LaneId, LightState, MapGraph};

use super::corridor::{Corridor, Footprint, Start};
use super::{Obstacle, Scene, in_intersection};
use crate::path::{Path, baseline, curvature_at_start, nearest_on_baseline};
use gump_rollout::worlds::idm_euler_step;

/// Number of past lanes that a vehicle remembers.
///
/// Source: the IDM agents of nuplan-devkit.
const REMEMBERED_LANES: usize = 5;

/// A vehicle on its path.
#[derive(Debug)]
pub(super) struct Vehicle {
    agent: Agent,
    /// Index of the vehicle among those present at first.
    index: usize,
    lanes: VecDeque<LaneId>,
    corridor: Corridor,
    /// Number of times the corridor has been renewed.
    renewals: u32,
    /// Arc length of the box centre on the path, metres.
    progress: f64,
    speed: f64,
    target_speed: f64,
    /// The box and, once it has moved, its position in 1.5 s.
    footprint: Footprint,
    /// Index among the others, the fixed ones first, of the leader in the last step.
    led_by: Option<usize>,
    /// Kept between steps for its memory: see [`Vehicle::nearest`].
    near: Vec<(f64, usize)>,
}

/// All possible obstacles of a vehicle: the fixed ones, then all other vehicles.
#[derive(Clone, Copy)]
pub(super) struct Others<'a> {
    pub(super) fixed: &'a [Obstacle],
    pub(super) before: &'a [Vehicle],
    pub(super) after: &'a [Vehicle],
}

impl<'a> Others<'a> {
    fn len(self) -> usize {
        self.fixed.len() + self.before.len() + self.after.len()
    }

    fn get(self, i: usize) -> InTheWay<'a> {
        let n_before = self.fixed.len() + self.before.len();
        let vehicle = match self.fixed.get(i) {
            Some(fixed) => {
                return InTheWay {
                    footprint: &fixed.footprint,
                    heading: fixed.heading,
                    speed: fixed.speed,
                    vehicle: None,
                };
            }
            None if i < n_before => &self.before[i - self.fixed.len()],
            None => &self.after[i - n_before],
        };
        InTheWay {
            footprint: &vehicle.footprint,
            heading: vehicle.pose().heading,
            speed: vehicle.speed,
            vehicle: Some(vehicle),
        }
    }
}

/// A fixed obstacle or vehicle that may be in the way of a vehicle.
#[derive(Clone, Copy)]
struct InTheWay<'a> {
    footprint: &'a Footprint,
    heading: f64,
    speed: f64,
    vehicle: Option<&'a Vehicle>,
}

/// Pairs of vehicles whose corridors intersect. Computed once per pair of corridors, which only get
/// shorter until they are renewed.
#[derive(Debug, Default)]
pub(super) struct Encounters {
    n: usize,
    /// By pair of vehicles: the renewals of both at the time of the computation, and its result.
    known: Vec<Option<(u32, u32, bool)>>,
}

impl Encounters {
    /// For `n` vehicles, without results.
    pub(super) fn among(n: usize) -> Self {
        Self {
            n,
            known: vec![None; n * n],
        }
    }

    fn meet(&mut self, own: &Vehicle, other: &Vehicle) -> bool {
        let known = &mut self.known[own.index * self.n + other.index];
        match *known {
            Some((a, b, meet)) if (a, b) == (own.renewals, other.renewals) => meet,
            _ => {
                let behind = other.progress - other.agent.length / 2.0;
                let meet = own.corridor.meets(own.progress, &other.corridor, behind);
                *known = Some((own.renewals, other.renewals, meet));
                meet
            }
        }
    }
}

/// The leader, in terms of the path.
#[derive(Clone, Copy)]
struct Lead {
    gap: f64,
    speed: f64,
}

impl Vehicle {
    /// Places the vehicle on the centre of its lane; `None` if it is on none.
    ///
    /// Where lanes overlap the one with the nearest direction is taken; directions are compared as
    /// plain numbers, as in nuPlan. `target` is the desired speed of the previous vehicle, and of
    /// this one if its lane states no limit.
    pub(super) fn snapped(
        agent: &Agent,
        index: usize,
        map: &MapGraph,
        target: &mut f64,
    ) -> Option<Self> {
        let center = agent.state.pose.position;
        let lanes: Vec<&Lane> = map.lanes_containing(center).collect();
        let on_lane = lanes.iter().any(|lane| !lane.in_intersection);
        if !on_lane && !in_intersection(map, center) {
            return None;
        }
        let (lane, s, pose) = lanes
            .into_iter()
            .filter(|lane| lane.in_intersection != on_lane)
            .map(|lane| {
                let (s, pose) = nearest_on_baseline(lane, center);
                (lane, s, pose)
            })
            .min_by(|a, b| {
                let off = |pose: &Pose| (pose.heading - agent.state.pose.heading).abs();
                off(&a.2).total_cmp(&off(&b.2))
            })?;
        if let Some(limit) = lane.speed_limit {
            *target = limit;
        }
        let path = Path::without_last(&baseline(lane))?;
        let placed = OrientedBox {
            pose,
            ..agent.oriented_box()
        };
        let mut vehicle = Self {
            agent: *agent,
            index,
            lanes: VecDeque::from([lane.id]),
            corridor: Corridor::new(path, agent.width / 2.0),
            renewals: 0,
            progress: s,
            speed: agent.state.speed(),
            target_speed: *target,
            footprint: Footprint::new(vec![Quad::from(&placed)]),
            led_by: None,
            near: Vec::new(),
        };
        vehicle.place(pose);
        Some(vehicle)
    }

    pub(super) fn agent(&self) -> Agent {
        self.agent
    }

    pub(super) fn pose(&self) -> Pose {
        self.agent.state.pose
    }

    pub(super) fn oriented_box(&self) -> OrientedBox {
        self.agent.oriented_box()
    }

    /// Moves for `dt` seconds; `others` are in their current states.
    pub(super) fn step(
        &mut self,
        scene: &Scene<'_>,
        others: Others<'_>,
        encounters: &mut Encounters,
        dt: f64,
    ) {
        self.extend(scene);
        let lead = self.lead(scene, others, encounters);
        let last = self.lanes.back().and_then(|&id| scene.map.lane(id));
        if let Some(limit) = last.and_then(|lane| lane.speed_limit).filter(|&l| l > 0.0) {
            self.target_speed = limit;
        }
        let law = &scene.config.law;
        let now = (self.progress, self.speed);
        let (progress, speed) =
            idm_euler_step(law, now, self.target_speed, lead.gap, lead.speed, dt);
        (self.progress, self.speed) = (progress, speed.max(0.0));
        self.place(self.corridor.path().pose_at(self.progress));
        self.sweep(law.headway);
    }

    fn place(&mut self, pose: Pose) {
        self.agent.state = AgentState {
            pose,
            velocity: pose.direction() * self.speed,
        };
    }

    /// Renews the footprint: the box and the road it covers within the headway.
    fn sweep(&mut self, headway: f64) {
        let half = self.agent.length / 2.0;
        let own = Quad::from(&self.agent.oriented_box());
        let to = self.progress + half + self.speed * headway;
        self.footprint
            .sweep(own, &self.corridor, self.progress - half, to);
    }

    /// Adds lanes while the path ahead is short; it ends where none may be entered.
    fn extend(&mut self, scene: &Scene<'_>) {
        let config = scene.config;
        let needed = config.minimum_path_length + self.target_speed * config.law.headway;
        // Bounded, because a ring of lanes without length would never reach ahead.
        for _ in 0..1000 {
            if self.corridor.path().length() - self.progress >= needed {
                return;
            }
            let Some(next) = self.lanes.back().and_then(|&last| straightest(scene, last)) else {
                return;
            };
            let mut poses = self.corridor.path().poses_from(self.progress);
            poses.extend(baseline(next));
            let Some(path) = Path::without_last(&poses) else {
                return;
            };
            self.corridor = Corridor::new(path, self.agent.width / 2.0);
            self.renewals += 1;
            self.progress = 0.0;
            self.lanes.push_back(next.id);
            if self.lanes.len() > REMEMBERED_LANES {
                self.lanes.pop_front();
            }
        }
    }

    /// The nearest agent that reaches into the path ahead; the end of the path where there is none.
    fn lead(&mut self, scene: &Scene<'_>, others: Others<'_>, encounters: &mut Encounters) -> Lead {
        let start = self.corridor.start(self.progress);
        let bounds = self.corridor.bounds_from(start);
        let mut near = std::mem::take(&mut self.near);
        let nearest = self.nearest(others, start, encounters, &mut near);
        self.near = near;
        self.led_by = nearest.map(|(_, i)| i);
        let mut nearest = nearest.map(|(distance, i)| {
            let InTheWay { heading, speed, .. } = others.get(i);
            (distance, speed * (heading - self.pose().heading).cos())
        });
        for line in self
            .lanes
            .iter()
            .flat_map(|&lane| scene.red_stop_lines(lane))
        {
            if self.reaches(line, bounds) {
                let distance = self.footprint.distance_to_polygon(line);
                if nearest.is_none_or(|(least, _)| distance < least) {
                    nearest = Some((distance, 0.0));
                }
            }
        }
        match nearest {
            Some((gap, speed)) => Lead { gap, speed },
            None => Lead {
                gap: self.corridor.path().length() - self.progress - self.agent.length / 2.0,
                speed: 0.0,
            },
        }
    }

    /// The distance to the nearest of the others that reach into the path ahead, and which it is: of
    /// several as near as each other the first. `near` is overwritten.
    ///
    /// They are looked at in the order of the gaps between bounding boxes, up to the first gap
    /// larger than the least distance. The nearest of the last step is tested first: mostly it
    /// still is, and few have a smaller gap than its distance.
    fn nearest(
        &self,
        others: Others<'_>,
        start: Start,
        encounters: &mut Encounters,
        near: &mut Vec<(f64, usize)>,
    ) -> Option<(f64, usize)> {
        let bounds = self.corridor.bounds_from(start);
        let mut measure = |i: usize| {
            let found = others.get(i);
            self.is_crossed(found, start, encounters)
                .then(|| self.footprint.distance(found.footprint))
        };
        let gap_squared = |i: usize| {
            let footprint = others.get(i).footprint;
            let is_within = footprint.is_within(bounds);
            is_within.then(|| self.footprint.gap_squared(footprint))
        };
        let mut nearest: Option<(f64, usize)> = None;
        if let Some(i) = self.led_by.filter(|&i| i < others.len())
            && let Some(gap) = gap_squared(i)
            && let Some(distance) = measure(i)
            // Not where rounding makes it nearer than its bounds: the order would then matter.
            && distance >= gap.sqrt()
        {
            nearest = Some((distance, i));
        }
        let first = nearest;
        // The root decides, but only of what may be near.
        let may_be_near = first.map_or(f64::INFINITY, |(d, _)| d * d * (1.0 + 1e-9));
        near.clear();
        for i in 0..others.len() {
            if let Some(gap) = gap_squared(i).filter(|&gap| gap <= may_be_near) {
                near.push((gap.sqrt(), i));
            }
        }
        near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for &(gap, i) in near.iter() {
            if let Some((least, first)) = nearest {
                // Those without a gap come first, in their own order.
                if gap > least || (least == 0.0 && i > first) {
                    break;
                }
            }
            if first.is_some_and(|(_, first)| first == i) {
                continue;
            }
            if let Some(distance) = measure(i)
                && nearest.is_none_or(|least| (distance, i) < least)
            {
                nearest = Some((distance, i));
            }
        }
        nearest
    }

    /// True if something reaches into the path ahead.
    fn is_crossed(&self, other: InTheWay<'_>, start: Start, encounters: &mut Encounters) -> bool {
        match other.vehicle {
            // All that it sweeps lies on its own way, which does not meet this one.
            Some(vehicle) if !encounters.meet(self, vehicle) => {
                self.corridor.is_touched_by_body(start, other.footprint)
            }
            _ => self.corridor.is_touched(start, other.footprint),
        }
    }

    fn reaches(
        &self,
        polygon: &Polygon,
        bounds: (gump_geometry::DVec2, gump_geometry::DVec2),
    ) -> bool {
        let (min, max) = polygon.bounds();
        if min.cmpgt(bounds.1).any() || max.cmplt(bounds.0).any() {
            return false;
        }
        let mut pieces = Vec::new();
        self.corridor
            .pieces(self.progress, f64::INFINITY, &mut pieces);
        pieces.iter().any(|piece| piece.intersects_polygon(polygon))
    }
}

/// The successor of `last` that turns least at its start, among those that may be entered.
///
/// A lane controlled by lights may only be entered at green, any other one unless its light is red.
fn straightest<'m>(scene: &Scene<'m>, last: LaneId) -> Option<&'m Lane> {
    let mut best: Option<(f64, &Lane)> = None;
    for lane in scene.map.successors(last) {
        let state = scene.frame.light(lane.id).map(|light| light.state);
        let open = if lane.has_lights == Some(true) {
            state == Some(LightState::Green)
        } else {
            state != Some(LightState::Red)
        };
        let turn = curvature_at_start(lane).abs();
        if open && best.is_none_or(|(least, _)| turn < least) {
            best = Some((turn, lane));
        }
    }
    best.map(|(_, lane)| lane)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::closed_loop::{Recording, Step, Traffic};
    use crate::reactive_agents::{NuplanIdm, fixed_obstacles};
    use crate::tracking::Trajectory;
    use std::fmt::Write as _;

    /// A road of two lanes in a bend, one that joins it, two that cross it at an angle; queues on all
    /// of them and people beside them.
    fn busy() -> Recording {
        let bend = |radius: f64, i: i32| {
            let angle = f64::from(i) * 0.05;
            (radius * angle.sin(), 60.0 - radius * angle.cos(), angle)
        };
        let line = |x: f64, y: f64, angle: f64, i: i32| {
            let s = f64::from(i) * 4.0;
            (x + s * angle.cos(), y + s * angle.sin(), angle)
        };
        let at = |lane: i32, i: i32| match lane {
            1 => bend(60.0, i),
            2 => bend(56.5, i),
            3 => line(-80.0, 0.0, 0.0, i),
            4 => line(-15.0, 45.0, -0.9, i),
            _ => line(60.0, -20.0, 2.3, i),
        };
        let mut text = String::from("history 0.1 future 9 dt 0.1\nego vehicle 0: 3,0.2\n");
        for (lane, rest) in [(1, ""), (2, ""), (3, " next 1"), (4, ""), (5, "")] {
            write!(text, "lane {lane}:").unwrap();
            for i in 0..=20 {
                let (x, y, _) = at(lane, i);
                write!(text, " {x:.3},{y:.3}").unwrap();
            }
            writeln!(text, " speed {}{rest}", 6 + 2 * lane).unwrap();
            for i in 0..6 {
                let (x, y, heading) = at(lane, 3 * i + 1);
                let id = 10 * lane + i;
                let (vx, vy) = (5.0 * heading.cos(), 5.0 * heading.sin());
                writeln!(
                    text,
                    "agent vehicle {id}: {x:.3},{y:.3} heading {heading} velocity {vx},{vy}"
                )
                .unwrap();
            }
            let (x, y, _) = at(lane, 9);
            let y = y - 3.0;
            writeln!(
                text,
                "agent pedestrian {}: {x},{y} velocity 0,0.7",
                100 + lane
            )
            .unwrap();
        }
        text.push_str("route 1\n");
        Recording::of_boxes(gump_scene::fixture::scenario(&text).unwrap()).unwrap()
    }

    /// [`Vehicle::nearest`], without leaving anything out.
    fn plainly(
        vehicle: &Vehicle,
        others: Others<'_>,
        encounters: &mut Encounters,
    ) -> Option<(f64, usize)> {
        let mut ahead = Vec::new();
        let corridor = &vehicle.corridor;
        corridor.pieces(vehicle.progress, f64::INFINITY, &mut ahead);
        let apart = |a: &[Quad], b: &[Quad]| {
            let pairs = a.iter().flat_map(|a| b.iter().map(|b| a.distance(b)));
            pairs.fold(f64::INFINITY, f64::min)
        };
        let mut nearest = None;
        for i in 0..others.len() {
            let other = others.get(i);
            let pieces = other.footprint.pieces();
            let meets = other
                .vehicle
                .is_none_or(|other| encounters.meet(vehicle, other));
            let reaching = if meets { pieces } else { &pieces[..1] };
            let touches = |a: &Quad| reaching.iter().any(|b| a.intersects(b));
            if ahead.iter().any(touches) {
                let found = (apart(vehicle.footprint.pieces(), pieces), i);
                if nearest.is_none_or(|least| found < least) {
                    nearest = Some(found);
                }
            }
        }
        nearest
    }

    #[test]
    fn the_leader_is_that_of_a_plain_search() {
        let recording = busy();
        let mut traffic = NuplanIdm::default();
        traffic.begin(&recording).unwrap();
        assert!(traffic.vehicles.len() > 20);
        let scene = recording.scenario().present();
        let (mut led, mut touching, mut free) = (0, 0, 0);
        for iteration in 0..80 {
            let (ego, next) = (recording.ego_at(iteration), recording.ego_at(iteration + 1));
            let plan = Trajectory::new(vec![*ego, *next]).unwrap();
            let step = Step {
                recording: &recording,
                iteration,
                ego,
                next,
                plan: &plan,
                scene,
            };
            traffic.advance(&step).unwrap();
            let shape = recording.vehicle().footprint(ego.rear_axle);
            let fixed = fixed_obstacles(&shape, ego.speed(), step.logged());
            for i in 0..traffic.vehicles.len() {
                let (before, rest) = traffic.vehicles.split_at(i);
                let others = Others {
                    fixed: &fixed,
                    before,
                    after: &rest[1..],
                };
                let vehicle = &rest[0];
                let start = vehicle.corridor.start(vehicle.progress);
                let encounters = &mut traffic.encounters;
                let expected = plainly(vehicle, others, encounters);
                let found = vehicle.nearest(others, start, encounters, &mut Vec::new());
                assert_eq!(found, expected, "vehicle {i} in step {iteration}");
                match found {
                    Some((distance, _)) if distance > 0.0 => led += 1,
                    Some(_) => touching += 1,
                    None => free += 1,
                }
            }
        }
        assert!(
            led > 200 && touching > 200 && free > 200,
            "{led} {touching} {free}"
        );
    }
}
