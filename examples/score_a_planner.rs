//! A planner of one's own, judged in three worlds: the log, reactive rules and learned agents.
//!
//! `cargo run -p examples --example score_a_planner [FILE]`. Exchange `Cruise` for
//! `gump_planner::PdmClosed::default()`, or for `InteractiveDriver::new(&learned, ...)?`, which
//! imagines before it drives.

use gump_geometry::dvec2;
use gump_model::{Device, SamplingConfig, checkpoint, world::TransformerWorld};
use gump_planner::closed_loop::drive_and_score;
use gump_rollout::BoxError;
use gump_rollout::closed_loop::*;
use gump_rollout::dynamics::Trajectory;
use gump_rollout::worlds::NuplanIdm;
use gump_scene::{EgoState, Seed};

const DATASETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../datasets");

/// Goes on straight at the speed it has.
struct Cruise;

impl Driver for Cruise {
    fn name(&self) -> &str {
        "cruise"
    }

    fn start(&mut self, _: &Mission<'_>) -> Result<(), BoxError> {
        Ok(())
    }

    fn drive(&mut self, moment: &Moment<'_>) -> Result<Trajectory, BoxError> {
        let after = |i: i64| {
            let mut state: EgoState = *moment.ego;
            state.time_us += i * 100_000;
            state.rear_axle.position = state.rear_axle * dvec2(state.speed() * 0.1 * i as f64, 0.0);
            state
        };
        Ok(Trajectory::new((0..=40).map(after).collect())?)
    }
}

fn main() -> anyhow::Result<()> {
    let shipped = format!("{DATASETS}/mini/procedural.tfrecord.gz");
    let path = std::env::args().nth(1).unwrap_or(shipped);
    let weights = format!("{DATASETS}/weights/gump-tiny.safetensors");
    let network = checkpoint::load(weights.as_ref(), &Device::Cpu)?;
    let learned = TransformerWorld::new(network, SamplingConfig::default());
    for record in gump_data::open(path.as_ref())?.take(3) {
        let mut scenario = record?.scenario;
        let map = scenario.map.clone(); // Judged on the map as it is; driving needs roadblocks.
        derive_roadblocks(&mut scenario);
        let recording = Recording::of_boxes(scenario)?;
        let (mut rules, mut model) = (NuplanIdm::default(), Imagined::new(&learned, Seed(0)));
        for world in [&mut Replayed as &mut dyn Traffic, &mut rules, &mut model] {
            let config = DriveConfig::default();
            let scored = drive_and_score(&recording, &map, world, &mut Cruise, &config)?;
            let id = &recording.scenario().id;
            println!("{id} among {}: {:.3}", world.name(), scored.score);
        }
    }
    Ok(())
}
