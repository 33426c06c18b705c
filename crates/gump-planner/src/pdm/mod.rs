//! PDM-Closed: fifteen proposals by rule, each driven and judged against a constant-velocity
//! forecast; the best one is followed.
//!
//! Start with [`PdmClosed`]. `propose` makes the proposals on the lines that the route gives,
//! `track` drives them, `score` judges them on what `ground` and `forecast` say of the road and of
//! everyone else.
//!
//! Everything is as its authors' code has it, oddities included: where they matter a comment says
//! so. Source: Dauner et al. 2023, "Parting with Misconceptions about Learning-based Vehicle Motion
//! Planning", and the released tuPlan Garage; agrees with its goldens.

mod comfort;
mod forecast;
mod ground;
mod propose;
mod score;
#[cfg(test)]
mod tests;
mod track;

pub use score::PdmScore;

use std::collections::BTreeSet;
use std::sync::Arc;

use gump_geometry::{Polygon, Pose, Quad, angle_difference};
use gump_rollout::closed_loop::{Driver, Mission, Moment};
use gump_rollout::dynamics::Trajectory;
use gump_rollout::worlds::IdmConfig;
use gump_rollout::{BoxError, Path, baseline};
use gump_scene::{
    EgoState, Lane, LaneId, LightState, MapGraph, RoadblockId, SceneState, VehicleParameters,
};

use crate::PlanError;
use crate::considered::{Considered, Explain};
use crate::route_search::{correct_route, lanes_of_route, nearest_vertex, shortest_lanes};
use comfort::ComfortFilters;
use forecast::Forecast;
use ground::Ground;
use propose::{DT, Line, Proposal, Proposer};
use score::Judge;
use track::Tracker;

/// Steps of a proposal.
const STEPS: usize = 40;
/// Steps of the trajectory that is followed.
const TRAJECTORY_STEPS: usize = 80;
/// Roadblocks of the route that the centre line is laid through.
const WINDOW: usize = 30;
/// A collision sooner than this, in steps, calls for the brake ...
const BRAKE_STEPS: usize = 20;
/// ... if the ego is not faster than this, metres per second.
const BRAKE_SPEED: f64 = 5.0;

/// Which proposals are made.
#[derive(Clone, Debug, PartialEq)]
pub struct PdmConfig {
    /// Desired speeds as shares of the limit.
    pub speed_fractions: Vec<f64>,
    /// Lines to follow, metres to the left of the centre.
    pub lateral_offsets: Vec<f64>,
    /// The limit of a lane that states none, metres per second.
    pub fallback_speed: f64,
    /// The car-following law; of its limits only the two accelerations are used.
    pub law: IdmConfig,
}

impl Default for PdmConfig {
    /// The released configuration.
    fn default() -> Self {
        Self {
            speed_fractions: vec![0.2, 0.4, 0.6, 0.8, 1.0],
            lateral_offsets: vec![0.0, -1.0, 1.0],
            fallback_speed: 15.0,
            law: IdmConfig {
                min_gap: 1.0,
                headway: 1.5,
                max_acceleration: 1.5,
                max_deceleration: 3.0,
                exponent: 10.0,
                ..IdmConfig::default()
            },
        }
    }
}

/// The planner PDM-Closed.
#[derive(Debug)]
pub struct PdmClosed {
    config: PdmConfig,
    mission: Option<State>,
    tracker: Tracker,
    comfort: ComfortFilters,
    thought: Thought,
}

/// What it knows since the mission began.
#[derive(Debug)]
struct State {
    map: Arc<MapGraph>,
    vehicle: VehicleParameters,
    stated: Vec<RoadblockId>,
    /// The way, once the ego has been seen.
    way: Option<Way>,
    ground: Ground,
    forecast: Forecast,
}

#[derive(Debug)]
struct Way {
    lanes: BTreeSet<LaneId>,
    in_order: Vec<LaneId>,
    route: Vec<RoadblockId>,
    /// One per lateral offset, the centre line among them where the offset is 0.
    lines: Vec<Line>,
    centerline: Line,
}

/// What it made of the last moment.
#[derive(Clone, Debug, Default)]
pub(crate) struct Thought {
    pub(crate) proposals: Vec<Proposal>,
    pub(crate) drives: Vec<Vec<EgoState>>,
    pub(crate) scores: Vec<PdmScore>,
    pub(crate) best: usize,
    pub(crate) braked: bool,
}

impl Default for PdmClosed {
    fn default() -> Self {
        Self::new(PdmConfig::default()).expect("the released configuration is valid")
    }
}

impl PdmClosed {
    /// A planner with these proposals.
    ///
    /// # Errors
    /// [`PlanError::Parameter`] for a number out of its range.
    pub fn new(config: PdmConfig) -> Result<Self, PlanError> {
        check(&config)?;
        Ok(Self {
            config,
            mission: None,
            tracker: Tracker::new(STEPS),
            comfort: ComfortFilters::new(STEPS + 1, DT),
            thought: Thought::default(),
        })
    }

    /// The scores of the last step's proposals: lateral offsets one after another, within each the
    /// speeds.
    pub fn scores(&self) -> &[PdmScore] {
        &self.thought.scores
    }

    /// Index of the proposal that was best in the last step.
    pub fn best(&self) -> usize {
        self.thought.best
    }

    #[cfg(test)]
    pub(crate) fn thought(&self) -> &Thought {
        &self.thought
    }
}

fn check(config: &PdmConfig) -> Result<(), PlanError> {
    let law = &config.law;
    let numbers = [
        ("fallback_speed", config.fallback_speed),
        ("min_gap", law.min_gap),
        ("headway", law.headway),
        ("max_acceleration", law.max_acceleration),
        ("max_deceleration", law.max_deceleration),
        ("exponent", law.exponent),
    ];
    let fractions = config
        .speed_fractions
        .iter()
        .map(|&f| ("speed_fraction", f));
    for (name, value) in numbers.into_iter().chain(fractions) {
        if !(value > 0.0 && value.is_finite()) {
            let expected = "a positive number";
            return Err(PlanError::Parameter {
                name,
                value,
                expected,
            });
        }
    }
    let n = config.speed_fractions.len() * config.lateral_offsets.len();
    if n == 0
        || config
            .lateral_offsets
            .iter()
            .any(|offset| !offset.is_finite())
    {
        return Err(PlanError::Parameter {
            name: "number of proposals",
            value: n as f64,
            expected: "at least one speed and one finite offset",
        });
    }
    Ok(())
}

impl Driver for PdmClosed {
    fn name(&self) -> &str {
        "pdm-closed"
    }

    fn start(&mut self, mission: &Mission<'_>) -> Result<(), BoxError> {
        let stated = stated_route(mission)?;
        self.thought = Thought::default();
        self.mission = Some(State {
            map: Arc::clone(mission.map),
            vehicle: mission.vehicle,
            stated,
            way: None,
            ground: Ground::default(),
            forecast: Forecast::default(),
        });
        Ok(())
    }

    fn drive(&mut self, moment: &Moment<'_>) -> Result<Trajectory, BoxError> {
        let state = self.mission.as_mut().ok_or(PlanError::NoMission)?;
        state.look(moment, &self.config)?;
        let lane = state.starting_lane(moment.ego)?;
        state.lay_lines(lane, &self.config)?;
        let limit = state.map.lane(lane).and_then(|lane| lane.speed_limit);
        let limit = limit.unwrap_or(self.config.fallback_speed);
        let speeds: Vec<f64> = self
            .config
            .speed_fractions
            .iter()
            .map(|f| f * limit)
            .collect();
        let way = state.way.as_ref().expect("the lines were just laid");
        let proposer = Proposer {
            law: &self.config.law,
            vehicle: &state.vehicle,
            forecast: &state.forecast,
            lines: &way.lines,
            desired_speeds: &speeds,
        };
        let ego = moment.ego;
        let thought = &mut self.thought;
        thought.proposals = proposer.propose(ego.rear_axle, ego.velocity.x, STEPS);
        thought.drives.resize(thought.proposals.len(), Vec::new());
        for (proposal, states) in thought.proposals.iter().zip(&mut thought.drives) {
            let wheel_base = state.vehicle.wheel_base;
            self.tracker.drive(ego, &proposal.poses, wheel_base, states);
        }
        let judge = Judge {
            vehicle: &state.vehicle,
            forecast: &state.forecast,
            ground: &state.ground,
            centerline: &way.centerline,
        };
        thought.scores = judge.judge(&thought.drives, &mut self.comfort);
        thought.best = first_best(&thought.scores);
        let best = &thought.scores[thought.best];
        let soon = best.collision_step.is_some_and(|step| step <= BRAKE_STEPS);
        thought.braked = soon && ego.speed() <= BRAKE_SPEED;
        let poses = if thought.braked {
            brake(ego, &state.vehicle)
        } else {
            let mut chosen = [thought.proposals[thought.best].clone()];
            proposer.drive(&mut chosen, STEPS + 1..=TRAJECTORY_STEPS);
            let [chosen] = chosen;
            chosen.poses
        };
        Ok(trajectory(ego.time_us, &poses)?)
    }
}

/// The roadblocks of a mission that are in the map.
///
/// # Errors
/// [`PlanError::NoRoute`] if the mission states none, [`PlanError::ForeignRoute`] if none of them
/// is in the map.
pub(crate) fn stated_route(mission: &Mission<'_>) -> Result<Vec<RoadblockId>, PlanError> {
    let stated = mission
        .route
        .map(|route| &route.roadblocks[..])
        .unwrap_or_default();
    if stated.is_empty() {
        return Err(PlanError::NoRoute);
    }
    let known: Vec<_> = stated
        .iter()
        .copied()
        .filter(|&id| mission.map.roadblock(id).is_some())
        .collect();
    if known.is_empty() {
        return Err(PlanError::ForeignRoute { first: stated[0] });
    }
    Ok(known)
}

/// Poses of the rear axle a tenth of a second apart as something to follow.
pub(crate) fn trajectory(
    start_us: i64,
    poses: &[Pose],
) -> Result<Trajectory, gump_rollout::RolloutError> {
    let state = |(i, &rear_axle): (usize, &Pose)| EgoState {
        time_us: start_us + i as i64 * 100_000,
        rear_axle,
        ..EgoState::default()
    };
    Trajectory::new(poses.iter().enumerate().map(state).collect())
}

fn first_best(scores: &[PdmScore]) -> usize {
    let mut best = 0;
    for (i, score) in scores.iter().enumerate() {
        if score.total > scores[best].total {
            best = i;
        }
    }
    best
}

/// A reference straight ahead at a constant speed that makes the tracker brake hard. That speed is
/// mostly negative: the reference runs backwards, and is laid afresh at every step.
fn brake(ego: &EgoState, vehicle: &VehicleParameters) -> Vec<Pose> {
    let (low, high) = (-4.05, 2.4);
    let speed = ego.velocity.x;
    let swing = vehicle.rear_axle_to_center() * (ego.yaw_rate.powi(2) + ego.yaw_acceleration);
    let acceleration = ego.acceleration.x + swing;
    let reference = if speed > 0.2 {
        1.1 * (speed + (-10.0 * speed).clamp(low, high))
    } else {
        (-4.0 * speed - acceleration).clamp(low, high)
    };
    let direction = ego.rear_axle.direction();
    (0..=TRAJECTORY_STEPS)
        .map(|i| Pose {
            position: ego.rear_axle.position + direction * (reference * DT * i as f64),
            ..ego.rear_axle
        })
        .collect()
}

impl State {
    /// Takes in the road and everyone around.
    fn look(&mut self, moment: &Moment<'_>, config: &PdmConfig) -> Result<(), PlanError> {
        let ego = moment.ego;
        if self.way.is_none() {
            let route = correct_route(&self.map, &self.stated, ego.rear_axle);
            let in_order: Vec<LaneId> = lanes_of_route(&self.map, &route)
                .iter()
                .map(|lane| lane.id)
                .collect();
            if in_order.is_empty() {
                return Err(PlanError::NoRoute);
            }
            let nowhere = Path::through(&[ego.rear_axle]).expect("a path of one pose");
            self.way = Some(Way {
                lanes: in_order.iter().copied().collect(),
                in_order,
                route,
                lines: Vec::with_capacity(config.lateral_offsets.len()),
                centerline: Line::new(nowhere),
            });
        }
        let way = self.way.as_ref().expect("the way was just found");
        let footprint = self.vehicle.footprint(ego.rear_axle);
        self.ground
            .look(&self.map, &way.lanes, footprint.pose.position);
        let scene = moment.scene;
        let others = scene
            .now()
            .agents()
            .iter()
            .filter(|agent| agent.id != scene.ego);
        let red = red_lights(&self.map, &scene, &way.lanes);
        self.forecast.look(&footprint, others, red);
        Ok(())
    }

    /// The lane of the route that the ego is on, or the one to go to.
    fn starting_lane(&self, ego: &EgoState) -> Result<LaneId, PlanError> {
        let way = self.way.as_ref().ok_or(PlanError::NoRoute)?;
        let at = |id: &LaneId| {
            self.map
                .lane(*id)
                .expect("lanes of the route are in the map")
        };
        let turned = |id: &LaneId| {
            let vertex = nearest_vertex(at(id), ego.rear_axle.position);
            angle_difference(vertex.heading, ego.rear_axle.heading).abs()
        };
        let own = self.ground.route_lanes_at(ego.rear_axle.position);
        if let Some(lane) = own.min_by(|a, b| turned(a).total_cmp(&turned(b))) {
            return Ok(lane);
        }
        let footprint = self.vehicle.footprint(ego.rear_axle);
        let center = footprint.pose.position;
        let surface = |id: &LaneId| at(id).surface();
        let holds = |id: &&LaneId| surface(id).is_some_and(|polygon| polygon.contains(center));
        if let Some(&lane) = way.in_order.iter().find(holds) {
            return Ok(lane);
        }
        let own = Quad::from(&footprint);
        let distance = |id: &LaneId| {
            surface(id).map_or(f64::INFINITY, |polygon| own.distance_to_polygon(&polygon))
        };
        let nearest = way
            .in_order
            .iter()
            .min_by(|a, b| distance(a).total_cmp(&distance(b)));
        nearest.copied().ok_or(PlanError::NoRoute)
    }

    /// Lays the lines through the route, once per mission.
    fn lay_lines(&mut self, start: LaneId, config: &PdmConfig) -> Result<(), PlanError> {
        let way = self.way.as_mut().ok_or(PlanError::NoRoute)?;
        if !way.lines.is_empty() {
            return Ok(());
        }
        let block = self.map.lane(start).and_then(|lane| lane.roadblock);
        let here = way
            .route
            .iter()
            .position(|&id| Some(id) == block)
            .unwrap_or(0);
        let window = &way.route[here..way.route.len().min(here + WINDOW)];
        let lanes = shortest_lanes(&self.map, start, window);
        let poses: Vec<Pose> = lanes
            .iter()
            .filter_map(|&id| self.map.lane(id))
            .flat_map(baseline)
            .collect();
        let center = Path::through(&poses).ok_or(PlanError::NoRoute)?;
        way.lines = config
            .lateral_offsets
            .iter()
            .map(|&left| Line::new(center.shifted(left)))
            .collect();
        way.centerline = Line::new(center);
        Ok(())
    }
}

/// Surfaces of the route's lanes through intersections whose lights are red.
fn red_lights(
    map: &MapGraph,
    scene: &SceneState<'_>,
    route: &BTreeSet<LaneId>,
) -> Vec<(LaneId, Polygon)> {
    let lights = scene.now().lights().iter();
    let red = lights.filter(|light| light.state == LightState::Red && route.contains(&light.lane));
    let lanes = red.filter_map(|light| map.lane(light.lane));
    lanes
        .filter(|lane| lane.in_intersection)
        .filter_map(|lane: &Lane| Some((lane.id, lane.surface()?.into_owned())))
        .collect()
}

impl Explain for PdmClosed {
    fn considered(&self) -> Vec<Considered> {
        let thought = &self.thought;
        let n = self.config.speed_fractions.len();
        let name = |i: usize| {
            let fraction = self.config.speed_fractions[i % n];
            let left = self.config.lateral_offsets[i / n];
            format!("idm {:.0} % of the limit, {left:+.1} m", fraction * 100.0)
        };
        let proposals = thought.proposals.iter().zip(&thought.scores).enumerate();
        let mut all: Vec<Considered> = proposals
            .map(|(i, (proposal, score))| Considered {
                name: name(i),
                chosen: i == thought.best && !thought.braked,
                score: Some(score.total),
                parts: vec![
                    ("no_at_fault_collisions", score.no_at_fault_collision),
                    ("drivable_area", score.drivable_area),
                    ("driving_direction", score.driving_direction),
                    ("progress", score.progress),
                    ("time_to_collision", score.time_to_collision),
                    ("comfort", score.comfort),
                ],
                poses: proposal.poses.clone(),
            })
            .collect();
        if thought.braked {
            all.push(Considered::alone("emergency brake", Vec::new()));
        }
        all
    }
}
