//! A recorded scene, 32 imagined futures of it, and how good they are.
//!
//! `cargo run -p examples --example quickstart [PATH#INDEX]`. Another world is another expression
//! in the place of `ConstantVelocity`: `Idm::default()`, or a trained `TransformerWorld` (see
//! `simulate.rs`).

use gump_metrics::summarize;
use gump_rollout::{SimulateConfig, Start, simulate, worlds::ConstantVelocity};
use gump_scene::Seed;

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../datasets/mini/procedural.tfrecord.gz"
);

fn main() -> anyhow::Result<()> {
    let name = std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into());

    // A scenario is what was recorded, its future included; a scene is what an actor may see of it.
    let scenario = gump_data::find(&name)?;
    let scene = scenario.present();
    println!("{}: {} agents", scenario.id, scene.now().agents().len());

    // A world says how traffic goes on. Future k depends on its start and seed.fork(k) alone.
    let start = Start {
        scene,
        n_futures: 32,
        seed: Seed(0),
    };
    let futures = simulate(
        &ConstantVelocity,
        &[start],
        None,
        &SimulateConfig::default(),
    )
    .map_err(|error| anyhow::anyhow!(error))?;

    // Metrics judge imagined frames alone, or compare them with what was recorded.
    for (kind, part) in summarize(&futures, Some(&scenario)).by_kind {
        let percent =
            |rate: Option<f64>| rate.map_or("-".into(), |r| format!("{:.1} %", 100.0 * r));
        let metres = |x: Option<f64>| x.map_or("-".into(), |x| format!("{x:.2} m"));
        println!(
            "{:<10}  collide {:>6}  leave the road {:>6}  displacement {:>7}",
            kind.name(),
            percent(part.collision_rate()),
            percent(part.offroad_rate()),
            metres(part.ade()),
        );
    }
    Ok(())
}
