//! Prints every candidate of a planner in one scene with its score, and the choice.
//!
//! `cargo run -p gump-planner --example explain_a_choice [FILE#INDEX]`

use gump_nuplan::closed_loop::{Recording, derive_roadblocks};
use gump_planner::closed_loop::plan_once;
use gump_planner::{Explain, InteractiveDriver, InteractiveDriverConfig};
use gump_rollout::BoxError;
use gump_rollout::worlds::Idm;

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../../datasets/mini/procedural.tfrecord.gz#17"
);

const GATES: [&str; 3] = [
    "no_at_fault_collisions",
    "drivable_area",
    "driving_direction",
];

fn main() -> Result<(), BoxError> {
    let name = std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into());
    let mut scenario = gump_data::find(&name)?;
    derive_roadblocks(&mut scenario);
    let recording = Recording::of_boxes(scenario)?;

    // Any world will do.
    let world = Idm::default();
    let mut planner = InteractiveDriver::new(&world, InteractiveDriverConfig::default())?;
    plan_once(&recording, &mut planner)?;
    let Some(decision) = planner.decision() else {
        return Err("a planner that planned has decided".into());
    };

    let speed = recording.ego_at(0).speed();
    println!("{}: the ego drives {speed:.1} m/s", recording.scenario().id);
    println!("   score  progress, m  comfort  candidate");
    for (i, candidate) in decision.candidates.iter().enumerate() {
        let parts = candidate.score.parts();
        let comfort = parts.iter().find(|(name, _)| *name == "comfort");
        // A gate is a factor: 0 where something happened in all imagined futures.
        let closed = parts
            .iter()
            .find(|(name, factor)| GATES.contains(name) && *factor < 1.0);
        println!(
            "{} {:6.3} {:12.1} {:8.2}  {}{}",
            if i == decision.chosen { '>' } else { ' ' },
            candidate.value,
            candidate.progress_m,
            comfort.map_or(f64::NAN, |(_, value)| *value),
            candidate.kind,
            closed.map_or(String::new(), |(name, _)| format!(" ({name})")),
        );
    }
    // It may still brake.
    println!("chosen: {}", decision.candidates[decision.chosen].kind);
    Ok(())
}
