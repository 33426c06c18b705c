//! Scenes with the statistics of recorded ones: the road families with additional features.
//!
//! `dress` adds side roads, car parks and parking to a plan, `bumps`, `driveways` and `islands` what
//! their names say; `scenery` adds parked vehicles, standing pedestrians and crossing ones anywhere on the
//! network; `manoeuvres`, `turn_ins` and `walkers` add motion in car parks and driveways; `turns` changes how the map shows
//! lanes; this module combines them. Numbers and shares are fitted by hand to
//! `configs/targets/waymo-like.toml` (docs/results/0017-recorded-like.md); distances that no target
//! measures are chosen by eye.

mod bumps;
mod dress;
mod driveways;
mod islands;
mod manoeuvres;
mod scenery;
mod turn_ins;
mod turns;
mod walkers;

use std::ops::RangeInclusive;
use std::sync::Arc;

use gump_scene::{AgentId, AgentKind, LaneId, Rng, Scenario, Seed};
use rand::Rng as _;

use self::driveways::Driveway;
use self::islands::Island;
use crate::layout::{Winding, draw_plan};
use crate::map::{build_map, lane_id};
use crate::network::Network;
use crate::plan::CAR_PARK_SPEED;
use crate::record::{Recording, Track};
use crate::scenario::{draw_placement, frames, route, targets};
use crate::traffic::{Demand, TrafficSimulation};
use crate::{RoadFamily, SynthesisConfig};

/// Weights of the families: recordings are made in towns, rarely on motorways. Fitted by hand in
/// several rounds, towards traffic as fast as recorded one.
const FAMILIES: [(RoadFamily, u32); 9] = [
    (RoadFamily::SignalizedCrossing, 14),
    (RoadFamily::StopCrossing, 30),
    (RoadFamily::TeeJunction, 6),
    (RoadFamily::Roundabout, 2),
    (RoadFamily::Arterial, 48),
    (RoadFamily::CurvedRoad, 20),
    (RoadFamily::OnRamp, 30),
    (RoadFamily::MidBlockCrosswalk, 4),
    (RoadFamily::Grid, 12),
];
// Some formats state no limits, signs or lights (docs/decisions/0014-unknown-inputs.md). The shares
// are chosen by hand, so that a network meets both.
/// Share of scenes whose map states no speed limits.
const NO_LIMITS: f64 = 0.5;
/// Share of scenes whose map states no stop signs, though drivers comply with them.
const NO_SIGNS: f64 = 0.12;
/// Share of scenes with lights whose lights are not recorded.
const NO_LIGHTS: f64 = 0.12;
/// Share of scenes whose map has no lanes in car parks.
const UNMAPPED_CAR_PARKS: f64 = 0.7;
/// Share of these whose road edges run across the mouths of car parks and yards, as they do across
/// driveways in recordings.
const CLOSED_MOUTHS: f64 = 0.6;
/// Roads with a higher limit are wide and carry more traffic, m/s; with one that is higher still it flows,
/// past ramps, too. Chosen by hand.
const WIDE_ROAD_SPEED: f64 = 15.0;
const FREEWAY_SPEED: f64 = 19.0;
/// With one that is higher than this it is a freeway, in most scenes of two carriageways.
const FREE_FLOW: f64 = 26.0;
/// Metres from the centre of the scene within which the ego is chosen: with the
/// 79 m that its tracker sees, this stays within the 150 m that roads reach.
const EGO_REACH: f64 = 60.0;

/// Targets of a scene with the statistics of recorded ones.
pub(crate) fn config() -> SynthesisConfig {
    SynthesisConfig {
        extent_m: 150.0,
        vehicles: 8..=44,
        pedestrians: 0..=46,
        bicycles: 0..=3,
        ..SynthesisConfig::standard()
    }
}

/// A random family, with these weights.
pub(crate) fn draw_family(rng: &mut Rng) -> RoadFamily {
    let total = FAMILIES.iter().map(|(_, weight)| weight).sum();
    let mut draw = rng.random_range(0..total);
    for (family, weight) in FAMILIES {
        if draw < weight {
            return family;
        }
        draw -= weight;
    }
    RoadFamily::Grid
}

/// One draw of a scene; `None` if vehicles touch or there is no suitable ego.
pub(crate) fn draw_scenario(
    config: &SynthesisConfig,
    family: RoadFamily,
    seed: Seed,
    attempt: u64,
) -> Option<Scenario> {
    let mut rng = seed.fork(attempt).rng();
    let mut plan = draw_plan(family, config.extent_m, Winding::Slight, &mut rng);
    dress::dress(&mut plan, config.extent_m, &mut rng);
    let (mut network, trimmed) = Network::roads(&plan, &mut rng);
    let n_lots = rng.random_range(3..=14);
    network.lay_lots(&plan, &trimmed, n_lots, 1..=6, &mut rng);
    let driveways = driveways::lay(&mut network, &plan, &trimmed, &mut rng);
    bumps::lay(&mut network, &plan, &trimmed, &mut rng);
    let islands = islands::lay(&mut network, &mut rng);
    let demand = draw_demand(config, &network, (&driveways, &islands), &mut rng);
    let traffic_rng = seed.fork(attempt).fork(1).rng();
    let mut traffic = TrafficSimulation::new(&network, demand, config.dt, traffic_rng);
    for _ in 0..(config.warmup_s / config.dt).round() as usize {
        traffic.step();
    }
    let mut recording = Recording::make(&mut traffic, config.n_frames());
    if config.steered {
        recording.steer();
    }
    if !recording.part_bodies() {
        return None;
    }
    let mut parking_rng = seed.fork(attempt).fork(2).rng();
    manoeuvres::add(&mut recording, &network, config.dt, &mut parking_rng);
    turn_ins::add(
        &mut recording,
        &network,
        &driveways,
        config.dt,
        &mut parking_rng,
    );
    walkers::add(&mut recording, &network, config.dt, &mut parking_rng);
    walkers::shift(&mut recording, config.dt, &mut parking_rng);
    recording.ease_people(config.dt);
    // Some that were added stayed clear of where others were before.
    if !recording.part_bodies() {
        return None;
    }
    let ego = choose_ego(&recording, config.now(), &mut rng)?;
    let placement = draw_placement(&mut rng);
    let mut route = route(&network, ego, &traffic, &placement);
    let (ego_id, targets) = (ego.body.id, targets(&recording, ego, config.now()));
    hide_car_parks(&mut network, ego, &mut rng);
    let is_mapped = |lane: &LaneId| !network.unmapped.iter().any(|&i| lane_id(i) == *lane);
    route.lanes.retain(is_mapped);
    turns::widen(&mut network, &mut rng);
    turns::skew(&mut network, &mut rng);
    network.hides_limits = rng.random_bool(NO_LIMITS);
    if rng.random_bool(NO_SIGNS) {
        network.furniture.stop_signs.clear();
    }
    if rng.random_bool(NO_LIGHTS) {
        recording.forget_lights();
    }
    let map = build_map(&network, &placement).expect("networks have finite coordinates");
    let log = frames(&recording, &placement, config.dt);
    let mut scenario = Scenario {
        id: format!("like-{family}-{:016x}", seed.0),
        map: Arc::new(map),
        route: Some(Arc::new(route)),
        targets,
        ego: AgentId(ego_id),
        log,
        dt: config.dt,
        now: config.now(),
        objects_of_interest: Vec::new(),
        tags: Vec::new(),
    };
    scenario.tags = gump_metrics::tags::extract_tags(&scenario);
    Some(scenario)
}

fn draw_demand(
    config: &SynthesisConfig,
    network: &Network,
    (driveways, islands): (&[Driveway], &[Island]),
    rng: &mut Rng,
) -> Demand {
    let metres: f64 = network
        .lanes
        .iter()
        .filter(|lane| lane.connector.is_none() && !lane.is_bike_lane())
        .map(|lane| lane.length())
        .sum();
    // One vehicle per 16 m of lane is as much as flows.
    let most = ((metres / 16.0) as usize).max(1);
    let fastest = network.lanes.iter().map(|lane| lane.speed_limit);
    let busy = match fastest.fold(0.0, f64::max) {
        FREE_FLOW.. => 2.5,
        FREEWAY_SPEED.. => 2.1,
        WIDE_ROAD_SPEED.. => 2.4,
        _ => 1.7,
    };
    let moving = draw_skewed(&config.vehicles, 1.3, busy * config.density, rng).clamp(1, most);
    // How busy people and parking are goes together.
    let bustle = rng.random_range(0.0_f64..1.0);
    let people = draw_skewed(
        &config.pedestrians,
        6.0,
        config.density * (0.4 + bustle),
        rng,
    );
    Demand {
        moving,
        parked: 0,
        people,
        bicycles: draw_skewed(&config.bicycles, 4.0, config.density, rng),
        arrivals: rng.random_range(0.05..0.25) * busy * config.density,
        scenery: scenery::draw(network, config, (driveways, islands, bustle), rng),
    }
}

/// A random number of the range, with small ones more frequent the higher `skew` is.
fn draw_skewed(range: &RangeInclusive<usize>, skew: f64, density: f64, rng: &mut Rng) -> usize {
    let part: f64 = rng.random_range(0.0..1.0);
    let (low, high) = (*range.start() as f64, *range.end() as f64);
    ((low + (high - low) * part.powf(skew)) * density).round() as usize
}

/// Leaves the lanes of most car parks and yards off the map, unless the ego drives there.
fn hide_car_parks(network: &mut Network, ego: &Track, rng: &mut Rng) {
    let slow = |lane: &crate::network::NetworkLane| lane.speed_limit < CAR_PARK_SPEED;
    let ego_parks = ego
        .places()
        .iter()
        .any(|(lane, _)| slow(&network.lanes[*lane]));
    if !ego_parks && rng.random_bool(UNMAPPED_CAR_PARKS) {
        let lanes = network.lanes.iter().enumerate();
        network.unmapped = lanes.filter(|(_, l)| slow(l)).map(|(i, _)| i).collect();
        if rng.random_bool(CLOSED_MOUTHS) {
            network.close_mouths(|curb| driveways::surface(curb, driveways::width(rng), rng));
        }
    }
}

/// Any car in traffic that is present all the time and near the centre, standing or not.
fn choose_ego<'a>(recording: &'a Recording, now: usize, rng: &mut Rng) -> Option<&'a Track> {
    let suits = |track: &&Track| {
        let body = track.body;
        let near = |pose: gump_geometry::Pose| pose.position.length() < EGO_REACH;
        // A vehicle that leaves a parking place has no lane.
        !track.places().is_empty()
            && body.is_mobile
            && body.kind == AgentKind::Vehicle
            && body.size[0] < 6.0
            && track.is_complete()
            && track.pose(now).is_some_and(near)
    };
    let able: Vec<&Track> = recording.tracks().filter(suits).collect();
    if able.is_empty() {
        return None;
    }
    let mut draw = || able[rng.random_range(0..able.len())];
    let first = draw();
    // Recorders drive more than the traffic around them.
    let other = draw();
    Some(if first.distance_driven() < 1.0 {
        other
    } else {
        first
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vehicles_neither_appear_nor_vanish_in_yards_and_car_parks() {
        let config = config();
        let mut inner = 0;
        for k in 0..12 {
            let mut rng = Seed(31).fork(k).rng();
            let mut plan = draw_plan(
                RoadFamily::Arterial,
                config.extent_m,
                Winding::Slight,
                &mut rng,
            );
            dress::dress(&mut plan, config.extent_m, &mut rng);
            let (mut network, trimmed) = Network::roads(&plan, &mut rng);
            network.lay_lots(&plan, &trimmed, 4, 1..=6, &mut rng);
            let demand = Demand {
                arrivals: 2.0,
                ..draw_demand(&config, &network, (&[], &[]), &mut rng)
            };
            let mut traffic = TrafficSimulation::new(&network, demand, config.dt, rng);
            for _ in 0..150 {
                traffic.step();
            }
            let recording = Recording::make(&mut traffic, config.n_frames());
            let last = recording.n_snapshots() - 1;
            let is_inner =
                |place: &(usize, f64)| network.lanes[place.0].speed_limit < CAR_PARK_SPEED;
            for track in recording.tracks() {
                let (Some(first), Some(end)) = (track.places().first(), track.places().last())
                else {
                    continue;
                };
                inner += usize::from(is_inner(first) || is_inner(end));
                let appears = track.pose_at_snapshot(0).is_none() && is_inner(first);
                let vanishes = track.pose_at_snapshot(last).is_none() && is_inner(end);
                assert!(!appears && !vanishes, "scene {k}: {}", track.body.id);
            }
        }
        assert!(inner > 10, "{inner}");
    }
}
