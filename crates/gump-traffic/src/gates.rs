//! Arrivals and departures: agents enter where lanes enter a window, in platoons as upstream
//! signals produce them, and leave where they drive out of it or where the map ends.
//!
//! There is one window around the start of the scene, and another around the ego once it has moved
//! away from there. As soon as the start is outside of that, it is left behind. When the ego leaves the
//! map there is the window around the start again.
//!
//! On average the number of agents per metre of lane stays as at the start. Agents do not appear or
//! vanish in sight of the ego, except where their lane ends.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, Polyline, Pose, angle_difference, dvec2};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, BendLimits, Frame, Lane, LaneId, LaneKind, Light,
    LightState, MapGraph, Rng, SceneState, Seed, TYPICAL_SPEED_LIMIT, bend_speed, lanes_ahead,
};
use rand::Rng as _;

/// Distances at which agents enter and leave.
#[derive(Clone, Debug, PartialEq)]
pub struct Arrivals {
    /// Radius of the windows around the start and around the ego, metres.
    pub window_m: f64,
    /// No agent enters or leaves nearer to the ego than this, metres.
    pub sight_m: f64,
}

impl Default for Arrivals {
    /// A window of 110 m, in which recordings show most agents; 50 m of sight, about half of it.
    /// Not tuned.
    fn default() -> Self {
        Self {
            window_m: 110.0,
            sight_m: 50.0,
        }
    }
}

/// The kinds of agents that enter, with their usual values.
const KINDS: [AgentKind; 3] = AgentKind::MOVING;
// Chosen by hand. Result 23 has the number of agents and the films that they lead to together; none
// was tuned by itself.

/// Usual speeds, metres per second, where the scene shows no agents; of those that it shows at least
/// half of these are assumed, since all may wait at the present.
const USUAL_SPEED: [f64; 3] = [7.0, 1.3, 4.5];
/// Share of the window's width that an entering agent crosses: 1 is a path through the middle;
/// others cut a corner or turn off.
const CROSSED: f64 = 0.6;
/// How much the rate of arrivals grows for the share of agents that are missing, and falls for those
/// that are too many. In balance, traffic that takes half as long again to cross the window as at the
/// start has `(1 + GAIN) / (GAIN + 2/3)` of the agents, 5 % more; with 2 it was 12 % (result 38).
const GAIN: f64 = 6.0;
/// The greatest rate, on an empty road, in that of the start.
const MOST_RATE: f64 = 3.0;
/// Distance that the ego may move before it gets its own window, or its gates are determined again,
/// metres: well below the 60 m from its sight to the window's border.
const MOVED_M: f64 = 20.0;
/// An agent that is this far outside the window and moves away leaves, metres: not just where
/// others enter.
const BEYOND_M: f64 = 12.0;
/// Where there are more lanes than this many times those of the start, the number of agents does not
/// grow any more: a simulation must not slow down without bound where the ego comes to a large junction.
const MOST_LANES: f64 = 2.0;
/// The ego is off the map if no lane is this near, metres: wider than a road with its shoulder.
const OFF_MAP_M: f64 = 15.0;
/// Sampling distance along lanes, metres: shorter crossings of the border are missed.
const STEP_M: f64 = 5.0;
/// Agents this many windows away leave, even if they do not move: 200 m.
const FAR: f64 = 1.8;
/// An agent nearer than this to the end of the map leaves there, metres: half a second at 10 m/s.
const END_M: f64 = 5.0;
/// Length of the path examined beyond a gate, metres: more than a stop from 14 m/s by gentle
/// braking.
const PATH_M: f64 = 70.0;
/// Gaps ahead and behind that an entering agent needs, metres: who is behind has not seen it
/// before.
const LEAST_GAP_M: f64 = 7.0;
const LEAST_REAR_M: f64 = 10.0;
/// The longest queue before a gate; further arrivals are lost, else a jam would let them in for
/// minutes after it.
const LONGEST_QUEUE: u32 = 4;
/// Faster roads have signals that let traffic through in platoons, metres per second: from 30
/// km/h on.
const PLATOON_LIMIT: f64 = 8.0;
/// Periods of such signals, seconds, and the share in which they let traffic through: usual cycles
/// of two phases.
const PERIOD_S: (f64, f64) = (40.0, 80.0);
const OPEN: f64 = 0.5;

/// What an entering driver accepts in bends and before them, gently.
const BENDS: BendLimits = BendLimits {
    lateral_mps2: 2.5,
    braking_mps2: 1.5,
    ahead_m: 80.0,
};
/// Distance at which an entering driver stops before a red light, metres.
const STOP_M: f64 = 3.0;

/// A place where agents enter.
#[derive(Clone, Debug)]
struct Gate {
    kind: usize,
    /// Index of the window it leads into.
    window: usize,
    lane: LaneId,
    pose: Pose,
    /// The path beyond it.
    path: Polyline,
    limit: f64,
    /// The greatest speed for the bends beyond it, metres per second.
    bends: f64,
}

/// Arrivals and departures of one future.
#[derive(Clone, Debug)]
pub(crate) struct Flow {
    config: Arrivals,
    seed: Seed,
    step: u64,
    time: f64,
    gates: Vec<Gate>,
    /// Position of the ego when the gates were determined.
    looked_at: DVec2,
    /// The start, and whether the ego has left it behind.
    start: DVec2,
    is_left: bool,
    /// The centres of the windows: the start, and the ego if it has moved on.
    centres: Vec<DVec2>,
    /// Metres of lanes in each window, and in that of the start at first.
    lanes_m: Vec<f64>,
    lanes_at_start_m: f64,
    /// Number of agents of each kind in the window at the start, and their mean speeds, with those
    /// that wait: as many cross the border as their number times their speed.
    usual: [f64; 3],
    speed: [f64; 3],
    /// Extents of the agents at the start.
    sizes: [Vec<[f64; 3]>; 3],
    /// Agents waiting to enter, by lane and kind.
    waiting: BTreeMap<(LaneId, usize), u32>,
    next_id: i64,
}

fn index_of(kind: AgentKind) -> Option<usize> {
    KINDS.iter().position(|known| *known == kind)
}

/// Whether agents can enter: a lane begins in the window around the ego or leads into it.
pub(crate) fn leads_anywhere(config: &Arrivals, scene: SceneState<'_>) -> bool {
    let ego = scene.ego_now().state.pose.position;
    !gates(scene.map, &[ego], ego, config).is_empty()
}

impl Flow {
    /// From the visible part of a scene; `None` if no lane leads into it, which is
    /// [noted](crate::Note::NoEntry).
    pub(crate) fn begin(config: &Arrivals, scene: SceneState<'_>, seed: Seed) -> Option<Self> {
        let ego = scene.ego_now().state.pose.position;
        let now = scene.now();
        let mut this = Self {
            config: config.clone(),
            seed,
            step: 0,
            time: 0.0,
            gates: gates(scene.map, &[ego], ego, config),
            looked_at: ego,
            start: ego,
            is_left: false,
            centres: vec![ego],
            lanes_m: Vec::new(),
            lanes_at_start_m: 0.0,
            usual: [0.0; 3],
            speed: USUAL_SPEED,
            sizes: Default::default(),
            waiting: BTreeMap::new(),
            // An agent that has left before the present keeps its id as well.
            next_id: scene
                .history
                .iter()
                .flat_map(Frame::agents)
                .map(|agent| agent.id.0)
                .max()
                .unwrap_or(0)
                .saturating_add(1),
        };
        this.lanes_m = lane_metres(scene.map, &this.centres, config.window_m);
        this.lanes_at_start_m = this.lanes_m[0];
        this.usual = this.count(scene.map, now, scene.ego)[0];
        for (k, kind) in KINDS.into_iter().enumerate() {
            let of = now.agents().iter().filter(|agent| agent.kind == kind);
            let others = of.filter(|agent| agent.id != scene.ego);
            this.sizes[k] = others.map(|a| [a.length, a.width, a.height]).collect();
            let taking_part = this.taking_part(scene.map, now, scene.ego);
            let of_kind = taking_part.filter(|(_, kind, _)| *kind == k);
            let speeds: Vec<f64> = of_kind.map(|(.., speed)| speed).collect();
            if !speeds.is_empty() {
                let mean = speeds.iter().sum::<f64>() / speeds.len() as f64;
                this.speed[k] = mean.max(USUAL_SPEED[k] / 2.0);
            }
        }
        (!this.gates.is_empty()).then_some(this)
    }

    /// Nearest window, kind and speed of the agents that take part in traffic; parked vehicles do not.
    fn taking_part<'a>(
        &'a self,
        map: &'a MapGraph,
        frame: &'a Frame,
        ego: AgentId,
    ) -> impl Iterator<Item = (usize, usize, f64)> + 'a {
        let others = frame.agents().iter().filter(move |agent| agent.id != ego);
        others.filter_map(move |agent| {
            let (at, speed) = (agent.state.pose.position, agent.state.speed());
            let kind = index_of(agent.kind)?;
            let is_parked = || {
                let is_slow = agent.kind == AgentKind::Vehicle && speed < 0.5;
                is_slow && map.lanes_near(at, 1.5).next().is_none()
            };
            let (window, distance) = nearest(&self.centres, at);
            (distance <= self.config.window_m && !is_parked()).then_some((window, kind, speed))
        })
    }

    /// Their numbers, by window and kind.
    fn count(&self, map: &MapGraph, frame: &Frame, ego: AgentId) -> Vec<[f64; 3]> {
        let mut counts = vec![[0.0; 3]; self.centres.len()];
        for (window, kind, _) in self.taking_part(map, frame, ego) {
            counts[window][kind] += 1.0;
        }
        counts
    }

    /// The agents that leave and enter before the next frame, `dt` seconds later.
    pub(crate) fn step(
        &mut self,
        map: &MapGraph,
        frame: &Frame,
        ego: AgentId,
        dt: f64,
    ) -> (Vec<AgentId>, Vec<Agent>) {
        self.step += 1;
        self.time += dt;
        let Some(driven) = frame.agent(ego) else {
            return (Vec::new(), Vec::new());
        };
        let centre = driven.state.pose.position;
        if centre.distance(self.looked_at) > MOVED_M {
            self.looked_at = centre;
            let is_on_map = map.lanes_near(centre, OFF_MAP_M).next().is_some();
            let metres = self.start.distance(centre);
            self.is_left = is_on_map && (self.is_left || metres > self.config.window_m);
            let start = (!self.is_left).then_some(self.start);
            let own = is_on_map && (self.is_left || metres > MOVED_M);
            self.centres = start.into_iter().chain(own.then_some(centre)).collect();
            self.gates = gates(map, &self.centres, centre, &self.config);
            self.lanes_m = lane_metres(map, &self.centres, self.config.window_m);
        }
        let others = frame.agents().iter().filter(|agent| agent.id != ego);
        let leave: Vec<AgentId> = others
            .filter(|agent| self.leaves(map, agent))
            .map(|agent| agent.id)
            .collect();
        let counts = self.count(map, frame, ego);
        let mut there: Vec<Agent> = frame.agents().to_vec();
        there.retain(|agent| !leave.contains(&agent.id));
        let mut come = Vec::new();
        for g in 0..self.gates.len() {
            let seed = self.seed.fork(self.step).fork(g as u64);
            // Gates are older than the ego's last metres.
            if self.gates[g].pose.position.distance(centre) < self.config.sight_m {
                continue;
            }
            let lights = frame.lights();
            if let Some(agent) =
                self.at_gate(g, map, (&there, lights), &counts, dt, &mut seed.rng())
            {
                there.push(agent);
                come.push(agent);
            }
        }
        (leave, come)
    }

    fn leaves(&self, map: &MapGraph, agent: &Agent) -> bool {
        let (at, velocity) = (agent.state.pose.position, agent.state.velocity);
        let (nearest, distance) = nearest(&self.centres, at);
        let away = at - self.centres[nearest];
        let window = self.config.window_m;
        if distance > FAR * window {
            return true;
        }
        let moves = velocity.length() > 0.5;
        if moves && distance > window + BEYOND_M && velocity.dot(away) > 0.0 {
            return true;
        }
        agent.kind != AgentKind::Pedestrian && moves && ends_at(map, agent)
    }

    /// The agent that enters at a gate in this step, if one does and there is room.
    fn at_gate(
        &mut self,
        g: usize,
        map: &MapGraph,
        (there, lights): (&[Agent], &[Light]),
        counts: &[[f64; 3]],
        dt: f64,
        rng: &mut Rng,
    ) -> Option<Agent> {
        let gate = &self.gates[g];
        let k = gate.kind;
        let is_beside = |other: &&Gate| (other.kind, other.window) == (k, gate.window);
        let same = self.gates.iter().filter(is_beside).count() as f64;
        let lanes = self.lanes_m[gate.window] / self.lanes_at_start_m.max(1.0);
        let usual = self.usual[k] * lanes.min(MOST_LANES);
        if usual == 0.0 {
            return None;
        }
        // As many come as leave in the mean, more of them while some are missing.
        let crossing = CROSSED * 2.0 * self.config.window_m / self.speed[k];
        let missing = (usual - counts[gate.window][k]) / usual;
        let rate = usual / crossing * (1.0 + GAIN * missing).clamp(0.0, MOST_RATE);
        let expected = rate / same * self.platoon(gate) * dt;
        let key = (gate.lane, k);
        let queue = self.waiting.entry(key).or_default();
        if rng.random::<f64>() < expected {
            *queue = (*queue + 1).min(LONGEST_QUEUE);
        }
        if *queue == 0 {
            return None;
        }
        let gate = &self.gates[g];
        let size = match self.sizes[k].as_slice() {
            [] => KINDS[k].usual_size(),
            sizes => sizes[rng.random_range(0..sizes.len())],
        };
        // Drivers keep to the limit, about, and people differ by a fifth; chosen by hand.
        let wanted = match KINDS[k] {
            AgentKind::Vehicle => {
                let wanted = gate.limit * rng.random_range(0.8..1.05);
                wanted.min(gate.bends).min(before_red(map, gate, lights))
            }
            _ => USUAL_SPEED[k] * rng.random_range(0.8..1.2),
        };
        let speed = entering_speed(gate, there, size[0], wanted)?;
        *self.waiting.entry(key).or_default() -= 1;
        let id = AgentId(self.next_id);
        self.next_id = self.next_id.saturating_add(1);
        let position = gate.pose.position;
        Some(Agent {
            id,
            kind: KINDS[k],
            length: size[0],
            width: size[1],
            height: size[2],
            elevation: map.elevation_at(position).unwrap_or_default() + size[2] / 2.0,
            state: AgentState {
                pose: gate.pose,
                velocity: gate.pose.direction() * speed,
            },
        })
    }

    /// Traffic density at a gate relative to its mean: high in a platoon, low between platoons.
    fn platoon(&self, gate: &Gate) -> f64 {
        if KINDS[gate.kind] != AgentKind::Vehicle || gate.limit < PLATOON_LIMIT {
            return 1.0;
        }
        let mut rng = self.seed.fork(u64::MAX).fork(gate.lane.0 as u64).rng();
        let period = rng.random_range(PERIOD_S.0..PERIOD_S.1);
        let offset = rng.random_range(0.0..period);
        let is_open = (self.time + offset) % period < OPEN * period;
        if is_open { 1.0 / OPEN } else { 0.0 }
    }
}

/// Whether a vehicle or bicycle has reached the end of a lane without successors.
fn ends_at(map: &MapGraph, agent: &Agent) -> bool {
    let pose = agent.state.pose;
    let lanes = map.lanes_near(pose.position, 3.0);
    let along = lanes.filter(|(lane, _)| lane.foot(pose).turned < 0.8);
    let nearest = along.min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.id.cmp(&b.0.id)));
    nearest.is_some_and(|(lane, _)| {
        let left = lane.centerline.length() - lane.foot(pose).along_m - agent.length / 2.0;
        left < END_M && map.successors(lane.id).next().is_none()
    })
}

/// The speed from which gentle braking is enough for the red lights beyond a gate, metres per
/// second.
fn before_red(map: &MapGraph, gate: &Gate, lights: &[Light]) -> f64 {
    let Some(lane) = map.lane(gate.lane) else {
        return f64::INFINITY;
    };
    let at = lane.centerline.project(gate.pose.position).arc_length;
    let (ahead, _) = lanes_ahead(map, lane, at, PATH_M);
    let red = lights.iter().filter(|l| l.state == LightState::Red);
    let stops = red.flat_map(|light| {
        let its = ahead.iter().filter(|part| part.lane.id == light.lane);
        its.map(|part| part.metres_to_stop_line(light))
    });
    let least = stops.filter(|metres| *metres > 0.0).reduce(f64::min);
    least.map_or(f64::INFINITY, |metres| {
        (2.0 * BENDS.braking_mps2 * (metres - STOP_M).max(0.0)).sqrt()
    })
}

/// The speed at which an agent with this desired speed may enter; `None` if there is no room.
fn entering_speed(gate: &Gate, there: &[Agent], length: f64, wanted: f64) -> Option<f64> {
    let mut speed = wanted;
    for agent in there {
        let at = agent.state.pose.position;
        if at.distance_squared(gate.pose.position) > PATH_M * PATH_M {
            continue;
        }
        let foot = gate.path.project(at);
        // As far as it extends across the path: parked vehicles stand at an angle.
        let way = gate.path.pose_at(foot.arc_length).heading;
        let (sin, cos) = angle_difference(agent.state.pose.heading, way).sin_cos();
        let half = (cos.abs() * agent.width + sin.abs() * agent.length) / 2.0;
        if foot.distance > 1.0 + half && foot.arc_length > 0.0 {
            continue;
        }
        let gap = foot.arc_length - (length + agent.length) / 2.0;
        if foot.arc_length <= 0.0 {
            // Behind, or beside the gate.
            let behind = gate.pose.inverse() * at;
            if behind.x > -LEAST_REAR_M - agent.length && behind.y.abs() < 3.0 {
                return None;
            }
            continue;
        }
        if gap < LEAST_GAP_M {
            return None;
        }
        let room = gap - 2.0;
        let along = agent.state.velocity.dot(gate.pose.direction()).max(0.0);
        // So that a second of headway is left, and gentle braking is enough.
        let safe = (along * along + 2.0 * 1.5 * room).sqrt();
        speed = speed.min(safe).min(room / 1.0);
    }
    Some(speed)
}

/// Index and distance of the nearest of these points.
fn nearest(centres: &[DVec2], at: DVec2) -> (usize, f64) {
    let each = centres.iter().map(|centre| centre.distance(at)).enumerate();
    each.min_by(|a, b| a.1.total_cmp(&b.1))
        .unwrap_or((0, f64::INFINITY))
}

/// Metres of lanes for motor traffic in the windows around these centres, each metre in the nearest.
fn lane_metres(map: &MapGraph, centres: &[DVec2], radius: f64) -> Vec<f64> {
    let mut metres = vec![0.0; centres.len()];
    for (window, centre) in centres.iter().enumerate() {
        for lane in map.lanes_in_square(*centre, radius) {
            if lane.kind == LaneKind::BikeLane {
                continue;
            }
            let length = lane.centerline.length();
            let n = (length / STEP_M).ceil().max(1.0);
            let place = |i: usize| length * (i as f64 + 0.5) / n;
            let places = (0..n as usize).map(|i| lane.centerline.pose_at(place(i)).position);
            let is_own = |at: &DVec2| matches!(nearest(centres, *at), (of, m) if of == window && m <= radius);
            metres[window] += places.filter(is_own).count() as f64 * length / n;
        }
    }
    metres
}

/// The places where lanes enter the windows around these centres, and where pedestrians walk beside
/// the lanes; out of sight of the ego.
fn gates(map: &MapGraph, centres: &[DVec2], ego: DVec2, config: &Arrivals) -> Vec<Gate> {
    let mut gates = Vec::new();
    let reach = config.window_m + 5.0;
    let mut lanes: Vec<&Lane> = centres
        .iter()
        .flat_map(|centre| map.lanes_in_square(*centre, reach))
        .collect();
    lanes.sort_by_key(|lane| lane.id);
    lanes.dedup_by_key(|lane| lane.id);
    for lane in lanes {
        if lane.in_intersection {
            continue;
        }
        let is_for_bicycles = lane.kind == LaneKind::BikeLane;
        let mut entries: Vec<f64> = Vec::new();
        if map.predecessors(lane.id).next().is_none() {
            entries.push(0.5_f64.min(lane.centerline.length() / 2.0));
        }
        entries.extend(crossings(lane, centres, config.window_m, 1.0));
        for s in entries {
            let pose = lane.centerline.pose_at(s);
            let (window, distance) = nearest(centres, pose.position);
            let is_seen = pose.position.distance(ego) < config.sight_m;
            if is_seen || distance > config.window_m + 1.0 {
                continue;
            }
            let Some(path) = path_from(map, lane, s) else {
                continue;
            };
            let limit = lane.speed_limit.unwrap_or(TYPICAL_SPEED_LIMIT);
            let bends = bend_speed(map, lane, s, BENDS);
            let gate = |kind: usize, pose: Pose| Gate {
                kind,
                window,
                lane: lane.id,
                pose,
                path: path.clone(),
                limit,
                bends,
            };
            if !is_for_bicycles {
                gates.push(gate(0, pose));
            }
            let edge = if is_for_bicycles {
                0.0
            } else {
                // 0.7 m from the right edge: half a bicycle and some room.
                0.7 - lane.width / 2.0
            };
            gates.push(gate(2, aside(pose, edge)));
        }
        for (inward, turned) in [(1.0, 0.0), (-1.0, std::f64::consts::PI)] {
            for s in crossings(lane, centres, config.window_m, inward) {
                // 2 m beyond the lane, on a sidewalk.
                let pose = aside(lane.centerline.pose_at(s), -lane.width / 2.0 - 2.0);
                let is_seen = pose.position.distance(ego) < config.sight_m;
                if is_seen || map.lanes_containing(pose.position).next().is_some() {
                    continue;
                }
                let pose = Pose {
                    heading: gump_geometry::wrap_angle(pose.heading + turned),
                    ..pose
                };
                let end = pose.position + pose.direction() * 10.0;
                let Some(path) = Polyline::new(vec![pose.position, end]) else {
                    continue;
                };
                gates.push(Gate {
                    kind: 1,
                    window: nearest(centres, pose.position).0,
                    lane: lane.id,
                    pose,
                    path,
                    limit: TYPICAL_SPEED_LIMIT,
                    bends: f64::INFINITY,
                });
            }
        }
    }
    gates
}

/// A pose so many metres to the left.
fn aside(pose: Pose, left: f64) -> Pose {
    Pose {
        position: pose * dvec2(0.0, left),
        ..pose
    }
}

/// Arc lengths at which a lane enters circles around these centres, or leaves them if `inward` is
/// -1, metres.
fn crossings(lane: &Lane, centres: &[DVec2], radius: f64, inward: f64) -> Vec<f64> {
    let line = lane.centerline.resample(STEP_M);
    let beyond = |p: DVec2| inward * (nearest(centres, p).1 - radius);
    let pairs = line.points().windows(2).zip(line.arc_lengths().windows(2));
    pairs
        .filter_map(|(points, s)| {
            let (from, to) = (beyond(points[0]), beyond(points[1]));
            let share = from / (from - to);
            (from > 0.0 && to <= 0.0).then(|| s[0] + share * (s[1] - s[0]))
        })
        .collect()
}

/// The path ahead from a position on a lane, straight on where it forks; `None` if it is short: 25
/// m, too little to be worth an arrival.
fn path_from(map: &MapGraph, lane: &Lane, s: f64) -> Option<Polyline> {
    let mut path = lane.centerline.slice(s, lane.centerline.length());
    let mut last = lane;
    for _ in 0..4 {
        if path.length() >= PATH_M {
            break;
        }
        let heading = path.pose_at(path.length()).heading;
        let turn = |lane: &Lane| {
            let way = &lane.centerline;
            let end = way.pose_at(way.length()).heading;
            angle_difference(end, heading).abs()
        };
        let next = map.successors(last.id);
        let Some(next) = next.min_by(|a, b| turn(a).total_cmp(&turn(b)).then(a.id.cmp(&b.id)))
        else {
            break;
        };
        let points = path.points().iter().chain(next.centerline.points());
        path = Polyline::new(points.copied().collect())?;
        last = next;
    }
    (path.length() > 25.0).then_some(path)
}

#[cfg(test)]
mod tests {
    use gump_scene::{Scenario, fixture};

    use super::*;

    /// A scene, and its gate for vehicles on lane 1, which enters the window 110 m before the ego.
    fn entry(text: &str) -> (Scenario, Gate) {
        let scenario = fixture::scenario(&format!("{text}\nego vehicle 0: 0,0")).unwrap();
        let all = gates(
            &scenario.map,
            &[DVec2::ZERO],
            DVec2::ZERO,
            &Arrivals::default(),
        );
        let mut of_lane = all
            .into_iter()
            .filter(|g| (g.kind, g.lane) == (0, LaneId(1)));
        let gate = of_lane.next().expect("lane 1 leads into the window");
        (scenario, gate)
    }

    #[test]
    fn nobody_enters_into_a_vehicle_that_is_parked_askew() {
        // Its centre is 3 m beside the path: along the road there is room, across it is not.
        let enters = |heading: f64| {
            let text =
                format!("lane 1: -200,0 200,0\nagent vehicle 1: -106,3 heading {heading} size 5,2");
            let (scenario, gate) = entry(&text);
            let there = scenario.present().now().agents();
            entering_speed(&gate, there, 4.5, 10.0).is_some()
        };
        assert!(enters(0.0));
        assert!(!enters(0.6));
    }

    #[test]
    fn who_enters_before_a_bend_or_a_red_light_can_take_it_gently() {
        let (_, straight) = entry("lane 1: -200,0 200,0");
        assert!(straight.bends.is_infinite());
        // A right angle after 30 m.
        let (_, bend) = entry("lane 1: -200,0 -80,0 -80,90");
        assert!((6.0..12.0).contains(&bend.bends), "{}", bend.bends);
        let speed = |colour: &str| {
            let text = format!(
                "lane 1: -200,0 -60,0 next 2\nlane 2: -60,0 200,0\nlight 2 {colour}: -60,0"
            );
            let (scenario, gate) = entry(&text);
            before_red(&scenario.map, &gate, scenario.present().now().lights())
        };
        // 50 m, of which the last 3 are left, with 1.5 m/s².
        assert!(
            (speed("red") - 141_f64.sqrt()).abs() < 0.1,
            "{}",
            speed("red")
        );
        assert!(speed("green").is_infinite());
    }

    #[test]
    fn the_window_follows_the_ego_on_the_map() {
        // Two lanes from the start on, one beyond it.
        let text = "lane 1: -400,0 0,0 next 2\nlane 2: 0,0 400,0\nlane 3: -400,4 0,4\n\
                    ego vehicle 0: 0,0\nagent vehicle 1: -60,0 velocity 10,0";
        let scenario = fixture::scenario(text).unwrap();
        let scene = scenario.present();
        let mut flow = Flow::begin(&Arrivals::default(), scene, Seed(0)).unwrap();
        let mut ego = *scene.ego_now();
        let mut at = |x: f64| {
            ego.state.pose.position = dvec2(x, 0.0);
            flow.step(
                &scenario.map,
                &Frame::new(vec![ego], Vec::new()),
                ego.id,
                0.5,
            );
            let centres: Vec<f64> = flow.centres.iter().map(|centre| centre.x).collect();
            let lanes: Vec<f64> = flow
                .lanes_m
                .iter()
                .map(|m| (m / 10.0).round() * 10.0)
                .collect();
            (centres, lanes)
        };
        assert_eq!(at(10.0), (vec![0.0], vec![330.0]));
        // Each metre is in the nearest window.
        assert_eq!(at(60.0), (vec![0.0, 60.0], vec![250.0, 140.0]));
        // The start is left behind, even if the ego returns.
        assert_eq!(at(200.0), (vec![200.0], vec![220.0]));
        assert_eq!(at(50.0).0, [50.0]);
        // Off the map, and on it again.
        assert_eq!(at(395.0).0, [395.0]);
        assert_eq!(at(500.0), (vec![0.0], vec![330.0]));
        assert_eq!(at(300.0).0, [300.0]);
    }

    #[test]
    fn new_agents_get_ids_that_nobody_had() {
        let text = "lane 1: -200,0 200,0\nego vehicle 0: 0,0\nagent vehicle 7: 30,0\n\
                    history 1 future 0 dt 0.5";
        let mut scenario = fixture::scenario(text).unwrap();
        let ego = *scenario.present().ego_now();
        scenario.log[scenario.now] = Frame::new(vec![ego], Vec::new());
        let next_id = |scenario: &Scenario| {
            let flow = Flow::begin(&Arrivals::default(), scenario.present(), Seed(0));
            flow.unwrap().next_id
        };
        assert_eq!(next_id(&scenario), 8);
        let last = Agent {
            id: AgentId(i64::MAX),
            ..ego
        };
        scenario.log[0] = Frame::new(vec![ego, last], Vec::new());
        assert_eq!(next_id(&scenario), i64::MAX);
    }

    #[test]
    fn as_many_enter_as_would_cross_the_window_at_the_speed_of_all() {
        let speed = |moving: &str| {
            let text = format!("lane 1: -200,0 200,0\nego vehicle 0: 0,0\n{moving}");
            let scenario = fixture::scenario(&text).unwrap();
            let flow = Flow::begin(&Arrivals::default(), scenario.present(), Seed(0)).unwrap();
            (flow.usual[0], flow.speed[0])
        };
        let one = "agent vehicle 1: -60,0 velocity 12,0";
        assert_eq!(speed(one), (1.0, 12.0));
        // One that waits counts, one that is parked does not.
        assert_eq!(speed(&format!("{one}\nagent vehicle 2: 30,0")), (2.0, 6.0));
        assert_eq!(speed(&format!("{one}\nagent vehicle 2: 30,4")), (1.0, 12.0));
        assert_eq!(speed("agent vehicle 2: 30,0"), (1.0, USUAL_SPEED[0] / 2.0));
    }
}
