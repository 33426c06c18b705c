//! Futures of the shipped weights: routes, and what rules do.

use gump_model::relative::route::Route;
use gump_scene::{LaneId, Scenario, fixture};

use super::*;

fn world(routes: Routes) -> RelativeWorld {
    sampled(RelativeSampling {
        routes,
        ..RelativeSampling::default()
    })
}

fn ruled() -> RelativeWorld {
    sampled(RelativeSampling {
        redraws: 12,
        limits: true,
        ..RelativeSampling::default()
    })
}

fn sampled(sampling: RelativeSampling) -> RelativeWorld {
    let path = "../../datasets/weights/gump-relative.safetensors";
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
    let weights = RelativeWeights::read(&std::fs::read(path).unwrap()).unwrap();
    RelativeWorld::of_weights(&weights, sampling).unwrap()
}

/// A vehicle that comes to a place where it may go on or turn to either side.
fn fork() -> Scenario {
    fixture::scenario(
        "lane 1: -80,0 0,0 speed 13 next 2,3,4
         lane 2: 0,0 30,0 speed 13 next 5
         lane 3: 0,0 6,1 11,4 14,9 15,15 speed 8 next 6
         lane 4: 0,0 4,-0.7 8,-3 10.5,-6.5 11.5,-11 speed 8 next 7
         lane 5: 30,0 120,0 speed 13
         lane 6: 15,15 15,100 speed 13
         lane 7: 11.5,-11 11.5,-100 speed 13
         ego vehicle 0: -32,0 velocity 6,0",
    )
    .unwrap()
}

/// A future of a scene after so many steps, and the route that its first agent had after one.
fn future(
    world: &RelativeWorld,
    scenario: &Scenario,
    seed: u64,
    steps: usize,
) -> (Future, Option<Route>) {
    let start = Start {
        scene: scenario.present(),
        n_futures: 1,
        seed: Seed(seed),
    };
    let mut future = world.begin(&[start]).unwrap().remove(0);
    let mut room = Workspace::default();
    let mut meant = None;
    for step in 0..steps {
        let all = std::slice::from_mut(&mut future);
        Future::step_all(all, &world.engine, &world.sampling, None, &mut room);
        if step == 0 {
            meant = future.members[0].intent.route().cloned();
        }
    }
    (future, meant)
}

#[test]
fn vehicles_follow_their_routes() {
    let (world, scenario) = (world(Routes::Always), fork());
    let mut followed = [(0, 0); 2];
    for seed in 0..512 {
        let (future, meant) = future(&world, &scenario, seed, 18);
        let meant = meant.expect("the vehicle is on a lane");
        let turns = usize::from(!meant.lanes().contains(&LaneId(2)));
        let away = meant.offset_m(&scenario.map, future.members[0].now().pose);
        followed[turns].0 += usize::from(away < 3.0);
        followed[turns].1 += 1;
    }
    for (on, of) in followed {
        assert!(of > 40 && 10 * on >= 9 * of, "{followed:?}");
    }
}

#[test]
fn who_stands_in_a_lane_of_a_made_scene_waits() {
    let text = "lane 1: 0,0 200,0 speed 13\nego vehicle 0: 10,0 velocity 5,0\n\
                agent vehicle 1: 60,0\nagent vehicle 2: 90,4";
    let recorded = fixture::scenario(text).unwrap();
    let world = ruled();
    let begun = |scenario: &Scenario| future(&world, scenario, 1, 0).0;
    let has_driven = |future: &Future| -> Vec<bool> {
        let members = future.members.iter();
        members.map(|member| member.has_driven).collect()
    };
    let mut future = begun(&recorded);
    assert_eq!(has_driven(&future), [true, false, false]);
    assert!(!future.is_late());
    // Who stands beside the lane may be parked all the same.
    future.take_for_made();
    assert_eq!(has_driven(&future), [true, true, false]);
    assert!(future.is_late());
    // A scene without a past is made.
    let mut snapshot = recorded.clone();
    snapshot.log.drain(..snapshot.now);
    snapshot.now = 0;
    let future = begun(&snapshot);
    assert_eq!(has_driven(&future), [true, true, false]);
    assert!(future.is_late());
}

#[test]
fn without_routes_there_are_none() {
    let (future, meant) = future(&world(Routes::Never), &fork(), 1, 6);
    assert_eq!(meant, None);
    assert_eq!(future.members[0].intent.route(), None);
}

#[test]
fn the_rules_know_that_who_is_shown_to_set_off_still_stands() {
    let scenario = fixture::scenario("lane 1: -80,0 80,0\nego vehicle 0: 0,0").unwrap();
    let world = ruled();
    let (mut future, _) = future(&world, &scenario, 0, 1);
    let member = &mut future.members[0];
    member.agent.state.velocity = DVec2::ZERO;
    member.seen.restart(&world.engine, SETS_OFF);
    member.could_go = true;
    assert!((member.now().velocity().length() - SETS_OFF).abs() < 1e-9);
    assert_eq!(member.as_it_moves().velocity(), DVec2::ZERO);
}

/// Two lanes that cross in a junction, and on each a vehicle that stands in the way of the other.
fn stuck() -> Scenario {
    let mut scenario = fixture::scenario(
        "lane 1: -60,0 20,0 speed 13 next 2
         lane 2: 20,0 40,0 speed 13 next 3
         lane 3: 40,0 120,0 speed 13
         lane 4: 30,-70 30,-10 speed 13 next 5
         lane 5: 30,-10 30,10 speed 13 next 6
         lane 6: 30,10 30,90 speed 13
         ego vehicle 0: 26.65,0
         agent vehicle 1: 30,-2.2 heading 1.5708",
    )
    .unwrap();
    let mut parts = scenario.map.parts().clone();
    for lane in &mut parts.lanes {
        lane.in_intersection = [2, 5].contains(&lane.id.0);
    }
    scenario.map = Arc::new(MapGraph::new(parts).unwrap());
    scenario
}

#[test]
fn one_of_two_that_hold_each_other_in_a_junction_backs_up() {
    let (world, scenario) = (ruled(), stuck());
    let at = |future: &Future, i: usize| future.members[i].now().pose.position;
    let mut backed = 0;
    for seed in 0..8 {
        let back = |steps: usize| {
            let (future, _) = future(&world, &scenario, seed, steps);
            [at(&future, 0).x < 26.4, at(&future, 1).y < -2.5]
        };
        // 12 to 16 s after the start.
        let back = [24, 26, 28, 32].map(back);
        assert!(back.iter().all(|back| *back != [true, true]), "{back:?}");
        backed += usize::from(back.iter().any(|back| *back != [false, false]));
        let (after, _) = future(&world, &scenario, seed, 80);
        let gone = [at(&after, 0).x > 40.0, at(&after, 1).y > 10.0];
        assert_eq!(gone, [true, true], "{seed}");
    }
    assert!(backed >= 4, "{backed}");
}

/// A vehicle that heads for the edge of its road, on a map around this place.
fn towards_the_edge(place: DVec2) -> Scenario {
    let at = |x: f64, y: f64| format!("{},{}", x + place.x, y + place.y);
    let text = format!(
        "lane 1: {} {} {} speed 13
         edge: {} {}
         ego vehicle 0: {} heading -0.12 velocity 11.91,-1.44 size 4.8,2",
        at(-100.0, 0.0),
        at(0.0, 0.0),
        at(250.0, 0.0),
        at(-100.0, -2.0),
        at(250.0, -2.0),
        at(0.0, -0.3),
    );
    fixture::scenario(&text).unwrap()
}

#[test]
fn rules_keep_vehicles_on_the_road_wherever_the_map_is() {
    let leave = |world: &RelativeWorld, place: DVec2| {
        let scenario = towards_the_edge(place);
        let leaves = |seed: &u64| {
            let (future, _) = future(world, &scenario, *seed, 4);
            let y = |point: DVec2| point.y - place.y;
            let now = future.members[0].now();
            let side = now.body.width / 2.0;
            let corner = DVec2::new(now.body.length / 2.0, -side);
            y(now.pose * corner).min(y(now.pose * DVec2::new(-corner.x, -side))) < -2.1
        };
        (0..32).filter(leaves).count()
    };
    let (alone, ruled) = (sampled(RelativeSampling::default()), ruled());
    for place in [
        DVec2::ZERO,
        DVec2::new(-300.0, 200.0),
        DVec2::new(7000.0, -2000.0),
    ] {
        let (alone, ruled) = (leave(&alone, place), leave(&ruled, place));
        assert!(
            alone >= 4 && ruled == 0,
            "{alone} alone, {ruled} ruled at {place}"
        );
    }
}

#[test]
fn a_light_has_shown_its_colour_since_it_was_first_seen_in_it() {
    let light = |state: Option<LightState>| {
        state.map(|state| Light {
            lane: LaneId(1),
            state,
            stop_point: None,
        })
    };
    let elapsed = |states: &[Option<LightState>]| {
        let frame = |state: &Option<LightState>| {
            Frame::new(Vec::new(), light(*state).into_iter().collect())
        };
        let frames: Vec<Frame> = states.iter().map(frame).collect();
        lights_at(&frames, 0.1).by_lane[0].2
    };
    let (red, green) = (Some(LightState::Red), Some(LightState::Green));
    let unknown = Some(LightState::Unknown);
    assert_eq!(elapsed(&[red, green]), Some(0.0));
    assert_eq!(elapsed(&[red, green, green, green]), Some(0.2));
    // Out of sight in between, as in `gump_model`'s samples.
    assert_eq!(
        elapsed(&[red, green, None, None, green]),
        Some(0.30000000000000004)
    );
    assert_eq!(elapsed(&[red, None, None, green]), Some(0.0));
    assert_eq!(elapsed(&[green, green]), None);
    assert_eq!(elapsed(&[unknown, green, green]), None);
}

#[test]
fn lights_that_are_shown_later_stop_vehicles_too() {
    let (world, scenario) = (ruled(), fork());
    let lit = fixture::scenario(
        "lane 2: 0,0 30,0\nlane 3: 0,0 30,1\nlight 2 red: 0,0\nlight 3 red: 0,0
         ego vehicle 0: -32,0",
    )
    .unwrap();
    let lights = lit.present().now().lights().to_vec();
    let front = |seed: u64, lights: &[Light]| {
        let start = Start {
            scene: scenario.present(),
            n_futures: 1,
            seed: Seed(seed),
        };
        let mut future = world.begin(&[start]).unwrap().remove(0);
        let mut room = Workspace::default();
        for _ in 0..16 {
            future.show(lights);
            let all = std::slice::from_mut(&mut future);
            Future::step_all(all, &world.engine, &world.sampling, None, &mut room);
        }
        let now = future.members[0].now();
        now.pose.position.x + now.body.length / 2.0
    };
    for seed in 0..8 {
        let (red, none) = (front(seed, &lights), front(seed, &[]));
        assert!(
            red < 0.6 && none > 1.0,
            "{red} before red lights, {none} without"
        );
    }
}

/// A street with a driveway to the south, at which a vehicle arrives.
fn driveway() -> Scenario {
    fixture::scenario(
        "lane 1: 0,0 120,0 speed 11
         lane 2: 120,3.5 0,3.5 speed 11
         edge: 0,-2 120,-2
         edge: 120,5.5 0,5.5
         driveway: 58,-2.4 63,-2.4 63,-12 58,-12
         ego vehicle 0: 44,0 velocity 4.5,0 size 4.6,1.9",
    )
    .unwrap()
}

#[test]
fn some_who_come_slowly_turn_into_a_driveway_and_stop_there() {
    let scenario = driveway();
    let turns_in = |world: &RelativeWorld, seed: u64| {
        let (future, _) = future(world, &scenario, seed, 4);
        future.members[0].intent.turns_in().is_some()
    };
    // Of ten, so many that decide to get there, square to the street. With rules all do, and stop there;
    // without, some drive past, and on beyond, the first ones after five seconds.
    let (ruled, raw) = (ruled(), world(Routes::Late));
    for (world, least, when) in [(&ruled, 10, 40..41), (&raw, 8, 8..24)] {
        let seeds: Vec<u64> = (0..240).filter(|seed| turns_in(world, *seed)).collect();
        // 8 %, and those that have not come there yet.
        assert!((8..30).contains(&seeds.len()), "{seeds:?}");
        let is_there = |seed: &u64| {
            when.clone().step_by(2).any(|step| {
                let (future, _) = future(world, &scenario, *seed, step);
                let pose = future.members[0].now().pose;
                let (at, askew) = (pose.position, pose.heading + std::f64::consts::FRAC_PI_2);
                (57.5..63.5).contains(&at.x) && (-12.0..-5.0).contains(&at.y) && askew.abs() < 0.4
            })
        };
        let there = seeds.iter().filter(|seed| is_there(seed)).count();
        assert!(
            10 * there >= least * seeds.len(),
            "{there} of {}",
            seeds.len()
        );
    }
    let never = sampled(RelativeSampling {
        redraws: 12,
        limits: true,
        routes: Routes::Never,
        ..RelativeSampling::default()
    });
    assert!((0..60).all(|seed| !turns_in(&never, seed)));
}

#[test]
fn who_turns_into_a_driveway_at_once_is_read_so_at_the_present() {
    // The ego may be driven from outside: it does not decide at the present.
    let scenario = fixture::scenario(
        "lane 1: 0,0 120,0 speed 11
         lane 2: 120,3.5 0,3.5 speed 11
         edge: 0,-2 120,-2
         edge: 120,5.5 0,5.5
         driveway: 58,-2.4 63,-2.4 63,-12 58,-12
         ego vehicle 0: 100,3.5 heading 180 velocity -5,0
         agent vehicle 1: 48,0 velocity 4.5,0 size 4.6,1.9",
    )
    .unwrap();
    let world = world(Routes::Late);
    let begun = |seed: u64| future(&world, &scenario, seed, 0).0;
    let plain = (0..80)
        .map(begun)
        .find(|f| f.members[1].intent.turns_in().is_none());
    let turning = (0..240)
        .map(begun)
        .find(|f| f.members[1].intent.turns_in().is_some());
    let (plain, turning) = (plain.unwrap(), turning.unwrap());
    assert_eq!(plain.frames, turning.frames);
    let c = plain.hidden.len() / plain.members.len();
    assert_ne!(plain.hidden[c..], turning.hidden[c..]);
}

#[test]
fn halts_of_people_and_starts_of_parked_vehicles_are_drawn_again() {
    let scenario = fixture::scenario(
        "lane 1: 0,0 200,0 speed 13
         ego vehicle 0: 20,0 velocity 8,0
         agent pedestrian 1: 30,-6 velocity 1.3,0
         agent pedestrian 2: 35,-6
         agent vehicle 3: 60,-5
         agent vehicle 4: 80,0
         agent bicycle 5: 90,-4",
    )
    .unwrap();
    let (future, _) = future(&ruled(), &scenario, 1, 0);
    let share = |id: u32, step: Pose| {
        let mut members = future.members.iter();
        let member = members
            .find(|member| member.agent.id.0 as u32 == id)
            .unwrap();
        let rare = |seed: &u64| member.is_rare(&scenario.map, step, Seed(*seed));
        (0..400).filter(rare).count()
    };
    let (halt, go) = (Pose::IDENTITY, Pose::new(0.6, 0.0, 0.0));
    assert!((290..350).contains(&share(1, halt)), "{}", share(1, halt));
    assert!((290..350).contains(&share(3, go)), "{}", share(3, go));
    // Who walks on, who stands, who drives, and who stands in a lane.
    for (id, step) in [
        (1, go),
        (2, halt),
        (2, go),
        (3, halt),
        (0, halt),
        (0, go),
        (4, go),
        (5, go),
    ] {
        assert_eq!(share(id, step), 0, "{id} {step:?}");
    }
}
