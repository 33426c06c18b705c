//! Behaviour of the rules in simple scenes; `tests` compares every number.

use std::sync::Arc;

use approx::assert_abs_diff_eq;
use gump_geometry::angle_difference;
use gump_nuplan::closed_loop::{Recording, derive_roadblocks};
use gump_scene::{LaneId, MapGraph, MapParts, Scenario, fixture};

use super::*;
use crate::closed_loop::plan_once;

const STREET: &str = "
    lane 1: 0,0 150,0 400,0 speed 10
    drivable: 0,-4 400,-4 400,4 0,4
    route 1
";

fn plan(mut scenario: Scenario) -> (Recording, PdmClosed) {
    derive_roadblocks(&mut scenario);
    let recording = Recording::of_boxes(scenario).unwrap();
    let mut planner = PdmClosed::default();
    plan_once(&recording, &mut planner).unwrap();
    (recording, planner)
}

fn check(text: &str) -> (Recording, PdmClosed) {
    plan(fixture::scenario(text).unwrap())
}

/// Final position of the front bumper of the car that follows proposal `i`, metres.
fn front(recording: &Recording, planner: &PdmClosed, i: usize) -> f64 {
    let drive = &planner.thought().drives[i];
    drive[STEPS].rear_axle.position.x + recording.vehicle().front_length
}

#[test]
fn every_speed_is_proposed_on_every_line() {
    let (recording, planner) = check(&format!("{STREET} ego vehicle 0: 10,0 velocity 6,0"));
    let thought = planner.thought();
    assert_eq!(thought.proposals.len(), 15);
    let behind = recording.vehicle().rear_axle_to_center();
    for (i, (proposal, drive)) in thought.proposals.iter().zip(&thought.drives).enumerate() {
        assert_eq!(
            (proposal.poses.len() > STEPS, drive.len()),
            (true, STEPS + 1)
        );
        let speed = 10.0 * [0.2, 0.4, 0.6, 0.8, 1.0][i % 5];
        let lateral_offset = [0.0, -1.0, 1.0][i / 5];
        let end = proposal.poses[STEPS];
        assert_abs_diff_eq!(end.position.y, lateral_offset, epsilon = 1e-9);
        assert_abs_diff_eq!(proposal.states[STEPS].speed, speed, epsilon = 0.2);
        assert!(drive[0].rear_axle.position.x == 10.0 - behind);
    }
}

#[test]
fn a_free_start_follows_the_law() {
    let (_, planner) = check(&format!("{STREET} ego vehicle 0: 10,0"));
    let fastest = &planner.thought().proposals[4].states;
    // (v / 10)^10 is below 0.03 up to 7 m/s, so it gains 0.15 m/s every tenth of a second.
    for pair in fastest[1..20].windows(2) {
        assert_abs_diff_eq!(pair[1].speed - pair[0].speed, 0.15, epsilon = 1e-3);
        let driven = pair[1].progress - pair[0].progress;
        assert_abs_diff_eq!(driven, pair[0].speed * 0.1, epsilon = 1e-9);
    }
}

#[test]
fn nobody_is_run_into() {
    for (others, speed) in [
        ("agent vehicle 1: 50,0", 9.0),
        ("agent vehicle 1: 30,0.5 velocity 4,0", 9.0),
        ("agent vehicle 1: 60,-18 velocity 0,5", 10.0),
    ] {
        let text = format!("{STREET} ego vehicle 0: 10,0 velocity {speed},0\n{others}");
        let (recording, planner) = check(&text);
        let other = recording.scenario().present().now().agents()[1];
        for (step, state) in planner.thought().drives[planner.best()].iter().enumerate() {
            let mut forecast = other.oriented_box();
            forecast.pose.position += other.state.velocity * (step as f64 * DT);
            let own = recording.vehicle().footprint(state.rear_axle);
            assert!(!own.overlaps(&forecast), "{others} at step {step}");
        }
        assert_eq!(planner.scores()[planner.best()].no_at_fault_collision, 1.0);
    }
}

#[test]
fn who_is_not_in_the_way_does_not_matter() {
    let ego = "ego vehicle 0: 20,0 velocity 6,0\n";
    let (_, free) = check(&format!("{STREET}{ego}"));
    for others in [
        "agent vehicle 1: 40,4",
        // Slower than the slowest proposal: a faster one would come past that and be its lead.
        "agent vehicle 1: 10,0 velocity 1,0",
        "agent vehicle 1: 120,0 velocity 30,0",
        "agent pedestrian 1: 40,-9 velocity 0,1",
    ] {
        let (_, found) = check(&format!("{STREET}{ego}{others}"));
        let poses = |planner: &PdmClosed| planner.thought().proposals[4].poses.clone();
        assert_eq!(poses(&found), poses(&free), "{others}");
    }
}

#[test]
fn a_box_between_two_bends_of_the_way_is_on_one_of_them() {
    // The route returns 6 m beside itself; the parked truck stands in between.
    let out = (0..=20).map(|i| format!("{},0 ", 2 * i));
    let back = (0..=20).rev().map(|i| format!("{},6 ", 2 * i));
    let line: String = out.chain(back).collect();
    let bends = format!(
        "lane 1: {line} speed 10\n route 1\n drivable: -10,-4 50,-4 50,10 -10,10
         ego vehicle 0: 5,0 velocity 5,0 size 5,2\n"
    );
    let poses = |others: &str| {
        let (_, planner) = check(&format!("{bends}{others}"));
        planner.thought().proposals[4].poses[..20].to_vec()
    };
    let free = poses("");
    assert_eq!(poses("agent vehicle 1: 20,2.9 size 8,2.4"), free);
    assert_ne!(poses("agent vehicle 1: 20,2 size 8,2.4"), free);
}

/// The obstacle stands before the second point of the lane, the ego is past the first.
#[test]
fn an_obstacle_between_points_of_a_lane_is_stopped_for() {
    let street = STREET.replace("150,0", "40,0 80,0");
    let text = format!("{street} ego vehicle 0: 10,0 velocity 5,0\nagent vehicle 1: 30,0");
    let (recording, planner) = check(&text);
    for i in 0..5 {
        let front = front(&recording, &planner, i);
        assert!(front < 28.0, "{front}");
    }
}

#[test]
fn a_red_light_is_stopped_for() {
    let text = "lane 1: 0,0 40,0 speed 10 next 2\n lane 2: 40,0 60,0 speed 10 next 3
        lane 3: 60,0 300,0 speed 10\n route 1,2,3\n drivable: 0,-4 300,-4 300,4 0,4
        light 2 red: 40,0\n ego vehicle 0: 10,0 velocity 8,0";
    let drive = |text: &str| {
        let mut scenario = fixture::scenario(text).unwrap();
        let map = &scenario.map;
        let mut lanes = map.lanes().to_vec();
        for lane in &mut lanes {
            lane.in_intersection = lane.id == LaneId(2);
        }
        let parts = MapParts {
            drivable: map.drivable().to_vec(),
            lanes,
            ..MapParts::default()
        };
        scenario.map = Arc::new(MapGraph::new(parts).unwrap());
        let (recording, planner) = plan(scenario);
        [0, 1, 2, 3, 4].map(|i| front(&recording, &planner, i))
    };
    let red = drive(text);
    assert!(red.iter().all(|&front| front < 40.0), "{red:?}");
    assert!(drive(&text.replace("red", "green"))[4] > 40.0);
}

#[test]
fn drives_leave_the_ego_smoothly() {
    let text = "lane 1: 0,0 30,0 60,10 90,40 speed 10\n drivable: -9,-9 99,-9 99,60 -9,60
        route 1\n ego vehicle 0: 10,1.2 heading 0.1 velocity 7.96,0.8";
    let (recording, planner) = check(text);
    for drive in &planner.thought().drives {
        assert_eq!(drive[0].rear_axle, recording.ego_at(0).rear_axle);
        for pair in drive.windows(2) {
            let moved = (pair[1].rear_axle.position - pair[0].rear_axle.position) / DT;
            let velocity = pair[0].rear_axle.direction() * pair[0].velocity.x;
            assert!((moved - velocity).length() < 0.05, "{moved} but {velocity}");
            let turn = angle_difference(pair[1].rear_axle.heading, pair[0].rear_axle.heading);
            assert!(turn.abs() < 0.1, "{turn}");
        }
    }
}

#[test]
fn a_standing_ego_that_stays_does_not_slide() {
    let text =
        format!("{STREET} ego vehicle 0: 10,1.2 heading 0.1\n agent vehicle 1: 15.6,1 size 5,2");
    let (recording, planner) = check(&text);
    let now = recording.ego_at(0).rear_axle;
    for drive in &planner.thought().drives[..5] {
        let across = |state: &EgoState| (now.inverse() * state.rear_axle.position).y;
        let end = drive.last().unwrap();
        assert!(end.rear_axle.position.distance(now.position) < 0.5);
        assert!(drive.iter().all(|state| across(state).abs() < 0.05));
    }
}
