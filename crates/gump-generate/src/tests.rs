//! Scenes of an untrained network satisfy all constraints.

use std::sync::Arc;

use gump_engine::placement::object_spec::ObjectSpec;
use gump_engine::{SamplingConfig, TransformerWorld};
use gump_geometry::Pose;
use gump_metrics::overlapping;
use gump_model::Network;
use gump_model::config::ModelConfig;
use gump_scene::{Agent, AgentId, AgentKind, Frame, Seed, fixture};

use super::*;
use crate::constraint::parse_constraints;
use crate::headway::Moving;

/// Two lanes each way with edges, a crosswalk, a light.
const ROAD: &str = "lane 1: -100,-2 100,-2 width 3.6
     lane 2: 100,2 -100,2 width 3.6
     lane 3: -100,-6 100,-6 width 3.6
     edge: -100,-8 100,-8
     edge: 100,4 -100,4
     drivable: -100,-8 100,-8 100,4 -100,4
     crosswalk: 30,-8 34,-8 34,4 30,4
     light 1 red: 28,-2
     ego vehicle 0: 0,-2 velocity 8,0";

fn network() -> Network {
    let mut config = ModelConfig::tiny();
    config.visual.side_px = 104;
    config.visual.metres_per_px = 2.0;
    let device = candle_core::Device::Cpu;
    Network::random(config, Seed(5), &device).unwrap()
}

fn world() -> TransformerWorld {
    TransformerWorld::new(network(), SamplingConfig::default())
}

fn request(objects: Vec<ObjectSpec>) -> GenerateRequest {
    let scenario = fixture::scenario(ROAD).unwrap();
    let now = scenario.present().now();
    GenerateRequest {
        map: Arc::clone(&scenario.map),
        ego: EgoStart {
            pose: scenario.present().ego_now().state.pose,
            length: 4.8,
            width: 2.0,
            velocity: None,
        },
        lights: now.lights().to_vec(),
        fixtures: Vec::new(),
        prompts: Vec::new(),
        counts: Some(Counts {
            vehicles: 6,
            pedestrians: 2,
            bicycles: 2,
        }),
        objects,
        config: GenerateConfig::default(),
    }
}

fn make(request: &GenerateRequest, n: u64) -> Vec<GeneratedScene> {
    let seeds: Vec<Seed> = (0..n).map(Seed).collect();
    let scenes = generate(&world(), request, &seeds).unwrap();
    scenes.into_iter().map(Result::unwrap).collect()
}

#[test]
fn scenes_have_what_was_asked_for_and_nobody_overlaps() {
    let request = request(Vec::new());
    for scene in make(&request, 3) {
        let agents = scene.frame.agents();
        let n = |kind| agents.iter().filter(|agent| agent.kind == kind).count();
        let counts = AgentKind::MOVING.map(n);
        assert_eq!(counts, [7, 2, 2]);
        for agent in agents {
            assert_eq!(overlapping(&scene.frame, agent).count(), 0);
            let on_road = agent.kind != AgentKind::Vehicle
                || request.map.is_drivable(agent.state.pose.position);
            assert!(on_road, "{agent:?}");
        }
        let scenario = scene.scenario("made".into(), &request.map, &[]);
        scenario.validate().unwrap();
        assert_eq!(scene.frame.lights().len(), 1);
    }
}

#[test]
fn who_drives_can_stop_unless_that_does_not_matter() {
    let mut request = request(Vec::new());
    let n_cannot = |request: &GenerateRequest| {
        let scenes = make(request, 8);
        let pairs = scenes.iter().flat_map(|scene| {
            let agents = scene.frame.agents().iter();
            let moving = agents.clone().map(|agent| Moving {
                outline: agent.oriented_box(),
                velocity: agent.state.velocity,
            });
            let drives = agents.map(|agent| agent.kind != AgentKind::Pedestrian);
            let moving: Vec<(Moving, bool)> = moving.zip(drives).collect();
            let drives = moving.clone().into_iter().filter(|(_, drives)| *drives);
            drives.flat_map(move |(one, _)| moving.clone().into_iter().map(move |m| (one, m.0)))
        });
        let cannot = pairs.filter(|(one, other)| one.runs_into(other, &request.map));
        cannot.count()
    };
    assert_eq!(n_cannot(&request), 0);
    request.config.ready_to_drive = false;
    let n = n_cannot(&request);
    assert!(n > 0, "{n}");
}

#[test]
fn a_scene_depends_on_its_seed_alone() {
    let request = request(Vec::new());
    let many = make(&request, 3);
    let one = generate(&world(), &request, &[Seed(2)]).unwrap();
    let one = one.into_iter().next().unwrap().unwrap();
    assert_eq!(one.frame, many[2].frame);
    assert_ne!(many[1].frame, many[2].frame);
}

#[test]
fn wishes_are_met() {
    let objects = parse_constraints(
        "[[object]]\nid = \"ego\"\nspeed = [1, 2]\n\
         [[object]]\nid = \"bike\"\nclass = \"bicycle\"\nahead_of = { object = \"ego\", metres = 6 }\n\
         [[object]]\nid = \"truck\"\nlane = 2\nlength = 12\nspeed = 0\nx = [-40, 40]",
    )
    .unwrap();
    for scene in make(&request(objects), 3) {
        let agent = |name: &str| scene.frame.agent(scene.names[name]).unwrap();
        let (ego, bike, truck) = (agent("ego"), agent("bike"), agent("truck"));
        assert!((1.0 - 1e-9..2.0 + 1e-9).contains(&ego.state.speed()));
        let gap = bike.state.pose.position.x
            - ego.state.pose.position.x
            - (bike.length + ego.length) / 2.0;
        assert!((gap - 6.0).abs() < 0.5, "{gap}");
        assert_eq!((truck.length, truck.state.speed()), (12.0, 0.0));
        assert!((truck.state.pose.position.y - 2.0).abs() < 1.0);
        assert!(truck.state.pose.heading.cos() < -0.9);
    }
}

#[test]
fn slow_vehicles_move_where_they_face() {
    let objects = parse_constraints(
        "[[object]]\nid = \"ego\"\nspeed = [6, 9]\n\
         [[object]]\nid = \"slow truck\"\nlength = 9\nspeed = [0.5, 2]\n\
         ahead_of = { object = \"ego\", metres = 12 }\n\
         [[object]]\nid = \"other\"\nspeed = [0.2, 0.6]",
    )
    .unwrap();
    let request = request(objects);
    for scene in make(&request, 6) {
        for name in ["slow truck", "other", "ego"] {
            let state = scene.frame.agent(scene.names[name]).unwrap().state;
            let along = state.velocity.dot(state.pose.direction());
            assert!((along - state.speed()).abs() < 1e-9, "{name}: {state:?}");
        }
        let clauses = check::check_objects(&scene, &request.map, &request.objects);
        assert_eq!(clauses.len(), 5);
        assert!(clauses.iter().all(|c| c.holds == Some(true)), "{clauses:?}");
    }
}

#[test]
fn the_network_may_decide_how_many_there_are() {
    let mut request = request(Vec::new());
    request.counts = None;
    request.config.max_agents = 12;
    let scenes = make(&request, 4);
    let counts: Vec<usize> = scenes.iter().map(|s| s.frame.agents().len()).collect();
    // One that has learned nothing hardly ever stops.
    assert!(counts.iter().all(|n| (1..=13).contains(n)), "{counts:?}");
    for scene in &scenes {
        assert_eq!(scene.frame.agents()[0].id, scene.ego);
    }
    // What was asked for comes all the same.
    let bike = "[[object]]\nid = \"bike\"\nclass = \"bicycle\"\nspeed = [1, 2]";
    request.objects = parse_constraints(bike).unwrap();
    for scene in make(&request, 4) {
        assert!(scene.names.contains_key("bike"));
        assert!(scene.frame.agents().len() <= 14);
    }
}

#[test]
fn what_cannot_be_met_is_said() {
    let world = world();
    let error = |request: &GenerateRequest| match generate(&world, request, &[Seed(0)]) {
        Err(error) => error.to_string(),
        Ok(mut scenes) => scenes.remove(0).unwrap_err().to_string(),
    };
    let wish = |text: &str| request(parse_constraints(text).unwrap());
    let found = error(&wish("[[object]]\nid = \"a\"\nlane = 9"));
    assert!(found.contains("the map has no lane 9"), "{found}");
    let found = error(&wish("[[object]]\nid = \"a\"\nlane = 2\ny = [-9, -5]"));
    assert!(found.contains("no point of lane 2"), "{found}");
    let field = "[[object]]\nid = \"a\"\nx = 5\ny = 40";
    let found = error(&wish(field));
    assert!(
        found.contains("\"a\" found no place") && found.contains("on the road"),
        "{found}"
    );
    let mut many = request(Vec::new());
    many.counts = Some(Counts {
        vehicles: 400,
        ..Counts::default()
    });
    assert!(error(&many).contains("400 objects are more than the"));
    let mut nowhere = request(Vec::new());
    nowhere.map = fixture::scenario("ego vehicle 0: 0,0").unwrap().map;
    assert!(error(&nowhere).contains("no drivable lane"));
    let mut never = request(Vec::new());
    never.config.tries = 0;
    assert!(error(&never).contains("tries is 0"));
}

#[test]
fn another_start_is_tried_where_a_wish_cannot_be_met() {
    // Only one that starts before x = 40 has such a place ahead.
    let wish = "[[object]]\nid = \"a\"\nlane = 1\nx = [60, 90]\ny = [-1, 1]";
    let mut request = request(parse_constraints(wish).unwrap());
    request.counts = None;
    request.config.max_agents = 1;
    let order = pipeline::GenerationJob {
        request,
        roams: true,
        seconds: 0.0,
        attempts: 40,
    };
    let world = world();
    let worlds = pipeline::GenerationWorlds::of(&world);
    let made = pipeline::make_many(worlds, &order, 0..4, Seed(1)).unwrap();
    let attempts: Vec<usize> = made
        .into_iter()
        .map(|made| made.unwrap().attempts)
        .collect();
    assert!(attempts.iter().any(|n| *n > 1), "{attempts:?}");
}

#[test]
fn the_guide_lists_every_tag_with_its_rule() {
    let page = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../docs/guide/src/scenario-tags.md"
    );
    let text = std::fs::read_to_string(page).unwrap();
    let rows: Vec<&str> = text.lines().filter(|line| line.starts_with('|')).collect();
    let rules = gump_metrics::tags::rules().iter();
    let expected = rules.map(|rule| format!("| `{}` | {} |", rule.tag(), rule.meaning()));
    let head = ["| tag | rule |", "|---|---|"].map(String::from);
    let expected: Vec<String> = head.into_iter().chain(expected).collect();
    assert_eq!(
        rows, expected,
        "the table of {page} is not that of the code"
    );
}

#[test]
fn what_a_prompt_says_is_made_and_judged() {
    let mut request = request(Vec::new());
    request.prompts = vec!["behind_bike".parse().unwrap()];
    let order = pipeline::GenerationJob {
        request,
        roams: false,
        seconds: 0.0,
        attempts: 20,
    };
    let checked = pipeline::make_many(
        pipeline::GenerationWorlds::of(&world()),
        &order,
        0..2,
        Seed(1),
    )
    .unwrap();
    for checked in checked.into_iter().map(Result::unwrap) {
        assert_eq!(checked.clauses[0].clause, "behind_bike");
        assert_eq!(
            checked.clauses[0].holds,
            Some(true),
            "{:?}",
            checked.clauses
        );
        // Judging looks four seconds ahead, and histories are a second long at most.
        assert!(checked.scenario.future().len() >= 40 && checked.scenario.now <= 10);
    }
}

#[test]
fn prompted_scenes_do_not_depend_on_the_threads() {
    let order = |tag: &str| pipeline::GenerationJob {
        request: GenerateRequest {
            prompts: vec![tag.parse().unwrap()],
            ..request(Vec::new())
        },
        roams: false,
        seconds: 5.0,
        attempts: 20,
    };
    let order = order("stopping_with_lead");
    let checked_with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let generate = || {
            pipeline::make_many(
                pipeline::GenerationWorlds::of(&world()),
                &order,
                0..3,
                Seed(1),
            )
            .unwrap()
        };
        pool.build().unwrap().install(generate)
    };
    let checked: Vec<_> = checked_with(1).into_iter().map(Result::unwrap).collect();
    assert!(checked.iter().all(pipeline::CheckedScene::holds));
    assert!(
        checked
            .iter()
            .all(|checked| checked.scenario.future().len() >= 50)
    );
    for (one, two) in checked.iter().zip(checked_with(2)) {
        assert_eq!(one.scenario.log, two.unwrap().scenario.log);
    }
}

#[test]
fn a_prompt_that_the_map_cannot_hold_is_an_error() {
    let order = |tag: &str, placement| {
        let mut request = request(Vec::new());
        request.prompts = vec![tag.parse().unwrap()];
        request.config.placement = placement;
        pipeline::GenerationJob {
            request,
            roams: false,
            seconds: 0.0,
            attempts: 2,
        }
    };
    let make = |order: &pipeline::GenerationJob| {
        pipeline::make(pipeline::GenerationWorlds::of(&world()), order, 0, Seed(1))
    };
    let error = make(&order("on_carpark", Placement::Guided)).unwrap_err();
    assert!(error.to_string().contains("can hold on_carpark"), "{error}");
    // With free placement no stage is searched, and the verdict reports what is wrong.
    let checked = make(&order("on_carpark", Placement::Free));
    assert!(!matches!(checked, Err(GenerateError::NoSite { .. })));
}

#[test]
fn a_place_where_nobody_walks_is_left_for_another() {
    let mut request = request(Vec::new());
    let text = "lane 1: -60,0 40,0 width 3.6\ncrosswalk: -24,-6 -16,-6 -16,6 -24,6\n\
                ego vehicle 0: -55,0";
    request.map = fixture::scenario(text).unwrap().map;
    request.ego.pose = Pose::new(-55.0, 0.0, 0.0);
    request.prompts = vec!["near_multiple_pedestrians".parse().unwrap()];
    request.counts = Some(Counts {
        pedestrians: 4,
        ..Counts::default()
    });
    let order = pipeline::GenerationJob {
        request,
        roams: false,
        seconds: 0.0,
        attempts: 60,
    };
    let checked =
        pipeline::make(pipeline::GenerationWorlds::of(&world()), &order, 0, Seed(1)).unwrap();
    assert!(
        checked.attempts > 1 && checked.holds(),
        "{:?}",
        checked.clauses
    );
    let ego = checked.scene.frame.agent(checked.scene.ego).unwrap();
    assert!((-40.0..0.0).contains(&ego.state.pose.position.x));
}

#[test]
fn a_steered_ego_is_where_its_drive_says() {
    let scene = &make(&request(Vec::new()), 1)[0];
    let map = &request(Vec::new()).map;
    let scenario = scene.scenario("made".into(), map, &[]);
    let maneuver = drive::Maneuver {
        acceleration: -1.5,
        ..drive::Maneuver::default()
    };
    let rng = &mut Seed(2).rng();
    let lane = (&map.lanes()[0], 100.0);
    let drive = drive::PlannedDrive::along(map, lane, 0.0, 3.0, maneuver, rng).unwrap();
    let takes = futures::steered(&world(), &scenario, &drive, Seed(4)).unwrap();
    assert!(!takes.is_empty());
    for take in takes {
        // Steered for four seconds, then imagined for two more.
        assert_eq!(take.log.len(), 61);
        for (frame, seconds) in [(10, 1.0), (20, 2.0), (40, 4.0)] {
            let ego = take.log[frame].agent(take.ego).unwrap().state.pose.position;
            let there = drive.state_after(seconds).pose.position;
            assert!(ego.distance(there) < 0.05, "{ego} instead of {there}");
        }
    }
}

#[test]
fn cones_stand_clear_of_everybody() {
    let mut request = request(Vec::new());
    request.prompts = vec!["near_trafficcone_on_driveable".parse().unwrap()];
    let order = pipeline::GenerationJob {
        request,
        roams: false,
        seconds: 0.0,
        attempts: 20,
    };
    let checked =
        pipeline::make(pipeline::GenerationWorlds::of(&world()), &order, 0, Seed(1)).unwrap();
    assert!(checked.holds(), "{:?}", checked.clauses);
    let present = checked.scenario.present();
    let agents = present.now().agents().iter();
    let cones: Vec<&Agent> = agents
        .filter(|agent| agent.kind == AgentKind::TrafficCone)
        .collect();
    assert!(cones.len() >= 3);
    for cone in cones {
        assert_eq!(overlapping(present.now(), cone).count(), 0);
    }
}

#[test]
fn traffic_lives_where_it_is_let() {
    let scene = &make(&request(Vec::new()), 1)[0];
    let map = fixture::scenario(ROAD).unwrap().map;
    let scenario = scene.scenario("made".into(), &map, &[]);
    let frames = |spawn: bool| {
        let sampling = SamplingConfig {
            spawn,
            ..SamplingConfig::default()
        };
        let world = TransformerWorld::new(network(), sampling);
        let start = gump_rollout::Start {
            scene: scenario.present(),
            n_futures: 2,
            seed: Seed(4),
        };
        let config = gump_rollout::SimulateConfig {
            seconds: 6.0,
            ..gump_rollout::SimulateConfig::default()
        };
        let rollouts = gump_rollout::simulate(&world, &[start], None, &config).unwrap();
        rollouts[0].imagined().to_vec()
    };
    let ids = |frame: &Frame| -> Vec<AgentId> { frame.agents().iter().map(|a| a.id).collect() };
    let still = frames(false);
    assert!(still.iter().all(|frame| ids(frame) == ids(&scene.frame)));
    let alive = frames(true);
    assert!(alive.iter().all(|frame| frame.agent(scene.ego).is_some()));
    // An untrained network finds departures and arrivals near the border likely.
    assert_ne!(ids(&alive[alive.len() - 1]), ids(&scene.frame));
    assert_eq!(alive, frames(true));
}
