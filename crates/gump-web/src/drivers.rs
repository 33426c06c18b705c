//! Rule-based drivers of the ego, which plan at each half second.

use gump_geometry::dvec2;
use gump_nuplan::closed_loop::{Driver as Planner, PlannerInput, Recording};
use gump_planner::{NuplanIdmDriver, PdmClosed};
use gump_rollout::BoxError;
use gump_scene::{AgentState, EgoState, SceneState};

use crate::GameError;
use crate::tape::EgoDriver;

/// Microseconds between frames.
const FRAME_US: i64 = 100_000;

/// What a driver plans from.
pub(crate) struct PlanningContext<'a> {
    pub(crate) recording: &'a Recording,
    pub(crate) scene: SceneState<'a>,
    /// The ego from the start of the drive to now.
    pub(crate) ego: &'a [EgoState],
}

/// The ego's states over the next `n` frames, by box centre. A driver keeps no state from one half
/// second to the next, so that a rewound drive continues like one that was not rewound.
///
/// Error: a driver that cannot drive here, or one that is not rule-based.
pub(crate) fn plan(
    driver: EgoDriver,
    context: &PlanningContext<'_>,
    n: usize,
) -> Result<Vec<AgentState>, GameError> {
    let planned = match driver {
        EgoDriver::Idm => follow(&mut NuplanIdmDriver::default(), context, n),
        EgoDriver::Pdm => follow(&mut PdmClosed::default(), context, n),
        EgoDriver::Hand | EgoDriver::Network => Ok(Vec::new()),
    };
    planned.map_err(|error| GameError::Driver {
        driver: driver.name(),
        what: error.to_string(),
    })
}

fn follow(
    planner: &mut dyn Planner,
    context: &PlanningContext<'_>,
    n: usize,
) -> Result<Vec<AgentState>, BoxError> {
    planner.start(&context.recording.initialization())?;
    let Some((ego, past)) = context.ego.split_last() else {
        return Ok(Vec::new());
    };
    let plan = planner.drive(&PlannerInput {
        iteration: past.len(),
        scene: context.scene,
        ego,
        past,
    })?;
    let vehicle = context.recording.vehicle();
    let at = |i: usize| plan.at(ego.time_us + FRAME_US * i as i64);
    let states = (1..=n).map(|i| Ok(at(i)?.agent_state(vehicle)));
    states.collect()
}

/// The ego as a car with a rear axle, from where its box was and is.
pub(crate) fn ego_state(
    recording: &Recording,
    before: Option<&EgoState>,
    now: &AgentState,
    dt: f64,
) -> EgoState {
    let vehicle = recording.vehicle();
    let rear_axle = vehicle.rear_axle_of(now.pose);
    let speed = now.velocity.dot(now.pose.direction());
    let Some(before) = before else {
        return EgoState {
            rear_axle,
            velocity: dvec2(speed, 0.0),
            ..EgoState::default()
        };
    };
    let turned = gump_geometry::angle_difference(rear_axle.heading, before.rear_axle.heading);
    let yaw_rate = turned / dt;
    EgoState {
        time_us: before.time_us + FRAME_US,
        rear_axle,
        velocity: dvec2(speed, 0.0),
        acceleration: dvec2((speed - before.velocity.x) / dt, 0.0),
        // At a crawl the angle is noise.
        steering_angle: if speed.abs() > 0.5 {
            (yaw_rate * vehicle.wheel_base / speed)
                .atan()
                .clamp(-1.0, 1.0)
        } else {
            0.0
        },
        yaw_rate,
        ..EgoState::default()
    }
}
