//! Your own policy drives the ego in two worlds, to see whether traffic reacts to it.
//!
//! `cargo run -p examples --example brake_for_nobody [FILE#INDEX]`

use gump::prelude::*;

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../datasets/mini/procedural.tfrecord.gz#14"
);

/// Brakes to a halt in the middle of the road, whatever the road is like.
struct BrakeForNobody;

impl Policy for BrakeForNobody {
    fn name(&self) -> &str {
        "brake-for-nobody"
    }

    fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError> {
        let brake = |_| Command::Drive {
            acceleration: -4.0,
            curvature: 0.0,
        };
        Ok(scenes.iter().map(brake).collect())
    }
}

fn main() -> anyhow::Result<()> {
    let name = std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into());
    let scenario = gump::data::find(&name)?;
    let speed = scenario.present().ego_now().state.speed();
    println!("{}: the ego brakes from {speed:.1} m/s", scenario.id);

    // The log goes on as it was recorded; drivers of the other world look ahead.
    let (log, reactive) = (LogReplay::new(&scenario), Idm::default());
    let worlds: [&dyn WorldModel; 2] = [&log, &reactive];
    for world in worlds {
        let start = Start {
            scene: scenario.present(),
            n_futures: 8,
            seed: Seed(0),
        };
        let config = SimulateConfig::default();
        let futures = simulate(world, &[start], Some(&mut BrakeForNobody), &config)
            .map_err(anyhow::Error::from_boxed)?;
        let summary = summarize(&futures, None);
        let rate = summary.total().collision_rate().unwrap_or(f64::NAN);
        println!(
            "among {}: {:.1} % of agents collide",
            world.name(),
            100.0 * rate
        );
    }
    Ok(())
}
