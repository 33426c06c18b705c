//! Planning in recorded traffic; skips visibly where the real files are not beside the repository.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

#[path = "../../../tests/shared.rs"]
mod shared_data;

use std::ops::Range;

use gump_nuplan::closed_loop::{DriveConfig, Recording, Replayed, derive_roadblocks};
use gump_planner::closed_loop::{drive_scenario, plan_once};
use gump_planner::{Explain, InteractiveDriver, InteractiveDriverConfig, NuplanIdmDriver};
use gump_rollout::WorldModel;
use gump_rollout::worlds::{Idm, LogReplay};
use gump_scene::{EgoState, Scenario};

fn shared(name: &str) -> Option<Scenario> {
    let path = shared_data::shared(&format!("data/waymo/{name}"))?;
    Some(gump_data::find(&path.display().to_string()).unwrap())
}

/// Plans interactively among reactive and among replayed traffic; metres the choice drives.
fn check(scenario: &Scenario, expected: Range<f64>) {
    let replay = LogReplay::new(scenario);
    let mut driven = scenario.clone();
    derive_roadblocks(&mut driven);
    let recording = Recording::of_boxes(driven).unwrap();
    for world in [&Idm::default() as &dyn WorldModel, &replay] {
        let config = InteractiveDriverConfig::default();
        let mut planner = InteractiveDriver::new(world, config).unwrap();
        plan_once(&recording, &mut planner).unwrap();
        let decision = planner.decision().unwrap();
        // Beside 19 policies and imitation two for each lane to change to.
        let n = decision.candidates.len();
        assert!(n >= 20 && n.is_multiple_of(2), "{n}");
        assert!(!decision.brakes, "the emergency brake was needed");
        for evaluation in &decision.candidates {
            for pair in evaluation.drives[0].windows(2) {
                let moved = (pair[1].rear_axle.position - pair[0].rear_axle.position) / 0.1;
                let velocity = |state: &EgoState| state.rear_axle.direction() * state.velocity.x;
                let middle = (velocity(&pair[0]) + velocity(&pair[1])) / 2.0;
                assert!((moved - middle).length() < 0.3, "{moved} but {middle}");
            }
        }
        let metres = decision.candidates[decision.chosen].progress_m;
        assert!(expected.contains(&metres), "{metres} m in {}", world.name());
    }
}

#[test]
fn the_ego_waits_where_it_waited() {
    if let Some(scenario) = shared("scenario_a.tfrecord") {
        check(&scenario, -0.1..0.1);
    }
}

#[test]
fn the_ego_turns_right_where_it_turned_right() {
    let Some(scenario) = shared("scenario_b.tfrecord") else {
        return;
    };
    check(&scenario, 10.0..25.0);
    let config = DriveConfig {
        seconds: 8.0,
        ..DriveConfig::default()
    };
    let mut driver = NuplanIdmDriver::default();
    let scored = drive_scenario(&scenario, &mut Replayed, &mut driver, &config).unwrap();
    let ego = scored.driven.rollout.last().ego_now().state;
    let foot = scenario
        .route
        .as_ref()
        .unwrap()
        .path
        .project(ego.pose.position);
    assert!(foot.arc_length > 30.0, "{foot:?}");
}
