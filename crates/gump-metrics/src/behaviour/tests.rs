//! Scenes as text, futures as motions: what counts and what does not.

use std::sync::Arc;

use gump_geometry::{Pose, dvec2};
use gump_scene::{Agent, AgentId, Frame, Light, LightState, Rollout, Scenario, fixture};

use super::*;
use crate::logged;

/// A future of 8 s in which every agent is at the place that `drive` returns for the time in
/// seconds.
fn future(scenario: &Scenario, drive: impl Fn(&Agent, f64) -> Pose) -> Rollout {
    let present = scenario.present();
    let mut rollout = Rollout::begin(present);
    for step in 1..=80 {
        let agents = present.now().agents().iter().map(|agent| {
            let mut agent = *agent;
            agent.state.pose = drive(&agent, f64::from(step) * 0.1);
            agent
        });
        let frame = Frame::new(agents.collect(), present.now().lights().to_vec());
        rollout.push(frame);
    }
    rollout
}

/// All agents continue as now, except agent `id`.
fn only(scenario: &Scenario, id: i64, drive: impl Fn(Pose, f64) -> Pose) -> Rollout {
    future(scenario, |agent, t| {
        let pose = agent.state.pose;
        if agent.id == AgentId(id) {
            return drive(pose, t);
        }
        Pose {
            position: pose.position + agent.state.velocity * t,
            ..pose
        }
    })
}

fn ahead(pose: Pose, metres: f64) -> Pose {
    pose * Pose::new(metres, 0.0, 0.0)
}

/// Distance covered in `t` seconds by a vehicle that brakes from `speed` with 3 m/s² to a stop.
fn braking(speed: f64, t: f64) -> f64 {
    let t = t.min(speed / 3.0);
    speed * t - 1.5 * t * t
}

fn scenario(text: &str) -> Scenario {
    fixture::scenario(text).unwrap()
}

fn events(scenario: &Scenario, rollout: &Rollout, measure: Measure) -> f64 {
    let tally = Behaviour::new(scenario, 8).of(rollout).tally;
    let found = tally.0.iter().filter(|(key, _)| key.measure == measure);
    found.map(|(_, count)| count.events).sum()
}

const ROAD: &str = "lane 1: -100,0 500,0\nego vehicle 0: 0,0 velocity 10,0\n";

#[test]
fn a_parked_vehicle_that_moves_counts() {
    let scenario = scenario(&format!(
        "{ROAD}agent vehicle 1: 30,-5\nagent pedestrian 2: 0,9"
    ));
    let check = |metres: f64, expected: f64| {
        let rollout = only(&scenario, 1, |pose, t| ahead(pose, metres * t / 8.0));
        let tally = Behaviour::new(&scenario, 8).of(&rollout).tally;
        let found = tally.count(Measure::ParkedMove, Class::Vehicle, 8);
        assert_eq!((found.events, found.of), (expected, 1.0), "{metres} m");
        let beside = tally.count(Measure::RoadsideMove, Class::Vehicle, 8);
        assert_eq!((beside.events, beside.of), (expected, 1.0), "{metres} m");
    };
    check(2.5, 1.0);
    check(-2.5, 1.0);
    check(1.9, 0.0);
    check(0.0, 0.0);
    let log = Behaviour::new(&scenario, 8).log().tally;
    assert_eq!(
        log.count(Measure::ParkedMove, Class::Vehicle, 8).rate(),
        Some(0.0)
    );
}

#[test]
fn who_stands_in_a_lane_is_not_at_the_roadside() {
    for (y, of) in [(0.9, 0.0), (-5.0, 1.0)] {
        let scenario = scenario(&format!("{ROAD}agent vehicle 1: 30,{y}"));
        let tally = Behaviour::new(&scenario, 8).log().tally;
        let count = |measure| tally.count(measure, Class::Vehicle, 8).of;
        assert_eq!(count(Measure::ParkedMove), 1.0, "{y}");
        assert_eq!(count(Measure::RoadsideMove), of, "{y}");
    }
}

#[test]
fn who_moves_in_the_log_is_not_parked() {
    let scenario = scenario(&format!("{ROAD}agent vehicle 1: 30,-5 velocity 0.1,0"));
    assert_eq!(Behaviour::new(&scenario, 8).parked().count(), 0);
    // A tracker's jitter is no motion.
    let mut still = self::scenario(&format!("{ROAD}agent vehicle 1: 30,-5"));
    for (i, frame) in still.log.iter_mut().enumerate() {
        let jitter = dvec2(0.1 * (i as f64 * 1.7).sin(), 0.05 * (i as f64 * 2.3).cos());
        let agents = frame.agents().iter().map(|agent| {
            let mut agent = *agent;
            if agent.id == AgentId(1) {
                agent.state.pose.position += jitter;
            }
            agent
        });
        *frame = Frame::new(agents.collect(), Vec::new());
    }
    let behaviour = Behaviour::new(&still, 8);
    assert_eq!(behaviour.parked().collect::<Vec<_>>(), [AgentId(1)]);
    let log = behaviour.log().tally;
    let standing = log.count(Measure::Standing, Class::Vehicle, 8);
    assert_eq!((standing.events, standing.of), (1.0, 2.0));
    for measure in [Measure::SetOff, Measure::HardAcceleration, Measure::Slip] {
        assert_eq!(
            log.count(measure, Class::Vehicle, 8).events,
            0.0,
            "{measure}"
        );
    }
}

#[test]
fn a_stop_on_a_free_road_counts_and_one_with_a_reason_does_not() {
    // The ego brakes to a halt at 16.7 m, its front bumper at 19.1 m.
    let check = |further: &str, expected: f64| {
        let scenario = scenario(&format!("{ROAD}{further}"));
        let rollout = only(&scenario, 0, |pose, t| ahead(pose, braking(10.0, t)));
        let found = events(&scenario, &rollout, Measure::FreeRoadStop);
        assert_eq!(found, expected, "{further}");
    };
    check("", 1.0);
    check("agent vehicle 1: 60,0", 1.0);
    check("agent vehicle 1: 5,-7", 1.0);
    check("agent vehicle 1: 35,0.5", 0.0);
    check("agent cone 1: 30,1", 0.0);
    check("agent pedestrian 1: 25,3.5", 0.0);
    check("agent pedestrian 1: 25,9", 1.0);
    check("light 1 red: 30,0", 0.0);
    check("light 1 yellow: 30,0", 0.0);
    check("light 1 green: 30,0", 1.0);
    check("light 1 red: 5,0", 1.0);
}

#[test]
fn a_stop_beside_the_lane_or_at_its_end_is_not_one_on_a_free_road() {
    let at = |lane: &str| {
        let scenario = scenario(&format!("{lane}\nego vehicle 0: 0,0 velocity 10,0"));
        let rollout = only(&scenario, 0, |pose, t| ahead(pose, braking(10.0, t)));
        events(&scenario, &rollout, Measure::FreeRoadStop)
    };
    assert_eq!(at("lane 1: -100,0 500,0"), 1.0);
    assert_eq!(at("lane 1: -100,1.5 500,1.5"), 0.0);
    assert_eq!(at("lane 1: -100,0 40,0"), 0.0);
    assert_eq!(at("lane 1: -100,0 40,0 next 2\nlane 2: 40,0 90,0"), 1.0);
    assert_eq!(at("lane 1: 500,0 -100,0"), 0.0);
}

#[test]
fn at_an_intersection_way_is_given_to_who_comes_nearer() {
    let check = |other: &str, expected: f64| {
        let mut scenario = scenario(&format!("{ROAD}agent vehicle 1: {other}"));
        let mut parts = scenario.map.parts().clone();
        parts.lanes[0].in_intersection = true;
        scenario.map = Arc::new(MapGraph::new(parts).unwrap());
        let rollout = only(&scenario, 0, |pose, t| ahead(pose, braking(10.0, t)));
        let found = events(&scenario, &rollout, Measure::FreeRoadStop);
        assert_eq!(found, expected, "{other}");
    };
    check("40,40 velocity 0,-5", 0.0);
    check("40,10 velocity 0,5", 1.0);
    check("40,40", 1.0);
    // Behind and the same way.
    check("-40,3.5 velocity 5,0", 1.0);
}

#[test]
fn a_halt_of_a_moment_is_no_stop() {
    let scenario = scenario(ROAD);
    // Stands from 3.3 to 4.8 s.
    let rollout = only(&scenario, 0, |pose, t| {
        ahead(pose, braking(10.0, t) + 5.0 * (t - 4.8).max(0.0))
    });
    assert_eq!(events(&scenario, &rollout, Measure::FreeRoadStop), 0.0);
}

/// Vehicles that stand for ten seconds without a reason, and those that could, within `seconds` of
/// futures in which only the ego moves: to the place that `drive` returns.
fn standing_free(
    text: &str,
    seconds: u32,
    drive: impl Fn(f64) -> f64,
    lights: impl Fn(f64) -> LightState,
) -> (f64, f64) {
    let scenario = scenario(text);
    let mut rollout = Rollout::begin(scenario.present());
    for step in 1..=10 * seconds {
        let t = f64::from(step) * 0.1;
        let agents = scenario.present().now().agents().iter().map(|agent| {
            let mut agent = *agent;
            if agent.id == AgentId(0) {
                agent.state.pose = ahead(agent.state.pose, drive(t));
            }
            agent
        });
        let shown = scenario.present().now().lights().iter();
        let shown = shown.map(|light| Light {
            state: lights(t),
            ..*light
        });
        rollout.push(Frame::new(agents.collect(), shown.collect()));
    }
    let tally = Behaviour::new(&scenario, seconds).of(&rollout).tally;
    let found = tally.count(Measure::FreeRoadStanding, Class::Vehicle, seconds);
    (found.events, found.of)
}

#[test]
fn who_stands_long_on_a_free_road_counts_once() {
    let stop = |t: f64| braking(10.0, t);
    let check = |further: &str, drive: &dyn Fn(f64) -> f64| {
        let text = format!("{ROAD}{further}");
        standing_free(&text, 30, drive, |_| LightState::Red)
    };
    assert_eq!(check("", &stop), (1.0, 1.0));
    // What has a reason does not count, and neither does who goes on before ten seconds are over.
    assert_eq!(check("agent vehicle 1: 35,0.5", &stop), (0.0, 1.0));
    assert_eq!(check("light 1 red: 30,0", &stop), (0.0, 1.0));
    let pause = |wait: f64| move |t: f64| stop(t) + 5.0 * (t - 3.4 - wait).max(0.0);
    assert_eq!(check("", &pause(9.0)), (0.0, 1.0));
    assert_eq!(check("", &pause(13.0)), (1.0, 1.0));
    // Once for each vehicle, however long and however often it stands.
    let twice = |t: f64| stop(t.min(15.0)) + stop((t - 15.0).max(0.0));
    assert_eq!(check("", &twice), (1.0, 1.0));
    // Who has never moved is parked, on the lane or beside it. The wait of one that starts late is
    // none, but it is among those that move.
    let parked = "agent vehicle 1: -60,0\nagent vehicle 2: 90,-5";
    assert_eq!(check(parked, &stop), (1.0, 1.0));
    let waits = "lane 1: -100,0 500,0\nego vehicle 0: 0,0";
    let late = |t: f64| 8.0 * (t - 20.0).max(0.0);
    assert_eq!(
        standing_free(waits, 30, late, |_| LightState::Red),
        (0.0, 1.0)
    );
}

#[test]
fn ten_seconds_on_a_free_road_begin_when_the_reason_ends() {
    // The ego stands from 3.3 s on, before a light at 30 m.
    let at = |green_from: f64, green_until: f64| {
        let text = format!("{ROAD}light 1 red: 30,0");
        let lights = |t: f64| match (green_from..green_until).contains(&t) {
            true => LightState::Green,
            false => LightState::Red,
        };
        standing_free(&text, 30, |t| braking(10.0, t), lights).0
    };
    assert_eq!(at(15.0, 99.0), 1.0);
    assert_eq!(at(22.0, 99.0), 0.0);
    // A reason in between starts the count again.
    assert_eq!(at(5.0, 12.0), 0.0);
    assert_eq!(at(5.0, 18.0), 1.0);
}

#[test]
fn standing_long_needs_the_whole_horizon_and_ten_seconds_of_it() {
    let stop = |t: f64| braking(10.0, t);
    assert_eq!(
        standing_free(ROAD, 8, stop, |_| LightState::Red),
        (0.0, 0.0)
    );
    assert_eq!(standing_free(ROAD, 30, stop, |_| LightState::Red).1, 1.0);
    let scenario = scenario(ROAD);
    let log = Behaviour::new(&scenario, 30).log().tally;
    let found = log.count(Measure::FreeRoadStanding, Class::Vehicle, 30);
    assert_eq!(found.rate(), None);
}

#[test]
fn overlaps_are_counted_by_pair_and_class() {
    let check = |other: &str, class: Class, expected: f64| {
        let scenario = scenario(&format!("ego vehicle 0: 0,0 velocity 5,0\nagent {other}"));
        let tally = Behaviour::new(&scenario, 8).log().tally;
        for (class, expected) in [(class, expected), (Class::All, expected)] {
            let found = tally.count(Measure::NewOverlap, class, 8);
            assert_eq!(
                (found.events, found.of),
                (expected, 2.0),
                "{other}: {class}"
            );
        }
    };
    check("vehicle 1: 30,0", Class::Vehicle, 1.0);
    check("pedestrian 1: 30,0.5", Class::Pedestrian, 1.0);
    check("bicycle 1: 30,0.5", Class::Bicycle, 1.0);
    check("vehicle 1: 30,4", Class::Vehicle, 0.0);
    // No deeper than boxes are exact; and one that was there from the start.
    check("vehicle 1: 30,1.95", Class::Vehicle, 0.0);
    check("vehicle 1: 4,0.5", Class::Vehicle, 0.0);
    let scenario = scenario("ego vehicle 0: 0,0 velocity 5,0\nagent vehicle 1: 30,0");
    let seen = Behaviour::new(&scenario, 8).log();
    let by: Vec<_> = seen
        .incidents
        .iter()
        .map(|incident| (incident.agent, incident.other))
        .collect();
    // A standing agent is run into and runs into no other.
    assert_eq!(by, [(AgentId(0), Some(AgentId(1)))]);
    assert!((seen.incidents[0].at_s - 5.1).abs() < 1e-9, "{seen:?}");
}

#[test]
fn hard_accelerations_count_once_each() {
    let scenario = scenario(ROAD);
    let check = |drive: &dyn Fn(f64) -> f64, expected: f64| {
        let rollout = only(&scenario, 0, |pose, t| ahead(pose, drive(t)));
        let found = events(&scenario, &rollout, Measure::HardAcceleration);
        assert_eq!(found, expected);
    };
    check(&|t| 10.0 * t, 0.0);
    check(&|t| braking(10.0, t), 0.0);
    // From 10 m/s to nothing at once, in the present and later; and back.
    check(&|_| 0.0, 1.0);
    check(&|t| 10.0 * t.min(3.0), 1.0);
    check(&|t| 10.0 * t.min(3.0) + 10.0 * (t - 5.0).max(0.0), 2.0);
}

#[test]
fn sliding_is_told_from_turning() {
    let text = "ego vehicle 0: 0,0 velocity 6,0 size 5,2";
    let scenario = scenario(text);
    let share = |drive: &dyn Fn(Pose, f64) -> Pose| {
        let rollout = only(&scenario, 0, drive);
        let tally = Behaviour::new(&scenario, 8).of(&rollout).tally;
        tally.count(Measure::Slip, Class::Vehicle, 8).rate()
    };
    assert_eq!(share(&|pose, t| ahead(pose, 6.0 * t)), Some(0.0));
    let sideways = share(&|pose, t| pose * Pose::new(6.0 * t, 0.8 * t, 0.0));
    assert!(sideways.unwrap() > 0.9, "{sideways:?}");
    // A circle of 8 m that the rear axle, 1.4 m behind the middle, drives at 6 m/s.
    let turning = share(&|pose, t| {
        let angle = 6.0 * t / 8.0;
        let axle = dvec2(8.0 * angle.sin(), 8.0 * (1.0 - angle.cos()));
        pose * Pose {
            position: axle + 1.4 * dvec2(angle.cos(), angle.sin()),
            heading: angle,
        }
    });
    // Where the circle begins the window is half straight.
    assert!(turning.unwrap() < 0.05, "{turning:?}");
    assert_eq!(share(&|pose, _| pose), Some(0.0));
}

#[test]
fn red_lights_are_those_of_the_lane_that_is_followed() {
    let fork = "lane 1: -50,0 20,0 next 2,3
        lane 2: 20,0 80,0
        lane 3: 20,0 30,2 38,10 40,60
        ego vehicle 0: 0,0 velocity 8,0\n";
    let count = |lights: &str| {
        let scenario = scenario(&format!("{fork}{lights}"));
        let tally = Behaviour::new(&scenario, 8).log().tally;
        let count = tally.count(Measure::RedLight, Class::Vehicle, 8);
        (count.events, count.of)
    };
    assert_eq!(count("light 2 red: 22,0\nlight 3 green: 22,0"), (1.0, 1.0));
    assert_eq!(count("light 2 green: 22,0\nlight 3 red: 22,0"), (0.0, 1.0));
    assert_eq!(
        count("light 2 unknown: 22,0\nlight 3 red: 22,0"),
        (0.0, 0.0)
    );
    assert_eq!(count("light 2 red: 79,0"), (0.0, 0.0));
}

#[test]
fn lights_that_change_count_per_minute_of_a_light() {
    let mut scenario = scenario(&format!("{ROAD}light 1 red: 40,0"));
    let now = scenario.now;
    // Unknown for a second, then green for two, yellow for three, and red to the end.
    for (k, frame) in scenario.log[now + 1..].iter_mut().enumerate() {
        let state = match k {
            0..10 => LightState::Unknown,
            10..30 => LightState::Green,
            30..60 => LightState::Yellow,
            _ => LightState::Red,
        };
        let mut light = frame.lights()[0];
        light.state = state;
        *frame = Frame::new(frame.agents().to_vec(), vec![light]);
    }
    let tally = Behaviour::new(&scenario, 8).log().tally;
    let changes = tally.count(Measure::LightChange, Class::Light, 8);
    let red = tally.count(Measure::LightRed, Class::Light, 8);
    assert_eq!((changes.events, red.events, red.of), (2.0, 20.0, 70.0));
    assert!((changes.of * 60.0 - 7.0).abs() < 1e-9, "{changes:?}");
    // A second of red before it is unknown does not end in sight, nor does the red at the end.
    let phase = |measure| tally.count(measure, Class::Light, 8);
    let (red, green) = (phase(Measure::RedPhase), phase(Measure::GreenPhase));
    assert!((red.events - 1.9).abs() < 1e-9, "{red:?}");
    assert_eq!((red.of, red.rate()), (0.0, None));
    assert!((green.events - 2.0).abs() < 1e-9, "{green:?}");
    assert_eq!(green.of, 1.0);
}

#[test]
fn phases_that_a_window_cuts_have_their_mean_length() {
    // Lights of 25 s red, 3 s yellow and 12 s green, each seen for 8 s from another moment on: less
    // than any red lasts.
    let scenario = scenario(&format!("{ROAD}light 1 red: 40,0"));
    let state = |t: f64| match t.rem_euclid(40.0) {
        t if t < 25.0 => LightState::Red,
        t if t < 37.0 => LightState::Green,
        _ => LightState::Yellow,
    };
    let behaviour = Behaviour::new(&scenario, 8);
    let mut sum = Tally::default();
    for start in 0..400 {
        let start = 0.1 * f64::from(start) + 0.05;
        let light = |t: f64| Light {
            state: state(start + t),
            ..scenario.present().now().lights()[0]
        };
        let mut first = scenario.clone();
        let now = first.now;
        first.log[now] = Frame::new(first.log[now].agents().to_vec(), vec![light(0.0)]);
        let mut rollout = Rollout::begin(first.present());
        for step in 1..=80 {
            let agents = first.present().now().agents().to_vec();
            rollout.push(Frame::new(agents, vec![light(f64::from(step) * 0.1)]));
        }
        sum.merge(&behaviour.of(&rollout).tally);
    }
    let seconds = |measure| sum.count(measure, Class::Light, 8).rate();
    let (red, green) = (seconds(Measure::RedPhase), seconds(Measure::GreenPhase));
    assert!((red.unwrap() - 25.0).abs() < 0.01, "{red:?}");
    assert!((green.unwrap() - 12.0).abs() < 0.01, "{green:?}");
}

#[test]
fn lane_changes_go_to_the_lane_beside() {
    let lanes = "lane 1: -50,0 60,0 next 3
        lane 2: -50,3.5 60,3.5 next 4
        lane 3: 60,0 400,0
        lane 4: 60,3.5 400,3.5
        lane 5: 400,7 -50,7
        ego vehicle 0: 0,0 velocity 10,0\n";
    let scenario = scenario(lanes);
    let check = |aside: f64, expected: f64| {
        let rollout = only(&scenario, 0, |pose, t| {
            let share = ((t - 2.0) / 3.0).clamp(0.0, 1.0);
            let slope = if (0.0..1.0).contains(&share) {
                aside / 30.0
            } else {
                0.0
            };
            pose * Pose::new(10.0 * t, aside * share, f64::atan(slope))
        });
        let found = events(&scenario, &rollout, Measure::LaneChange);
        assert_eq!(found, expected, "{aside} m to the left");
    };
    check(0.0, 0.0);
    check(1.0, 0.0);
    check(3.5, 1.0);
    // Into oncoming traffic there is no lane of the same direction.
    check(7.0, 1.0);
    check(-3.5, 0.0);
    // One lane that leads into the other beside it is driven along.
    let text = "lane 1: -50,0 20,0 next 2\nlane 2: 20,0 50,3.5 200,3.5\n\
                ego vehicle 0: 0,0 velocity 10,0";
    let joined = self::scenario(text);
    let rollout = only(&joined, 0, |pose, t| {
        let x = 10.0 * t;
        pose * Pose::new(x, 3.5 * ((x - 20.0) / 30.0).clamp(0.0, 1.0), 0.0)
    });
    assert_eq!(events(&joined, &rollout, Measure::LaneChange), 0.0);
}

#[test]
fn who_drives_over_the_edge_leaves_the_road_once() {
    let border = "edge: -100,-4 500,-4\nedge: 500,4 -100,4\n";
    let check = |map: &str, y: f64, aside: fn(f64) -> f64, expected: f64| {
        let agent = format!("agent vehicle 1: 30,{y} velocity 5,0");
        let scenario = scenario(&format!("{ROAD}{map}{agent}"));
        let rollout = only(&scenario, 1, |pose, t| {
            pose * Pose::new(5.0 * t, -aside(t), 0.0)
        });
        assert_eq!(events(&scenario, &rollout, Measure::RoadExit), expected);
    };
    check(border, 0.0, |_| 0.0, 0.0);
    check(border, 0.0, |t| t, 1.0);
    // Along a lane that the edge leaves out.
    let turn = format!("{border}lane 50: 30,0 80,-10\n");
    check(&turn, 0.0, |t| t, 0.0);
    // On the kerb; and off the road, back to the kerb and off again.
    check(border, 0.0, |t| t.min(4.4), 0.0);
    let kerb = |t: f64| {
        if (4.0..6.0).contains(&t) {
            4.2
        } else {
            5.0 * t.min(1.0)
        }
    };
    check(border, 0.0, kerb, 1.0);
    // Off the road, back on it and off again.
    let back = |t: f64| {
        if (4.0..6.0).contains(&t) {
            3.0
        } else {
            5.0 * t.min(1.0)
        }
    };
    check(border, 0.0, back, 2.0);
    // Past the end of the map, and on a map without a border.
    check("edge: -100,-4 40,-4\nedge: 40,4 -100,4\n", 0.0, |t| t, 0.0);
    check("", 0.0, |t| t, 0.0);
    // Who is off the road from the start has not left it.
    check(border, -6.0, |_| 0.0, 0.0);
}

#[test]
fn who_sets_off_and_who_stands() {
    let scenario = scenario("ego vehicle 0: 0,0\nagent pedestrian 1: 9,9 velocity 1.5,0");
    let rollout = only(&scenario, 0, |pose, t| {
        ahead(pose, 4.0 * (t - 3.0).max(0.0))
    });
    let tally = Behaviour::new(&scenario, 8).of(&rollout).tally;
    let starts = tally.count(Measure::SetOff, Class::Vehicle, 8);
    assert_eq!(starts.events, 1.0);
    assert!((starts.of * 60.0 - 8.0).abs() < 1e-9, "{starts:?}");
    let standing = |seconds| {
        tally
            .count(Measure::Standing, Class::Vehicle, seconds)
            .rate()
    };
    assert_eq!([2, 4, 8].map(standing), [Some(1.0), Some(0.0), Some(0.0)]);
    assert_eq!(standing(10), None);
    let walker = tally.count(Measure::SetOff, Class::Pedestrian, 8);
    assert_eq!((walker.events, walker.of), (0.0, starts.of));
}

#[test]
fn who_drives_slowly_and_comes_to_rest() {
    let text = format!(
        "{ROAD}history 1 future 8 dt 0.1
         agent vehicle 1: 60,0
         agent vehicle 2: 20,7 velocity 20,0
         agent bicycle 3: 40,7 velocity 5,0"
    );
    let scenario = scenario(&text);
    let rollout = only(&scenario, 0, |pose, t| ahead(pose, braking(10.0, t)));
    let behaviour = Behaviour::new(&scenario, 8);
    let (log, future) = (behaviour.log().tally, behaviour.of(&rollout).tally);
    let at_rest = |tally: &Tally, seconds| {
        let found = tally.count(Measure::ComeToRest, Class::Vehicle, seconds);
        (found.events, found.of)
    };
    // The ego alone: one vehicle stands before, one is fast, and bicycles do not count.
    assert_eq!(
        [2, 8].map(|s| at_rest(&future, s)),
        [(0.0, 1.0), (1.0, 1.0)]
    );
    assert_eq!([2, 8].map(|s| at_rest(&log, s)), [(0.0, 1.0), (0.0, 1.0)]);
    let cyclist = future.count(Measure::ComeToRest, Class::Bicycle, 8);
    assert_eq!(cyclist.rate(), None);
    // Mean speeds of those that move: the ego and the fast one, and the cyclist.
    let speed = |tally: &Tally, class| tally.count(Measure::Speed, class, 8);
    let (slowed, logged) = (speed(&future, Class::Vehicle), speed(&log, Class::Vehicle));
    assert_eq!((slowed.of, logged.of), (2.0, 2.0));
    assert!((logged.events - 30.0).abs() < 0.1 && (slowed.events - 20.0).abs() < 0.1);
    let ridden = speed(&future, Class::Bicycle).rate().unwrap();
    assert!((ridden - 5.0).abs() < 0.1, "{ridden}");
}

#[test]
fn who_is_around_the_ego_is_counted_where_agents_enter_and_leave() {
    let text = format!(
        "{ROAD}agent vehicle 1: 60,0 velocity 10,0\nagent vehicle 2: 150,0\n\
         agent pedestrian 3: 10,8"
    );
    let scenario = scenario(&text);
    // The ego turns away over the grass, and only the others of the log remain.
    let away = only(&scenario, 0, |pose, t| {
        let position = pose.position + dvec2(0.0, 3.0 * t);
        Pose { position, ..pose }
    });
    let behaviour = Behaviour::new(&scenario, 8).with_newcomers();
    let count = |tally: &Tally, measure, class| {
        [2, 8].map(|seconds| tally.count(measure, class, seconds).rate())
    };
    let (log, future) = (behaviour.log().tally, behaviour.of(&away).tally);
    // In the log, the ego at 20 and 80 m comes to within 100 m of the second.
    assert_eq!(
        count(&log, Measure::NearEgo, Class::Vehicle),
        [Some(1.0), Some(2.0)]
    );
    assert_eq!(
        count(&future, Measure::NearEgo, Class::Vehicle),
        [Some(1.0), Some(0.0)],
        "vehicles that the ego leaves behind"
    );
    assert_eq!(
        count(&log, Measure::NearEgo, Class::Pedestrian),
        [Some(1.0), Some(1.0)]
    );
    assert_eq!(
        count(&log, Measure::EgoOnLane, Class::Vehicle),
        [Some(1.0), Some(1.0)]
    );
    assert_eq!(
        count(&future, Measure::EgoOnLane, Class::Vehicle),
        [Some(0.0), Some(0.0)]
    );
    let without = Behaviour::new(&scenario, 8).log().tally;
    let near = without.count(Measure::NearEgo, Class::Vehicle, 8);
    assert_eq!(near.rate(), None, "{near:?}");
}

#[test]
fn crossing_lights_must_not_be_green_at_once() {
    let check = |lights: &str, expected: Option<f64>| {
        let text = format!(
            "lane 1: -30,0 30,0
             lane 2: 0,-30 0,30
             lane 3: 30,3 -30,3
             lane 4: -30,0 -5,0 3,8 3,30
             ego vehicle 0: 90,90\n{lights}"
        );
        let tally = Behaviour::new(&scenario(&text), 8).log().tally;
        let found = tally.count(Measure::ConflictingGreen, Class::Light, 8);
        assert_eq!(found.rate(), expected, "{lights}");
    };
    check("light 1 green: -20,0\nlight 2 green: 0,-20", Some(1.0));
    check("light 1 green: -20,0\nlight 2 red: 0,-20", Some(0.0));
    check("light 1 green: -20,0\nlight 2 unknown: 0,-20", None);
    // Opposite, forking and turning left before oncoming traffic.
    check("light 1 green: -20,0\nlight 3 green: 20,3", None);
    check("light 1 green: -20,0\nlight 4 green: -20,0", None);
    check("light 3 green: 20,3\nlight 4 green: -20,0", None);
}

#[test]
fn a_log_that_ends_early_is_counted_as_far_as_it_goes() {
    let text = format!("{ROAD}agent vehicle 1: 30,-5\nhistory 1 future 3 dt 0.1");
    let scenario = scenario(&text);
    let log = Behaviour::new(&scenario, 8).log().tally;
    let count = |measure, class, seconds| log.count(measure, class, seconds).rate();
    assert_eq!(count(Measure::Standing, Class::Vehicle, 2), Some(0.5));
    assert_eq!(count(Measure::Standing, Class::Vehicle, 4), None);
    assert_eq!(count(Measure::ParkedMove, Class::Vehicle, 8), None);
    assert_eq!(count(Measure::NewOverlap, Class::All, 8), None);
    assert_eq!(
        count(Measure::HardAcceleration, Class::Vehicle, 8),
        Some(0.0)
    );
    // Nor is anybody held to a log that is over.
    let rollout = only(&scenario, 1, ahead);
    let seen = Behaviour::new(&scenario, 8).of(&rollout).tally;
    assert_eq!(
        seen.count(Measure::ParkedMove, Class::Vehicle, 8).rate(),
        Some(1.0)
    );
}

#[test]
fn the_log_as_a_future_is_the_log_and_threads_change_nothing() {
    let text = format!(
        "{ROAD}agent vehicle 1: 30,0\nagent pedestrian 2: 20,8 velocity 0,-1.2\n\
         agent bicycle 3: -20,1 velocity 6,0\nlight 1 red: 60,0"
    );
    let scenario = scenario(&text);
    let behaviour = Behaviour::new(&scenario, 8);
    let once = behaviour.log();
    assert_eq!(behaviour.of(&logged(&scenario)), once);
    let rollouts = vec![logged(&scenario); 5];
    let with = |n: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build();
        pool.unwrap().install(|| behaviour.tally(&rollouts))
    };
    assert_eq!(with(1), with(4));
    let key = (Measure::NewOverlap, Class::All, 8);
    let (one, five) = (
        once.tally.count(key.0, key.1, key.2),
        with(2).count(key.0, key.1, key.2),
    );
    assert_eq!((five.events, five.of), (5.0 * one.events, 5.0 * one.of));
}

#[test]
fn newcomers_count_only_where_that_is_asked_for() {
    let scenario = scenario(ROAD);
    let mut rollout = logged(&scenario);
    let mut frame = rollout.last().now().clone();
    let mut born = frame.agents()[0];
    born.id = AgentId(9);
    frame = Frame::new([frame.agents(), &[born]].concat(), Vec::new());
    rollout.push(frame);
    // A future must be whole for pairs to count.
    while rollout.steps() < 300 {
        rollout.push(rollout.last().now().clone());
    }
    let new = || Behaviour::new(&scenario, 30);
    let count = |behaviour: Behaviour<'_>| {
        let count = behaviour
            .of(&rollout)
            .tally
            .count(Measure::NewOverlap, Class::All, 30);
        (count.events, count.of)
    };
    assert_eq!(count(new()), (0.0, 1.0));
    assert_eq!(count(new().with_newcomers()), (1.0, 2.0));
}

#[test]
fn what_the_log_does_too_is_no_deed() {
    let text = "ego vehicle 0: 0,0 velocity 5,0\nagent vehicle 1: 30,0";
    let scenario = scenario(text);
    let conduct = Behaviour::new(&scenario, 8).conduct(&[logged(&scenario)]);
    assert!(
        conduct
            .iter()
            .all(|one| one.deeds.is_empty() && one.any == 0.0)
    );
}

#[test]
fn lights_that_change_in_conflict_are_found_from_the_moment_they_do() {
    let text = "lane 1: -30,0 30,0\nlane 2: 0,-30 0,30\nego vehicle 0: 90,90\n\
                light 1 green: -20,0\nlight 2 red: 0,-20";
    let scenario = scenario(text);
    let mut rollout = Rollout::begin(scenario.present());
    for (i, frame) in scenario.future().iter().enumerate() {
        let lights = frame.lights().iter().map(|light| Light {
            state: if i < 60 {
                light.state
            } else {
                LightState::Green
            },
            ..*light
        });
        rollout.push(Frame::new(frame.agents().to_vec(), lights.collect()));
    }
    let tally = Behaviour::new(&scenario, 8).of(&rollout).tally;
    let found = tally.count(Measure::ConflictingGreen, Class::Light, 8);
    assert_eq!((found.events, found.of), (20.0, 80.0));
}
