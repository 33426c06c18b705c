//! Builds a scenario from your own numbers: a lane and two tracks, with a query on them.
//!
//! `cargo run -p gump-scene --example build_a_scenario`

use std::error::Error;
use std::sync::Arc;

use gump_geometry::{Polyline, Pose, dvec2};
use gump_scene::*;

fn main() -> Result<(), Box<dyn Error>> {
    let centre = Polyline::new(vec![dvec2(0.0, 0.0), dvec2(200.0, 0.0)]).ok_or("two points")?;
    let lane = Lane::new(LaneId(1), centre, vec![0.0; 2]);
    let map = MapGraph::new(MapParts {
        lanes: vec![lane],
        ..MapParts::default()
    })?;
    let car = |id: i64, x: f64, speed: f64| Agent {
        id: AgentId(id),
        kind: AgentKind::Vehicle,
        length: 4.6,
        width: 1.9,
        height: 1.5,
        elevation: 0.75,
        state: AgentState {
            pose: Pose::new(x, 0.0, 0.0), // The middle of the box, not the rear axle.
            velocity: dvec2(speed, 0.0),
        },
    };
    let frame = |step: i32| {
        let t = f64::from(step) * 0.1; // One at 9 m/s, one that brakes by 1.5 m/s² before it.
        let braking = car(2, 40.0 + 12.0 * t - 0.75 * t * t, 12.0 - 1.5 * t);
        Frame::new(vec![car(1, 10.0 + 9.0 * t, 9.0), braking], vec![])
    };
    // ANCHOR: scenario
    let scenario = Scenario {
        id: "mine-1".into(),
        map: Arc::new(map),
        route: None,
        log: (0..=80).map(frame).collect(),
        dt: 0.1,
        now: 10,
        ego: AgentId(1),
        targets: vec![AgentId(2)],
        objects_of_interest: vec![],
        tags: vec![],
    };
    scenario.validate()?;
    // ANCHOR_END: scenario

    for second in 1..=8 {
        let scene = scenario.at(10 * second);
        let (ego, ahead) = (scene.ego_now(), scene.now().agent(AgentId(2)));
        let gap = ahead.map(|other| ego.oriented_box().signed_distance(&other.oriented_box()));
        println!(
            "after {second} s: {:+.1} m to the car ahead",
            gap.unwrap_or(f64::NAN)
        );
    }
    Ok(())
}
