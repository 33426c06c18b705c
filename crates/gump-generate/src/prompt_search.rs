//! Search for a place at which prompts can hold: the requested one, or anywhere on the map.
//!
//! Whether the tags hold in the trial of a place determines, without a network, whether a map
//! admits them.

use gump_geometry::Pose;
use gump_metrics::tags;
use gump_scene::{Lane, LaneKind, MapGraph, Rng, ScenarioTag, Seed};
use rand::Rng as _;
use rand::seq::{IndexedRandom as _, SliceRandom as _};

use crate::prompt::PromptSpec;
use crate::site::Site;
use crate::{EgoStart, GenerateRequest};

/// Maximum distance of the ego from the requested pose, metres: a few blocks. Chosen by hand; the
/// larger, the more prompts a map admits.
const ROAM_M: f64 = 150.0;
/// Spacing of candidate places along a lane, metres: some tags ask for a stop line within 2 m.
const SPACING_M: f64 = 2.0;
/// Trials of a given place, each with another path and speed. They need no network, so many are
/// cheap.
const TRIALS: usize = 60;
/// Trials of every place of a map, each with other paths through the junctions ahead. Chosen by
/// hand.
const ROUNDS: usize = 2;
/// The frames of a trial at which the tags may hold; later ones for tags that take time: after 1 s a
/// jolt begins, and tags measure it from both sides.
const MOMENTS: [usize; 2] = [0, 10];

/// The search criteria.
pub(crate) struct Search<'a> {
    pub(crate) cast: &'a PromptSpec,
    pub(crate) request: &'a GenerateRequest,
    pub(crate) prompts: &'a [ScenarioTag],
}

impl Search<'_> {
    /// A site at the requested pose, on whose lanes the ego keeps its lateral offset; `None` if
    /// the prompts cannot hold there.
    pub(crate) fn here(&self, seed: Seed) -> Option<Site> {
        let pose = self.request.ego.pose;
        let map: &MapGraph = &self.request.map;
        let rng = &mut seed.rng();
        let mut lanes = Vec::new();
        // The lane that the ego is on, or beside: about a lane's width off and 30 degrees turned.
        for (lane, _) in map.lanes_near(pose.position, 3.0) {
            let on = lane.foot(pose);
            if on.turned < 0.5 {
                lanes.push((lane, on));
            }
        }
        lanes.retain(|(lane, _)| lane.kind != LaneKind::BikeLane);
        for _ in 0..TRIALS {
            let (lane, on) = lanes.choose(rng)?;
            let site = self.site((lane, on.along_m), Some(pose), rng);
            if let Some(site) = site.filter(|site| self.holds(site)) {
                return Some(site);
            }
        }
        None
    }

    /// A stage somewhere on the map; `None` if the prompts can hold nowhere.
    pub(crate) fn anywhere(&self, seed: Seed) -> Option<Site> {
        let (map, lights) = (&self.request.map, &self.request.lights);
        let mut needs = self.cast.needs.iter();
        if !needs.all(|need| need.is_met(map, lights)) {
            return None;
        }
        let lanes = lanes_around(&self.request.map, self.request.ego.pose);
        let mut places: Vec<(&Lane, f64)> = lanes
            .into_iter()
            .flat_map(|lane| {
                let n = (lane.centerline.length() / SPACING_M).ceil() as usize;
                (0..n).map(move |i| (lane, i as f64 * SPACING_M))
            })
            .collect();
        let rng = &mut seed.rng();
        for _ in 0..ROUNDS {
            places.shuffle(rng);
            for &(lane, at) in &places {
                let at = at + rng.random_range(0.0..SPACING_M);
                let at = at.min(lane.centerline.length());
                let site = self.site((lane, at), None, rng);
                if let Some(site) = site.filter(|site| self.holds(site)) {
                    return Some(site);
                }
            }
        }
        None
    }

    fn site(&self, place: (&Lane, f64), pose: Option<Pose>, rng: &mut Rng) -> Option<Site> {
        Site::set(self.cast, self.request, place, pose, rng)
    }

    /// Whether all tags hold at the same instant of the trial.
    fn holds(&self, site: &Site) -> bool {
        if self.prompts.is_empty() {
            return true;
        }
        let mut trial = site.trial(self.request);
        let moments = if site.takes_time() {
            &MOMENTS[..]
        } else {
            &MOMENTS[..1]
        };
        moments.iter().any(|&now| {
            trial.now = now;
            let mut tags = self.prompts.iter();
            tags.all(|tag| tags::holds(*tag, &trial) != Some(false))
        })
    }
}

/// A start on any lane around a pose, with uniform position; the pose itself if there is no lane.
pub(crate) fn any_start(map: &MapGraph, around: EgoStart, seed: Seed) -> EgoStart {
    let lanes = lanes_around(map, around.pose);
    let total: f64 = lanes.iter().map(|lane| lane.centerline.length()).sum();
    let mut along = seed.rng().random::<f64>() * total;
    for lane in lanes {
        if along < lane.centerline.length() {
            let pose = lane.centerline.pose_at(along);
            return EgoStart { pose, ..around };
        }
        along -= lane.centerline.length();
    }
    around
}

/// Lanes that vehicles drive on, around a pose.
fn lanes_around(map: &MapGraph, pose: Pose) -> Vec<&Lane> {
    let mut lanes: Vec<&Lane> = map
        .lanes_near(pose.position, ROAM_M)
        .map(|(lane, _)| lane)
        .filter(|lane| lane.kind != LaneKind::BikeLane && lane.centerline.length() > 1.0)
        .collect();
    lanes.sort_by_key(|lane| lane.id);
    lanes
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use gump_engine::placement::object_spec::{Bounds, ObjectSpec, Relation};
    use gump_geometry::DVec2;
    use gump_scene::{AreaKind, LaneId, MapParts, StopSign, fixture};

    use super::*;
    use crate::GenerateConfig;
    use crate::constraint::EGO;

    /// Two lanes that lead to a junction, straight on or to the left, one of which is narrow.
    const JUNCTION: &str = "lane 1: -120,0 0,0 next 3,4 left 2
        lane 2: -120,3.5 0,3.5 width 2.6 right 1
        lane 3: 0,0 20,0 next 5
        lane 4: 0,0 8,2 14,8 16,16 16,20 next 6
        lane 5: 20,0 140,0
        lane 6: 16,20 16,140
        lane 7: 12,-80 12,60
        drivable: -120,-2 140,-2 140,6 -120,6
        ego vehicle 0: -60,0 velocity 5,0";

    fn request(text: &str, change: impl Fn(&mut MapParts)) -> GenerateRequest {
        let scenario = fixture::scenario(&format!("{JUNCTION}\n{text}")).unwrap();
        let mut parts = scenario.map.parts().clone();
        for lane in &mut parts.lanes {
            lane.in_intersection = matches!(lane.id.0, 3 | 4);
        }
        change(&mut parts);
        GenerateRequest {
            map: Arc::new(MapGraph::new(parts).unwrap()),
            ego: EgoStart {
                pose: Pose::new(-60.0, 0.0, 0.0),
                length: 4.8,
                width: 2.0,
                velocity: None,
            },
            lights: scenario.present().now().lights().to_vec(),
            fixtures: Vec::new(),
            prompts: Vec::new(),
            counts: None,
            objects: Vec::new(),
            config: GenerateConfig::default(),
        }
    }

    fn found(request: &GenerateRequest, tags: &[&str]) -> Option<Site> {
        let prompts: Vec<ScenarioTag> = tags.iter().map(|tag| tag.parse().unwrap()).collect();
        let search = Search {
            cast: &PromptSpec::of(&prompts),
            request,
            prompts: &prompts,
        };
        search.anywhere(Seed(3))
    }

    #[test]
    fn a_map_admits_what_it_has_a_place_for() {
        let plain = request("", |_| ());
        for tag in [
            "starting_left_turn",
            "starting_unprotected_cross_turn",
            "starting_straight_stop_sign_intersection_traversal",
            "changing_lane_to_left",
            "changing_lane_with_trail",
            "crossed_by_vehicle",
            "crossed_by_bike",
            "near_trafficcone_on_driveable",
            "high_magnitude_jerk",
            "high_lateral_acceleration",
            "traversing_narrow_lane",
            "following_lane_with_lead",
        ] {
            let is_about_signs = tag.contains("stop_sign");
            assert_eq!(found(&plain, &[tag]).is_some(), !is_about_signs, "{tag}");
        }
        for tag in [
            "starting_right_turn",
            "starting_u_turn",
            "accelerating_at_stop_sign",
            "stationary_at_crosswalk",
            "waiting_for_pedestrian_to_cross",
            "stationary_at_traffic_light_without_lead",
            "on_carpark",
            "on_all_way_stop_intersection",
        ] {
            assert!(found(&plain, &[tag]).is_none(), "{tag}");
        }
    }

    #[test]
    fn what_the_map_has_more_is_used() {
        let signed = request("crosswalk: 1,-3 4,-3 4,6 1,6", |parts| {
            parts.stop_signs = vec![StopSign {
                id: 900,
                position: gump_geometry::dvec3(-1.0, -3.0, 2.0),
                lanes: vec![LaneId(1)],
            }];
        });
        for tag in [
            "accelerating_at_stop_sign",
            "stopping_at_stop_sign_without_lead",
            "starting_straight_stop_sign_intersection_traversal",
            "stationary_at_crosswalk",
            "near_pedestrian_on_crosswalk_with_ego",
        ] {
            assert!(found(&signed, &[tag]).is_some(), "{tag}");
        }
        // The crosswalk is nearer than the tag allows.
        let without = "accelerating_at_stop_sign_no_crosswalk";
        assert!(found(&signed, &[without]).is_none());
        let waits = found(&signed, &["waiting_for_pedestrian_to_cross"]).unwrap();
        let person = waits.objects.last().unwrap();
        let ahead = person.x.unwrap().low + 0.25 - waits.ego.length / 2.0;
        assert!((1.0..6.5).contains(&ahead), "{ahead}");
        let place = waits.ego.pose * DVec2::new(person.x.unwrap().low + 0.25, 0.0);
        assert!((1.0..4.0).contains(&place.x), "{place}");
    }

    #[test]
    fn drives_keep_to_red_lights() {
        let red = request("light 3 red: -1,0\nlight 4 green: -1,0", |_| ());
        assert!(found(&red, &["starting_protected_cross_turn"]).is_some());
        let straight = "starting_straight_traffic_light_intersection_traversal";
        assert!(found(&red, &[straight]).is_none());
        let waits = found(&red, &["stationary_at_traffic_light_without_lead"]).unwrap();
        assert_eq!(waits.ego.velocity.unwrap().length(), 0.0);
    }

    #[test]
    fn the_place_asked_for_is_taken_if_it_will_do() {
        let request = request("", |_| ());
        let here = |tag: &str| {
            let prompts = [tag.parse().unwrap()];
            let search = Search {
                cast: &PromptSpec::of(&prompts),
                request: &request,
                prompts: &prompts,
            };
            search.here(Seed(1))
        };
        let site = here("following_lane_with_lead").unwrap();
        let directed = site.direct(&request);
        assert_eq!(directed.ego.pose, request.ego.pose);
        assert!((4.5..9.0).contains(&directed.ego.velocity.unwrap().length()));
        assert_eq!(directed.objects.len(), 1);
        assert!(here("starting_left_turn").is_none());
    }

    #[test]
    fn what_is_placed_at_a_pose_askew_is_relative_to_that_pose() {
        let mut request = request("crosswalk: -56,-6 -51,-6 -51,6 -56,6", |_| ());
        request.ego.pose = Pose::new(-60.0, 0.5, 0.35);
        let tags = ["near_pedestrian_on_crosswalk", "low_magnitude_speed"];
        let prompts = tags.map(|tag| tag.parse().unwrap());
        let search = Search {
            cast: &PromptSpec::of(&prompts),
            request: &request,
            prompts: &prompts,
        };
        let site = search.here(Seed(1)).unwrap();
        assert_eq!(site.ego.pose, request.ego.pose);
        let velocity = site.ego.velocity.unwrap();
        let ahead = site.ego.pose.direction() * velocity.length();
        assert!(velocity.distance(ahead) < 1e-9, "{velocity}");
        let person = site.objects.last().unwrap();
        let middle = |bounds: Option<Bounds>| bounds.unwrap().low + 0.25;
        let at = site.ego.pose * DVec2::new(middle(person.x), middle(person.y));
        let walks = request.map.areas().iter();
        let mut walks = walks.filter(|area| area.kind == AreaKind::Crosswalk);
        assert!(walks.any(|area| area.polygon.contains(at)), "{at}");
    }

    #[test]
    fn the_user_has_the_last_word() {
        let mut request = request("", |_| ());
        request.objects = vec![
            ObjectSpec {
                id: EGO.into(),
                speed: Some(Bounds::new(5.0, 5.5)),
                ..ObjectSpec::default()
            },
            ObjectSpec {
                id: "truck".into(),
                length: Some(Bounds::new(12.0, 12.0)),
                ahead_of: Some(Relation {
                    object: EGO.into(),
                    metres: 6.0,
                }),
                ..ObjectSpec::default()
            },
        ];
        let site = found(&request, &["starting_left_turn"]).unwrap();
        let speed = site.ego.velocity.unwrap().length();
        assert!((5.0..=5.5).contains(&speed), "{speed}");
        // The truck is the requested lead, and no other vehicle is placed there.
        let site = found(&request, &["behind_long_vehicle"]).unwrap();
        assert_eq!(site.objects.len(), 2);
        assert!(found(&request, &["following_lane_without_lead"]).is_none());
        request.ego.velocity = Some(DVec2::new(8.0, 0.0));
        let site = found(&request, &["medium_magnitude_speed"]).unwrap();
        assert_eq!(site.ego.velocity, request.ego.velocity);
    }
}
