//! The game without a browser: shipped scenes and weights, driven by hand and by the other drivers.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::{Path, PathBuf};

use gump_web::{
    EgoDriver, FUTURES, Game, HEAD, Input, MAX_FRAMES, STEPS, Settings, decode, encode,
};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn scene() -> Vec<u8> {
    fs::read(root().join("datasets/mini/procedural.tfrecord.gz")).unwrap()
}

fn weights() -> Vec<u8> {
    fs::read(root().join("datasets/weights/gump-relative.safetensors")).unwrap()
}

fn game(settings: Settings) -> Game {
    Game::open(&scene(), "procedural", &weights(), settings).unwrap()
}

/// Gas, a wide turn, the network, rules, and a bolder world.
fn inputs(n: usize) -> Vec<Input> {
    let input = |i: usize| Input {
        driver: match i {
            20..30 => EgoDriver::Network,
            30..37 => EgoDriver::Idm,
            37..43 => EgoDriver::Pdm,
            _ => EgoDriver::Hand,
        },
        pedal: if i < 15 { 80 } else { -30 },
        wheel: (i % 7) as i8 * 5 - 15,
        temperature: if i < 40 { 20 } else { 26 },
        reverse: false,
    };
    (0..n).map(input).collect()
}

fn drive(game: &mut Game, inputs: &[Input]) {
    for &input in inputs {
        game.tick(input).unwrap();
    }
}

fn ego_metres(game: &Game) -> f64 {
    let at = |frame: usize| {
        let scene = game.at(frame).unwrap();
        scene.ego_now().state.pose.position
    };
    at(0).distance(at(game.driven()))
}

#[test]
fn whoever_drives_gets_somewhere_and_the_others_move() {
    for driver in EgoDriver::ALL {
        let mut game = game(Settings::default());
        let input = Input {
            driver,
            pedal: 50,
            ..Input::default()
        };
        drive(&mut game, &[input; 40]);
        assert_eq!(game.driven(), 40);
        // The others wait where they see a reason to.
        let least = if driver == EgoDriver::Hand { 2.0 } else { 0.1 };
        assert!(
            ego_metres(&game) > least,
            "{driver:?}: {}",
            ego_metres(&game)
        );
        let (before, now) = (game.at(0).unwrap(), game.at(40).unwrap());
        let moved = now.now().agents().iter().filter(|agent| {
            let was = before.now().agent(agent.id).unwrap();
            was.state.pose.position.distance(agent.state.pose.position) > 1.0
        });
        assert!(moved.count() > 5, "{driver:?}");
        // Nobody jumps: at most 45 m/s.
        for pair in game.scene().history.windows(2) {
            for agent in pair[1].agents() {
                let Some(was) = pair[0].agent(agent.id) else {
                    continue;
                };
                let step = was.state.pose.position.distance(agent.state.pose.position);
                assert!(step < 4.5, "{driver:?}: {} moves {step} m", agent.id);
            }
        }
    }
}

#[test]
fn a_link_gives_the_same_drive_to_the_bit() {
    let settings = Settings {
        seed: 7,
        density: 0.7,
    };
    let mut first = game(settings);
    drive(&mut first, &inputs(47));
    let code = first.code();
    let mut again = game(settings);
    drive(&mut again, &decode(&code, MAX_FRAMES).unwrap());
    assert_eq!(again.fingerprint(), first.fingerprint());
    assert_eq!(encode(again.inputs()), code);
    let mut other = game(Settings {
        seed: 8,
        ..settings
    });
    drive(&mut other, &inputs(47));
    assert_ne!(other.fingerprint(), first.fingerprint());
}

#[test]
fn reverse_gear_brakes_stands_and_drives_backwards() {
    let mut game = game(Settings::default());
    let press = |pedal: i8, wheel: i8, reverse: bool| Input {
        pedal,
        wheel,
        reverse,
        ..Input::default()
    };
    let ego = |game: &Game| game.scene().ego_now().state;
    let forward = |game: &Game| ego(game).velocity.dot(ego(game).pose.direction());
    drive(&mut game, &[press(100, 0, false); 10]);
    // With the brake alone, the car stands still for as long as it is held.
    drive(&mut game, &[press(-100, 0, false); 40]);
    assert_eq!(forward(&game), 0.0);
    let stood = ego(&game).pose;
    drive(&mut game, &[press(-100, 0, true); 40]);
    assert!((forward(&game) + 5.0).abs() < 1e-9, "{}", forward(&game));
    let off = stood.inverse() * ego(&game).pose;
    assert!(off.position.x < -10.0 && off.position.y.abs() < 1e-6);
    // The wheel to the left takes the rear to the left.
    drive(&mut game, &[press(-50, 60, true); 10]);
    let off = stood.inverse() * ego(&game).pose;
    assert!(off.position.y > 0.1 && off.heading < 0.0, "{off:?}");
    // Gas in reverse brakes; without the gear it drives on forwards.
    drive(&mut game, &[press(100, 0, true); 15]);
    assert_eq!(forward(&game), 0.0);
    assert!(game.numbers(90).unwrap()[1] < 0.0);
    drive(&mut game, &[press(100, 0, false); 10]);
    assert!(forward(&game) > 1.0);
    // A link encodes the gear, and stays in version 1 without it.
    let mut again = self::game(Settings::default());
    drive(&mut again, &decode(&game.code(), MAX_FRAMES).unwrap());
    assert_eq!(again.fingerprint(), game.fingerprint());
    assert!(game.code().starts_with("Ag") && encode(&inputs(47)).starts_with("AQ"));
}

#[test]
fn a_drive_that_was_taken_back_goes_on_as_one_that_was_not() {
    let inputs = inputs(100);
    let mut straight = game(Settings::default());
    drive(&mut straight, &inputs);
    for moment in [0, 5, 23, 33, 38, 40, 88, 99] {
        let mut taken = game(Settings::default());
        drive(&mut taken, &inputs);
        taken.rewind(moment).unwrap();
        assert_eq!(taken.driven(), moment);
        drive(&mut taken, &inputs[moment..]);
        assert_eq!(taken.fingerprint(), straight.fingerprint(), "from {moment}");
        assert_eq!(taken.events(), straight.events());
    }
    assert!(
        straight
            .rewind(101)
            .unwrap_err()
            .to_string()
            .contains("10.1 s has not been driven")
    );
}

#[test]
fn eight_futures_begin_alike_and_the_drive_knows_nothing_of_them() {
    let mut game = game(Settings::default());
    let inputs = inputs(40);
    drive(&mut game, &inputs[..33]);
    let before = game.fingerprint();
    game.branch(27).unwrap();
    while game.go_on_branching() {}
    let branches = game.branches().unwrap();
    assert_eq!(branches.from_frame(), 25);
    assert_eq!(branches.progress(), (FUTURES * STEPS, FUTURES * STEPS));
    let ends = branches.all().iter().map(|branch| {
        assert_eq!(branch.frames.len(), STEPS + 1);
        assert_eq!(branch.frames[0], *game.at(25).unwrap().now());
        format!("{:?}", branch.frames[STEPS].agents())
    });
    let ends: std::collections::BTreeSet<_> = ends.collect();
    assert_eq!(ends.len(), FUTURES);
    assert_eq!(game.fingerprint(), before);
    assert_eq!(
        game.branch_numbers(0).len(),
        2 + game.scenario().present().now().agents().len() * (3 + 3 * (STEPS + 1))
    );
    drive(&mut game, &inputs[33..]);
    let mut straight = self::game(Settings::default());
    drive(&mut straight, &inputs);
    assert_eq!(game.fingerprint(), straight.fingerprint());
}

#[test]
fn fewer_are_fewer_of_the_same() {
    let agents = |density: f64| {
        let game = game(Settings { seed: 1, density });
        let scene = game.scene();
        let ids: Vec<_> = scene.now().agents().iter().map(|agent| agent.id).collect();
        assert!(ids.contains(&scene.ego));
        ids
    };
    let (none, some, all) = (agents(0.0), agents(0.5), agents(1.0));
    assert_eq!(none.len(), 1);
    assert!(some.len() > all.len() / 4 && some.len() < all.len() * 3 / 4);
    assert!(some.iter().all(|id| all.contains(id)));
}

#[test]
fn a_drive_is_scored_and_drawn() {
    let mut game = game(Settings::default());
    assert!(
        game.score()
            .unwrap_err()
            .to_string()
            .contains("two seconds")
    );
    let input = Input {
        driver: EgoDriver::Network,
        ..Input::default()
    };
    drive(&mut game, &[input; 79]);
    assert!(
        game.realism()
            .unwrap_err()
            .to_string()
            .contains("eight seconds")
    );
    drive(&mut game, &[input; 41]);
    let score = game.score().unwrap();
    assert!((0.0..=1.0).contains(&score.total), "{}", score.total);
    assert_eq!(score.parts.len(), 8);
    let realism = game.realism().unwrap();
    assert!((0.3..1.0).contains(&realism), "{realism}");
    let summary: serde_json::Value = serde_json::from_str(&game.summary().unwrap()).unwrap();
    assert_eq!(summary["seconds"], 12.0);
    assert_eq!(summary["compared_seconds"], 8.0);
    let road: serde_json::Value = serde_json::from_str(&game.road()).unwrap();
    assert!(!road["lanes"].as_array().unwrap().is_empty());
    let numbers = game.numbers(120).unwrap();
    assert_eq!(numbers[0], 120.0);
    let agents = numbers[3] as usize;
    assert_eq!(
        numbers.len(),
        HEAD + agents * gump_web::AGENT + numbers[4] as usize
    );
    let fans = game.fan_numbers(0..4);
    assert!(!fans.is_empty() && fans.len().is_multiple_of(4 * gump_web::WAY));
}

#[test]
fn what_the_page_cannot_take_is_told_in_a_sentence() {
    let check = |scene: &[u8], weights: &[u8], settings: Settings, expected: &str| {
        let error = Game::open(scene, "dropped.json", weights, settings).unwrap_err();
        let error = error.to_string();
        assert!(error.contains(expected), "{error}");
        assert!(error.ends_with('.'), "{error}");
    };
    let usual = Settings::default();
    check(b"hello", &weights(), usual, "cannot be read as a scene");
    check(b"", &weights(), usual, "empty file");
    check(&scene(), b"hello", usual, "weights cannot be used");
    let density = 2.0;
    check(
        &scene(),
        &weights(),
        Settings { density, ..usual },
        "between 0 and 1",
    );
    let mut cut = weights();
    cut.truncate(cut.len() / 2);
    check(&scene(), &cut, usual, "weights cannot be used");
}

/// The page that is served is built from the sources that lie beside this test.
#[test]
fn the_page_that_is_served_is_that_of_the_sources() {
    let live = root().join("docs/live");
    let page = fs::read_dir(root().join("crates/gump-web/page")).unwrap();
    let mut sources: Vec<_> = page.map(|entry| entry.unwrap().path()).collect();
    sources.retain(|path| !path.ends_with("scenes.json"));
    // What the page shares with the viewer.
    sources.push(root().join("crates/gump-viz/src/traffic.js"));
    assert!(sources.len() >= 8, "only {} files", sources.len());
    for source in sources {
        let served = live.join(source.file_name().unwrap());
        let is_same = fs::read(&served).ok() == Some(fs::read(&source).unwrap());
        assert!(
            is_same,
            "{} differs: run `cargo xtask web --keep-engine`",
            served.display()
        );
    }
    let manifest = fs::read(live.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    let scenes = manifest["scenes"].as_array().unwrap();
    for listed in scenes.iter().chain([&manifest["weights"]]) {
        let file = listed["file"].as_str().unwrap();
        let bytes = fs::read(live.join(file)).unwrap();
        assert_eq!(listed["sha256"], gump_web::checksum(&bytes), "{file}");
    }
    let shipped = gump_web::checksum(&weights());
    assert_eq!(
        manifest["weights"]["sha256"], shipped,
        "other weights are shipped: run `cargo xtask web`"
    );
}
