//! Where on a map what a prompt asks for can be: a place of the ego with a drive from there, whoever
//! the prompt is about put around it, and a trial that shows that nothing else is needed.
//!
//! In the trial nobody is there but the ego and those cast. Whether the tags hold in it says, without
//! any network, whether a map admits them.

use std::sync::Arc;

use gump_geometry::{DVec2, OrientedBox, Pose, angle_difference};
use gump_metrics::tags;
use gump_scene::{Agent, AgentId, AgentKind, AgentState, Frame, Lane, LaneKind, MapGraph};
use gump_scene::{Rng, Scenario, ScenarioTag, Seed};
use rand::Rng as _;
use rand::seq::{IndexedRandom as _, SliceRandom as _};

use super::constraint::{Bounds, Class, EGO, ObjectSpec, Relation};
use super::drive::{Drive, PLANNED_S};
use super::prompt::{Cast, OnCrosswalk};
use super::{EgoStart, GenerateRequest, roadside};

/// How far from where it is asked the ego may be put, metres.
const ROAM_M: f64 = 150.0;
/// Metres between places along a lane.
const SPACING_M: f64 = 2.0;
/// Trials of a place that is given.
const TRIALS: usize = 60;
/// Times every place of a map is tried, each time another way through the junctions ahead.
const ROUNDS: usize = 2;
/// Frames of a trial per second.
const TRIAL_HZ: f64 = 10.0;
/// The frames of a trial that may be the moment of the tags; later ones where that takes time.
const MOMENTS: [usize; 2] = [0, 10];
/// Somebody who crosses does so after so many seconds.
const CROSSES_S: f64 = 1.8;

/// Where a scene is to be and who has a part in it.
#[derive(Clone, Debug)]
pub(crate) struct Stage {
    ego: EgoStart,
    /// What the ego does if it is steered.
    drive: Drive,
    /// The wishes of the prompts, and the ego's.
    objects: Vec<ObjectSpec>,
    fixtures: Vec<Agent>,
}

/// Somebody in a trial.
struct Extra {
    kind: AgentKind,
    size: [f64; 2],
    way: Way,
}

/// How somebody moves in a trial.
enum Way {
    /// Ahead of the ego by so much, from centre to centre.
    Ahead(f64),
    /// At a constant velocity.
    Straight(AgentState),
    /// As an ego would.
    Along(Drive),
}

/// What is looked for.
pub(crate) struct Search<'a> {
    pub(crate) cast: &'a Cast,
    pub(crate) request: &'a GenerateRequest,
    pub(crate) prompts: &'a [ScenarioTag],
}

impl Search<'_> {
    /// A stage at the place the request gives, on whose lanes the ego stays as far to the side as
    /// it is; `None` if the prompts cannot hold there.
    pub(crate) fn here(&self, seed: Seed) -> Option<Stage> {
        let pose = self.request.ego.pose;
        let map: &MapGraph = &self.request.map;
        let rng = &mut seed.rng();
        let mut lanes = Vec::new();
        for (lane, _) in map.lanes_near(pose.position, 3.0) {
            let on = lane.centerline.project(pose.position);
            let way = lane.centerline.pose_at(on.arc_length).heading;
            if angle_difference(way, pose.heading).abs() < 0.5 {
                lanes.push((lane, on));
            }
        }
        lanes.retain(|(lane, _)| lane.kind != LaneKind::BikeLane);
        for _ in 0..TRIALS {
            let (lane, on) = lanes.choose(rng)?;
            let mut stage = self.stage((lane, on.arc_length), on.lateral, rng);
            if let Some((stage, _)) = &mut stage {
                stage.ego.pose = pose;
            }
            if let Some(stage) = stage.filter(|s| self.holds(s)).map(|s| s.0) {
                return Some(stage);
            }
        }
        None
    }

    /// A stage somewhere on the map; `None` if the prompts can hold nowhere.
    pub(crate) fn anywhere(&self, seed: Seed) -> Option<Stage> {
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
                let stage = self.stage((lane, at), 0.0, rng);
                if let Some((stage, _)) = stage.filter(|stage| self.holds(stage)) {
                    return Some(stage);
                }
            }
        }
        None
    }

    /// Everybody put around the ego at a place; `None` where that cannot be.
    fn stage(
        &self,
        place: (&Lane, f64),
        offset: f64,
        rng: &mut Rng,
    ) -> Option<(Stage, Vec<Extra>)> {
        let Self { cast, request, .. } = *self;
        let map: &MapGraph = &request.map;
        let own = request.objects.iter().find(|object| object.id == EGO);
        let wished = own.and_then(|ego| ego.speed).or(cast.speed);
        let given = request.ego.velocity.map(DVec2::length);
        let speed = given
            .or_else(|| Some(drawn(wished?, rng)))
            .unwrap_or_else(|| rng.random_range(3.0..8.0));
        let maneuver = cast.maneuver(rng);
        let drive = Drive::along(map, place, offset, speed, maneuver, rng)?;
        if drive.runs_red(&request.lights, request.ego.length) {
            return None;
        }
        let mut ego = request.ego;
        ego.pose = drive.pose_ahead(0.0);
        if ego.velocity.is_none() && wished.is_some() {
            ego.velocity = Some(ego.pose.direction() * speed);
        }
        let mut stage = Stage {
            ego,
            drive,
            objects: request.objects.clone(),
            fixtures: Vec::new(),
        };
        let mut extras = Vec::new();
        self.put_cast(&mut stage, &mut extras, rng)?;
        self.put_on_crosswalk(&mut stage, &mut extras, rng)?;
        self.put_crossing(&mut stage, &mut extras, rng)?;
        self.put_trail(&mut stage, &mut extras, speed, rng)?;
        if let Some(works) = cast.works {
            stage.fixtures = roadside::put(map, place.0, &stage.drive, ego.length, works)?;
        }
        Some((stage, extras))
    }

    /// Those whose places the tags themselves give.
    fn put_cast(&self, stage: &mut Stage, extras: &mut Vec<Extra>, rng: &mut Rng) -> Option<()> {
        // Somebody else may already be where the prompt wants somebody.
        let leads = |object: &ObjectSpec| {
            let relation = object.ahead_of.as_ref();
            relation.is_some_and(|relation| relation.object == EGO)
        };
        let follows = |object: &ObjectSpec| object.id == EGO && object.behind.is_some();
        let is_led = stage.objects.iter().any(|o| leads(o) || follows(o));
        for object in &self.cast.objects {
            if is_led && leads(object) {
                continue;
            }
            let size = size_of(object);
            let speed = object.speed.map_or(1.0, |bounds| drawn(bounds, rng));
            let pose = stage.ego.pose;
            let way = match &object.ahead_of {
                Some(Relation { metres, .. }) => {
                    let ahead = stage.ego.length / 2.0 + metres + size[0] / 2.0;
                    let there = (pose * Pose::new(ahead, 0.0, 0.0)).position;
                    // A row is straight, and whoever heads it is on the road, too.
                    self.request.map.lanes_near(there, 1.0).next()?;
                    Way::Ahead(ahead)
                }
                None => Way::Straight(AgentState {
                    pose,
                    velocity: pose.direction() * speed,
                }),
            };
            extras.push(Extra {
                kind: object.class.kind(),
                size,
                way,
            });
            stage.objects.push(object.clone());
        }
        Some(())
    }

    /// The person on a crosswalk.
    fn put_on_crosswalk(
        &self,
        stage: &mut Stage,
        extras: &mut Vec<Extra>,
        rng: &mut Rng,
    ) -> Option<()> {
        let Some(whereabouts) = self.cast.crosswalk else {
            return Some(());
        };
        let ego = stage.ego;
        let at = roadside::on_crosswalk(&self.request.map, &ego, |local, is_shared| {
            let ahead = local.x - ego.length / 2.0;
            match whereabouts {
                OnCrosswalk::Near => true,
                OnCrosswalk::WithEgo => is_shared,
                OnCrosswalk::InTheWay => (1.0..6.5).contains(&ahead) && local.y.abs() < 1.0,
            }
        });
        let local = *at.choose(rng)?;
        // On the spot, but for the grid.
        let near = |at: f64| Some(Bounds::new(at - 0.25, at + 0.25));
        stage.objects.push(ObjectSpec {
            id: "on crosswalk".into(),
            class: Class::Pedestrian,
            x: near(local.x),
            y: near(local.y),
            speed: Some(Bounds::new(0.0, 1.2)),
            ..ObjectSpec::default()
        });
        extras.push(Extra {
            kind: AgentKind::Pedestrian,
            size: [0.8, 0.8],
            way: Way::Straight(AgentState {
                pose: ego.pose * Pose::new(local.x, local.y, 0.0),
                velocity: DVec2::ZERO,
            }),
        });
        Some(())
    }

    /// Whoever crosses ahead: on a lane that crosses the line ahead, shortly before it.
    fn put_crossing(
        &self,
        stage: &mut Stage,
        extras: &mut Vec<Extra>,
        rng: &mut Rng,
    ) -> Option<()> {
        let Some(class) = self.cast.crossing else {
            return Some(());
        };
        let map: &MapGraph = &self.request.map;
        let speeds = match class {
            Class::Bicycle => [3.0, 5.0],
            _ => [4.5, 7.5],
        };
        let speed = rng.random_range(speeds[0]..speeds[1]);
        let crossings = roadside::crossings(map, &stage.ego);
        let (mut lane, at) = *crossings.choose(rng)?;
        let mut from = at - speed * CROSSES_S;
        while from < 0.0 {
            let before: Vec<&Lane> = map.predecessors(lane.id).collect();
            lane = before.choose(rng)?;
            from += lane.centerline.length();
        }
        let drive = Drive::along(map, (lane, from), 0.0, speed, Default::default(), rng)?;
        self.put_along(stage, extras, "crossing", class, lane, drive);
        Some(())
    }

    /// Whoever follows in the lane that is changed to.
    fn put_trail(
        &self,
        stage: &mut Stage,
        extras: &mut Vec<Extra>,
        speed: f64,
        rng: &mut Rng,
    ) -> Option<()> {
        if !self.cast.is_trailed {
            return Some(());
        }
        let map: &MapGraph = &self.request.map;
        let lane = map.lane(stage.drive.neighbor?)?;
        let on = lane.centerline.project(stage.ego.pose.position);
        let from = on.arc_length - rng.random_range(9.0..15.0);
        if from < 0.0 {
            return None;
        }
        let drive = Drive::along(map, (lane, from), 0.0, speed, Default::default(), rng)?;
        self.put_along(stage, extras, "trail", Class::Vehicle, lane, drive);
        Some(())
    }

    fn put_along(
        &self,
        stage: &mut Stage,
        extras: &mut Vec<Extra>,
        id: &str,
        class: Class,
        lane: &Lane,
        drive: Drive,
    ) {
        let start = stage.ego.pose.inverse() * drive.pose_ahead(0.0).position;
        // Wider than what is taken for a fixed place: the lane says the rest.
        let near = |at: f64| Some(Bounds::new(at - 0.8, at + 0.8));
        let spec = ObjectSpec {
            id: id.into(),
            class,
            x: near(start.x),
            y: near(start.y),
            speed: Some(Bounds::new(drive.speed - 0.4, drive.speed + 0.4)),
            lane: Some(lane.id.0),
            ..ObjectSpec::default()
        };
        extras.push(Extra {
            kind: class.kind(),
            size: size_of(&spec),
            way: Way::Along(drive),
        });
        stage.objects.push(spec);
    }

    /// Whether all tags hold at one moment of the trial.
    fn holds(&self, (stage, extras): &(Stage, Vec<Extra>)) -> bool {
        if self.prompts.is_empty() {
            return true;
        }
        let mut trial = self.trial(stage, extras);
        let moments = if stage.drive.is_maneuver() {
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

    fn trial(&self, stage: &Stage, extras: &[Extra]) -> Scenario {
        let map = &self.request.map;
        let frame = |i: usize| {
            let seconds = i as f64 / TRIAL_HZ;
            let ego = stage.drive.state_after(seconds);
            let size = [stage.ego.length, stage.ego.width];
            let mut agents = stage.fixtures.clone();
            agents.push(flat(AgentId(0), AgentKind::Vehicle, size, ego));
            agents.extend(extras.iter().zip(1..).map(|(extra, id)| {
                let state = match &extra.way {
                    Way::Ahead(metres) => AgentState {
                        pose: ego.pose * Pose::new(*metres, 0.0, 0.0),
                        velocity: ego.velocity,
                    },
                    Way::Straight(state) => AgentState {
                        pose: Pose {
                            position: state.pose.position + state.velocity * seconds,
                            ..state.pose
                        },
                        velocity: state.velocity,
                    },
                    Way::Along(drive) => drive.state_after(seconds),
                };
                flat(AgentId(id), extra.kind, extra.size, state)
            }));
            Frame::new(agents, self.request.lights.clone())
        };
        let n = (PLANNED_S * TRIAL_HZ) as usize;
        Scenario {
            id: "trial".into(),
            map: Arc::clone(map),
            route: None,
            log: (0..=n).map(frame).collect(),
            dt: 1.0 / TRIAL_HZ,
            now: 0,
            ego: AgentId(0),
            targets: Vec::new(),
            objects_of_interest: Vec::new(),
            tags: Vec::new(),
        }
    }
}

impl Stage {
    /// The drive of the ego as it is in a scene made here: at its own speed, if that was open.
    pub(crate) fn drive_from(&self, ego: &Agent) -> Drive {
        let mut drive = self.drive.clone();
        drive.speed = ego.state.speed();
        drive
    }

    /// The request for a scene here.
    pub(crate) fn direct(&self, request: &GenerateRequest) -> GenerateRequest {
        let mut request = request.clone();
        request.ego = self.ego;
        request.objects.clone_from(&self.objects);
        request.fixtures.extend_from_slice(&self.fixtures);
        // What was recorded where the ego now is has to make room.
        let own = OrientedBox {
            pose: self.ego.pose,
            length: self.ego.length,
            width: self.ego.width,
        };
        let is_clear = |agent: &Agent| !own.overlaps(&agent.oriented_box());
        request.fixtures.retain(is_clear);
        request
    }
}

/// A start on any lane around one, any place as likely as any other; that one if there is no lane.
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

/// Somebody in a trial, in which heights do not matter.
fn flat(id: AgentId, kind: AgentKind, [length, width]: [f64; 2], state: AgentState) -> Agent {
    Agent {
        id,
        kind,
        length,
        width,
        height: 1.6,
        elevation: 0.8,
        state,
    }
}

fn drawn(bounds: Bounds, rng: &mut Rng) -> f64 {
    rng.random_range(bounds.low..=bounds.high)
}

/// The extent of somebody cast.
fn size_of(object: &ObjectSpec) -> [f64; 2] {
    let [length, width] = match object.class {
        Class::Vehicle => [4.5, 1.9],
        Class::Pedestrian => [0.8, 0.8],
        Class::Bicycle => [1.8, 0.7],
    };
    let middle = |bounds: Bounds| (bounds.low + bounds.high) / 2.0;
    [object.length.map_or(length, middle), width]
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
    use super::super::GenerateConfig;
    use super::*;
    use gump_scene::{LaneId, MapParts, StopSign, fixture};

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

    fn found(request: &GenerateRequest, tags: &[&str]) -> Option<Stage> {
        let prompts: Vec<ScenarioTag> = tags.iter().map(|tag| tag.parse().unwrap()).collect();
        let search = Search {
            cast: &Cast::of(&prompts),
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
                cast: &Cast::of(&prompts),
                request: &request,
                prompts: &prompts,
            };
            search.here(Seed(1))
        };
        let stage = here("following_lane_with_lead").unwrap();
        let directed = stage.direct(&request);
        assert_eq!(directed.ego.pose, request.ego.pose);
        assert!((4.5..9.0).contains(&directed.ego.velocity.unwrap().length()));
        assert_eq!(directed.objects.len(), 1);
        assert!(here("starting_left_turn").is_none());
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
        let stage = found(&request, &["starting_left_turn"]).unwrap();
        let speed = stage.ego.velocity.unwrap().length();
        assert!((5.0..=5.5).contains(&speed), "{speed}");
        // Who is ahead already needs no company; but the trial does not know the truck.
        let stage = found(&request, &["following_lane_without_lead"]).unwrap();
        assert_eq!(stage.objects.len(), 2);
        request.ego.velocity = Some(DVec2::new(8.0, 0.0));
        let stage = found(&request, &["medium_magnitude_speed"]).unwrap();
        assert_eq!(stage.ego.velocity, request.ego.velocity);
    }
}
