//! The closed loop from the outside: drivers that behave, and all the ways in which one may not.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use gump_geometry::Pose;
use gump_nuplan::closed_loop::{
    DriveConfig, Driver, PlannerInitialization, PlannerInput, Recording, Replayed,
    derive_roadblocks,
};
use gump_nuplan::reactive_agents::NuplanIdm;
use gump_nuplan::tracking::Trajectory;
use gump_planner::closed_loop::{drive_and_score, evaluate};
use gump_planner::{
    Explain, ImitationDriver, InteractiveDriver, InteractiveDriverConfig, LogDriver,
    NuplanIdmDriver, PdmClosed, SimpleDriver, WarmStart,
};
use gump_rollout::BoxError;
use gump_rollout::worlds::Idm;
use gump_scene::{EgoState, MapGraph, Seed, fixture};

const STREET: &str = "
    lane 1: 0,0 400,0 speed 12 left 2
    lane 2: 0,3.5 400,3.5 speed 12 right 1
    drivable: -20,-2 400,-2 400,6 -20,6
    agent vehicle 1: 70,0 velocity 6,0
    agent vehicle 2: 30,3.5 velocity 9,0
    agent pedestrian 3: 90,5.5 velocity 0.5,0
";

fn recording(text: &str) -> (Recording, Arc<MapGraph>) {
    let mut scenario = fixture::scenario(text).unwrap();
    let map = Arc::clone(&scenario.map);
    derive_roadblocks(&mut scenario);
    (Recording::of_boxes(scenario).unwrap(), map)
}

fn street() -> (Recording, Arc<MapGraph>) {
    recording(&format!(
        "{STREET} route 1\n ego vehicle 0: 20,0 velocity 8,0 size 5,2"
    ))
}

fn drive_with(case: &(Recording, Arc<MapGraph>), driver: &mut dyn Driver) -> Result<f64, String> {
    let mut traffic = NuplanIdm::default();
    let config = DriveConfig::default();
    drive_and_score(&case.0, &case.1, &mut traffic, driver, &config)
        .map(|scored| scored.score)
        .map_err(|error| error.to_string())
}

#[test]
fn every_driver_comes_home_on_a_map_without_roadblocks() {
    let case = street();
    let world = Idm::default();
    let policies = InteractiveDriverConfig {
        n_futures: 1,
        replan_every: 10,
        ..InteractiveDriverConfig::default()
    };
    let taking_over = InteractiveDriverConfig {
        warm_start: WarmStart::Rest,
        network_modes: 3,
        n_futures: 2,
        ..policies.clone()
    };
    let drivers: [Box<dyn Explain>; 7] = [
        Box::new(LogDriver::new(&case.0, &[])),
        Box::new(NuplanIdmDriver::default()),
        Box::new(SimpleDriver::default()),
        Box::new(PdmClosed::default()),
        Box::new(InteractiveDriver::new(&world, policies).unwrap()),
        Box::new(InteractiveDriver::new(&world, taking_over).unwrap()),
        Box::new(ImitationDriver::new(&world, 1, 10, Seed(0)).unwrap()),
    ];
    for mut driver in drivers {
        let score = drive_with(&case, &mut *driver).unwrap();
        assert!((0.0..=1.0).contains(&score), "{}: {score}", driver.name());
        let chosen = driver.candidates().iter().filter(|c| c.chosen).count();
        assert_eq!(chosen, 1, "{}", driver.name());
        // Once more gives the same: nothing is left over from the first drive.
        assert_eq!(
            drive_with(&case, &mut *driver).unwrap(),
            score,
            "{}",
            driver.name()
        );
    }
}

#[test]
fn a_planner_drives_on_and_stops_behind_who_stands() {
    let street = "lane 1: 0,0 400,0 speed 12
        drivable: -20,-4 400,-4 400,4 -20,4
        route 1
        ego vehicle 0: 10,0 velocity 12,0 size 4.8,2";
    let drive = |text: &str| {
        let (recording, map) = recording(text);
        let (mut driver, config) = (PdmClosed::default(), DriveConfig::default());
        drive_and_score(&recording, &map, &mut Replayed, &mut driver, &config).unwrap()
    };
    let free = drive(street).driven.rollout;
    let end = free.last().ego_now().state;
    // Nearly as far as the limit of 12 m/s leads: in the first tenth of a second of every plan PDM
    // sees an obstacle that is not there.
    let limit = 10.0 + 12.0 * 0.1 * free.steps() as f64;
    assert!(
        (limit - 3.0..limit).contains(&end.pose.position.x),
        "{end:?}"
    );
    assert!(end.speed() > 11.5, "{end:?}");
    let blocked = drive(&format!("{street}\n agent vehicle 1: 80,0 size 4.8,2"));
    let end = blocked.driven.rollout.last().ego_now().state;
    // It stands or creeps behind the obstacle, whose rear is at 77.6.
    let (speed, x) = (end.speed(), end.pose.position.x);
    assert!(speed < 2.0 && (65.0..75.2).contains(&x), "{end:?}");
    assert_eq!(blocked.metrics.collisions.score, 1.0);
}

#[test]
fn displacements_of_a_driven_ego_agree_with_its_velocity() {
    let text = "lane 1: 0,0 60,0 120,40 400,40 speed 12
        drivable: -20,-20 400,-20 400,60 -20,60
        route 1
        ego vehicle 0: 40,0.5 velocity 4,0 size 4.8,2";
    let (recording, map) = recording(text);
    let config = DriveConfig::default();
    let mut driver = PdmClosed::default();
    let scored = drive_and_score(&recording, &map, &mut Replayed, &mut driver, &config).unwrap();
    let velocity = |state: &EgoState| state.rear_axle.direction() * state.velocity.x;
    assert!(scored.driven.ego.len() > 70);
    for pair in scored.driven.ego.windows(2) {
        let moved = (pair[1].rear_axle.position - pair[0].rear_axle.position) / 0.1;
        let middle = (velocity(&pair[0]) + velocity(&pair[1])) / 2.0;
        assert!((moved - middle).length() < 0.2, "{moved} but {middle}");
    }
}

#[test]
fn the_log_replayed_is_the_log() {
    let (recording, map) = street();
    let mut log = LogDriver::new(&recording, &[]);
    let config = DriveConfig::default();
    let scored = drive_and_score(&recording, &map, &mut Replayed, &mut log, &config).unwrap();
    for (step, state) in scored.driven.ego.iter().enumerate() {
        let logged = recording.ego_at(step).rear_axle.position;
        assert!(
            state.rear_axle.position.distance(logged) < 0.05,
            "step {step}"
        );
    }
    let other = scored.driven.rollout.last();
    let logged = &recording.scenario().log[recording.scenario().now + scored.driven.ego.len() - 1];
    assert_eq!(other.now().agents().len(), logged.agents().len());
}

/// Stays in place until iteration `from`, then plans the states that `answer` returns.
struct Odd {
    from: usize,
    answer: fn(&EgoState) -> Result<Vec<EgoState>, BoxError>,
}

impl Driver for Odd {
    fn name(&self) -> &str {
        "odd"
    }

    fn start(&mut self, _: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        Ok(())
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let stay = |i: i64| EgoState {
            time_us: input.ego.time_us + i * 500_000,
            ..*input.ego
        };
        if input.iteration < self.from {
            return Ok(Trajectory::new((0..9).map(stay).collect())?);
        }
        Ok(Trajectory::new((self.answer)(input.ego)?)?)
    }
}

#[test]
fn drivers_that_fail_are_named_with_the_iteration() {
    let case = street();
    let check = |answer: fn(&EgoState) -> Result<Vec<EgoState>, BoxError>, expected: &str| {
        let error = drive_with(&case, &mut Odd { from: 3, answer }).unwrap_err();
        assert!(error.starts_with("iteration 3: odd: "), "{error}");
        assert!(error.contains(expected), "{error}");
    };
    check(|ego| Ok(vec![*ego]), "at least two states, got 1");
    check(
        |ego| {
            let rear_axle = Pose::new(f64::NAN, 0.0, 0.0);
            let next = EgoState {
                time_us: ego.time_us + 100_000,
                rear_axle,
                ..*ego
            };
            Ok(vec![*ego, next])
        },
        "not a finite number",
    );
    check(|ego| Ok(vec![*ego, *ego]), "not later than the one before");
    check(
        |ego| {
            let soon = EgoState {
                time_us: ego.time_us + 50_000,
                ..*ego
            };
            Ok(vec![*ego, soon])
        },
        "says nothing of",
    );
    check(|_| Err("lost its way".into()), "lost its way");
}

#[test]
fn missing_routes_are_named_and_an_ego_off_the_road_still_drives() {
    let astray = recording(&format!("{STREET} ego vehicle 0: 20,0 velocity 8,0"));
    let (world, config) = (Idm::default(), InteractiveDriverConfig::default());
    for mut driver in [
        Box::new(PdmClosed::default()) as Box<dyn Driver>,
        Box::new(NuplanIdmDriver::default()),
        Box::new(InteractiveDriver::new(&world, config).unwrap()),
    ] {
        let error = drive_with(&astray, &mut *driver).unwrap_err();
        assert!(error.contains("has no route"), "{error}");
    }
    let text = format!("{STREET} route 1\n ego vehicle 0: 20,-9 velocity 8,0");
    let score = drive_with(&recording(&text), &mut PdmClosed::default()).unwrap();
    assert_eq!(score, 0.0, "driving beside the road is worth nothing");
}

#[test]
fn failures_keep_their_place_among_results() {
    let texts: Vec<String> = (0..6)
        .map(|i| {
            let route = if i % 3 == 1 { "" } else { "route 1\n" };
            format!("{STREET} {route} ego vehicle 0: {},0 velocity 8,0", 20 + i)
        })
        .collect();
    let results = evaluate(texts.iter(), |i, text| {
        (
            i,
            drive_with(&recording(text), &mut PdmClosed::default()).is_ok(),
        )
    });
    let expected: Vec<(usize, bool)> = (0..6).map(|i| (i, i % 3 != 1)).collect();
    assert_eq!(results, expected);
}

#[test]
fn a_lane_that_ends_is_left_in_comfort() {
    // The right lane ends after 100 m.
    let case = recording(
        "lane 1: -30,0 100,0 speed 12 left 2
         lane 2: -30,3.5 100,3.5 speed 12 right 1 next 3
         lane 3: 100,3.5 400,3.5 speed 12
         drivable: -30,-2 100,-2 100,1.5 400,1.5 400,5.5 -30,5.5
         agent vehicle 1: 60,3.5 velocity 10,0
         agent vehicle 2: -15,3.5 velocity 8,0
         route 1,2,3
         ego vehicle 0: 20,0 velocity 10,0 size 5,2",
    );
    let world = Idm::default();
    let config = InteractiveDriverConfig {
        n_futures: 1,
        imitation: false,
        ..InteractiveDriverConfig::default()
    };
    let mut driver = InteractiveDriver::new(&world, config).unwrap();
    let drive = DriveConfig {
        seconds: 8.0,
        ..DriveConfig::default()
    };
    let mut traffic = NuplanIdm::default();
    let scored = drive_and_score(&case.0, &case.1, &mut traffic, &mut driver, &drive).unwrap();
    let end = scored.driven.ego.last().unwrap().rear_axle;
    assert!(end.position.x > 75.0, "{end:?}");
    assert!((end.position.y - 3.5).abs() < 0.5, "{end:?}");
    let metric = |name: &str| {
        let named = scored.metrics.scores();
        let found = named.into_iter().find(|(metric, _)| *metric == name);
        found.and_then(|(_, value)| value)
    };
    assert_eq!(metric("ego_is_comfortable"), Some(1.0));
    assert_eq!(metric("no_ego_at_fault_collisions"), Some(1.0));
}
