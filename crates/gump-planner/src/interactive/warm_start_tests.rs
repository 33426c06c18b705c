//! Decisions one after another, with and without a warm start.

use std::sync::Mutex;

use gump_nuplan::closed_loop::{Recording, derive_roadblocks};
use gump_rollout::worlds::ConstantVelocity;
use gump_scene::fixture;

use super::tests::{
    BEHIND, ByLaw, FREE, NARROW, PullsOut, at_random_speed, recording, recording_on,
};
use super::*;

fn with(warm_start: WarmStart) -> InteractiveDriverConfig {
    InteractiveDriverConfig {
        warm_start,
        ..InteractiveDriverConfig::default()
    }
}

/// One decision in the present of each recording, half a second apart by their count.
fn decisions(
    world: &dyn WorldModel,
    config: InteractiveDriverConfig,
    scenes: &[&Recording],
) -> Vec<Decision> {
    let mut driver = InteractiveDriver::new(world, config).unwrap();
    driver.start(&scenes[0].initialization()).unwrap();
    let decide = |(i, recording): (usize, &&Recording)| {
        let input = PlannerInput {
            iteration: 5 * i,
            scene: recording.scenario().present(),
            ego: recording.ego_at(0),
            past: recording.past(),
        };
        driver.drive(&input).unwrap();
        driver.decision().unwrap().clone()
    };
    scenes.iter().enumerate().map(decide).collect()
}

fn rests(decision: &Decision) -> usize {
    let all = decision.candidates.iter();
    all.filter(|candidate| candidate.rests > 0).count()
}

#[test]
fn who_rests_comes_back_within_two_seconds() {
    let world = ByLaw(at_random_speed);
    let scene = recording(BEHIND);
    let all = decisions(&world, with(WarmStart::Rest), &[&scene; 16]);
    assert_eq!(rests(&all[0]), 0);
    assert!(all[1..].iter().map(rests).sum::<usize>() > 30);
    for i in 0..all[0].candidates.len() {
        for four in all.windows(4) {
            let simulated = four
                .iter()
                .any(|decision| decision.candidates[i].rests == 0);
            assert!(simulated, "{} is left out", four[0].candidates[i].kind);
        }
    }
    for (before, now) in all.iter().zip(&all[1..]) {
        for (before, now) in before.candidates.iter().zip(&now.candidates) {
            if now.rests == 0 {
                continue;
            }
            // What is shown of it is the future in which the others keep their velocity.
            assert_eq!(now.rests, before.rests + 1);
            assert_eq!(now.value, before.value);
            assert_eq!((now.futures.len(), now.drives.len()), (1, 1));
            assert_eq!(now.futures[0].steps(), 8);
            assert_eq!(now.score.mean, now.hedge.as_ref().unwrap().total);
            assert!(!now.finalist);
            let moved = |step: usize| {
                let future = now.futures[0].at(step);
                let other = future.now().agents().iter().find(|agent| agent.id.0 == 1);
                other.unwrap().state.pose.position.x
            };
            assert!((moved(4) - moved(0) - 10.0).abs() < 1e-9);
        }
    }
}

#[test]
fn where_nothing_changes_the_choice_is_that_without_a_warm_start() {
    for text in [FREE, BEHIND] {
        let scene = recording_on(NARROW, text);
        let scenes = [&scene; 9];
        let off = decisions(&ConstantVelocity, with(WarmStart::Off), &scenes);
        let rest = decisions(&ConstantVelocity, with(WarmStart::Rest), &scenes);
        let most = rest.iter().map(rests).max();
        assert!(most > Some(4), "{text}: {most:?}");
        for (off, rest) in off.iter().zip(&rest) {
            assert_eq!(off.chosen, rest.chosen);
            for (a, b) in off.candidates.iter().zip(&rest.candidates) {
                assert_eq!(a.finalist, b.finalist, "{}", a.kind);
                if a.finalist {
                    assert_eq!((a.value, &a.drives), (b.value, &b.drives));
                }
            }
        }
    }
}

/// Three lanes, so that a line beside the centre is on the road.
fn avenue(text: &str) -> Recording {
    let lanes = "
        lane 1: -30,0 300,0 speed 12 left 2 right 3
        lane 2: -30,3.5 300,3.5 speed 12 right 1
        lane 3: -30,-3.5 300,-3.5 speed 12 left 1
        drivable: -30,-6 300,-6 300,6 -30,6
        route 1";
    let mut scenario = fixture::scenario(&format!("{lanes}\n{text}")).unwrap();
    derive_roadblocks(&mut scenario);
    Recording::of_boxes(scenario).unwrap()
}

#[test]
fn who_could_win_now_is_woken_and_meets_the_same_futures() {
    // Slow drivers are clearly worse on a free road. Then a vehicle pulls out, which no forecast
    // shows.
    let world = || PullsOut {
        starts: Mutex::default(),
    };
    let free = avenue(FREE);
    let blocked = avenue(&format!("{FREE}\n agent vehicle 1: 36,6"));
    let scenes = [&free, &free, &blocked];
    let with = |warm_start| InteractiveDriverConfig {
        lane_changes: false,
        ..with(warm_start)
    };
    let rest = decisions(&world(), with(WarmStart::Rest), &scenes);
    let off = decisions(&world(), with(WarmStart::Off), &scenes);
    let quiet = decisions(&world(), with(WarmStart::Rest), &[&free; 3]);
    assert!(rests(&rest[1]) > 4);
    let [now, quiet] = [&rest[2], &quiet[2]].map(rests);
    assert!(now == 0 && quiet > 3, "{now} of {quiet}");
    assert_eq!(rest[2].chosen, off[2].chosen);
    let best = off[2].candidates[off[2].chosen].value;
    for (a, b) in rest[2].candidates.iter().zip(&off[2].candidates) {
        if a.rests > 0 {
            assert!(b.value < best - 0.1, "{} was right to rest", b.kind);
            continue;
        }
        assert_eq!((a.value, a.finalist), (b.value, b.finalist));
        assert_eq!((&a.score, &a.drives), (&b.score, &b.drives));
    }
}

#[test]
fn a_warm_start_repeats_and_begins_cold() {
    let world = ByLaw(at_random_speed);
    let scene = recording(BEHIND);
    let summary = || {
        let all = decisions(&world, with(WarmStart::Rest), &[&scene; 6]);
        let of = |decision: &Decision| {
            let all = decision.candidates.iter();
            let all = all.map(|c| (c.rests, c.value, c.drives.clone()));
            (decision.chosen, all.collect::<Vec<_>>())
        };
        all.iter().map(of).collect::<Vec<_>>()
    };
    assert_eq!(summary(), summary());
    let mut driver = InteractiveDriver::new(&world, with(WarmStart::Rest)).unwrap();
    for _ in 0..3 {
        crate::closed_loop::plan_once(&scene, &mut driver).unwrap();
        assert_eq!(rests(driver.decision().unwrap()), 0);
    }
}

#[test]
fn nobody_rests_where_all_have_all_futures() {
    let world = ByLaw(at_random_speed);
    let scene = recording(BEHIND);
    let uniform = InteractiveDriverConfig {
        allocation: Allocation::Uniform,
        ..with(WarmStart::Rest)
    };
    let single = InteractiveDriverConfig {
        n_futures: 1,
        ..with(WarmStart::Rest)
    };
    for config in [uniform, single] {
        let all = decisions(&world, config, &[&scene; 4]);
        assert!(all.iter().all(|decision| rests(decision) == 0));
    }
    // Without weight of the hedge there is none, and candidates rest all the same.
    let config = InteractiveDriverConfig {
        hedge: 0.0,
        ..with(WarmStart::Rest)
    };
    let all = decisions(&world, config, &[&scene; 4]);
    assert!(all.iter().map(rests).sum::<usize>() > 0);
    let hedges = all.iter().flat_map(|decision| &decision.candidates);
    assert!(hedges.clone().all(|candidate| candidate.hedge.is_none()));
}
