//! Generates synthetic scenes of a chosen kind: busy roundabouts, written in Waymo's format.
//!
//! `cargo run -p gump-synthesis --example make_scenes` writes `out/roundabouts.tfrecord`.

use std::error::Error;
use std::path::Path;

use gump_data::womd;
use gump_scene::Seed;
use gump_synthesis::{RoadFamily, SynthesisConfig, synthesize_many};

fn main() -> Result<(), Box<dyn Error>> {
    // ANCHOR: make
    let config = SynthesisConfig {
        family: Some(RoadFamily::Roundabout),
        vehicles: 40..=60,
        ..SynthesisConfig::standard()
    };
    let scenes = synthesize_many(&config, Seed(7), 4);
    // ANCHOR_END: make
    for scene in &scenes {
        let present = scene.present();
        let agents = present.now().agents();
        let moving = agents.iter().filter(|agent| agent.state.speed() > 0.5);
        println!(
            "{}: {} agents, {} of them moving, the ego at {:.1} m/s",
            scene.id,
            agents.len(),
            moving.count(),
            present.ego_now().state.speed()
        );
    }
    let path = Path::new("out/roundabouts.tfrecord");
    std::fs::create_dir_all("out")?;
    womd::write_scenarios(path, &scenes)?;
    println!(
        "{} scenes in {}",
        gump_data::open(path)?.count(),
        path.display()
    );
    Ok(())
}
