//! The engine in a browser gives the same results as the native engine: the same scene, weights and
//! seed, driven by the network, in Node and natively with the portable kernel.
//!
//! The test needs Node and the engine that `cargo xtask web` builds; without them it is skipped
//! with a message.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use gump_web::{EgoDriver, Game, Input, Settings};

/// Half seconds that are compared.
const HALF_SECONDS: usize = 12;
/// Metres by which places may differ. Products are rounded once more there, and sines may differ in
/// their last bit; places are sums of bins that are drawn, and draws do not differ.
const TOLERANCE: f64 = 1e-3;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn scene() -> PathBuf {
    root().join("docs/live/scenes/crossing.tfrecord.gz")
}

/// Positions of all agents at each half second, a line each: x, y and heading relative to the ego's
/// start.
fn native() -> Vec<Vec<f64>> {
    let weights = fs::read(root().join("docs/live/gump-relative.safetensors")).unwrap();
    let scene = fs::read(scene()).unwrap();
    let mut game = Game::open(&scene, "crossing", &weights, Settings::default()).unwrap();
    let input = Input {
        driver: EgoDriver::Network,
        ..Input::default()
    };
    let half_second = |_| {
        (0..5).for_each(|_| game.tick(input).unwrap());
        let numbers = game.numbers(game.driven()).unwrap();
        numbers.into_iter().map(f64::from).collect()
    };
    (0..HALF_SECONDS).map(half_second).collect()
}

#[test]
fn the_engine_in_a_browser_answers_as_this_one_does() {
    let has_node = Command::new("node").arg("--version").output().is_ok();
    let engine = root().join("docs/live/engine/gump_web_bg.wasm");
    if !has_node || !engine.is_file() {
        let what = if has_node {
            "the engine: run `cargo xtask web`"
        } else {
            "Node"
        };
        eprintln!("SKIPPED: expected {what}, found none");
        return;
    }
    gump_web::compute_as_browsers_do().unwrap();
    let here = native();
    let there = Command::new("node")
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/drive.mjs"))
        .arg(root().join("docs/live"))
        .arg(HALF_SECONDS.to_string())
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&there.stdout);
    let error = String::from_utf8_lossy(&there.stderr);
    let start = text
        .find("ANSWERS ")
        .unwrap_or_else(|| panic!("{text}{error}"));
    let there: Vec<Vec<f64>> = serde_json::from_str(text[start + 8..].trim()).unwrap();
    assert_eq!(here.len(), HALF_SECONDS);
    let mut worst: f64 = 0.0;
    for (step, (a, b)) in here.iter().zip(&there).enumerate() {
        assert_eq!(a.len(), b.len(), "after {step} half seconds");
        for (i, (a, b)) in a.iter().zip(b).enumerate() {
            worst = worst.max((a - b).abs());
            assert!(
                (a - b).abs() < TOLERANCE,
                "half second {step}, number {i}: {a} and {b}"
            );
        }
    }
    println!("the largest difference is {worst} m");
}
