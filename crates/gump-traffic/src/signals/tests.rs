//! Signals of synthetic junctions.

use gump_geometry::dvec2;
use gump_scene::{Frame, LaneId, Scenario, fixture};

use super::*;
use crate::notes::{Note, Notes};
use LightState::{Green, Red, Unknown, Yellow};

/// A junction of two roads: through lanes 1 to 4 from west, east, south and north, and 5, a left turn
/// from the west with a separate lane.
fn crossing(states: [&str; 5]) -> Scenario {
    let light = |(i, state): (usize, &&str)| format!("light {} {state}:", i + 1);
    let lights: Vec<String> = states.iter().enumerate().map(light).collect();
    let text = format!(
        "lane 11: -90,-2 -10,-2 next 1
         lane 12: 90,2 10,2 next 2
         lane 13: 2,-90 2,-10 next 3
         lane 14: -2,90 -2,10 next 4
         lane 15: -90,1 -10,1 next 5
         lane 1: -10,-2 10,-2 next 21
         lane 2: 10,2 -10,2 next 22
         lane 3: 2,-10 2,10 next 23
         lane 4: -2,10 -2,-10 next 24
         lane 5: -10,1 -3,3 0,5 2,10 next 23
         lane 21: 10,-2 90,-2
         lane 22: -10,2 -90,2
         lane 23: 2,10 2,90
         lane 24: -2,-10 -2,-90
         {}
         ego vehicle 0: -20,-2",
        lights.join("\n")
    );
    // Lanes of the fixture are not marked as inside an intersection: lines are where lanes end.
    let mut scenario = fixture::scenario(&text).unwrap();
    let stop = [
        (-10.0, -2.0),
        (10.0, 2.0),
        (2.0, -10.0),
        (-2.0, 10.0),
        (-10.0, 1.0),
    ];
    for frame in &mut scenario.log {
        let mut lights = frame.lights().to_vec();
        for (light, (x, y)) in lights.iter_mut().zip(stop) {
            light.stop_point = Some(dvec2(x, y));
        }
        *frame = Frame::new(frame.agents().to_vec(), lights);
    }
    scenario
}

fn plan(scenario: &Scenario) -> Arc<SignalPlan> {
    let scene = scenario.present();
    Arc::new(SignalPlan::of(scene.map, scene.history, scene.dt))
}

/// The lights of a future in which every junction has detectors.
fn detecting(plan: &Arc<SignalPlan>, seed: u64) -> Signals {
    let mut signals = Signals::begin(plan, Seed(seed));
    signals
        .turns
        .iter_mut()
        .for_each(|turn| turn.detects = true);
    signals
}

fn states(signals: &Signals) -> Vec<LightState> {
    signals.lights().iter().map(|light| light.state).collect()
}

/// Positions of vehicles that wait on every approach.
fn everywhere() -> Vec<Pose> {
    let at = |x: f64, y: f64, heading: f64| Pose {
        position: dvec2(x, y),
        heading,
    };
    let half = std::f64::consts::FRAC_PI_2;
    vec![
        at(-15.0, -2.0, 0.0),
        at(15.0, 2.0, 2.0 * half),
        at(2.0, -15.0, half),
        at(-2.0, 15.0, -half),
        at(-15.0, 1.0, 0.0),
    ]
}

#[test]
fn lights_of_one_junction_are_found_and_grouped() {
    let plan = plan(&crossing(["green", "green", "red", "red", "red"]));
    let groups = plan.groups();
    assert_eq!(groups.len(), 1);
    // Every approach is a group, and the left turn is a separate one.
    let lanes: Vec<Vec<i64>> = groups[0]
        .iter()
        .map(|group| group.iter().map(|lane: &LaneId| lane.0).collect())
        .collect();
    assert_eq!(lanes, [[1], [2], [3], [4], [5]]);
    assert_eq!(plan.contradictions(), 0);
}

#[test]
fn movements_that_cross_are_never_green_together() {
    let conflicts = [(0, 2), (0, 3), (1, 2), (1, 3), (4, 1), (4, 2), (4, 3)];
    for now in [
        ["green", "green", "red", "red", "red"],
        ["red", "red", "green", "green", "red"],
        ["red", "red", "red", "red", "green"],
        ["yellow", "yellow", "red", "red", "red"],
        ["red"; 5],
        ["unknown"; 5],
        // A log that contradicts itself.
        ["green", "green", "green", "red", "red"],
    ] {
        let plan = plan(&crossing(now));
        for seed in 0..20 {
            let mut signals = Signals::begin(&plan, Seed(seed));
            let mut greens = [0; 5];
            let mut before = states(&signals);
            for step in 0..600 {
                signals.advance(0.5, Some(&everywhere()));
                let shown = states(&signals);
                for (a, b) in conflicts {
                    let both = shown[a] == Green && shown[b] == Green;
                    assert!(!both, "{now:?}: {a} and {b} are green at step {step}");
                }
                for (i, pair) in before.iter().zip(&shown).enumerate() {
                    let is_known = step > 0 && *pair.0 != Unknown;
                    let turns = matches!(pair, (Green, Red) | (Yellow, Green) | (Red, Yellow));
                    assert!(
                        !is_known || !turns,
                        "{now:?}: light {i} {pair:?} at step {step}"
                    );
                    greens[i] += usize::from(*pair.1 == Green);
                }
                before = shown;
            }
            // Within five minutes every light has had its turns.
            assert!(greens.iter().all(|green| *green > 10), "{now:?} {greens:?}");
        }
    }
}

#[test]
fn phases_last_as_long_as_signals_do() {
    let plan = plan(&crossing(["green", "green", "red", "red", "red"]));
    let mut signals = Signals::begin(&plan, Seed(3));
    let mut runs: Vec<(LightState, f64)> = Vec::new();
    for _ in 0..6000 {
        signals.advance(0.1, None);
        match runs.last_mut() {
            Some((state, seconds)) if *state == states(&signals)[0] => *seconds += 0.1,
            _ => runs.push((states(&signals)[0], 0.1)),
        }
    }
    let whole = &runs[1..runs.len() - 1];
    assert!(whole.len() > 20);
    for (state, seconds) in whole {
        let range = match state {
            Green => 9.8..40.2,
            Yellow => 2.9..3.5,
            // The cross street and the left turn, or one of them.
            _ => 8.0..70.0,
        };
        assert!(range.contains(seconds), "{state:?} for {seconds} s");
    }
}

#[test]
fn what_nobody_waits_for_is_left_out() {
    let plan = plan(&crossing(["green", "green", "red", "red", "red"]));
    let mut signals = detecting(&plan, 0);
    for _ in 0..400 {
        signals.advance(0.5, Some(&[]));
        assert_eq!(states(&signals), [Green, Green, Red, Red, Red]);
    }
    // Only the left turn is asked for.
    let left = [everywhere()[4]];
    let turned = (0..100).any(|_| {
        signals.advance(0.5, Some(&left));
        assert_eq!(states(&signals)[2], Red);
        states(&signals)[4] == Green
    });
    assert!(turned);
}

#[test]
fn green_without_traffic_ends_early_where_others_wait() {
    let plan = plan(&crossing(["red", "red", "green", "green", "red"]));
    // Seconds until the road from south and north, where nobody is, loses green.
    let until = |seed: u64, vehicles: &[Pose]| {
        let mut signals = detecting(&plan, seed);
        let mut steps = 0..200;
        steps.position(|_| {
            signals.advance(0.5, Some(vehicles));
            states(&signals)[2] != Green
        })
    };
    let west = [everywhere()[0]];
    for seed in 0..20 {
        let (alone, all) = (until(seed, &west), until(seed, &everywhere()));
        // Its least green is 10 s, and some of it has passed.
        assert!(
            alone.is_some_and(|steps| steps <= 20),
            "seed {seed}: {alone:?}"
        );
        assert!(alone <= all, "seed {seed}: {alone:?} {all:?}");
    }
    let earlier = (0..20).filter(|&seed| until(seed, &west) < until(seed, &everywhere()));
    assert!(earlier.count() > 10);
}

#[test]
fn half_of_the_junctions_take_turns_whoever_waits() {
    let plan = plan(&crossing(["green", "green", "red", "red", "red"]));
    let turns = (0..200).filter(|&seed| {
        let mut signals = Signals::begin(&plan, Seed(seed));
        (0..120).any(|_| {
            signals.advance(0.5, Some(&[]));
            states(&signals)[2] == Green
        })
    });
    let n = turns.count();
    assert!((75..=125).contains(&n), "{n} of 200");
}

#[test]
fn one_seed_one_course_and_futures_differ() {
    let plan = plan(&crossing(["green", "green", "red", "red", "red"]));
    let course = |seed: u64, dt: f64| {
        let mut signals = Signals::begin(&plan, Seed(seed));
        let mut course = Vec::new();
        for _ in 0..30 {
            (0..(1.0 / dt) as usize).for_each(|_| signals.advance(dt, Some(&everywhere())));
            course.push(states(&signals));
        }
        course
    };
    assert_eq!(course(1, 0.5), course(1, 0.5));
    assert!((2..12).any(|seed| course(seed, 0.5) != course(1, 0.5)));
}

#[test]
fn a_light_alone_takes_turns_with_who_is_not_seen() {
    let scenario = fixture::scenario(
        "lane 1: 0,0 40,0
         light 1 red:
         light 99 green:
         ego vehicle 0: 0,0",
    )
    .unwrap();
    let plan = plan(&scenario);
    let mut signals = Signals::begin(&plan, Seed(0));
    let mut seen = Vec::new();
    for _ in 0..300 {
        let waits = Pose {
            position: dvec2(30.0, 0.0),
            heading: 0.0,
        };
        signals.advance(0.5, Some(&[waits]));
        let shown = states(&signals);
        // Lane 99 is not on the map.
        assert_eq!(shown[1], Green);
        seen.push(shown[0]);
    }
    assert!(seen.contains(&Green) && seen.contains(&Yellow) && seen.contains(&Red));
}

#[test]
fn lanes_of_few_points_cross_too() {
    let scenario = fixture::scenario(
        "lane 1: -60,0 -8,0 next 3
         lane 2: 0,-60 0,-8 next 4
         lane 3: -8,0 60,0
         lane 4: 0,-8 0,60
         light 1 green:
         light 2 red:
         ego vehicle 0: -30,0",
    )
    .unwrap();
    let plan = plan(&scenario);
    assert_eq!(plan.groups().len(), 1);
    let mut signals = Signals::begin(&plan, Seed(5));
    for _ in 0..2000 {
        signals.advance(0.5, None);
        assert_ne!(states(&signals), [Green, Green]);
    }
}

#[test]
fn where_all_roads_are_red_one_of_them_is_next() {
    // Red in every frame: longer than the clearance between two phases.
    let plan = plan(&crossing(["red"; 5]));
    for seed in 0..20 {
        let mut signals = Signals::begin(&plan, Seed(seed));
        for _ in 0..4 {
            signals.advance(0.5, Some(&everywhere()));
        }
        assert!(states(&signals).contains(&Green), "seed {seed}");
    }
}

#[test]
fn no_lights_no_plan() {
    let scenario = fixture::scenario("lane 1: 0,0 40,0\nego vehicle 0: 0,0").unwrap();
    assert!(plan(&scenario).is_empty());
}

#[test]
fn lines_before_the_end_of_a_lane_are_of_the_junction_behind() {
    let mut scenario = fixture::scenario(
        "lane 1: -60,0 -8,0 next 3
         lane 2: 0,-60 0,-8 next 4
         lane 3: -8,0 60,0
         lane 4: 0,-8 0,60
         light 1 green: -11,0
         light 2 red: 0,-11
         ego vehicle 0: -30,0",
    )
    .unwrap();
    assert_eq!(plan(&scenario).groups().len(), 1);
    // Red since a moment ago: another phase is next, and none without green takes turns.
    let now = scenario.now;
    let mut lights = scenario.log[now].lights().to_vec();
    lights[0].state = Red;
    scenario.log[now] = Frame::new(scenario.log[now].agents().to_vec(), lights);
    let mut signals = Signals::begin(&plan(&scenario), Seed(1));
    let mut dark = 0;
    for _ in 0..400 {
        signals.advance(0.5, None);
        dark = match states(&signals) == [Red, Red] {
            true => dark + 1,
            false => 0,
        };
        assert!(dark <= 4, "all are red for {dark} half seconds");
    }
}

#[test]
fn yellow_beside_green_ends_alone() {
    let plan = plan(&crossing(["green", "red", "red", "red", "yellow"]));
    for seed in 0..20 {
        let mut signals = Signals::begin(&plan, Seed(seed));
        signals.advance(0.5, Some(&everywhere()));
        assert!(matches!(states(&signals)[4], Yellow | Red));
        let stays = (0..20).all(|seed| {
            let mut signals = Signals::begin(&plan, Seed(seed));
            signals.advance(0.1, Some(&everywhere()));
            states(&signals)[0] == Green
        });
        assert!(stays);
    }
}

/// The notes of a plan, as pairs of a note and its number of cases.
fn cases(notes: &Notes) -> Vec<(Note, usize)> {
    notes
        .iter()
        .map(|(note, count)| (note, count.cases))
        .collect()
}

#[test]
fn a_log_that_contradicts_itself_is_counted_and_not_continued() {
    let contradicts = plan(&crossing(["green", "green", "green", "red", "red"]));
    // Lanes 1 and 2 cross lane 3.
    let expected = [(Note::ContradictingLights, 2)];
    assert_eq!(cases(&contradicts.notes()), expected);
    assert_eq!(contradicts.contradictions(), 2);
    let agrees = plan(&crossing(["green", "green", "red", "red", "red"]));
    assert!(agrees.notes().is_empty());
}

#[test]
fn lights_without_a_lane_and_lanes_that_lead_nowhere_are_counted() {
    let scenario = fixture::scenario(
        "lane 1: -60,0 -8,0
         lane 2: 0,-60 0,-8 next 3
         lane 3: 0,-8 0,60
         light 1 red:
         light 2 green:
         light 98 green:
         light 99 red:
         ego vehicle 0: -30,0",
    )
    .unwrap();
    let plan = plan(&scenario);
    let expected = [(Note::UnmappedLight, 2), (Note::UnconnectedLight, 1)];
    assert_eq!(cases(&plan.notes()), expected);
    let mut signals = Signals::begin(&plan, Seed(2));
    let mut greens = [0; 2];
    for _ in 0..1200 {
        signals.advance(0.5, None);
        let shown = states(&signals);
        // Those without a lane stay, the others have their turns.
        assert_eq!(shown[2..], [Green, Red]);
        for (n, state) in greens.iter_mut().zip(&shown) {
            *n += usize::from(*state == Green);
        }
    }
    assert!(greens.iter().all(|n| (100..1100).contains(n)), "{greens:?}");
}

#[test]
fn lights_that_cannot_be_grouped_still_take_turns() {
    // Three lanes from the west whose lights never agree, and one from the south that crosses all.
    let text = "lane 1: -60,0 -8,0 next 11
         lane 2: -60,-3 -8,-3 next 12
         lane 3: -60,-6 -8,-6 next 13
         lane 4: 0,-60 0,-20 next 14
         lane 11: -8,0 60,0
         lane 12: -8,-3 60,-3
         lane 13: -8,-6 60,-6
         lane 14: 0,-20 0,60
         light 1 green:
         light 2 red:
         light 3 yellow:
         light 4 red:
         ego vehicle 0: -30,0";
    let plan = plan(&fixture::scenario(text).unwrap());
    assert_eq!(cases(&plan.notes()), [(Note::UngroupedLight, 2)]);
    assert_eq!(plan.groups().concat().len(), 4);
    for seed in 0..10 {
        let mut signals = Signals::begin(&plan, Seed(seed));
        let mut greens = [0; 4];
        for step in 0..1200 {
            signals.advance(0.5, None);
            let shown = states(&signals);
            let crosses = shown[..3].contains(&Green) && shown[3] == Green;
            assert!(!crosses, "seed {seed}, step {step}: {shown:?}");
            for (n, state) in greens.iter_mut().zip(&shown) {
                *n += usize::from(*state == Green);
            }
        }
        assert!(greens.iter().all(|n| *n > 100), "seed {seed}: {greens:?}");
    }
}
