//! State of a drive: the way, the road around the ego and the objects on it.

use std::collections::BTreeSet;
use std::sync::Arc;

use gump_geometry::{DVec2, Polygon, Pose, Quad, angle_difference};
use gump_nuplan::closed_loop::{PlannerInitialization, PlannerInput};
use gump_nuplan::path::{Path, baseline};
use gump_nuplan::tracking::Trajectory;
use gump_rollout::RolloutError;
use gump_rollout::worlds::IdmConfig;
use gump_scene::{
    EgoState, Lane, LaneId, LightState, MapGraph, RoadblockId, SceneState, VehicleParameters,
};

use super::forecast::Forecast;
use super::ground::Ground;
use super::lane_change::{Change, OTHER_LANE_M, Side, changes, way_from};
use super::propose::{DT, Line, Proposer};
use super::{PdmConfig, TRAJECTORY_STEPS};
use crate::PlanError;
use crate::route_search::{correct_route, lanes_of_route, nearest_vertex, shortest_lanes};

/// Roadblocks of the route that the centre line is laid through. Source: tuPlan Garage.
const WINDOW: usize = 30;

/// State since the drive began.
#[derive(Debug)]
pub(crate) struct State {
    pub(crate) map: Arc<MapGraph>,
    pub(crate) vehicle: VehicleParameters,
    stated: Vec<RoadblockId>,
    /// The way, once the ego has been seen.
    way: Option<Way>,
    pub(crate) ground: Ground,
    pub(crate) forecast: Forecast,
    /// The limit stated by the lane, metres per second, once a step was prepared.
    pub(crate) stated_limit: Option<f64>,
}

#[derive(Debug)]
struct Way {
    lanes: BTreeSet<LaneId>,
    in_order: Vec<LaneId>,
    route: Vec<RoadblockId>,
    /// One per lateral offset, the centre line among them where the offset is 0.
    lines: Vec<Line>,
    centerline: Line,
    /// The centre line that progress counts on, where the ego's own ends before the route does.
    goes_on: Option<Line>,
    /// The lanes of the centre line.
    chain: Vec<LaneId>,
    /// Changes of lane, whose lines follow those of the lateral offsets.
    changes: Vec<Change>,
}

impl State {
    /// Takes an initialization; the way is found in the first step.
    ///
    /// # Errors
    /// As [`stated_route`].
    pub(crate) fn new(initialization: &PlannerInitialization<'_>) -> Result<Self, PlanError> {
        Ok(Self {
            stated: stated_route(initialization)?,
            map: Arc::clone(initialization.map),
            vehicle: initialization.vehicle,
            way: None,
            ground: Ground::new(initialization.map),
            forecast: Forecast::default(),
            stated_limit: None,
        })
    }

    /// Updates the state for a step and lays the lines if necessary; returns the desired speeds,
    /// metres per second.
    ///
    /// # Errors
    /// [`PlanError::NoRoute`] if there is no way from the ego's position, [`PlanError::NotFinite`]
    /// for an agent whose state is not finite, because a forecast could not place it.
    pub(crate) fn prepare(
        &mut self,
        input: &PlannerInput<'_>,
        config: &PdmConfig,
    ) -> Result<Vec<f64>, PlanError> {
        let mut agents = input.scene.now().agents().iter();
        if let Some(agent) = agents.find(|agent| !agent.state.is_finite()) {
            return Err(PlanError::NotFinite { agent: agent.id });
        }
        self.look(input, config)?;
        let lane = self.starting_lane(input.ego)?;
        self.lay_lines(lane, config)?;
        let lane = self.map.lane(lane);
        let limit = lane.and_then(|lane| lane.speed_limit.or(lane.kind.usual_speed_limit()));
        self.stated_limit = lane.and_then(|lane| lane.speed_limit);
        let limit = limit.unwrap_or(config.fallback_speed);
        Ok(config.speed_fractions.iter().map(|f| f * limit).collect())
    }

    /// The proposer of the prepared step.
    pub(crate) fn proposer<'a>(&'a self, law: &'a IdmConfig, speeds: &'a [f64]) -> Proposer<'a> {
        Proposer {
            law,
            vehicle: &self.vehicle,
            forecast: &self.forecast,
            lines: &self.prepared().lines,
            desired_speeds: speeds,
        }
    }

    /// The centre line that progress counts on.
    pub(crate) fn centerline(&self) -> &Line {
        let way = self.prepared();
        way.goes_on.as_ref().unwrap_or(&way.centerline)
    }

    fn prepared(&self) -> &Way {
        self.way.as_ref().expect("the moment was prepared")
    }

    /// Updates the road and the objects around the ego.
    fn look(&mut self, input: &PlannerInput<'_>, config: &PdmConfig) -> Result<(), PlanError> {
        let ego = input.ego;
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
                goes_on: None,
                chain: Vec::new(),
                changes: Vec::new(),
            });
        }
        let way = self.way.as_ref().expect("the way was just found");
        let footprint = self.vehicle.footprint(ego.rear_axle);
        self.ground
            .look(&self.map, &way.lanes, footprint.pose.position);
        let scene = input.scene;
        let others = scene
            .now()
            .agents()
            .iter()
            .filter(|agent| agent.id != scene.ego);
        let red = red_lights(&self.map, &scene, &way.lanes);
        self.forecast.look(&footprint, others, red);
        Ok(())
    }

    /// The lane of the route that the ego is on, or the one to drive to.
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

    /// Lays the lines through the route, once per drive.
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
        way.chain = lanes;
        Ok(())
    }

    /// Lays lines into the lanes beside the ego's own, anew for every decision, but for the change
    /// that is under way; once the ego is in another lane, its own lines are laid there.
    ///
    /// # Errors
    /// As [`Self::prepare`].
    pub(crate) fn lay_changes(
        &mut self,
        ego: &EgoState,
        config: &PdmConfig,
        under_way: Option<Side>,
    ) -> Result<(), PlanError> {
        let place = ego.rear_axle.position;
        let here = self.starting_lane(ego)?;
        let way = self.way.as_mut().ok_or(PlanError::NoRoute)?;
        let first = way.lines.len() - way.changes.len();
        let mut laid = way.changes.iter().zip(&way.lines[first..]);
        let kept = laid
            .find(|(change, line)| Some(change.side) == under_way && change.goes_on(line, place));
        let kept = kept.map(|(change, line)| {
            let change = Change {
                is_due: true,
                ..change.clone()
            };
            (change, line.clone())
        });
        let off = |id: &LaneId| metres_to(&self.map, *id, place);
        let least = way.chain.iter().map(off).fold(f64::INFINITY, f64::min);
        if !way.chain.contains(&here) && least > OTHER_LANE_M {
            way.lines.clear();
            self.lay_lines(here, config)?;
        }
        let way = self.way.as_mut().ok_or(PlanError::NoRoute)?;
        way.lines.truncate(config.lateral_offsets.len());
        way.changes.clear();
        way.goes_on = None;
        let off = |id: &LaneId| metres_to(&self.map, *id, place);
        let own = way.chain.iter().min_by(|a, b| off(a).total_cmp(&off(b)));
        let Some(&own) = own else { return Ok(()) };
        let block = self.map.lane(own).and_then(|lane| lane.roadblock);
        let at = way.route.iter().position(|&id| Some(id) == block);
        let Some(at) = at else { return Ok(()) };
        let window = &way.route[at..way.route.len().min(at + WINDOW)];
        let mut found = changes(&self.map, own, window, ego.rear_axle, ego.speed());
        let arrives = way_from(&self.map, own, window).is_some_and(|(_, arrives)| arrives);
        // A lane that ends looks empty, and good for as long as a rollout reaches.
        found.retain(|(change, _)| change.arrives || !arrives);
        for (change, _) in &mut found {
            change.is_due = !arrives && change.arrives;
        }
        if let Some(kept) = kept {
            found.retain(|(change, _)| change.side != kept.0.side);
            found.push(kept);
        }
        if !arrives && let Some(change) = found.iter().map(|found| &found.0).find(|c| c.arrives) {
            way.goes_on = Some(Line::new(change.target.clone()));
        }
        for (change, line) in found {
            way.lines.push(line);
            way.changes.push(change);
        }
        Ok(())
    }

    /// The changes of lane that are laid, with the indices of their lines.
    pub(crate) fn lane_changes(&self) -> impl Iterator<Item = (usize, &Change)> {
        self.way.iter().flat_map(|way| {
            let first = way.lines.len() - way.changes.len();
            (first..).zip(&way.changes)
        })
    }
}

/// Metres to the centre line of a lane.
fn metres_to(map: &MapGraph, lane: LaneId, place: DVec2) -> f64 {
    let lane = map.lane(lane);
    lane.map_or(f64::INFINITY, |lane| {
        lane.centerline.project(place).distance
    })
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

/// The roadblocks of an initialization that are in the map.
///
/// # Errors
/// [`PlanError::NoRoute`] if the initialization states none, [`PlanError::ForeignRoute`] if none of them
/// is in the map.
pub(crate) fn stated_route(
    initialization: &PlannerInitialization<'_>,
) -> Result<Vec<RoadblockId>, PlanError> {
    let stated = initialization
        .route
        .map(|route| &route.roadblocks[..])
        .unwrap_or_default();
    if stated.is_empty() {
        return Err(PlanError::NoRoute);
    }
    let known: Vec<_> = stated
        .iter()
        .copied()
        .filter(|&id| initialization.map.roadblock(id).is_some())
        .collect();
    if known.is_empty() {
        return Err(PlanError::ForeignRoute { first: stated[0] });
    }
    Ok(known)
}

/// Poses of the rear axle a tenth of a second apart as a reference.
pub(crate) fn trajectory(start_us: i64, poses: &[Pose]) -> Result<Trajectory, RolloutError> {
    let state = |(i, &rear_axle): (usize, &Pose)| EgoState {
        time_us: start_us + i as i64 * 100_000,
        rear_axle,
        ..EgoState::default()
    };
    Trajectory::new(poses.iter().enumerate().map(state).collect())
}

/// A reference straight ahead at a constant speed that makes the tracker brake hard. That speed is
/// mostly negative: the reference runs backwards, and is computed again at every step.
///
/// Source: the gains are tuPlan Garage's, the bounds nuPlan's of comfortable acceleration, m/s².
pub(crate) fn brake(ego: &EgoState, vehicle: &VehicleParameters) -> Vec<Pose> {
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
