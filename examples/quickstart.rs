//! Simulates 32 futures of a recorded scene, scores them and draws a picture.
//!
//! `cargo run -p examples --example quickstart [FILE#INDEX]` writes `out/quickstart.png`.

use std::path::Path;

use gump::prelude::*;
use gump::viz::{Camera, PictureSpec, draw_futures};

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../datasets/mini/procedural.tfrecord.gz#22"
);

fn main() -> anyhow::Result<()> {
    // A scenario is what was recorded, its future included; a scene is what an actor may see.
    let name = std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into());
    let scenario = gump::data::find(&name)?;
    let scene = scenario.present();
    println!("{}: {} agents", scenario.id, scene.now().agents().len());

    // A world says how traffic goes on; these two follow rules, `simulate.rs` takes a learned one.
    let (straight_on, reactive) = (ConstantVelocity, Idm::default());
    let worlds: [&dyn WorldModel; 2] = [&straight_on, &reactive];
    for world in worlds {
        // Future k depends on its start and seed.fork(k) alone, never on its neighbours.
        let start = Start {
            scene,
            n_futures: 32,
            seed: Seed(0),
        };
        let futures = simulate(world, &[start], None, &SimulateConfig::default())
            .map_err(anyhow::Error::from_boxed)?;

        // Metrics judge what was imagined; displacements compare it with the log.
        let all = summarize(&futures, Some(&scenario)).total();
        println!("{} over {} futures", world.name(), futures.len());
        for (what, value) in [
            ("share of agents that collide", all.collision_rate()),
            ("share of vehicles that leave the road", all.offroad_rate()),
            ("displacement from the log, m", all.ade()),
        ] {
            let value = value.map_or("not defined".into(), |value| format!("{value:.3}"));
            println!("  {what}: {value}");
        }

        // The scene now, and a thin trail per agent and future. The last world's picture stays.
        let camera = Camera::on_ego(&scene, 100.0, 800, 800);
        let trails: Vec<_> = futures.iter().map(Rollout::imagined).collect();
        let spec = PictureSpec::new(camera).with_label(world.name());
        std::fs::create_dir_all("out")?;
        draw_futures(&scene, &trails, &spec).save_png(Path::new("out/quickstart.png"))?;
    }
    println!("open out/quickstart.png");
    Ok(())
}
