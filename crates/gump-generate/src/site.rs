//! The site of a prompted scene: the ego's pose and drive, the other agents that the prompt needs,
//! and a trial with only these.

use std::sync::Arc;

use gump_engine::placement::object_spec::{Bounds, Class, ObjectSpec};
use gump_geometry::{DVec2, OrientedBox, Pose};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Frame, Lane, Light, MapGraph, Rng, Scenario,
};
use rand::Rng as _;
use rand::seq::IndexedRandom as _;

use crate::constraint::EGO;
use crate::drive::{PLANNED_S, PlannedDrive};
use crate::prompt::{OnCrosswalk, PromptSpec};
use crate::{EgoStart, GenerateRequest, roadside};

/// Frames of a trial per second: those of scenarios.
const TRIAL_HZ: f64 = 10.0;
/// Time at which a crossing agent crosses, seconds: the tag allows 3, and the world may slow it
/// down.
const CROSSES_S: f64 = 1.8;

/// The place of a scene, with the agents that its prompts need.
#[derive(Clone, Debug)]
pub(crate) struct Site {
    pub(super) ego: EgoStart,
    /// The ego's drive if it is steered.
    drive: PlannedDrive,
    /// All constraints, of the user and of the prompts.
    pub(super) objects: Vec<ObjectSpec>,
    fixtures: Vec<Agent>,
    /// The agents that the prompts need, as in the trial.
    extras: Vec<Extra>,
}

/// An agent in a trial.
#[derive(Clone, Debug)]
struct Extra {
    kind: AgentKind,
    size: [f64; 2],
    way: Way,
}

/// The motion of an agent in a trial.
#[derive(Clone, Debug)]
enum Way {
    /// At this distance ahead of the ego, centre to centre.
    Ahead(f64),
    /// At a constant velocity.
    Straight(AgentState),
    /// Along a drive, like an ego.
    Along(PlannedDrive),
}

impl Site {
    /// Places all agents around an ego on a lane: in the lane's direction and in its middle, or at
    /// `pose`, which is beside that place. `None` where that is impossible.
    pub(crate) fn set(
        cast: &PromptSpec,
        request: &GenerateRequest,
        place: (&Lane, f64),
        pose: Option<Pose>,
        rng: &mut Rng,
    ) -> Option<Self> {
        let map: &MapGraph = &request.map;
        let own = request.objects.iter().find(|object| object.id == EGO);
        let wished = own.and_then(|ego| ego.speed).or(cast.speed);
        let given = request.ego.velocity.map(DVec2::length);
        let speed = given
            .or_else(|| Some(drawn(wished?, rng)))
            .unwrap_or_else(|| rng.random_range(3.0..8.0));
        let maneuver = cast.maneuver(rng);
        let offset = pose.map_or(0.0, |pose| place.0.foot(pose).lateral_m);
        let drive = PlannedDrive::along(map, place, offset, speed, maneuver, rng)?;
        if drive.runs_red(&request.lights, request.ego.length) {
            return None;
        }
        let mut ego = request.ego;
        ego.pose = pose.unwrap_or_else(|| drive.pose_ahead(0.0));
        if ego.velocity.is_none() && wished.is_some() {
            ego.velocity = Some(ego.pose.direction() * speed);
        }
        let mut site = Self {
            ego,
            drive,
            objects: request.objects.clone(),
            fixtures: Vec::new(),
            extras: Vec::new(),
        };
        site.put_cast(cast, map, rng)?;
        if let Some(whereabouts) = cast.crosswalk {
            site.put_on_crosswalk(whereabouts, map, rng)?;
        }
        if let Some(class) = cast.crossing {
            site.put_crossing(class, map, rng)?;
        }
        if cast.is_trailed {
            site.put_trail(speed, map, rng)?;
        }
        if let Some(works) = cast.works {
            site.fixtures = roadside::put(map, place.0, &site.drive, ego.length, works)?;
        }
        Some(site)
    }

    /// The drive of the ego in a scene generated here: at its own speed, if that was open. `None` if
    /// at that speed the road ends too early or the ego passes one of the lights at red.
    pub(crate) fn drive_from(&self, ego: &Agent, lights: &[Light]) -> Option<PlannedDrive> {
        let drive = self.drive.at_speed(ego.state.speed())?;
        (!drive.runs_red(lights, ego.length)).then_some(drive)
    }

    /// The request for a scene at this place.
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

    /// True if the ego's manoeuvre starts after the first moment.
    pub(crate) fn takes_time(&self) -> bool {
        self.drive.takes_time()
    }

    /// The trial: the scenario with only these agents.
    pub(crate) fn trial(&self, request: &GenerateRequest) -> Scenario {
        let frame = |i: usize| {
            let seconds = i as f64 / TRIAL_HZ;
            let ego = self.drive.state_after(seconds);
            let size = [self.ego.length, self.ego.width];
            let mut agents = self.fixtures.clone();
            agents.push(flat(AgentId(0), AgentKind::Vehicle, size, ego));
            agents.extend(self.extras.iter().zip(1..).map(|(extra, id)| {
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
            Frame::new(agents, request.lights.clone())
        };
        let n = (PLANNED_S * TRIAL_HZ) as usize;
        Scenario {
            id: "trial".into(),
            map: Arc::clone(&request.map),
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

    /// The agents ahead of the ego, and those whose positions the tags specify.
    fn put_cast(&mut self, cast: &PromptSpec, map: &MapGraph, rng: &mut Rng) -> Option<()> {
        let own = self.objects.clone();
        let leaders = leaders(&own);
        // If there is a leader already, the prompt needs no other.
        let wanted = cast.objects.iter();
        let wanted = wanted.filter(|object| leaders.is_empty() || object.ahead_of.is_none());
        let gap = |object: &ObjectSpec| object.ahead_of.as_ref().map(|relation| relation.metres);
        self.objects.extend(wanted.clone().cloned());
        let all = leaders.iter().map(|(object, gap)| (*object, Some(*gap)));
        for (object, gap) in all.chain(wanted.map(|object| (object, gap(object)))) {
            let size = size_of(object);
            let speed = object.speed.map_or(1.0, |bounds| drawn(bounds, rng));
            let pose = self.ego.pose;
            let way = if let Some(gap) = gap {
                let ahead = self.ego.length / 2.0 + gap + size[0] / 2.0;
                let there = (pose * Pose::new(ahead, 0.0, 0.0)).position;
                // A row is straight, and its head is on the road, too.
                map.lanes_near(there, 1.0).next()?;
                Way::Ahead(ahead)
            } else {
                Way::Straight(AgentState {
                    pose,
                    velocity: pose.direction() * speed,
                })
            };
            self.extras.push(Extra {
                kind: object.class.kind(),
                size,
                way,
            });
        }
        Some(())
    }

    /// The pedestrian on a crosswalk.
    fn put_on_crosswalk(
        &mut self,
        whereabouts: OnCrosswalk,
        map: &MapGraph,
        rng: &mut Rng,
    ) -> Option<()> {
        let ego = self.ego;
        let at = roadside::on_crosswalk(map, &ego, |local, is_shared| {
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
        self.objects.push(ObjectSpec {
            id: "on crosswalk".into(),
            class: Class::Pedestrian,
            x: near(local.x),
            y: near(local.y),
            speed: Some(Bounds::new(0.0, 1.2)),
            ..ObjectSpec::default()
        });
        self.extras.push(Extra {
            kind: AgentKind::Pedestrian,
            size: [0.8, 0.8],
            way: Way::Straight(AgentState {
                pose: ego.pose * Pose::new(local.x, local.y, 0.0),
                velocity: DVec2::ZERO,
            }),
        });
        Some(())
    }

    /// The agent that crosses ahead: on a lane that crosses the line ahead, shortly before it.
    fn put_crossing(&mut self, class: Class, map: &MapGraph, rng: &mut Rng) -> Option<()> {
        // Usual speeds at junctions, metres per second; chosen by hand.
        let speeds = match class {
            Class::Bicycle => [3.0, 5.0],
            _ => [4.5, 7.5],
        };
        let speed = rng.random_range(speeds[0]..speeds[1]);
        let crossings = roadside::crossings(map, &self.ego);
        let (mut lane, at) = *crossings.choose(rng)?;
        let mut from = at - speed * CROSSES_S;
        while from < 0.0 {
            let before: Vec<&Lane> = map.predecessors(lane.id).collect();
            lane = before.choose(rng)?;
            from += lane.centerline.length();
        }
        let drive = PlannedDrive::along(map, (lane, from), 0.0, speed, Default::default(), rng)?;
        self.put_along("crossing", class, lane, drive);
        Some(())
    }

    /// The agent that follows in the lane that is changed to.
    fn put_trail(&mut self, speed: f64, map: &MapGraph, rng: &mut Rng) -> Option<()> {
        let lane = map.lane(self.drive.neighbor?)?;
        let on = lane.centerline.project(self.ego.pose.position);
        // The tag allows 20 m behind; less than 9 m is no room to change lanes.
        let from = on.arc_length - rng.random_range(9.0..15.0);
        if from < 0.0 {
            return None;
        }
        let drive = PlannedDrive::along(map, (lane, from), 0.0, speed, Default::default(), rng)?;
        self.put_along("trail", Class::Vehicle, lane, drive);
        Some(())
    }

    /// An agent that drives along a lane from now on.
    fn put_along(&mut self, id: &str, class: Class, lane: &Lane, drive: PlannedDrive) {
        let start = self.ego.pose.inverse() * drive.pose_ahead(0.0).position;
        // Wider than the bounds of a fixed place: the lane determines the rest.
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
        self.extras.push(Extra {
            kind: class.kind(),
            size: size_of(&spec),
            way: Way::Along(drive),
        });
        self.objects.push(spec);
    }
}

/// The agents ahead of the ego in a row, and the gaps in metres.
fn leaders(objects: &[ObjectSpec]) -> Vec<(&ObjectSpec, f64)> {
    let ego = objects.iter().find(|object| object.id == EGO);
    let followed = ego.and_then(|ego| ego.behind.as_ref());
    let gap = |object: &ObjectSpec| {
        let ahead = object.ahead_of.as_ref().filter(|r| r.object == EGO);
        let relation = ahead.or(followed.filter(|r| r.object == object.id))?;
        Some(relation.metres)
    };
    let leaders = objects.iter();
    leaders
        .filter_map(|object| Some((object, gap(object)?)))
        .collect()
}

/// An agent in a trial, in which heights do not matter.
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

/// The extent of an agent, metres: a usual one of its class, where none is asked for.
fn size_of(object: &ObjectSpec) -> [f64; 2] {
    let [length, width] = match object.class {
        Class::Vehicle => [4.5, 1.9],
        Class::Pedestrian => [0.8, 0.8],
        Class::Bicycle => [1.8, 0.7],
    };
    let middle = |bounds: Bounds| (bounds.low + bounds.high) / 2.0;
    [object.length.map_or(length, middle), width]
}
