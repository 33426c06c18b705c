//! nuPlan's IDM planner: follows the route's centre line at the speed limit, behind agents in the
//! way.

use std::collections::BTreeSet;
use std::sync::Arc;

use gump_geometry::{OrientedBox, Polygon, Pose, Quad, widen};
use gump_nuplan::closed_loop::{Driver, PlannerInitialization, PlannerInput};
use gump_nuplan::path::{Path, baseline};
use gump_nuplan::tracking::Trajectory;
use gump_rollout::BoxError;
use gump_rollout::worlds::{IdmConfig, idm_euler_step};
use gump_scene::{
    Agent, EgoState, Lane, LaneId, LightState, MapGraph, RoadblockId, VehicleParameters,
};

use crate::PlanError;
use crate::candidates::{Candidate, Explain};
use crate::pdm::state::stated_route;
use crate::route_search::{first_lanes, lanes_of_route};

/// States of a plan besides the present ...
const STATES: usize = 16;
/// ... and the seconds between them.
const DT: f64 = 0.5;
/// Objects farther away are ignored, metres.
const RADIUS: f64 = 40.0;

/// Follows the route by the Intelligent Driver Model; all other agents are assumed to stand.
///
/// Source: nuPlan's IDM planner with its default parameters; agrees with its recorded simulations.
#[derive(Debug)]
pub struct NuplanIdmDriver {
    law: IdmConfig,
    known: Option<Known>,
    plan: Vec<Pose>,
}

#[derive(Debug)]
struct Known {
    map: Arc<MapGraph>,
    vehicle: VehicleParameters,
    route: Vec<RoadblockId>,
    lanes: BTreeSet<LaneId>,
    way: Option<Way>,
}

/// The path and the desired speed, found once per drive.
#[derive(Debug)]
struct Way {
    path: Path,
    target: f64,
}

impl Default for NuplanIdmDriver {
    fn default() -> Self {
        Self {
            law: IdmConfig {
                target_velocity: 10.0,
                min_gap: 1.0,
                headway: 1.5,
                max_acceleration: 1.0,
                max_deceleration: 3.0,
                exponent: 4.0,
                ..IdmConfig::default()
            },
            known: None,
            plan: Vec::new(),
        }
    }
}

impl Driver for NuplanIdmDriver {
    fn name(&self) -> &str {
        "idm"
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        let route = stated_route(initialization)?;
        let lanes = lanes_of_route(initialization.map, &route);
        self.plan.clear();
        self.known = Some(Known {
            map: Arc::clone(initialization.map),
            vehicle: initialization.vehicle,
            lanes: lanes.iter().map(|lane| lane.id).collect(),
            route,
            way: None,
        });
        Ok(())
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let known = self.known.as_mut().ok_or(PlanError::NotInitialized)?;
        if known.way.is_none() {
            known.way = Some(known.find_way(input.ego, self.law.target_velocity)?);
        }
        let states = known.follow(input, &self.law)?;
        self.plan = states.iter().map(|state| state.rear_axle).collect();
        Ok(Trajectory::new(states)?)
    }
}

/// An object in the way, as nuPlan's planner sees it.
enum Obstacle<'a> {
    Object(Quad, &'a Agent),
    RedLight(Polygon),
}

impl Obstacle<'_> {
    fn intersects(&self, pieces: &[Quad]) -> bool {
        match self {
            Self::Object(quad, _) => pieces.iter().any(|piece| piece.intersects(quad)),
            Self::RedLight(polygon) => pieces.iter().any(|p| p.intersects_polygon(polygon)),
        }
    }

    fn distance(&self, own: &Quad) -> f64 {
        match self {
            Self::Object(quad, _) => own.distance(quad),
            Self::RedLight(polygon) => own.distance_to_polygon(polygon),
        }
    }

    /// Its speed along a heading.
    fn speed_along(&self, heading: f64) -> f64 {
        match self {
            Self::Object(_, agent) if agent.kind.is_moving() => {
                agent.state.speed() * (agent.state.pose.heading - heading).cos()
            }
            _ => 0.0,
        }
    }
}

impl Known {
    fn find_way(&self, ego: &EgoState, fallback: f64) -> Result<Way, PlanError> {
        let (start, depth) = self.start(ego)?;
        let (lanes, _) = first_lanes(&self.map, start.id, &self.route, depth);
        let lanes = lanes.iter().filter_map(|&id| self.map.lane(id));
        let poses: Vec<Pose> = lanes.flat_map(baseline).collect();
        Ok(Way {
            path: Path::without_last(&poses).ok_or(PlanError::NoRoute)?,
            target: start.speed_limit.unwrap_or(fallback).max(ego.speed()),
        })
    }

    /// The lane to start from, and the number of lanes of the path from there.
    fn start(&self, ego: &EgoState) -> Result<(&Lane, usize), PlanError> {
        let footprint = self.vehicle.footprint(ego.rear_axle);
        let center = footprint.pose.position;
        let n = self.route.len();
        let first_two = self.route.iter().take(2).enumerate();
        let lanes: Vec<(&Lane, usize)> = first_two
            .flat_map(|(i, &id)| self.map.roadblock_lanes(id).map(move |lane| (lane, n - i)))
            .collect();
        let holds = |(lane, _): &&(&Lane, usize)| {
            lane.surface()
                .is_some_and(|polygon| polygon.contains(center))
        };
        if let Some(&found) = lanes.iter().find(holds) {
            return Ok(found);
        }
        let own = Quad::from(&footprint);
        let distance = |lane: &Lane| {
            let surface = lane.surface();
            surface.map_or(f64::INFINITY, |polygon| own.distance_to_polygon(&polygon))
        };
        let nearest = lanes
            .iter()
            .min_by(|a, b| distance(a.0).total_cmp(&distance(b.0)));
        nearest.copied().ok_or(PlanError::NoRoute)
    }

    fn follow(
        &self,
        input: &PlannerInput<'_>,
        law: &IdmConfig,
    ) -> Result<Vec<EgoState>, PlanError> {
        let way = self.way.as_ref().ok_or(PlanError::NoRoute)?;
        let ego = input.ego;
        let mut footprint = self.vehicle.footprint(ego.rear_axle);
        let obstacles = self.obstacles(input, &footprint);
        let mut now = (way.path.project(footprint.pose.position), ego.velocity.x);
        let mut states = vec![self.state(way, now, ego.time_us)];
        for step in 1..=STATES {
            let (gap, lead_speed) = self.lead(way, now.0, &footprint, &obstacles);
            let (progress, speed) = idm_euler_step(law, now, way.target, gap, lead_speed, DT);
            now = (progress, speed.max(0.0));
            let time_us = ego.time_us + (step as f64 * DT * 1e6) as i64;
            let state = self.state(way, now, time_us);
            footprint = self.vehicle.footprint(state.rear_axle);
            states.push(state);
        }
        Ok(states)
    }

    fn state(&self, way: &Way, (progress, speed): (f64, f64), time_us: i64) -> EgoState {
        EgoState {
            time_us,
            rear_axle: self.vehicle.rear_axle_of(way.path.pose_at(progress)),
            velocity: gump_geometry::dvec2(speed, 0.0),
            ..EgoState::default()
        }
    }

    /// Clear distance and speed of the leader; the end of the path counts as standing.
    fn lead(
        &self,
        way: &Way,
        progress: f64,
        footprint: &OrientedBox,
        obstacles: &[Obstacle<'_>],
    ) -> (f64, f64) {
        let reach = way.target * DT * STATES as f64;
        let ahead = way.path.line().slice(progress, progress + reach);
        let half_width = self.vehicle.width / 2.0;
        let own = Quad::from(footprint);
        let mut pieces = widen(ahead.points(), half_width, half_width);
        pieces.push(own);
        let nearest = obstacles
            .iter()
            .filter(|obstacle| obstacle.intersects(&pieces))
            .map(|obstacle| (obstacle.distance(&own), obstacle))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        match nearest {
            Some((gap, obstacle)) => (gap, obstacle.speed_along(footprint.pose.heading)),
            None => (
                way.path.length() - progress - self.vehicle.length() / 2.0,
                0.0,
            ),
        }
    }

    fn obstacles<'a>(&self, input: &PlannerInput<'a>, ego: &OrientedBox) -> Vec<Obstacle<'a>> {
        let scene = input.scene;
        let near = scene.now().agents().iter().filter(|agent| {
            let away = agent.state.pose.position.distance(ego.pose.position);
            agent.id != scene.ego && away < RADIUS
        });
        let objects = near.map(|agent| Obstacle::Object(Quad::from(&agent.oriented_box()), agent));
        let red = scene
            .now()
            .lights()
            .iter()
            .filter(|light| light.state == LightState::Red && self.lanes.contains(&light.lane));
        let lanes = red.filter_map(|light| self.map.lane(light.lane));
        let surfaces = lanes
            .filter(|lane| lane.in_intersection)
            .filter_map(Lane::surface);
        let lights = surfaces.map(|polygon| Obstacle::RedLight(polygon.into_owned()));
        objects.chain(lights).collect()
    }
}

impl Explain for NuplanIdmDriver {
    fn candidates(&self) -> Vec<Candidate> {
        vec![Candidate::alone("along the route", self.plan.clone())]
    }
}
