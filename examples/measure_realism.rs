//! Realism of a world by Waymo's metric, and its largest penalties.
//!
//! `cargo run -p examples --example measure_realism [FILE]`

use std::path::PathBuf;

use gump::prelude::*;
use gump::wosac::realism::{Config, Log, Mode, Reference, Rollouts, Scores, Year};

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../datasets/mini/sumo-hamburg.tfrecord.gz"
);

fn main() -> anyhow::Result<()> {
    let path = PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into()));
    let config = Config::of(Year::Y2025);
    let (straight_on, reactive) = (ConstantVelocity, Idm::default());
    let worlds: [&dyn WorldModel; 2] = [&straight_on, &reactive];
    for world in worlds {
        let (mut scores, mut largest) = (Vec::new(), None);
        for record in gump::data::open(&path)?.take(3) {
            let scenario = record?.scenario;
            let start = Start {
                scene: scenario.present().unguided(),
                n_futures: 32,
                seed: Seed(0),
            };
            let futures = simulate(world, &[start], None, &SimulateConfig::default())
                .map_err(anyhow::Error::from_boxed)?;

            // ANCHOR: score
            let log = Log::of(&scenario)?;
            let reference = Reference::new(&log, &config)?;
            let rollouts = Rollouts::of(&scenario.id, &futures, Mode::SimAgents)?;
            let evaluation = reference.evaluate(&rollouts)?;
            scores.push(evaluation.scores.clone());
            // ANCHOR_END: score
            let attribution = evaluation.explain().into_iter().next();
            largest = largest.or(attribution.map(|attribution| (scenario.id.clone(), attribution)));
        }
        if let (Some(mean), Some((id, attribution))) = (Scores::mean(&scores), largest) {
            println!("{}: realism {:.3}", world.name(), mean.metametric);
            let what = attribution.component.name().replace('_', " ");
            println!(
                "  costs most in {id}: {what} of agent {}",
                attribution.agent
            );
        }
    }
    Ok(())
}
