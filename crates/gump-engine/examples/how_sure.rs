//! The network's uncertainty: the spread of each agent's simulated positions after some seconds.
//!
//! `cargo run -p gump-engine --example how_sure [WEIGHTS] [FILE#INDEX]`

use std::path::Path;

use gump_engine::SamplingConfig;
use gump_engine::TransformerWorld;
use gump_geometry::DVec2;
use gump_model::{Device, checkpoint};
use gump_rollout::{BoxError, SimulateConfig, Start, simulate};
use gump_scene::Seed;

const DATASETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../datasets");

fn main() -> Result<(), BoxError> {
    let mut arguments = std::env::args().skip(1);
    let mut next = |shipped| arguments.next().unwrap_or(format!("{DATASETS}/{shipped}"));
    let weights = next("weights/gump-tiny.safetensors");
    let scenario = gump_data::find(&next("mini/procedural.tfrecord.gz#17"))?;
    let scene = scenario.present();

    // ANCHOR: imagine
    let network = checkpoint::load(Path::new(&weights), &Device::Cpu)?;
    println!("{} parameters", network.parameters().count());
    let world = TransformerWorld::new(network, SamplingConfig::default());
    let start = Start {
        scene,
        n_futures: 16,
        seed: Seed(0),
    };
    let config = SimulateConfig {
        seconds: 4.0,
        ..SimulateConfig::default()
    };
    let futures = simulate(&world, &[start], None, &config)?;
    // ANCHOR_END: imagine

    // Root mean square distance from where the futures have an agent on average.
    let mut spread = Vec::new();
    for agent in scene.now().agents() {
        let ends = futures
            .iter()
            .filter_map(|future| future.last().now().agent(agent.id));
        let ends: Vec<DVec2> = ends.map(|end| end.state.pose.position).collect();
        let mean = ends.iter().sum::<DVec2>() / ends.len() as f64;
        let squares = ends
            .iter()
            .map(|end| end.distance_squared(mean))
            .sum::<f64>();
        spread.push(((squares / ends.len() as f64).sqrt(), agent));
    }
    spread.sort_by(|a, b| b.0.total_cmp(&a.0));
    println!("{}: the least certain after 4 s", scenario.id);
    for (metres, agent) in spread.iter().take(5) {
        let (kind, speed) = (agent.kind.name(), agent.state.speed());
        println!("{metres:5.1} m  {kind} {} at {speed:.1} m/s", agent.id);
    }
    Ok(())
}
