//! nuPlan's reactive traffic: vehicles of the first frame drive on the lane graph, all other agents
//! are replayed.
//!
//! This module has the parameters and the traffic as a whole; `agent` is one vehicle, `corridor`
//! the strip it sweeps. [`gump_rollout::worlds::Idm`] uses the same car-following law
//! ([`gump_rollout::worlds::idm_acceleration`]), but does not use the log, moves pedestrians on,
//! and updates all vehicles at once. This world reproduces nuPlan's environment exactly, for
//! comparable scores:
//!
//! * Vehicles are snapped to the centre of their lane. Vehicles on no lane, those that would then
//!   touch something, bicycles, and vehicles that appear later are left out.
//! * Pedestrians, static objects and lights are replayed from the log.
//! * Vehicles move one after another, each seeing the new positions of those before it.
//! * A vehicle that is ever farther than 100 m from the ego is removed.

mod agent;
mod corridor;

use std::sync::Arc;

use gump_geometry::{OrientedBox, Polygon, Quad};
use gump_scene::{Agent, AgentKind, AreaKind, Frame, LightState, MapGraph};

use crate::closed_loop::{Others, Recording, Step, Traffic};
use agent::{Encounters, Vehicle};
use corridor::Footprint;
use gump_rollout::worlds::IdmConfig;
use gump_rollout::{BoxError, RolloutError};

/// Parameters of nuPlan's reactive agents.
#[derive(Clone, Debug, PartialEq)]
pub struct NuplanIdmConfig {
    /// The car-following law; only its two accelerations are used as limits.
    pub law: IdmConfig,
    /// A vehicle extends its path when less than this plus 1.5 s of driving is left, metres.
    pub minimum_path_length: f64,
    /// Vehicles farther than this from the ego are removed, metres.
    pub radius: f64,
}

impl Default for NuplanIdmConfig {
    /// The values of the closed-loop reactive challenge.
    fn default() -> Self {
        Self {
            law: IdmConfig {
                target_velocity: 10.0,
                min_gap: 1.0,
                headway: 1.5,
                max_acceleration: 1.0,
                max_deceleration: 2.0,
                exponent: 4.0,
                ..IdmConfig::default()
            },
            minimum_path_length: 20.0,
            radius: 100.0,
        }
    }
}

/// nuPlan's reactive traffic, see the module.
///
/// Source: the IDM agents of nuplan-devkit; agrees with its recorded simulations.
#[derive(Debug, Default)]
pub struct NuplanIdm {
    config: NuplanIdmConfig,
    map: Arc<MapGraph>,
    vehicles: Vec<Vehicle>,
    encounters: Encounters,
}

impl NuplanIdm {
    /// Traffic with these parameters.
    ///
    /// # Errors
    /// [`RolloutError::Parameter`] for a parameter that is not a positive number.
    pub fn new(config: NuplanIdmConfig) -> Result<Self, RolloutError> {
        config.law.check()?;
        for (name, value) in [
            ("minimum_path_length", config.minimum_path_length),
            ("radius", config.radius),
        ] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(RolloutError::Parameter { name, value });
            }
        }
        Ok(Self {
            config,
            ..Self::default()
        })
    }

    /// The vehicles, followed by the agents of `logged` that are replayed.
    fn others(&self, logged: &Frame) -> Others {
        let replayed = logged.agents().iter().filter(|agent| is_replayed(agent));
        Others {
            agents: self
                .vehicles
                .iter()
                .map(Vehicle::agent)
                .chain(replayed.copied())
                .collect(),
            lights: logged.lights().to_vec(),
        }
    }
}

impl Traffic for NuplanIdm {
    fn name(&self) -> &str {
        "idm"
    }

    fn begin(&mut self, recording: &Recording) -> Result<Others, BoxError> {
        let scenario = recording.scenario();
        let now = &scenario.log[scenario.now];
        self.map = Arc::clone(&scenario.map);
        self.vehicles.clear();
        let ego = recording.vehicle().footprint(recording.ego_at(0).rear_axle);
        let mut taken: Vec<Quad> = vec![Quad::from(&ego)];
        let replayed = now.agents().iter().filter(|agent| is_replayed(agent));
        taken.extend(replayed.map(|agent| Quad::from(&agent.oriented_box())));
        // A vehicle on a lane without a limit aims for the speed of the one before it: nuPlan
        // overwrites the default in its loop.
        let mut target = self.config.law.target_velocity;
        for agent in now.agents() {
            if agent.kind != AgentKind::Vehicle || agent.id == scenario.ego {
                continue;
            }
            let index = self.vehicles.len();
            let Some(vehicle) = Vehicle::snapped(agent, index, &self.map, &mut target) else {
                continue;
            };
            let quad = Quad::from(&vehicle.oriented_box());
            if !taken.iter().any(|other| other.intersects(&quad)) {
                taken.push(quad);
                self.vehicles.push(vehicle);
            }
        }
        self.encounters = Encounters::among(self.vehicles.len());
        Ok(self.others(now))
    }

    fn advance(&mut self, step: &Step<'_>) -> Result<Others, BoxError> {
        let logged = step.logged();
        let ego = step.recording.vehicle().footprint(step.ego.rear_axle);
        let radius = self.config.radius;
        self.vehicles.retain(|vehicle| {
            let away = vehicle.pose().position.distance(ego.pose.position);
            away <= radius
        });
        let scene = Scene {
            config: &self.config,
            map: &self.map,
            frame: logged,
            fixed: fixed_obstacles(&ego, step.ego.speed(), logged),
        };
        for i in 0..self.vehicles.len() {
            let (before, rest) = self.vehicles.split_at_mut(i);
            let (vehicle, after) = rest.split_first_mut().expect("vehicle i exists");
            let others = agent::Others {
                fixed: &scene.fixed,
                before,
                after,
            };
            vehicle.step(&scene, others, &mut self.encounters, step.dt());
        }
        Ok(self.others(logged))
    }
}

/// Inputs of a vehicle's decision other than the other vehicles.
struct Scene<'a> {
    config: &'a NuplanIdmConfig,
    map: &'a MapGraph,
    frame: &'a Frame,
    /// The ego first, then the replayed agents.
    fixed: Vec<Obstacle>,
}

impl Scene<'_> {
    /// Stop-line polygons of a lane whose light is red.
    fn red_stop_lines(&self, lane: gump_scene::LaneId) -> impl Iterator<Item = &Polygon> {
        let is_red = self
            .frame
            .light(lane)
            .is_some_and(|l| l.state == LightState::Red);
        let lines = is_red.then(|| self.map.stop_lines(lane));
        lines.into_iter().flatten().map(|area| &area.polygon)
    }
}

/// An agent that this world does not control.
struct Obstacle {
    footprint: Footprint,
    heading: f64,
    speed: f64,
}

/// Speeds of replayed agents count as 0, as in nuPlan.
fn fixed_obstacles(ego: &OrientedBox, ego_speed: f64, frame: &Frame) -> Vec<Obstacle> {
    let obstacle = |shape: &OrientedBox, speed: f64| Obstacle {
        footprint: Footprint::new(vec![Quad::from(shape)]),
        heading: shape.pose.heading,
        speed,
    };
    let replayed = frame.agents().iter().filter(|agent| is_replayed(agent));
    let replayed = replayed.map(|agent| obstacle(&agent.oriented_box(), 0.0));
    std::iter::once(obstacle(ego, ego_speed))
        .chain(replayed)
        .collect()
}

/// True for the kinds that nuPlan replays in its reactive traffic: pedestrians and static objects.
fn is_replayed(agent: &Agent) -> bool {
    !matches!(agent.kind, AgentKind::Vehicle | AgentKind::Bicycle)
}

/// True if the point lies in an intersection of the map.
fn in_intersection(map: &MapGraph, point: gump_geometry::DVec2) -> bool {
    map.areas_containing(point, AreaKind::Intersection)
        .next()
        .is_some()
}
