//! Reactive traffic: vehicles follow the lane graph by the Intelligent Driver Model.
//!
//! This module has the world and its parameters. `law` is the car-following law, `road` and `path`
//! the path ahead, `obstacles` the agents on it, `driver` one vehicle, `traffic` one future.
//!
//! Vehicles do not change lanes or give way to crossing traffic that is not yet in their corridor,
//! lights do not change, and agents neither appear nor vanish.

mod driver;
mod law;
mod obstacles;
mod path;
mod road;
mod traffic;

pub use law::{idm_acceleration, idm_euler_step};

use std::sync::{Arc, Mutex, PoisonError};

use gump_scene::MapGraph;

use super::independent::Independent;
use crate::{BoxError, RolloutError, Session, Start, WorldModel};
use road::Road;

/// Parameters of the law and of the driver model around it.
#[derive(Clone, Debug, PartialEq)]
pub struct IdmConfig {
    /// Desired speed where a lane states neither a limit nor its type, metres per second. Lanes of
    /// a known type have its usual limit, and a vehicle that is faster at the start keeps its own
    /// speed.
    pub target_velocity: f64,
    /// Gap kept at standstill, metres.
    pub min_gap: f64,
    /// Time gap kept to the vehicle ahead, seconds.
    pub headway: f64,
    /// Largest acceleration, metres per second squared.
    pub max_acceleration: f64,
    /// Comfortable deceleration `b` of the law, metres per second squared, positive.
    pub max_deceleration: f64,
    /// Exponent of the law: higher values keep acceleration up until nearer the desired speed.
    pub exponent: f64,
    /// Braking limit, metres per second squared, positive; the law itself has none.
    pub emergency_deceleration: f64,
    /// Distance ahead within which agents and lights are considered, metres.
    pub look_ahead: f64,
    /// Vehicles slow down for curves to stay below this, metres per second squared.
    pub lateral_acceleration: f64,
}

impl Default for IdmConfig {
    /// The law of Treiber et al. (2000) with nuPlan's values for its IDM planner. Vehicles may
    /// brake harder than comfortably, as drivers do (6 m/s², well within dry-road grip), and take
    /// curves at no more than 3 m/s², a usual comfort bound. They look as far ahead as it takes to
    /// stop comfortably from 22 m/s.
    fn default() -> Self {
        Self {
            target_velocity: 10.0,
            min_gap: 1.0,
            headway: 1.5,
            max_acceleration: 1.0,
            max_deceleration: 3.0,
            exponent: 4.0,
            emergency_deceleration: 6.0,
            look_ahead: 80.0,
            lateral_acceleration: 3.0,
        }
    }
}

impl IdmConfig {
    /// Checks that every parameter is a positive number.
    ///
    /// # Errors
    /// [`RolloutError::Parameter`] with the first that is not.
    pub fn check(&self) -> Result<(), RolloutError> {
        let fields = [
            ("target_velocity", self.target_velocity),
            ("min_gap", self.min_gap),
            ("headway", self.headway),
            ("max_acceleration", self.max_acceleration),
            ("max_deceleration", self.max_deceleration),
            ("exponent", self.exponent),
            ("emergency_deceleration", self.emergency_deceleration),
            ("look_ahead", self.look_ahead),
            ("lateral_acceleration", self.lateral_acceleration),
        ];
        match fields
            .into_iter()
            .find(|(_, v)| !(*v > 0.0 && v.is_finite()))
        {
            Some((name, value)) => Err(RolloutError::Parameter { name, value }),
            None => Ok(()),
        }
    }
}

/// Reactive rule-based traffic.
///
/// * A vehicle on a lane follows the lane graph and takes a random lane at forks, drawn from the
///   future's seed; the ego follows the scene's route. A vehicle keeps its offset in the lane at
///   first and moves to the centre as it drives. Where the map ends it continues straight on.
/// * It reacts to any agent whose box reaches into the strip that it will sweep, to red lights, and
///   to yellow ones at which it can stop. At a light of unknown colour, vehicles wait that already
///   stand there. **Lights keep their present colour** unless they are set
///   ([`Session::show`](crate::Session::show)). Vehicles slow down for curves and speed limits.
/// * A standing vehicle beside its lane is parked and stays. A moving one off every lane brakes
///   comfortably along its heading.
/// * Pedestrians, bicycles and all other agents keep their velocity.
///
/// Source: Treiber, Hennecke and Helbing 2000 for the law; the rest in the spirit of nuPlan's
/// reactive agents, but updated synchronously.
#[derive(Debug, Default)]
pub struct Idm {
    config: IdmConfig,
    /// The road prepared last, because planners open many sessions on one map.
    prepared: Mutex<Option<(Arc<MapGraph>, Arc<Road>)>>,
}

impl Idm {
    /// Builds the world.
    ///
    /// # Errors
    /// [`RolloutError::Parameter`] if a parameter is not a positive number.
    pub fn new(config: IdmConfig) -> Result<Self, RolloutError> {
        config.check()?;
        Ok(Self {
            config,
            prepared: Mutex::default(),
        })
    }

    fn road(&self, map: &Arc<MapGraph>) -> Arc<Road> {
        // The cache holds finished values only, so a panic elsewhere cannot have broken it.
        let mut prepared = self.prepared.lock().unwrap_or_else(PoisonError::into_inner);
        match &*prepared {
            Some((known, road)) if Arc::ptr_eq(known, map) => Arc::clone(road),
            _ => {
                let road = Arc::new(Road::new(map));
                *prepared = Some((Arc::clone(map), Arc::clone(&road)));
                road
            }
        }
    }
}

impl WorldModel for Idm {
    fn name(&self) -> &str {
        "idm"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let open = |start: &Start<'_>| {
            let road = self.road(start.scene.map);
            Ok(traffic::open(&self.config, &road, start))
        };
        Ok(Box::new(Independent::new(starts, Box::new(open))?))
    }
}
