//! Requirements of a prompt in guided placement, beyond the effect of its tokens on the network:
//! the ego's speed and manoeuvre, agents around it, objects at the roadside.
//!
//! This module makes a tag possible; `site` finds places where it can hold, and `check` checks
//! whether it does.

use gump_engine::placement::object_spec::{Bounds, Class, ObjectSpec, Relation};
use gump_scene::{AreaKind, Light, MapGraph, Rng, ScenarioTag};
use rand::Rng as _;

use crate::constraint::EGO;
use crate::drive::{Change, Maneuver};

/// Requirements of tags.
#[derive(Clone, Debug, Default)]
pub(crate) struct PromptSpec {
    /// Of the ego.
    pub(crate) speed: Option<Bounds>,
    /// Metres per second squared.
    acceleration: f64,
    jolts: bool,
    changes: Option<Changes>,
    /// Agents whose position is known without a map.
    pub(crate) objects: Vec<ObjectSpec>,
    /// A pedestrian on a crosswalk.
    pub(crate) crosswalk: Option<OnCrosswalk>,
    /// An agent that crosses ahead.
    pub(crate) crossing: Option<Class>,
    /// Whether an agent follows in the lane that is changed to.
    pub(crate) is_trailed: bool,
    /// Objects along the road.
    pub(crate) works: Option<WorkZone>,
    /// Required features of the map.
    pub(crate) needs: Vec<Need>,
}

/// A feature that a map may lack.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Need {
    /// A lane or an area of an intersection.
    Intersection,
    /// A stop sign.
    StopSign,
    /// A traffic light that is shown.
    Light,
    /// A crosswalk.
    Crosswalk,
    /// A car park.
    Carpark,
}

/// The lane changes that satisfy a tag.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Changes {
    /// To the left (true), to the right, to either side.
    Lanes(Option<bool>),
    /// Any swift one; a curve at speed also satisfies it.
    Swift,
}

/// Position of a pedestrian on a crosswalk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum OnCrosswalk {
    /// Near the ego.
    Near,
    /// On the one that the ego is on.
    WithEgo,
    /// In the ego's path.
    InTheWay,
}

/// Objects along the road.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum WorkZone {
    /// Cones.
    Cones,
    /// Barriers.
    Barriers,
    /// Cones, and a sign behind them.
    Sign,
}

impl PromptSpec {
    /// The combined requirements of all tags; in conflicts the first tag wins.
    pub(crate) fn of(prompts: &[ScenarioTag]) -> Self {
        let mut all = Self::default();
        for (i, tag) in prompts.iter().enumerate() {
            let cast = of_tag(tag.name());
            let named = cast.objects.into_iter().enumerate();
            all.objects.extend(named.map(|(k, object)| ObjectSpec {
                id: format!("{tag} {i}.{k}"),
                ..object
            }));
            all.speed = all.speed.or(cast.speed);
            if all.acceleration == 0.0 {
                all.acceleration = cast.acceleration;
            }
            all.jolts |= cast.jolts;
            all.changes = all.changes.or(cast.changes);
            all.crosswalk = all.crosswalk.or(cast.crosswalk);
            all.crossing = all.crossing.or(cast.crossing);
            all.is_trailed |= cast.is_trailed;
            all.works = all.works.or(cast.works);
            all.needs.extend(cast.needs);
        }
        all
    }

    /// One of the possible manoeuvres of the ego.
    pub(crate) fn maneuver(&self, rng: &mut Rng) -> Maneuver {
        let mut change = |is_left: Option<bool>, seconds: [f64; 2]| Change {
            is_left: is_left.unwrap_or_else(|| rng.random()),
            seconds: rng.random_range(seconds[0]..seconds[1]),
        };
        let change = match self.changes {
            None => None,
            // Seconds; the tag looks 4 s ahead.
            Some(Changes::Lanes(side)) => Some(change(side, [2.8, 3.4])),
            Some(Changes::Swift) => {
                // Over the width of a lane 2.4 to 3.8 m/s² at most: the tag asks for 1.5 to 3.
                let swift = change(None, [2.3, 2.9]);
                rng.random::<bool>().then_some(swift)
            }
        };
        Maneuver {
            acceleration: self.acceleration,
            jolts: self.jolts,
            change,
        }
    }
}

/// Requirements of one tag.
///
/// All numbers here and below lie inside the thresholds of the tags' rules (`gump_metrics::tags`),
/// with some room for the grid of tokens and for what the world makes of them; chosen by hand.
fn of_tag(name: &str) -> PromptSpec {
    let acceleration = if name.starts_with("accelerating") {
        1.8
    } else if name.starts_with("stopping") {
        -1.6
    } else {
        0.0
    };
    let changes = match name {
        "high_lateral_acceleration" => Some(Changes::Swift),
        "changing_lane_to_left" => Some(Changes::Lanes(Some(true))),
        "changing_lane_to_right" => Some(Changes::Lanes(Some(false))),
        _ if name.starts_with("changing_lane") => Some(Changes::Lanes(None)),
        _ => None,
    };
    let crosswalk = match name {
        "near_pedestrian_on_crosswalk" => Some(OnCrosswalk::Near),
        "near_pedestrian_on_crosswalk_with_ego" => Some(OnCrosswalk::WithEgo),
        "waiting_for_pedestrian_to_cross" => Some(OnCrosswalk::InTheWay),
        _ => None,
    };
    let works = match name {
        "near_trafficcone_on_driveable" => Some(WorkZone::Cones),
        "near_barrier_on_driveable" => Some(WorkZone::Barriers),
        "near_construction_zone_sign" => Some(WorkZone::Sign),
        _ => None,
    };
    PromptSpec {
        speed: speed_of(name),
        acceleration,
        jolts: name == "high_magnitude_jerk",
        changes,
        objects: objects_of(name),
        crosswalk,
        crossing: match name {
            "crossed_by_vehicle" => Some(Class::Vehicle),
            "crossed_by_bike" => Some(Class::Bicycle),
            _ => None,
        },
        is_trailed: name == "changing_lane_with_trail",
        works,
        needs: needs_of(name),
    }
}

/// The features that a map must have for a tag of this name, derived from the words of the name.
fn needs_of(name: &str) -> Vec<Need> {
    let has = |words: &[&str]| words.iter().any(|word| name.contains(word));
    let is_lit = has(&["traffic_light"]) || has(&["_protected"]);
    let is_walked = has(&["crosswalk", "waiting_for_pedestrian"]) && !has(&["no_crosswalk"]);
    let needs = [
        (Need::Intersection, has(&["intersection", "turn"])),
        (Need::StopSign, has(&["stop_sign", "all_way_stop"])),
        (Need::Light, is_lit),
        (Need::Crosswalk, is_walked),
        (Need::Carpark, has(&["carpark"])),
    ];
    let needed = needs.into_iter().filter(|(_, is_needed)| *is_needed);
    needed.map(|(need, _)| need).collect()
}

impl Need {
    /// Whether a map and its lights have it.
    pub(crate) fn is_met(self, map: &MapGraph, lights: &[Light]) -> bool {
        let area = |kind| map.areas().iter().any(|area| area.kind == kind);
        match self {
            Self::Intersection => {
                area(AreaKind::Intersection) || map.lanes().iter().any(|lane| lane.in_intersection)
            }
            Self::StopSign => !map.stop_signs().is_empty(),
            Self::Light => !lights.is_empty(),
            Self::Crosswalk => area(AreaKind::Crosswalk),
            Self::Carpark => area(AreaKind::Carpark),
        }
    }
}

/// Agents that a tag requires ahead of or around the ego.
fn objects_of(name: &str) -> Vec<ObjectSpec> {
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
    match name {
        "behind_bike" => vec![ahead(bike, 6.0, bounds(2.0, 4.5), None)],
        "behind_long_vehicle" => vec![ahead(vehicle, 6.0, None, bounds(9.0, 12.0))],
        "behind_pedestrian_on_driveable" => vec![ahead(person, 6.0, bounds(0.5, 1.5), None)],
        "changing_lane_with_lead" => vec![ahead(vehicle, 14.0, bounds(6.0, 9.0), None)],
        "following_lane_with_lead" => vec![ahead(vehicle, 5.5, bounds(4.5, 8.0), None)],
        "following_lane_with_slow_lead" => vec![ahead(vehicle, 6.0, bounds(1.2, 2.8), None)],
        "stationary_at_traffic_light_with_lead" => {
            vec![ahead(vehicle, 3.0, bounds(0.0, 0.0), None)]
        }
        _ if name.starts_with("stopping") && name.ends_with("_with_lead") => {
            vec![ahead(vehicle, 4.8, bounds(0.0, 0.5), None)]
        }
        _ if name.ends_with("_with_lead") => vec![ahead(vehicle, 8.0, bounds(2.0, 5.0), None)],
        "near_high_speed_vehicle" => vec![around(vehicle, [9.0, 7.0], bounds(12.5, 16.0), None)],
        "near_long_vehicle" => vec![around(vehicle, [9.0, 6.0], None, bounds(9.0, 12.0))],
        "near_multiple_bikes" => vec![around(bike, [9.0, 8.0], None, None); 3],
        "near_multiple_pedestrians" => vec![around(person, [7.0, 8.0], None, None); 4],
        "near_multiple_vehicles" => vec![around(vehicle, [13.0, 9.0], bounds(1.0, 9.0), None); 7],
        "stationary_in_traffic" => vec![around(vehicle, [13.0, 9.0], None, None); 7],
        _ => Vec::new(),
    }
}

/// A speed of the ego at which a tag can hold.
fn speed_of(name: &str) -> Option<Bounds> {
    let bounds = |low, high| Some(Bounds::new(low, high));
    match name {
        "low_magnitude_speed" => bounds(0.5, 1.0),
        "medium_magnitude_speed" => bounds(4.0, 8.0),
        "high_magnitude_speed" => bounds(9.8, 14.0),
        "high_magnitude_jerk" => bounds(6.0, 10.0),
        "high_lateral_acceleration" => bounds(5.0, 12.0),
        "near_multiple_vehicles" => bounds(6.5, 9.0),
        "starting_high_speed_turn" => bounds(6.5, 8.5),
        "starting_low_speed_turn" => bounds(1.5, 3.5),
        "following_lane_with_slow_lead" => bounds(1.2, 3.0),
        "waiting_for_pedestrian_to_cross" => bounds(0.0, 0.3),
        _ if name.starts_with("on_stopline") => bounds(0.0, 0.5),
        _ if name.starts_with("crossed_by") => bounds(0.0, 1.0),
        _ if name.starts_with("stationary") => bounds(0.0, 0.0),
        _ if name.starts_with("accelerating") => bounds(0.5, 1.8),
        _ if name.starts_with("stopping") && name.ends_with("_with_lead") => bounds(1.5, 2.6),
        _ if name.starts_with("stopping") => bounds(2.0, 4.0),
        _ if name.starts_with("following_lane") => bounds(4.5, 9.0),
        _ if name.starts_with("changing_lane") => bounds(6.0, 10.0),
        _ if name.starts_with("starting_") => bounds(3.0, 6.0),
        _ if name.starts_with("traversing") => bounds(2.0, 7.0),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use gump_scene::Seed;

    use super::*;

    fn cast(names: &[&str]) -> PromptSpec {
        let tags: Vec<ScenarioTag> = names.iter().map(|name| name.parse().unwrap()).collect();
        PromptSpec::of(&tags)
    }

    #[test]
    fn tags_add_up() {
        let both = cast(&["behind_bike", "stopping_at_crosswalk"]);
        assert_eq!(both.objects.len(), 1);
        assert_eq!(both.objects[0].id, "behind_bike 0.0");
        assert_eq!(both.speed, Some(Bounds::new(2.0, 4.0)));
        assert!(both.maneuver(&mut Seed(0).rng()).acceleration < 0.0);
    }

    #[test]
    fn names_say_what_a_map_must_have() {
        let needs = |name: &str| cast(&[name]).needs;
        assert_eq!(
            needs("accelerating_at_stop_sign_no_crosswalk"),
            [Need::StopSign]
        );
        let lit = [Need::Intersection, Need::Light];
        assert_eq!(needs("starting_protected_cross_turn"), lit);
        let turn = needs("starting_unprotected_cross_turn");
        assert_eq!(turn, [Need::Intersection]);
        let walks = needs("waiting_for_pedestrian_to_cross");
        assert_eq!(walks, [Need::Crosswalk]);
        assert_eq!(needs("on_carpark"), [Need::Carpark]);
        assert!(needs("behind_bike").is_empty());
    }

    #[test]
    fn sides_are_those_asked_for() {
        let left = |name: &str, seed| {
            let maneuver = cast(&[name]).maneuver(&mut Seed(seed).rng());
            maneuver.change.map(|change| change.is_left)
        };
        for seed in 0..8 {
            assert_eq!(left("changing_lane_to_left", seed), Some(true));
            assert_eq!(left("changing_lane_to_right", seed), Some(false));
            assert_eq!(left("starting_left_turn", seed), None);
        }
        let either: Vec<_> = (0..8).map(|seed| left("changing_lane", seed)).collect();
        assert!(either.contains(&Some(true)) && either.contains(&Some(false)));
    }
}
