//! Generation of a scenario from a seed: draws roads, simulates traffic, records it, chooses the
//! ego.

use std::sync::Arc;

use gump_geometry::{DVec2, Polyline, Pose, dvec2, wrap_angle};
use gump_scene::{AgentId, AgentKind, Frame, Light, Route, Scenario, Seed};
use rand::Rng as _;
use rayon::prelude::*;

use crate::layout::{Winding, draw_plan};
use crate::map::{Placement, build_map, lane_id};
use crate::network::{LaneIdx, Network};
use crate::record::{Recording, Track};
use crate::steering::steer;
use crate::traffic::{Demand, Scenery, TrafficSimulation};
use crate::{RoadFamily, SynthesisConfig};

/// Maximum number of draws of roads and traffic; a few suffice, see the test of this module.
const ATTEMPTS: u64 = 64;
/// Maximum number of prediction targets, as in the Waymo Open Motion Dataset.
const MAX_TARGETS: usize = 8;
/// Distance from the ego within which agents may be targets, metres: as where readers infer
/// targets. Chosen by hand.
const TARGET_RANGE: f64 = 60.0;

/// Generates one scenario; the same seed and config always give the same one.
///
/// # Panics
/// If the extent leaves no room for a vehicle to drive through for the logged time.
pub fn synthesize(config: &SynthesisConfig, seed: Seed) -> Scenario {
    try_synthesize(config, seed).expect("the extent leaves room for a vehicle to drive through")
}

/// As [`synthesize`], but `None` if no vehicle drives through for the logged time: this is random
/// where it takes about as long as the extent allows.
pub fn try_synthesize(config: &SynthesisConfig, seed: Seed) -> Option<Scenario> {
    let family = config
        .family
        .unwrap_or_else(|| RoadFamily::ALL[seed.rng().random_range(0..RoadFamily::ALL.len())]);
    // Scenes without traffic for an ego, or in which boxes touch, are drawn again.
    (0..ATTEMPTS).find_map(|attempt| draw_scenario(config, family, seed, attempt))
}

/// Generates `n` scenarios on all threads of the pool; scenario `k` comes from `seed.fork(k)`, so
/// results do not depend on the number of threads.
pub fn synthesize_many(config: &SynthesisConfig, seed: Seed, n: usize) -> Vec<Scenario> {
    (0..n as u64)
        .into_par_iter()
        .map(|k| synthesize(config, seed.fork(k)))
        .collect()
}

fn draw_scenario(
    config: &SynthesisConfig,
    family: RoadFamily,
    seed: Seed,
    attempt: u64,
) -> Option<Scenario> {
    let mut rng = seed.fork(attempt).rng();
    let plan = draw_plan(family, config.extent_m, Winding::Even, &mut rng);
    let network = Network::new(&plan, &mut rng);
    let demand = draw_demand(config, &network, &mut rng);
    let mut traffic = TrafficSimulation::new(
        &network,
        demand,
        config.dt,
        seed.fork(attempt).fork(1).rng(),
    );
    for _ in 0..(config.warmup_s / config.dt).round() as usize {
        traffic.step();
    }
    let recording = Recording::make(&mut traffic, config.n_frames());
    if recording.has_overlaps() {
        return None;
    }
    let ego = choose_ego(&recording, config.now(), &mut rng)?;
    let placement = draw_placement(&mut rng);
    let map = build_map(&network, &placement).expect("networks have finite coordinates");
    let route = route(&network, ego, &traffic, &placement);
    let log = frames(&recording, &placement, config.dt);
    let mut scenario = Scenario {
        id: format!("{family}-{:016x}", seed.0),
        map: Arc::new(map),
        route: Some(Arc::new(route)),
        targets: targets(&recording, ego, config.now()),
        ego: AgentId(ego.body.id),
        log,
        dt: config.dt,
        now: config.now(),
        objects_of_interest: Vec::new(),
        tags: Vec::new(),
    };
    if config.steered {
        steer(&mut scenario);
    }
    scenario.tags = gump_metrics::tags::extract_tags(&scenario);
    Some(scenario)
}

fn draw_demand(config: &SynthesisConfig, network: &Network, rng: &mut gump_scene::Rng) -> Demand {
    let mut draw = |range: &std::ops::RangeInclusive<usize>| {
        let n = rng.random_range(range.clone()) as f64;
        (n * config.density).round() as usize
    };
    let (vehicles, people, bicycles) = (
        draw(&config.vehicles),
        draw(&config.pedestrians),
        draw(&config.bicycles),
    );
    // Shares and rates here are chosen by hand.
    let can_park = !network.parking.is_empty() || !network.lot_places.is_empty();
    let share = if can_park {
        rng.random_range(0.25..0.75)
    } else {
        0.0
    };
    let parked = (vehicles as f64 * share).round() as usize;
    let metres: f64 = network
        .lanes
        .iter()
        .filter(|lane| lane.connector.is_none() && !lane.is_bike_lane())
        .map(|lane| lane.length())
        .sum();
    // One vehicle per 22 m of lane is as much as flows.
    let most = (metres / 22.0) as usize;
    Demand {
        moving: (vehicles - parked).min(most).max(1),
        parked,
        people,
        bicycles,
        arrivals: rng.random_range(0.06..0.3) * config.density,
        scenery: Scenery::default(),
    }
}

/// Somewhere in a world like that of recordings: kilometres from the origin, at any heading and
/// height, on slopes of up to 3 %. Ranges are chosen by hand.
pub(crate) fn draw_placement(rng: &mut gump_scene::Rng) -> Placement {
    let mut coordinate = || rng.random_range(-6000.0..6000.0);
    let position = dvec2(coordinate(), coordinate());
    let steepest = if rng.random_bool(0.4) { 0.03 } else { 0.0 };
    Placement {
        world_from_scene: Pose {
            position,
            heading: wrap_angle(rng.random_range(0.0..std::f64::consts::TAU)),
        },
        height: rng.random_range(-20.0..80.0),
        slope: dvec2(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)) * steepest,
    }
}

/// A car that is present all the time, drives, and is near the centre, with 30 m of chance. Bounds
/// are chosen by hand.
fn choose_ego<'a>(
    recording: &'a Recording,
    now: usize,
    rng: &mut gump_scene::Rng,
) -> Option<&'a Track> {
    let suits = |track: &&Track| {
        let body = track.body;
        let there = track.is_complete();
        body.is_mobile
            && body.kind == AgentKind::Vehicle
            && body.size[0] < 7.0
            && there
            && track.distance_driven() > 8.0
    };
    let mut best: Option<(f64, &Track)> = None;
    for track in recording.tracks().filter(suits) {
        let position = track.pose(now)?.position;
        let score = position.length() + rng.random_range(0.0..30.0);
        if score < 110.0 && best.is_none_or(|(s, _)| score < s) {
            best = Some((score, track));
        }
    }
    best.map(|(_, track)| track)
}

/// The moving agents nearest to the ego, including itself, sorted by id.
pub(crate) fn targets(recording: &Recording, ego: &Track, now: usize) -> Vec<AgentId> {
    let here = ego.pose(now).map_or(DVec2::ZERO, |pose| pose.position);
    let mut near: Vec<(f64, i64)> = recording
        .tracks()
        .filter(|track| track.body.is_mobile && track.lasts_after(now))
        .filter_map(|track| Some((track.pose(now)?.position.distance(here), track.body.id)))
        .filter(|(distance, _)| *distance < TARGET_RANGE)
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut ids: Vec<AgentId> = near
        .iter()
        .take(MAX_TARGETS)
        .map(|(_, id)| AgentId(*id))
        .collect();
    ids.sort();
    ids
}

/// The lanes the ego drove, then those it planned, and the path along them.
pub(crate) fn route(
    network: &Network,
    ego: &Track,
    traffic: &TrafficSimulation<'_>,
    placement: &Placement,
) -> Route {
    let mut runs: Vec<(LaneIdx, f64, f64)> = Vec::new();
    for &(lane, s) in ego.places() {
        match runs.last_mut() {
            Some(run) if run.0 == lane => run.2 = s,
            _ => runs.push((lane, s, s)),
        }
    }
    let ahead = traffic.remaining_path(ego.body.id).unwrap_or_default();
    runs.extend(
        ahead
            .into_iter()
            .skip(1)
            .map(|lane| (lane, 0.0, f64::INFINITY)),
    );
    let mut points = Vec::new();
    for (i, &(lane, first, last)) in runs.iter().enumerate() {
        let track = &network.lanes[lane].track;
        let is_successor = |a: LaneIdx, b: LaneIdx| network.lanes[a].successors.contains(&b);
        let from = match i.checked_sub(1).map(|before| runs[before].0) {
            None => first - 10.0,
            Some(before) if is_successor(before, lane) => 0.0,
            // A lane change takes about this long.
            Some(_) => first + 30.0,
        };
        let to = match runs.get(i + 1) {
            Some(next) if !is_successor(lane, next.0) => last,
            _ => track.length(),
        };
        let (from, to) = (from.max(0.0), to.min(track.length()));
        if to - from > 0.5 || runs.len() == 1 {
            points.extend_from_slice(track.slice(from, to.max(from + 0.5)).points());
        }
    }
    points.dedup_by(|a, b| a.distance(*b) < 1e-6);
    let placed = points
        .iter()
        .map(|p| placement.world_from_scene * *p)
        .collect();
    Route {
        lanes: runs.iter().map(|run| lane_id(run.0)).collect(),
        roadblocks: Vec::new(),
        path: Polyline::new(placed).expect("the ego has been somewhere"),
    }
}

pub(crate) fn frames(recording: &Recording, placement: &Placement, dt: f64) -> Vec<Frame> {
    (0..recording.n_frames())
        .map(|frame| {
            let agents = recording
                .tracks()
                .filter_map(|track| track.agent(frame, placement, dt))
                .collect();
            let lights = recording
                .lights(frame)
                .iter()
                .map(|&(lane, state, stop)| Light {
                    lane: lane_id(lane),
                    state,
                    stop_point: Some(placement.world_from_scene * stop),
                });
            Frame::new(agents, lights.collect())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn most_draws_are_kept() {
        // A draw that is thrown away skews what the scenes show, so it must be rare.
        let config = SynthesisConfig::standard();
        for family in RoadFamily::ALL {
            let draw = |k: &u64| draw_scenario(&config, family, Seed(99).fork(*k), 0).is_some();
            let kept = (0..30).filter(draw).count();
            assert!(kept >= 24, "{family}: {kept} of 30");
        }
    }

    #[test]
    fn overlaps_are_prevented_rather_than_thrown_away() {
        let config = SynthesisConfig::standard();
        let overlapping = |k: &u64| {
            let seed = Seed(7).fork(*k);
            let mut rng = seed.rng();
            let family = RoadFamily::ALL[*k as usize % RoadFamily::ALL.len()];
            let network = Network::new(
                &draw_plan(family, config.extent_m, Winding::Even, &mut rng),
                &mut rng,
            );
            let demand = draw_demand(&config, &network, &mut rng);
            let mut traffic = TrafficSimulation::new(&network, demand, config.dt, rng);
            for _ in 0..250 {
                traffic.step();
            }
            Recording::make(&mut traffic, config.n_frames()).has_overlaps()
        };
        let n = (0..180).filter(overlapping).count();
        assert!(n <= 9, "{n} of 180");
    }
}
