//! Planning in recorded traffic; skips visibly where the real files are not beside the repository.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

#[path = "../../../tests/shared.rs"]
mod shared_data;

use std::ops::Range;

use gump_planner::{
    IdmPlanner, Interactive, InteractiveConfig, Planner, PlannerPolicy, ProposalConfig,
};
use gump_rollout::worlds::{Idm, LogReplay};
use gump_rollout::{SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{Scenario, Seed};

fn shared(name: &str) -> Option<Scenario> {
    let path = shared_data::shared(&format!("data/waymo/{name}"))?;
    Some(gump_data::find(&path.display().to_string()).unwrap())
}

/// Plans interactively among reactive and among replayed traffic; metres the choice drives.
fn check(scenario: &Scenario, expected: Range<f64>) {
    let replay = LogReplay::new(scenario);
    for world in [&Idm::default() as &dyn WorldModel, &replay] {
        let mut planner = Interactive::new(world, InteractiveConfig::default()).unwrap();
        let plan = planner.plan(&scenario.present()).unwrap();
        assert_eq!(plan.candidates.len(), 15, "the emergency brake was needed");
        let now = scenario.present().ego_now().state;
        for candidate in &plan.candidates {
            let mut before = now;
            for state in candidate.proposal.resampled(&now, 0.1) {
                let moved = (state.pose.position - before.pose.position) / 0.1;
                let middle = (state.velocity + before.velocity) / 2.0;
                assert!((moved - middle).length() < 0.3, "{moved} but {middle}");
                before = state;
            }
        }
        let progress = plan.choice().score.as_ref().unwrap().futures[0].terms[0];
        assert_eq!(progress.name, "progress_m");
        let driven = progress.value.unwrap();
        assert!(expected.contains(&driven), "{driven} m in {}", world.name());
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
    let world = LogReplay::new(&scenario);
    let start = Start {
        scene: scenario.present(),
        n_futures: 1,
        seed: Seed(0),
    };
    let planner = IdmPlanner::new(ProposalConfig::default()).unwrap();
    let mut policy = PlannerPolicy::new(planner);
    let config = SimulateConfig::default();
    let rollouts = simulate(&world, &[start], Some(&mut policy), &config).unwrap();
    let ego = rollouts[0].last().ego_now().state;
    let foot = scenario
        .route
        .as_ref()
        .unwrap()
        .path
        .project(ego.pose.position);
    assert!(foot.arc_length > 30.0, "{foot:?}");
}
