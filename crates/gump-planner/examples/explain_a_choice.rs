//! Everything a planner considered in one scene, and why it chose what it chose.
//!
//! `cargo run -p gump-planner --example explain_a_choice [FILE#INDEX]`

use std::error::Error;

use gump_planner::{Interactive, InteractiveConfig, Planner};
use gump_rollout::worlds::Idm;

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../../datasets/mini/procedural.tfrecord.gz#17"
);

fn main() -> Result<(), Box<dyn Error>> {
    let name = std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into());
    let scenario = gump_data::find(&name)?;
    let scene = scenario.present();

    // Any world will do; a learned one takes the same place.
    let world = Idm::default();
    let mut planner = Interactive::new(&world, InteractiveConfig::default())?;
    let plan = planner.plan(&scene)?;

    let speed = scene.ego_now().state.speed();
    println!("{}: the ego drives {speed:.1} m/s", scenario.id);
    println!("  reward  progress, m  comfort  proposal");
    for (i, candidate) in plan.candidates.iter().enumerate() {
        let Some(score) = &candidate.score else {
            continue; // The emergency brake is chosen without being imagined.
        };
        let parts = score.parts();
        let part = |wanted| parts.iter().find(|(name, _)| *name == wanted);
        let value = |wanted| part(wanted).map_or(f64::NAN, |(_, value)| *value);
        // A gate is a factor: 0 where something happened in all imagined futures.
        let closed = parts.iter().find(|(name, factor)| {
            ["collision", "off_road", "red_light"].contains(name) && *factor < 1.0
        });
        println!(
            "{} {:6.3} {:12.1} {:8.2}  {}{}",
            if i == plan.chosen { '>' } else { ' ' },
            score.mean,
            value("progress_m"),
            value("comfort"),
            candidate.proposal.kind,
            closed.map_or(String::new(), |(name, _)| format!(" ({name})")),
        );
    }
    println!("chosen: {}", plan.choice().proposal.kind);
    Ok(())
}
