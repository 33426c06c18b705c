//! One vehicle of nuPlan's reactive traffic.

use std::collections::VecDeque;

use gump_geometry::{OrientedBox, Polygon, Pose, Quad};
use gump_scene::{Agent, AgentState, Lane, LaneId, LightState, MapGraph};

use super::corridor::{Corridor, Footprint};
use super::{Scene, in_intersection};
use crate::path::{Path, baseline, curvature_at_start, nearest_on_baseline};
use gump_rollout::worlds::idm_euler_step;

/// Number of past lanes that a vehicle remembers.
const REMEMBERED_LANES: usize = 5;

/// A vehicle on its path.
#[derive(Debug)]
pub(super) struct Vehicle {
    agent: Agent,
    /// Index of the vehicle among those present at first.
    index: usize,
    lanes: VecDeque<LaneId>,
    corridor: Corridor,
    /// How often the corridor has been renewed.
    renewals: u32,
    /// Arc length of the box centre on the path, metres.
    progress: f64,
    speed: f64,
    target_speed: f64,
    /// The box and, once it has moved, its position in 1.5 s.
    footprint: Footprint,
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
    pub(super) fn step<'a>(
        &mut self,
        scene: &Scene<'_>,
        others: impl Iterator<Item = &'a Self>,
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
        self.footprint.pieces.clear();
        self.footprint.pieces.push(own);
        let (from, to) = (
            self.progress - half,
            self.progress + half + self.speed * headway,
        );
        self.corridor.pieces(from, to, &mut self.footprint.pieces);
        self.footprint.measure();
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
    fn lead<'a>(
        &self,
        scene: &Scene<'_>,
        others: impl Iterator<Item = &'a Self>,
        encounters: &mut Encounters,
    ) -> Lead {
        let bounds = self.corridor.bounds_from(self.progress);
        let fixed = scene.fixed.iter();
        let fixed = fixed.map(|fixed| (&fixed.footprint, fixed.heading, fixed.speed, None));
        let others = others.map(|other| {
            let heading = other.pose().heading;
            (&other.footprint, heading, other.speed, Some(other))
        });
        let mut near: Vec<_> = fixed
            .chain(others)
            .filter(|(footprint, ..)| footprint.is_within(bounds))
            .enumerate()
            .map(|(i, other)| (self.footprint.gap_at_least(other.0), i, other))
            .collect();
        near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut nearest: Option<(f64, usize, f64)> = None;
        for (gap, i, (footprint, heading, speed, vehicle)) in near {
            if nearest.is_some_and(|(least, ..)| gap > least) {
                break;
            }
            if !self.is_crossed(footprint, vehicle, encounters) {
                continue;
            }
            let distance = self.footprint.distance(footprint);
            // Of several as near as each other the first counts.
            if nearest.is_none_or(|(least, first, _)| (distance, i) < (least, first)) {
                nearest = Some((distance, i, speed * (heading - self.pose().heading).cos()));
            }
        }
        let mut nearest = nearest.map(|(distance, _, speed)| (distance, speed));
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

    /// True if a footprint, possibly of a vehicle, reaches into the path ahead.
    fn is_crossed(
        &self,
        footprint: &Footprint,
        vehicle: Option<&Self>,
        encounters: &mut Encounters,
    ) -> bool {
        match vehicle {
            // All that it sweeps lies on its own way, which does not meet this one.
            Some(other) if !encounters.meet(self, other) => {
                let body = &footprint.pieces[..1];
                self.corridor
                    .is_touched_by(self.progress, body, body[0].bounds())
            }
            _ => self.corridor.is_touched(self.progress, footprint),
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
