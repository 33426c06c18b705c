//! Realism from the outside: what an actor must not know, and the ways of decoding.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod workplace;

use std::fs;

use gump_data::{cache, find, womd};
use gump_geometry::{DVec2, Pose, dvec2};
use gump_model::checkpoint::StorageType;
use gump_model::{Device, ModelConfig, Network, checkpoint};
use gump_scene::{
    Agent, AgentId, AgentState, Frame, LaneId, Light, LightState, Scenario, Seed, fixture,
};
use serde_json::Value;
use workplace::Workplace;

impl Workplace {
    /// The results of a verb that succeeds.
    fn results(&self, words: &str) -> Value {
        let output = self.run(&format!("{words} --quiet --out out"));
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{words}: {error}");
        let report = fs::read_to_string(self.path("out/report.json")).unwrap();
        serde_json::from_str::<Value>(&report).unwrap()["results"].take()
    }

    /// Checks the exit status and that the error is one sentence with these parts.
    fn fails(&self, words: &str, status: i32, parts: &[&str]) {
        let output = self.run(words);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(status), "{words}: {error}");
        assert_eq!(error.trim().lines().count(), 1, "{words}: {error}");
        for part in parts {
            assert!(error.contains(part), "{words}: expected {part} in: {error}");
        }
    }

    /// Weights of a very small network that has learned nothing.
    fn weights(&self) -> &'static str {
        let config = ModelConfig {
            width: 32,
            layers: 1,
            heads: 2,
            trajectory_heads: vec![0],
            reconstruction: false,
            ..ModelConfig::tiny()
        };
        let network = Network::random(config, Seed(0), &Device::Cpu).unwrap();
        checkpoint::save(&network, &self.path("w.safetensors"), StorageType::Half).unwrap();
        "w.safetensors"
    }
}

/// Future of a recording after a present that it shares with others.
#[derive(Clone, Copy)]
enum Way {
    /// The ego turns left; the light it waits for was red and stays so.
    Left,
    /// The ego turns right, the light turns green, and another agent appears.
    Right,
}

/// A fork with a light that is out of sight at the present.
///
/// Up to the present both ways are equal. After it everything that readers infer is not: the ego's
/// route, and the colour of the light, which is seen again within four seconds.
fn recording(way: Way) -> Scenario {
    let mut scenario = fixture::scenario(
        "lane 1: -60,0 -20,0 20,0 speed 15 width 3.5 next 2,3
         lane 2: 20,0 40,10 50,40 50,120 speed 15 width 3.5
         lane 3: 20,0 40,-10 50,-40 50,-120 speed 15 width 3.5
         edge: -60,-3 15,-3
         edge: 15,3 -60,3
         ego vehicle 0: 0,0 velocity 8,0
         agent vehicle 1: 35,6 heading 0.5
         agent vehicle 2: -20,0 velocity 8,0
         agent pedestrian 3: 30,-12 velocity 0,1
         history 1.0 future 8.0 dt 0.1",
    )
    .unwrap();
    scenario.id = "fork".into();
    scenario.targets = vec![AgentId(0), AgentId(2)];
    let (side, colour) = match way {
        Way::Left => (1.0, LightState::Red),
        Way::Right => (-1.0, LightState::Green),
    };
    let now = scenario.now;
    let path = scenario.map.lane(LaneId(if side > 0.0 { 2 } else { 3 }));
    let path = path.unwrap().centerline.clone();
    let light = |state| Light {
        lane: LaneId(1),
        state,
        stop_point: Some(dvec2(15.0, 0.0)),
    };
    for (step, frame) in scenario.log.iter_mut().enumerate() {
        let mut agents: Vec<Agent> = frame.agents().to_vec();
        let ego = agents.iter_mut().find(|agent| agent.id == AgentId(0));
        let ego = ego.unwrap();
        let beyond = ego.state.pose.position.x - 20.0;
        if beyond > 0.0 {
            let pose: Pose = path.pose_at(beyond);
            let velocity = 8.0 * DVec2::from_angle(pose.heading);
            *ego = ego.with_state(AgentState { pose, velocity });
        }
        if step > now + 10 && matches!(way, Way::Right) {
            agents.push(Agent {
                id: AgentId(9),
                ..agents[1]
            });
        }
        let state = match step {
            ..=6 => Some(LightState::Red),
            7..=14 => None,
            _ => Some(colour),
        };
        *frame = Frame::new(agents, state.map(light).into_iter().collect());
    }
    scenario
}

/// Files of both ways, in a format that states what was seen and in one that keeps what readers
/// have inferred: name and ending.
fn recordings(place: &Workplace) -> [[String; 2]; 2] {
    let name = |way, ending| format!("{way}.{ending}");
    for (way, named) in [(Way::Left, "left"), (Way::Right, "right")] {
        let messages = place.path(&name(named, "tfrecord"));
        womd::write_scenarios(&messages, [recording(way)]).unwrap();
        let read = find(&messages.display().to_string()).unwrap();
        cache::write_shard(&place.path(&name(named, "cache")), [read]).unwrap();
    }
    ["tfrecord", "cache"].map(|ending| ["left", "right"].map(|way| name(way, ending)))
}

/// Every digest in a report, in order.
fn digests(results: &Value, found: &mut Vec<String>) {
    match results {
        Value::Object(fields) => {
            for (key, value) in fields {
                match (key.as_str(), value.as_str()) {
                    ("digest", Some(digest)) => found.push(digest.into()),
                    _ => digests(value, found),
                }
            }
        }
        Value::Array(values) => values.iter().for_each(|value| digests(value, found)),
        _ => {}
    }
}

#[test]
fn what_readers_make_of_the_present_is_equal_and_of_the_future_is_not() {
    let place = Workplace::new();
    for files in recordings(&place) {
        let [left, right] = files.map(|file| {
            let path = place.path(&file).display().to_string();
            find(&path).unwrap()
        });
        assert_eq!(left.log[..=left.now], right.log[..=right.now]);
        assert!(
            left.present().now().lights().is_empty(),
            "it is out of sight"
        );
        let route = |scenario: &Scenario| scenario.route.as_ref().unwrap().lanes.clone();
        assert_eq!(route(&left), [LaneId(1), LaneId(2)]);
        assert_eq!(route(&right), [LaneId(1), LaneId(3)]);
        assert!(left.present().unguided().route.is_none());
    }
}

#[test]
fn no_world_and_no_verb_sees_what_comes_after_the_present() {
    let place = Workplace::new();
    let model = format!("model:{}", place.weights());
    let shipped = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../datasets/weights/gump-relative.safetensors");
    let relative = format!("model:{}", shipped.display());
    let rollouts = "--rollouts-per-scenario 1";
    let maker =
        "--account me@example.org --method test --parameters 1K --complies-with-closed-loop";
    let mut checked = 0;
    for files in recordings(&place) {
        let check = |n: usize, words: &dyn Fn(&str) -> String| {
            let [left, right] = files.each_ref().map(|file| {
                let mut found = Vec::new();
                digests(&place.results(&words(file)), &mut found);
                found
            });
            assert_eq!(left.len(), n, "{}", words(&files[0]));
            assert_eq!(left, right, "{}", words(&files[0]));
        };
        for world in ["idm", "constant-velocity", &model, &relative] {
            let n = if world.starts_with("model:") { 2 } else { 1 };
            check(1, &|f| {
                format!("simulate --scenario {f} --world {world} --futures 2")
            });
            check(n, &|f| {
                format!("evaluate wosac --scenarios {f} --world {world} {rollouts}")
            });
            check(1, &|f| {
                format!("evaluate motion --scenarios {f} --world {world} --futures 2")
            });
            check(1, &|f| {
                format!("submit wosac --scenarios {f} --world {world} {maker}")
            });
            checked += 4;
        }
        check(1, &|f| {
            format!("evaluate motion --scenarios {f} --world {model} --heads")
        });
        check(4, &|f| {
            format!("ablate nar --scenario {f} --world {model} --futures 1 --seconds 4")
        });
        check(8, &|f| {
            format!("ablate history --scenarios {f} --world {model} {rollouts}")
        });
        // The recordings do differ, as a replay shows.
        let [left, right] = files.each_ref().map(|file| {
            let words = format!("simulate --scenario {file} --world log --futures 1");
            place.results(&words)["digest"].clone()
        });
        assert_ne!(left, right);
    }
    assert_eq!(checked, 32);
}

#[test]
fn realism_is_told_of_the_network_alone_beside_what_rules_make_of_it() {
    let place = Workplace::new();
    let [[scene, _], _] = recordings(&place);
    let world = format!("model:{}", place.weights());
    let words = format!("evaluate wosac --scenarios {scene} --world {world}");
    let words = format!("{words} --rollouts-per-scenario 2");
    let rows = |flags: &str| {
        let results = place.results(&format!("{words}{flags}"));
        let rows = results["rows"].as_array().unwrap().clone();
        let names = rows.iter().map(|row| {
            let name = |key: &str| row[key].as_str().unwrap().to_owned();
            format!("{} {}", name("world"), name("decoding"))
        });
        let names: Vec<_> = names.collect();
        let mut found = Vec::new();
        digests(&results["digests"], &mut found);
        (rows, names, results["intervals"][0].clone(), found)
    };
    let yardsticks = ["logged-oracle -", "constant-velocity -"].map(String::from);
    let named = |categories: &[&str]| {
        let categories = categories.iter().map(|way| format!("{world} {way}"));
        categories.chain(yardsticks.clone()).collect::<Vec<_>>()
    };
    let (both, names, intervals, drawn) = rows("");
    assert_eq!(names, named(&["ruled", "raw"]));
    for key in [world.clone(), format!("{world} (raw)")] {
        assert!(intervals[&key].is_number(), "{key} in {intervals}");
    }
    assert_eq!(drawn.len(), 2);
    assert_ne!(drawn[0], drawn[1]);
    for (flags, way, row) in [(" --ruled", "ruled", 0), (" --raw", "raw", 1)] {
        let (one, names, _, found) = rows(flags);
        assert_eq!(names, named(&[way]));
        assert_eq!((&one[0], &found[0]), (&both[row], &drawn[row]), "{way}");
    }
    let (none, names, ..) = rows(" --redraws 0 --no-limits");
    assert_eq!((names, &none[0]), (named(&["raw"]), &both[1]));
    let (_, names, _, paper) = rows(" --paper");
    assert_eq!(names, named(&["paper"]));
    assert!(!drawn.contains(&paper[0]));
}

#[test]
fn a_simulation_says_how_it_was_decoded() {
    let place = Workplace::new();
    let [[scene, _], _] = recordings(&place);
    let world = format!("model:{}", place.weights());
    let check = |world: &str, flags: &str, decoding: &str| {
        let words = format!("simulate --scenario {scene} --world {world} --futures 1 --seconds 2");
        let results = place.results(&format!("{words}{flags}"));
        assert_eq!(results["decoding"], decoding, "{world}{flags}");
        results["digest"].clone()
    };
    let ruled = check(&world, "", "ruled");
    let raw = check(&world, " --raw", "raw");
    assert_eq!(raw, check(&world, " --redraws 0 --no-limits", "raw"));
    let paper = check(&world, " --paper", "paper");
    let sampled = " --redraws 0 --no-limits --temperature 1.1 --decay 1.2";
    let curved = check(&world, sampled, "raw");
    assert!(ruled != raw && raw != paper && ruled != paper);
    assert_ne!(paper, curved, "the paper's interpolation is part of it");
}

#[test]
fn flags_that_contradict_each_other_are_refused() {
    let place = Workplace::new();
    let [[scene, _], _] = recordings(&place);
    let world = format!("--world model:{}", place.weights());
    for verb in [
        format!("simulate --scenario {scene}"),
        format!("evaluate wosac --scenarios {scene}"),
        format!("evaluate motion --scenarios {scene}"),
        format!("ablate temperature --scenarios {scene}"),
        format!("ablate nar --scenario {scene}"),
    ] {
        for (flags, found) in [
            ("--raw --redraws 3", "found --redraws 3"),
            ("--raw --paper", "found --paper too"),
            ("--ruled --raw", "found --ruled too"),
            ("--paper --temperature 0.9", "found --temperature 0.9"),
            ("--paper --redraws 0", "found --redraws 0"),
            ("--ruled --redraws 0 --no-limits", "expected a rule"),
        ] {
            let words = format!("{verb} {world} {flags} --quiet --out failed");
            place.fails(&words, 2, &[found]);
        }
    }
}

#[test]
fn a_scene_without_lanes_is_refused_by_whoever_needs_them() {
    let place = Workplace::new();
    let scenario = fixture::scenario("edge: 0,-9 90,-9\nego vehicle 0: 0,0 velocity 5,0").unwrap();
    womd::write_scenarios(&place.path("bare.tfrecord"), [scenario]).unwrap();
    let world = format!("model:{}", place.weights());
    let needs = "expected a map with lanes";
    for words in [
        format!("simulate --scenario bare.tfrecord --world {world}"),
        "simulate --scenario bare.tfrecord --world idm".into(),
        format!("ablate nar --scenario bare.tfrecord --world {world}"),
        "evaluate wosac --scenarios bare.tfrecord --world idm".into(),
        "evaluate motion --scenarios bare.tfrecord --world idm".into(),
        "plan --scenario bare.tfrecord --planner idm --world log".into(),
    ] {
        place.fails(&format!("{words} --quiet --out failed"), 1, &[needs]);
    }
    let free = "simulate --scenario bare.tfrecord --world constant-velocity --futures 1";
    assert_eq!(place.results(free)["agents"], 1);
}
