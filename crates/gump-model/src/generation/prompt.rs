//! What a prompt asks for in a guided scene, beyond what the network makes of its tokens: a speed
//! of the ego, somebody in its way, a place on the map where such a thing can happen.
//!
//! A tag that depends on what happens next is only made likely here; whether it holds is for
//! `verdict` to say.

use std::sync::Arc;

use gump_geometry::Pose;
use gump_metrics::tags;
use gump_scene::{Agent, AgentId, AgentKind, AgentState, Frame, Lane, LaneKind, Light, MapGraph};
use gump_scene::{AreaKind, Scenario, ScenarioTag, Seed};
use rand::Rng as _;

use super::constraint::{Bounds, Class, EGO, ObjectSpec, Relation};
use super::{EgoStart, agent_of};

/// Places tried before any place is taken.
const PLACES: usize = 600;
/// How far from where it is asked the ego may be put, metres.
const ROAM_M: f64 = 150.0;
/// Seconds of a trial drive.
const TRIAL_S: f64 = 4.0;
/// Seconds between its frames.
const TRIAL_DT: f64 = 0.1;

/// What a tag asks for.
#[derive(Clone, Debug, Default)]
pub(crate) struct Cast {
    speed: Option<Bounds>,
    objects: Vec<ObjectSpec>,
    /// How a trial drive speeds up, metres per second squared.
    acceleration: f64,
    /// Whether a lone ego (and who is in a row with it) can show that a place fits.
    is_about_place: bool,
    /// Whether the people cast are on a crosswalk.
    is_about_crosswalk: bool,
}

impl Cast {
    /// What all tags ask for together; of two speeds the first counts.
    pub(crate) fn of(prompts: &[ScenarioTag]) -> Self {
        let mut all = Self::default();
        for (i, tag) in prompts.iter().enumerate() {
            let cast = of_tag(tag.name());
            all.speed = all.speed.or(cast.speed);
            all.acceleration += cast.acceleration;
            all.is_about_place |= cast.is_about_place;
            all.is_about_crosswalk |= cast.is_about_crosswalk;
            let named = cast.objects.into_iter().enumerate();
            all.objects.extend(named.map(|(k, object)| ObjectSpec {
                id: format!("{tag} {i}.{k}"),
                ..object
            }));
        }
        all
    }

    /// The wishes of a scene with these of the user's own, who has the last word on the ego.
    pub(crate) fn with(&self, own: &[ObjectSpec]) -> Vec<ObjectSpec> {
        let mut objects = own.to_vec();
        match objects.iter_mut().find(|object| object.id == EGO) {
            Some(ego) => ego.speed = ego.speed.or(self.speed),
            None => objects.push(ObjectSpec {
                id: EGO.into(),
                speed: self.speed,
                ..ObjectSpec::default()
            }),
        }
        // Somebody else may already be where the prompt wants somebody.
        let has = |relation: &Option<Relation>| {
            let gap = relation.as_ref().filter(|r| r.object == EGO);
            gap.is_some()
        };
        let is_led = own.iter().any(|object| has(&object.ahead_of));
        let cast = self.objects.iter();
        objects.extend(cast.filter(|o| !(is_led && has(&o.ahead_of))).cloned());
        objects
    }

    /// Where the ego may start so that the tags can hold; `around` if no place tried shows that.
    pub(crate) fn start(
        &self,
        map: &Arc<MapGraph>,
        lights: &[Light],
        prompts: &[ScenarioTag],
        around: EgoStart,
        seed: Seed,
    ) -> EgoStart {
        let lanes = lanes_around(map, around.pose);
        if lanes.is_empty() {
            return around;
        }
        let mut rng = seed.rng();
        let total: f64 = lanes.iter().map(|lane| lane.centerline.length()).sum();
        for _ in 0..PLACES {
            let mut along = rng.random::<f64>() * total;
            let lane = lanes.iter().find(|lane| {
                along -= lane.centerline.length();
                along < 0.0
            });
            let Some(lane) = lane else { continue };
            let at = along + lane.centerline.length();
            let start = EgoStart {
                pose: lane.centerline.pose_at(at),
                ..around
            };
            let speed = self.speed.unwrap_or(Bounds::new(5.0, 5.0));
            let speed = (speed.low + speed.high) / 2.0;
            let trial = || self.trial(map, lights, start, (lane, at), speed, &mut rng.clone());
            let holds = |tag: &ScenarioTag| tags::holds(*tag, &trial()) == Some(true);
            if !self.is_about_place || prompts.iter().all(holds) {
                return start;
            }
            // Another way through the next junction is another trial.
            rng.random::<u64>();
        }
        around
    }

    /// The ego driving along its lane and on, behind whoever is cast ahead of it.
    fn trial(
        &self,
        map: &Arc<MapGraph>,
        lights: &[Light],
        start: EgoStart,
        (lane, at): (&Lane, f64),
        speed: f64,
        rng: &mut gump_scene::Rng,
    ) -> Scenario {
        let mut ways = vec![lane];
        let mut left = 80.0 - (lane.centerline.length() - at);
        while left > 0.0 && ways.len() < 16 {
            let next: Vec<&Lane> = map.successors(ways[ways.len() - 1].id).collect();
            if next.is_empty() {
                break;
            }
            let next = next[rng.random_range(0..next.len())];
            left -= next.centerline.length();
            ways.push(next);
        }
        let pose_after = |metres: f64| {
            let mut s = at + metres;
            for way in &ways[..ways.len() - 1] {
                let length = way.centerline.length();
                if s <= length {
                    return way.centerline.pose_at(s);
                }
                s -= length;
            }
            ways[ways.len() - 1].centerline.pose_at(s)
        };
        let (mut metres, mut speed) = (0.0, speed);
        let mut log = Vec::new();
        for _ in 0..=(TRIAL_S / TRIAL_DT) as usize {
            let size = [start.length, start.width];
            let mover = |id: i64, kind, size: [f64; 2], pose: Pose| {
                let velocity = pose.direction() * speed;
                agent_of(AgentId(id), kind, size, AgentState { pose, velocity }, map)
            };
            let mut agents: Vec<Agent> =
                vec![mover(0, AgentKind::Vehicle, size, pose_after(metres))];
            let rows = self.objects.iter().filter_map(|object| {
                let gap = object.ahead_of.as_ref()?.metres;
                let length = object.length.map_or(4.5, |bounds| bounds.low);
                let ahead = start.length / 2.0 + gap + length / 2.0;
                let pose = pose_after(metres);
                let pose = pose * Pose::new(ahead, 0.0, 0.0);
                Some(mover(1, object.class.kind(), [length, 1.0], pose))
            });
            agents.extend(rows);
            log.push(Frame::new(agents, lights.to_vec()));
            speed = (speed + self.acceleration * TRIAL_DT).max(0.0);
            metres += speed * TRIAL_DT;
        }
        Scenario {
            id: "trial".into(),
            map: Arc::clone(map),
            route: None,
            log,
            dt: TRIAL_DT,
            now: 0,
            ego: AgentId(0),
            targets: Vec::new(),
            objects_of_interest: Vec::new(),
            tags: Vec::new(),
        }
    }

    /// Puts whoever is to be on a crosswalk onto the one nearest to the ego.
    pub(crate) fn on_crosswalk(&self, map: &MapGraph, ego: Pose, objects: &mut [ObjectSpec]) {
        if !self.is_about_crosswalk {
            return;
        }
        let ego_from_world = ego.inverse();
        let crosswalks = map.areas().iter().filter(|a| a.kind == AreaKind::Crosswalk);
        let places = crosswalks.map(|area| {
            let ring = area.polygon.ring();
            let sum: gump_geometry::DVec2 = ring.iter().copied().sum();
            ego_from_world * (sum / ring.len() as f64)
        });
        let nearest = places.min_by(|a, b| a.length().total_cmp(&b.length()));
        let Some(at) = nearest.filter(|at| at.length() < 20.0) else {
            return;
        };
        let near = |centre: f64| Some(Bounds::new(centre - 2.0, centre + 2.0));
        let cast = |object: &&mut ObjectSpec| {
            let is_cast = self.objects.iter().any(|cast| cast.id == object.id);
            is_cast && object.class == Class::Pedestrian
        };
        for person in objects.iter_mut().filter(cast) {
            (person.x, person.y) = (near(at.x), near(at.y));
        }
    }
}

/// Lanes that vehicles drive on, around a pose.
fn lanes_around(map: &MapGraph, pose: Pose) -> Vec<&Lane> {
    let mut lanes: Vec<(&Lane, f64)> = map.lanes_near(pose.position, ROAM_M).collect();
    lanes.retain(|(lane, _)| lane.kind != LaneKind::BikeLane && lane.centerline.length() > 1.0);
    lanes.sort_by_key(|(lane, _)| lane.id);
    lanes.into_iter().map(|(lane, _)| lane).collect()
}

/// The wishes of one tag.
fn of_tag(name: &str) -> Cast {
    let mut cast = Cast {
        speed: speed_of(name),
        is_about_place: true,
        is_about_crosswalk: name.contains("pedestrian_on_crosswalk")
            || name == "waiting_for_pedestrian_to_cross",
        ..Cast::default()
    };
    if name.starts_with("accelerating") {
        cast.acceleration = 1.2;
    } else if name.starts_with("stopping") {
        cast.acceleration = -1.5;
    }
    let bounds = |low, high| Some(Bounds::new(low, high));
    let ahead = |class, metres, speed, length| ObjectSpec {
        class,
        speed,
        length,
        ahead_of: Some(Relation {
            object: EGO.into(),
            metres,
        }),
        ..ObjectSpec::default()
    };
    let around = |class, reach: [f64; 2], speed, length| ObjectSpec {
        class,
        x: Some(Bounds::new(-reach[0], reach[0])),
        y: Some(Bounds::new(-reach[1], reach[1])),
        speed,
        length,
        ..ObjectSpec::default()
    };
    let (vehicle, person, bike) = (Class::Vehicle, Class::Pedestrian, Class::Bicycle);
    cast.objects = match name {
        "behind_bike" => vec![ahead(bike, 6.0, bounds(2.0, 4.5), None)],
        "behind_long_vehicle" => vec![ahead(vehicle, 6.0, None, bounds(9.0, 12.0))],
        "behind_pedestrian_on_driveable" => vec![ahead(person, 6.0, bounds(0.5, 1.5), None)],
        "following_lane_with_lead" => vec![ahead(vehicle, 5.5, bounds(4.5, 8.0), None)],
        "following_lane_with_slow_lead" => vec![ahead(vehicle, 6.0, bounds(1.2, 2.8), None)],
        "stationary_at_traffic_light_with_lead" => {
            vec![ahead(vehicle, 3.0, bounds(0.0, 0.0), None)]
        }
        "stopping_with_lead" | "stopping_at_stop_sign_with_lead" => {
            vec![ahead(vehicle, 4.0, bounds(0.0, 1.0), None)]
        }
        _ if name.ends_with("_with_lead") => vec![ahead(vehicle, 8.0, None, None)],
        _ => Vec::new(),
    };
    let others = match name {
        "near_high_speed_vehicle" => vec![around(vehicle, [9.0, 7.0], bounds(12.5, 16.0), None)],
        "near_long_vehicle" => vec![around(vehicle, [9.0, 6.0], None, bounds(9.0, 12.0))],
        "near_multiple_bikes" => vec![around(bike, [9.0, 8.0], None, None); 3],
        "near_multiple_pedestrians" => vec![around(person, [7.0, 8.0], None, None); 4],
        "near_multiple_vehicles" => vec![around(vehicle, [13.0, 9.0], bounds(1.0, 9.0), None); 7],
        "stationary_in_traffic" => vec![around(vehicle, [13.0, 9.0], None, None); 7],
        "crossed_by_vehicle" | "crossed_by_bike" => {
            let class = if name.ends_with("bike") {
                bike
            } else {
                vehicle
            };
            let mut crossing = around(class, [16.0, 9.0], bounds(3.0, 6.0), None);
            crossing.x = bounds(6.0, 18.0);
            crossing.y = bounds(-12.0, -4.0);
            crossing.heading = bounds(1.1, 2.0);
            vec![crossing]
        }
        "near_pedestrian_on_crosswalk"
        | "near_pedestrian_on_crosswalk_with_ego"
        | "waiting_for_pedestrian_to_cross" => vec![around(person, [10.0, 6.0], None, None)],
        _ => Vec::new(),
    };
    if !others.is_empty() {
        // Who must be near is not in the trial; the place is that of the crosswalk, if of any.
        cast.is_about_place = false;
        cast.objects.extend(others);
    }
    if name.starts_with("changing_lane")
        || name.starts_with("high_") && name != "high_magnitude_speed"
    {
        cast.is_about_place = false;
    }
    cast
}

/// A speed of the ego at which a tag can hold.
fn speed_of(name: &str) -> Option<Bounds> {
    let bounds = |low, high| Some(Bounds::new(low, high));
    match name {
        "low_magnitude_speed" => bounds(0.5, 1.0),
        "medium_magnitude_speed" => bounds(4.0, 8.0),
        "high_magnitude_speed" => bounds(9.8, 14.0),
        "near_multiple_vehicles" => bounds(6.5, 9.0),
        "starting_high_speed_turn" => bounds(6.5, 8.5),
        "starting_low_speed_turn" => bounds(1.5, 3.5),
        "following_lane_with_slow_lead" => bounds(1.2, 3.0),
        "waiting_for_pedestrian_to_cross" => bounds(0.0, 1.0),
        "high_lateral_acceleration" => bounds(7.0, 10.0),
        _ if name.starts_with("stationary") => bounds(0.0, 0.0),
        _ if name.starts_with("accelerating") => bounds(0.5, 2.0),
        _ if name.starts_with("stopping") => bounds(2.0, 4.0),
        _ if name.starts_with("following_lane") => bounds(4.5, 9.0),
        _ if name.starts_with("changing_lane") => bounds(6.0, 10.0),
        _ if name.starts_with("starting_") => bounds(3.0, 6.0),
        _ if name.starts_with("traversing") => bounds(2.0, 7.0),
        _ => None,
    }
}
