//! Worlds whose lights change and whose agents come and leave.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::{BTreeMap, BTreeSet};

use gump_rollout::worlds::{ConstantVelocity, Idm, LogReplay};
use gump_rollout::{SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{AgentId, AgentKind, Frame, LightState, Rollout, Scenario, Seed, fixture};
use gump_traffic::{Arrivals, LightControl, Living, LivingConfig, Note, RecordedLights};

/// Half a kilometre of road with a lane in either direction, a junction with a light in its middle,
/// and an ego parked beside it.
fn road(light: &str) -> Scenario {
    let vehicles: String = (0..6)
        .map(|i| {
            let (x, y, v) = (
                -90 + 30 * i,
                if i % 2 == 0 { -2 } else { 2 },
                8 - 16 * (i % 2),
            );
            format!("agent vehicle {}: {x},{y} velocity {v},0\n", i + 1)
        })
        .collect();
    fixture::scenario(&format!(
        "lane 1: -250,-2 0,-2 speed 12 next 2
         lane 2: 0,-2 250,-2 speed 12
         lane 3: 250,2 0,2 speed 12 next 4
         lane 4: 0,2 -250,2 speed 12
         lane 5: 4,-120 4,-10 speed 12 next 6
         lane 6: 4,-10 4,120 speed 12
         {light}
         {vehicles}
         agent pedestrian 20: -60,6 velocity 1.3,0
         ego vehicle 0: 30,-6"
    ))
    .unwrap()
}

fn futures(world: &dyn WorldModel, scenario: &Scenario, n: usize, seconds: f64) -> Vec<Rollout> {
    let start = Start {
        scene: scenario.present(),
        n_futures: n,
        seed: Seed(7),
    };
    let config = SimulateConfig {
        seconds,
        ..SimulateConfig::default()
    };
    simulate(world, &[start], None, &config).unwrap()
}

fn spawning() -> LivingConfig {
    LivingConfig {
        arrivals: Some(Arrivals::default()),
        ..LivingConfig::default()
    }
}

fn others(frame: &Frame) -> impl Iterator<Item = AgentId> + '_ {
    let agents = frame.agents().iter().map(|agent| agent.id);
    agents.filter(|id| *id != AgentId(0))
}

#[test]
fn two_minutes_later_as_many_are_there() {
    let scenario = road("");
    let world = Living::new(Idm::default(), spawning());
    let futures = futures(&world, &scenario, 4, 120.0);
    let mut vehicles = Vec::new();
    for future in &futures {
        let frames = future.imagined();
        let last = &frames[frames.len() - 1];
        // The initial vehicles are gone.
        assert!((1..=6).all(|id| last.agent(AgentId(id)).is_none()));
        for frame in frames.iter().skip(300).step_by(100) {
            let agents = frame.agents().iter();
            let n = agents.filter(|a| a.kind == AgentKind::Vehicle && a.id.0 != 0);
            vehicles.push(n.count() as f64);
        }
        // No agent enters twice, and none enters or leaves near the ego.
        let mut seen: BTreeMap<AgentId, (usize, usize)> = BTreeMap::new();
        for (k, frame) in frames.iter().enumerate() {
            for id in others(frame) {
                seen.entry(id).or_insert((k, k)).1 = k;
            }
        }
        let ego = scenario.present().ego_now().state.pose.position;
        for (id, (first, last)) in seen {
            let there = frames[first..=last]
                .iter()
                .all(|frame| frame.agent(id).is_some());
            assert!(there, "{id} was away for a while");
            let far = |k: usize| {
                let at = frames[k].agent(id).unwrap().state.pose.position;
                at.distance(ego) > 49.0
            };
            assert!(first == 0 || far(first), "{id} appeared in sight");
            assert!(
                last + 1 == frames.len() || far(last),
                "{id} vanished in sight"
            );
        }
    }
    // Six were there at first.
    let mean = vehicles.iter().sum::<f64>() / vehicles.len() as f64;
    assert!((4.0..9.0).contains(&mean), "{mean} vehicles: {vehicles:?}");
}

#[test]
fn who_comes_in_keeps_clear() {
    let scenario = road("");
    let world = Living::new(ConstantVelocity, spawning());
    for future in futures(&world, &scenario, 2, 60.0) {
        let mut known: BTreeSet<AgentId> = BTreeSet::new();
        for frame in future.imagined() {
            for agent in frame.agents() {
                if !known.insert(agent.id) {
                    continue;
                }
                let own = agent.oriented_box();
                let hit = |other: &&gump_scene::Agent| {
                    other.id != agent.id && own.overlaps(&other.oriented_box())
                };
                assert!(
                    !frame.agents().iter().any(|other| hit(&other)),
                    "{}",
                    agent.id
                );
            }
        }
        assert!(known.len() > 12, "{} came", known.len());
    }
}

#[test]
fn lights_change_and_rule_driven_traffic_heeds_them() {
    let scenario = road("light 1 red:\nlight 5 green:");
    let passes = |config: LivingConfig| -> usize {
        let world = Living::new(Idm::default(), config);
        let all = futures(&world, &scenario, 3, 60.0);
        let ahead = |future: &Rollout| {
            let last = future.last().now();
            let id = AgentId(3);
            let at = |frame: &Frame| frame.agent(id).map(|a| a.state.pose.position.x);
            // The one that stood at the line, at -30 m first; gone is passed.
            usize::from(at(last).is_none_or(|x| x > 20.0))
        };
        all.iter().map(ahead).sum()
    };
    let hold = LivingConfig {
        lights: LightControl::Hold,
        arrivals: None,
    };
    assert_eq!(passes(hold), 0);
    assert_eq!(passes(LivingConfig::default()), 3);
    let world = Living::new(Idm::default(), LivingConfig::default());
    for future in futures(&world, &scenario, 3, 60.0) {
        for frame in future.imagined() {
            let green = |light: &&gump_scene::Light| light.state == LightState::Green;
            assert!(frame.lights().iter().filter(green).count() < 2);
        }
    }
}

#[test]
fn recorded_lights_are_shown_as_recorded() {
    let mut scenario = road("light 1 red:\nlight 5 green:");
    let turns = scenario.now + 20;
    for frame in &mut scenario.log[turns..] {
        let mut lights = frame.lights().to_vec();
        lights[0].state = LightState::Yellow;
        *frame = Frame::new(frame.agents().to_vec(), lights);
    }
    let lights = LightControl::Recorded(std::sync::Arc::new(RecordedLights::of(&scenario)));
    let config = LivingConfig {
        lights,
        arrivals: None,
    };
    let world = Living::new(Idm::default(), config.clone());
    for (frame, logged) in futures(&world, &scenario, 1, 8.0)[0]
        .imagined()
        .iter()
        .zip(scenario.future())
    {
        assert_eq!(frame.lights(), logged.lights());
    }
    // A log replay shows its own lights, whatever lights it is given.
    let signals = Living::new(LogReplay::new(&scenario), LivingConfig::default());
    for (frame, logged) in futures(&signals, &scenario, 1, 8.0)[0]
        .imagined()
        .iter()
        .zip(scenario.future())
    {
        assert_eq!(frame.lights(), logged.lights());
    }
}

#[test]
fn futures_depend_on_their_seed_alone() {
    let scenario = road("light 1 red:\nlight 5 green:");
    let world = Living::new(Idm::default(), spawning());
    let (three, two) = (
        futures(&world, &scenario, 3, 40.0),
        futures(&world, &scenario, 2, 40.0),
    );
    assert_eq!(three[1].imagined(), two[1].imagined());
    assert_ne!(three[0].imagined(), three[1].imagined());
}

#[test]
fn sessions_let_futures_go_and_take_others_up() {
    let scenario = road("light 1 red:\nlight 5 green:");
    let world = Living::new(Idm::default(), spawning());
    let start = |n_futures: usize, seed: u64| Start {
        scene: scenario.present(),
        n_futures,
        seed: Seed(seed),
    };
    let mut session = world.open(&[start(3, 1)]).unwrap();
    let mut whole = world.open(&[start(3, 1)]).unwrap();
    for _ in 0..100 {
        assert_eq!(session.step(None).unwrap(), whole.step(None).unwrap());
    }
    assert!(session.keep(&[0, 2]));
    for _ in 0..100 {
        let (kept, all) = (session.step(None).unwrap(), whole.step(None).unwrap());
        assert_eq!((&kept[0], &kept[1]), (&all[0], &all[2]));
    }
    session.replace(1, start(1, 9)).unwrap();
    let mut fresh = world.open(&[start(1, 9)]).unwrap();
    for _ in 0..100 {
        assert_eq!(session.step(None).unwrap()[1], fresh.step(None).unwrap()[0]);
    }
}

#[test]
fn a_place_that_nothing_leads_to_stays_as_it_is() {
    let scenario = fixture::scenario("edge: 0,0 9,0\nego vehicle 0: 0,0 velocity 3,0").unwrap();
    let world = Living::new(ConstantVelocity, spawning());
    assert_eq!(world.notes(&scenario.present()).cases(Note::NoEntry), 1);
    let future = &futures(&world, &scenario, 1, 30.0)[0];
    assert_eq!(future.last().now().agents().len(), 1);
}

#[test]
fn on_a_map_without_lane_ends_nobody_enters_or_leaves() {
    let ring: String = (0..=16)
        .map(|i| {
            let angle = f64::from(i) * std::f64::consts::PI / 8.0;
            format!("{:.3},{:.3} ", 40.0 * angle.cos(), 40.0 * angle.sin())
        })
        .collect();
    let scenario = fixture::scenario(&format!(
        "lane 1: {ring}next 1
         ego vehicle 0: 40,0 heading 1.57 velocity 0,6
         agent vehicle 1: -40,0 heading -1.57 velocity 0,-6"
    ))
    .unwrap();
    let world = Living::new(Idm::default(), spawning());
    assert_eq!(world.notes(&scenario.present()).cases(Note::NoEntry), 1);
    let last = &futures(&world, &scenario, 1, 120.0)[0];
    assert_eq!(last.last().now().agents().len(), 2);
    // Without arrivals there is nothing to note, nor where a lane leads in.
    let alone = Living::new(Idm::default(), LivingConfig::default());
    assert!(alone.notes(&scenario.present()).is_empty());
    assert!(world.notes(&road("").present()).is_empty());
}

#[test]
fn recorded_lights_that_contradict_each_other_later_are_noted() {
    let mut scenario = road("light 1 red:\nlight 5 green:");
    let notes = |scenario: &Scenario| {
        let lights = LightControl::Recorded(std::sync::Arc::new(RecordedLights::of(scenario)));
        let config = LivingConfig {
            lights,
            arrivals: None,
        };
        let world = Living::new(ConstantVelocity, config);
        world
            .notes(&scenario.present())
            .cases(Note::ContradictingLights)
    };
    assert_eq!(notes(&scenario), 0);
    for frame in &mut scenario.log[scenario.now + 20..] {
        let mut lights = frame.lights().to_vec();
        lights[0].state = LightState::Green;
        *frame = Frame::new(frame.agents().to_vec(), lights);
    }
    assert_eq!(notes(&scenario), 1);
    // Signals do not look ahead.
    let signals = Living::new(ConstantVelocity, LivingConfig::default());
    assert!(signals.notes(&scenario.present()).is_empty());
}

#[test]
fn an_hour_goes_by_without_conflicting_greens() {
    let scenario = road("light 1 red:\nlight 5 green:\nlight 77 green:");
    let world = Living::new(ConstantVelocity, spawning());
    let start = Start {
        scene: scenario.present(),
        n_futures: 1,
        seed: Seed(3),
    };
    let mut session = world.open(&[start]).unwrap();
    let (mut greens, mut most, mut known) = ([0; 2], 0, BTreeSet::new());
    for step in 0..(3600.0 / scenario.dt) as usize {
        let frame = session.step(None).unwrap().swap_remove(0);
        let is_green = |lane: i64| {
            let light = frame.light(gump_scene::LaneId(lane)).unwrap();
            light.state == LightState::Green
        };
        let shown = [is_green(1), is_green(5)];
        assert_ne!(shown, [true, true], "step {step}");
        for (n, green) in greens.iter_mut().zip(shown) {
            *n += usize::from(green);
        }
        most = most.max(frame.agents().len());
        known.extend(others(&frame));
    }
    // Both have had their turns, and traffic goes on without growing.
    assert!(greens.iter().all(|n| *n > 5000), "{greens:?}");
    assert!(
        known.len() > 200 && most < 40,
        "{} came, {most} at once",
        known.len()
    );
    assert_eq!(
        world.notes(&scenario.present()).cases(Note::UnmappedLight),
        1
    );
}
