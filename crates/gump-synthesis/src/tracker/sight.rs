//! Visibility from the ego: within range, not behind buildings, not behind other agents.
//!
//! Directions around the sensor are divided into bins. For every box the bins it spans are
//! examined; a bin is hidden by a nearer box that reaches above the line from the sensor to the top
//! of the farther one, and by ground that is not open.

use std::collections::{BTreeMap, BTreeSet};

use gump_geometry::{DVec2, angle_difference};
use gump_scene::{Agent, AgentId, AgentKind, AreaKind, Scenario, Seed};
use rand::Rng as _;

use super::Tracker;

/// Directions around the sensor: half a degree each, of which a car at 79 m still spans three.
const BINS: usize = 720;
/// Height of the sensor above the ground, metres: on the roof of a car. Chosen by hand.
const SENSOR: f64 = 2.1;
/// Side of the squares into which open ground is divided, metres: a third of the
/// narrowest open strip beside a road.
const CELL: f64 = 3.0;
/// Interval of visibility checks, seconds: every frame of the usual 10 Hz.
const LOOK_S: f64 = 0.1;
/// Ground is open this far around all agents, metres: where they are is no building. Chosen by
/// hand.
const AROUND: f64 = 5.0;

/// The steps at which agents are tracked.
pub(super) struct Sight {
    tracked: Option<BTreeMap<AgentId, Vec<bool>>>,
}

impl Sight {
    /// Looks at every step.
    pub(super) fn of(scenario: &Scenario, tracker: &Tracker, seed: Seed) -> Self {
        let Some(range) = tracker.range_m else {
            return Self { tracked: None };
        };
        let n = scenario.log.len();
        let open = Open::of(
            scenario,
            seed.fork(0).rng().random_range(tracker.open_m.clone()),
        );
        let mut visible: BTreeMap<AgentId, Vec<f64>> = BTreeMap::new();
        let every = (LOOK_S / scenario.dt).round().max(1.0) as usize;
        for (step, frame) in scenario.log.iter().enumerate() {
            let Some(ego) = frame.agent(scenario.ego) else {
                continue;
            };
            if step % every != 0 {
                for shares in visible.values_mut() {
                    shares[step] = shares[step - 1];
                }
                continue;
            }
            let ego = ego.state.pose.position;
            for (id, share) in look(frame.agents(), (scenario.ego, ego), range, &open) {
                visible.entry(id).or_insert_with(|| vec![0.0; n])[step] = share;
            }
        }
        let frames = scenario.log.iter().flat_map(|frame| frame.agents());
        let kinds: BTreeMap<AgentId, AgentKind> = frames.map(|a| (a.id, a.kind)).collect();
        let tracked = visible.into_iter().map(|(id, shares)| {
            let (reach, misses) = ease(kinds[&id]);
            let ids_seed = seed.fork(1).fork(id.0 as u64);
            let distance = |step: usize| {
                let frame = &scenario.log[step];
                let [agent, ego] = [id, scenario.ego].map(|id| frame.agent(id));
                let both = agent.zip(ego);
                both.map_or(range, |(a, e)| {
                    a.state.pose.position.distance(e.state.pose.position)
                })
            };
            let near = |step| (distance(step) / (range * reach)).clamp(0.0, 1.0);
            let tracker = Tracker {
                misses_per_s: tracker.misses_per_s * misses,
                ..tracker.clone()
            };
            (
                id,
                keep_track(&shares, near, &tracker, scenario.dt, ids_seed),
            )
        });
        Self {
            tracked: Some(tracked.collect()),
        }
    }

    /// True if the tracker has the agent at this step.
    pub(super) fn is_tracked(&self, id: AgentId, step: usize) -> bool {
        let Some(tracked) = &self.tracked else {
            return true;
        };
        tracked.get(&id).is_some_and(|steps| steps[step])
    }
}

/// Trackability of a kind: the share of the range in which it is tracked, and its loss rate
/// relative to a vehicle's. Fitted by hand, like the quality of the tracker.
fn ease(kind: AgentKind) -> (f64, f64) {
    match kind {
        AgentKind::Pedestrian => (0.92, 5.0),
        AgentKind::Bicycle => (0.95, 2.5),
        _ => (1.0, 1.0),
    }
}

/// Turns visibility into a track, with delays at its beginning and end.
fn keep_track(
    shares: &[f64],
    distance: impl Fn(usize) -> f64,
    tracker: &Tracker,
    dt: f64,
    seed: Seed,
) -> Vec<bool> {
    let mut rng = seed.rng();
    // Agents in sight at the beginning have mostly been so for a while.
    let mut seen_s = if rng.random_bool(0.9) { 10.0 } else { 0.0 };
    let mut begins_after = rng.random_range(tracker.begins_after_s.clone());
    let mut coasts = rng.random_range(tracker.coasts_s.clone());
    let (mut hidden_s, mut lost_s) = (0.0, 0.0_f64);
    let mut on = false;
    let steps = shares.iter().enumerate().map(|(step, share)| {
        // With distance, more must be visible, and tracks are lost more often.
        let far = distance(step);
        let misses = tracker.misses_per_s * far.powi(2) * dt;
        if rng.random_bool(misses.clamp(0.0, 1.0)) {
            lost_s = rng.random_range(0.2..2.5);
        }
        lost_s -= dt;
        let needed = tracker.visible_share * (0.5 + far);
        if *share > needed && lost_s <= 0.0 && far < 1.0 {
            (seen_s, hidden_s) = (seen_s + dt, 0.0);
            if !on && seen_s > begins_after {
                on = true;
                coasts = rng.random_range(tracker.coasts_s.clone());
            }
        } else {
            (hidden_s, seen_s) = (hidden_s + dt, 0.0);
            if on && hidden_s > coasts || far >= 1.0 {
                on = false;
                begins_after = rng.random_range(tracker.begins_after_s.clone());
            }
        }
        on
    });
    steps.collect()
}

/// The share of each agent within range that is in sight.
fn look(
    agents: &[Agent],
    (ego_id, ego): (AgentId, DVec2),
    range: f64,
    open: &Open,
) -> Vec<(AgentId, f64)> {
    let mut order: Vec<(f64, &Agent)> = agents
        .iter()
        .filter(|agent| agent.id != ego_id && agent.kind.is_moving())
        .map(|agent| (agent.state.pose.position.distance(ego), agent))
        .filter(|(distance, _)| *distance < range)
        .collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.id.cmp(&b.1.id)));
    // The steepest rise per metre from the sensor to the top of what is nearer, by direction.
    let mut steepest = vec![f64::NEG_INFINITY; BINS];
    let mut seen = Vec::with_capacity(order.len());
    for (distance, agent) in order {
        let (first, n) = bins(agent, ego);
        let rise = (agent.height - SENSOR) / distance.max(1.0);
        let bin = |k: usize| (first + k) % BINS;
        let free = (0..n).filter(|&k| steepest[bin(k)] < rise).count();
        let behind = if open.is_between(ego, agent.state.pose.position) {
            1.0
        } else {
            0.0
        };
        seen.push((agent.id, behind * free as f64 / n as f64));
        for k in 0..n {
            let highest = &mut steepest[bin(k)];
            *highest = highest.max(rise);
        }
    }
    seen
}

/// The first direction that a box spans and how many there are.
fn bins(agent: &Agent, ego: DVec2) -> (usize, usize) {
    let middle = (agent.state.pose.position - ego).to_angle();
    let (mut low, mut high) = (0.0_f64, 0.0_f64);
    for corner in agent.oriented_box().corners() {
        let off = angle_difference((corner - ego).to_angle(), middle);
        (low, high) = (low.min(off), high.max(off));
    }
    let per_bin = std::f64::consts::TAU / BINS as f64;
    let first = ((middle + low).rem_euclid(std::f64::consts::TAU) / per_bin) as usize;
    let n = ((high - low) / per_bin).ceil().max(1.0) as usize;
    (first % BINS, n.min(BINS))
}

/// Ground that does not block the view: roads, their surroundings, and places of agents.
struct Open {
    cells: BTreeSet<(i32, i32)>,
}

impl Open {
    fn of(scenario: &Scenario, beside: f64) -> Self {
        let mut open = Self {
            cells: BTreeSet::new(),
        };
        for lane in scenario.map.lanes() {
            for point in lane.centerline.resample(2.0 * CELL).points() {
                open.add(*point, beside);
            }
        }
        for area in scenario
            .map
            .areas()
            .iter()
            .filter(|a| a.kind == AreaKind::Driveway)
        {
            for point in area.polygon.ring() {
                open.add(*point, AROUND);
            }
        }
        let frames = [scenario.log.first(), scenario.log.last()];
        for agent in frames.iter().flatten().flat_map(|frame| frame.agents()) {
            open.add(agent.state.pose.position, AROUND);
        }
        open
    }

    fn add(&mut self, point: DVec2, reach: f64) {
        let n = (reach / CELL).ceil() as i32;
        let (x, y) = cell(point);
        for (dx, dy) in (-n..=n).flat_map(|dx| (-n..=n).map(move |dy| (dx, dy))) {
            if f64::from(dx * dx + dy * dy) * CELL * CELL <= reach * reach {
                self.cells.insert((x + dx, y + dy));
            }
        }
    }

    /// True if the ground on the way is open.
    fn is_between(&self, from: DVec2, to: DVec2) -> bool {
        let n = (from.distance(to) / CELL).ceil() as usize;
        (1..n).all(|k| {
            self.cells
                .contains(&cell(from.lerp(to, k as f64 / n as f64)))
        })
    }
}

fn cell(point: DVec2) -> (i32, i32) {
    let scaled = (point / CELL).floor();
    (scaled.x as i32, scaled.y as i32)
}
