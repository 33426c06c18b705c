//! The closed loop: in every iteration a driver plans, a controller moves the ego, and traffic
//! reacts.
//!
//! [`drive`] is the loop, over a [`Recording`]. The [`Driver`] is the planner under test,
//! [`Traffic`] moves the other agents, and the [`Controller`] turns plans into motion. Scoring is
//! in `metrics`.
//!
//! [`gump_rollout::simulate`] is a different loop: many futures of a scene at once, box centres, no
//! vehicle. This one follows nuPlan's: one future, an ego vehicle with a rear axle, recorded time
//! stamps.

mod controller;
mod driver;
mod recording;
mod roadblocks;
mod traffic;

pub use controller::{Controller, Tracking};
pub use driver::{Driver, PlannerInitialization, PlannerInput};
pub use recording::Recording;
pub use roadblocks::{derive_roadblocks, has_derived_outlines};
pub use traffic::{ImaginedTraffic, Others, Replayed, Step, Traffic};

use gump_scene::{EgoState, Frame, Rollout, SceneState};

use crate::tracking::Trajectory;
use gump_rollout::RolloutError;

/// The result of a closed loop: one entry per executed iteration.
#[derive(Clone, Debug)]
pub struct Driven {
    /// The traffic, including the ego; simulated frame `i` is iteration `i + 1`.
    pub rollout: Rollout,
    /// The ego, from iteration 0 on.
    pub ego: Vec<EgoState>,
    /// The driver's plan at each iteration; empty unless requested.
    pub plans: Vec<Trajectory>,
}

/// Settings of a loop.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveConfig {
    /// The way in which plans are turned into motion.
    pub tracking: Tracking,
    /// Maximum duration in seconds, > 0; a recording may be shorter.
    pub seconds: f64,
    /// Whether plans are kept; they take a hundred times the memory of the rest.
    pub keep_plans: bool,
}

impl Default for DriveConfig {
    /// 15 s with nuPlan's two-stage controller, as in its closed-loop challenges.
    fn default() -> Self {
        Self {
            tracking: Tracking::TwoStage,
            seconds: 15.0,
            keep_plans: false,
        }
    }
}

/// Drives in a recording from its present on.
///
/// `n` recorded frames give `n - 1` iterations: nothing moves after the last plan. Collisions do
/// not end the loop.
///
/// Traffic receives the ego's state at the end of the previous iteration, not that of the one that
/// begins.
///
/// # Errors
/// [`RolloutError::Recording`] for a recording that is too short, [`RolloutError::Loop`] with the
/// iteration for errors of driver, controller or traffic.
///
/// Source: the simulation loop of nuplan-devkit.
pub fn drive(
    recording: &Recording,
    traffic: &mut dyn Traffic,
    driver: &mut dyn Driver,
    config: &DriveConfig,
) -> Result<Driven, RolloutError> {
    let n = recording.n_iterations(config.seconds)?;
    let failed = |iteration: usize, who: &str| {
        let who = who.to_owned();
        move |error: gump_rollout::BoxError| RolloutError::Loop {
            iteration,
            who,
            what: error.to_string(),
        }
    };
    let first = traffic
        .begin(recording)
        .map_err(failed(0, traffic.name()))?;
    let mut ego = *recording.ego_at(0);
    let mut rollout = begin(recording, &ego, first);
    driver
        .start(&recording.initialization())
        .map_err(failed(0, driver.name()))?;
    let mut states: Vec<EgoState> = recording.past().to_vec();
    let n_past = states.len();
    let mut plans = Vec::new();
    let mut controller = Controller::new(config.tracking);
    for iteration in 0..n {
        let input = PlannerInput {
            iteration,
            scene: rollout.last(),
            ego: &ego,
            past: &states,
        };
        let plan = driver
            .drive(&input)
            .map_err(failed(iteration, driver.name()))?;
        states.push(ego);
        if iteration + 1 < n {
            let next = controller
                .advance(recording, iteration, &ego, &plan)
                .map_err(|error| failed(iteration, driver.name())(error.into()))?;
            let step = Step {
                recording,
                iteration,
                ego: &ego,
                next: &next,
                plan: &plan,
                scene: rollout.last(),
            };
            let others = traffic
                .advance(&step)
                .map_err(failed(iteration, traffic.name()))?;
            rollout.push(frame(recording, &next, others));
            ego = next;
        }
        if config.keep_plans {
            plans.push(plan);
        }
    }
    states.drain(..n_past);
    Ok(Driven {
        rollout,
        ego: states,
        plans,
    })
}

/// The recorded past with the first frame of the traffic.
fn begin(recording: &Recording, ego: &EgoState, first: Others) -> Rollout {
    let scenario = recording.scenario();
    let mut history = scenario.log[..scenario.now].to_vec();
    history.push(frame(recording, ego, first));
    Rollout::begin(SceneState {
        history: &history,
        ..scenario.present()
    })
}

fn frame(recording: &Recording, ego: &EgoState, others: Others) -> Frame {
    let mut agents = others.agents;
    agents.push(recording.ego_agent(ego));
    Frame::new(agents, others.lights)
}
