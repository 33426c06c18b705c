//! Scores your own planner in three worlds: the log, reactive rules and learned agents.
//!
//! `cargo run -p examples --example score_a_planner [FILE]`. Replace `Cruise` by
//! `PdmClosed::default()`, or by `InteractiveDriver::new(&learned, ...)?`, which uses rollouts.

use gump::prelude::*;

const DATASETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../datasets");

// ANCHOR: driver
/// Goes on straight at the speed it has.
struct Cruise;

impl Driver for Cruise {
    fn name(&self) -> &str {
        "cruise"
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let speed = input.ego.speed();
        let states = (0..=40).map(|i| EgoState {
            time_us: input.ego.time_us + 100_000 * i,
            rear_axle: input.ego.rear_axle * Pose::new(0.1 * speed * i as f64, 0.0, 0.0),
            ..*input.ego
        });
        Ok(Trajectory::new(states.collect())?)
    }
}
// ANCHOR_END: driver

fn main() -> anyhow::Result<()> {
    let shipped = format!("{DATASETS}/mini/procedural.tfrecord.gz");
    let path = std::env::args().nth(1).unwrap_or(shipped);
    let weights = format!("{DATASETS}/weights/gump-tiny.safetensors");
    let network = checkpoint::load(weights.as_ref(), &Device::Cpu)?;
    let learned = TransformerWorld::new(network, SamplingConfig::default());
    for record in gump::data::open(path.as_ref())?.take(3) {
        let scenario = record?.scenario;
        let (mut rules, mut model) = (
            NuplanIdm::default(),
            ImaginedTraffic::new(&learned, Seed(0)),
        );
        for world in [&mut Replayed as &mut dyn Traffic, &mut rules, &mut model] {
            // ANCHOR: score
            let config = DriveConfig::default();
            let score = drive_scenario(&scenario, world, &mut Cruise, &config)?.score;
            println!("{} among {}: {score:.3}", scenario.id, world.name());
            // ANCHOR_END: score
        }
    }
    Ok(())
}
