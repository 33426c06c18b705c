//! Simulates futures of a scene in a learned world and writes them as a film.
//!
//! `cargo run -p examples --example simulate [WEIGHTS] [FILE#INDEX]` writes `out/simulate.gif`.
//! Weights are a file written by `cargo xtask train`; the default are the shipped ones.

use std::path::Path;

use gump::prelude::*;
use gump::viz::{Camera, FilmSpec, LabelledRollout, grid_film, log_as_rollout};

const DATASETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../datasets");

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let mut next = |shipped| arguments.next().unwrap_or(format!("{DATASETS}/{shipped}"));
    let weights = next("weights/gump-tiny.safetensors");
    let scenario = gump::data::find(&next("mini/procedural.tfrecord.gz#22"))?;
    let scene = scenario.present();

    // ANCHOR: imagine
    // A file of weights holds its configuration and needs nothing else. From here on the network
    // is a world like any other: whatever takes `&dyn WorldModel` takes it.
    let network = checkpoint::load(Path::new(&weights), &Device::Cpu)?;
    let world = TransformerWorld::new(network, SamplingConfig::default());
    let start = Start {
        scene,
        n_futures: 3,
        seed: Seed(0),
    };
    let futures = simulate(&world, &[start], None, &SimulateConfig::default())
        .map_err(anyhow::Error::from_boxed)?;
    // ANCHOR_END: imagine

    // The log, in the form in which futures come, and the futures beside it.
    let log = log_as_rollout(&scenario);
    let mut takes = vec![LabelledRollout {
        rollout: &log,
        label: "log".into(),
    }];
    takes.extend(
        futures
            .iter()
            .enumerate()
            .map(|(k, rollout)| LabelledRollout {
                rollout,
                label: format!("future {}", k + 1),
            }),
    );
    let spec = FilmSpec {
        columns: 2,
        ..FilmSpec::new(Camera::on_ego(&scene, 90.0, 400, 400))
    };
    std::fs::create_dir_all("out")?;
    grid_film(&takes, &spec)?.save(Path::new("out/simulate.gif"))?;
    println!(
        "{}: {} futures, open out/simulate.gif",
        scenario.id,
        futures.len()
    );
    Ok(())
}
