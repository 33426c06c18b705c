//! Futures of a scene in a reactive or a learned world, as a film.
//!
//! `cargo run -p examples --example simulate [PATH#INDEX [WEIGHTS]]` writes `out/simulate.gif`.

use std::path::Path;

use anyhow::Context as _;
use gump_model::{Device, SamplingConfig, checkpoint, world::TransformerWorld};
use gump_rollout::{SimulateConfig, Start, WorldModel, simulate, worlds::Idm};
use gump_scene::Seed;
use gump_viz::{Camera, FilmSpec, Take, grid_film};

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../datasets/mini/procedural.tfrecord.gz"
);

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let scenario = gump_data::find(&arguments.next().unwrap_or_else(|| SHIPPED.into()))?;

    // Rules and networks stand behind one trait; nothing below knows which it is.
    let world: Box<dyn WorldModel> = match arguments.next() {
        None => Box::new(Idm::default()),
        Some(weights) => {
            let network = checkpoint::load(Path::new(&weights), &Device::Cpu)?;
            Box::new(TransformerWorld::new(network, SamplingConfig::default()))
        }
    };
    let start = Start {
        scene: scenario.present(),
        n_futures: 4,
        seed: Seed(0),
    };
    let rollouts = simulate(&*world, &[start], None, &SimulateConfig::default())
        .map_err(|error| anyhow::anyhow!(error))?;

    let takes: Vec<_> = rollouts
        .iter()
        .enumerate()
        .map(|(k, rollout)| Take {
            rollout,
            label: format!("{}, future {}", world.name(), k + 1),
        })
        .collect();
    let camera = Camera::on_ego(&scenario.present(), 90.0, 400, 400);
    std::fs::create_dir_all("out").context("cannot create the folder out")?;
    let path = Path::new("out/simulate.gif");
    grid_film(&takes, &FilmSpec::new(camera))?.save(path)?;
    println!("{}: open {}", scenario.id, path.display());
    Ok(())
}
