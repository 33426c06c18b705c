//! A planner that imagines, what it weighs, and how it drives.
//!
//! `cargo run -p examples --example score_a_planner [FILE#INDEX]`. A planner of your own takes the
//! place of `Interactive` by implementing `gump_planner::Planner`.

use gump_planner::{Interactive, InteractiveConfig, Planner, PlannerPolicy, planning_reward};
use gump_rollout::{SimulateConfig, Start, simulate, worlds::Idm};
use gump_scene::Seed;

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../datasets/mini/procedural.tfrecord.gz#22"
);

fn main() -> anyhow::Result<()> {
    let name = std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into());
    let scenario = gump_data::find(&name)?;
    let scene = scenario.present();

    // The planner makes proposals, drives each through the world, where others answer it, and
    // takes the best over four futures. It keeps all of them, so that a choice can be explained.
    let world = Idm::default();
    let mut planner = Interactive::new(&world, InteractiveConfig::default())?;
    let plan = planner.plan(&scene)?;
    for (i, candidate) in plan.candidates.iter().enumerate() {
        let mark = if i == plan.chosen { '>' } else { ' ' };
        // The emergency brake, the last resort, is not imagined and has no score.
        let score = candidate.score.as_ref().map_or(f64::NAN, |s| s.mean);
        println!("{mark} {score:.3}  {:?}", candidate.proposal.kind);
    }

    // In closed loop it plans afresh at every step. Here the traffic it meets is the traffic it
    // imagines; another world in this place is the harder test.
    let mut policy = PlannerPolicy::new(planner);
    let start = Start {
        scene,
        n_futures: 1,
        seed: Seed(0),
    };
    let config = SimulateConfig {
        seconds: 4.0,
        ..SimulateConfig::default()
    };
    let driven = simulate(&world, &[start], Some(&mut policy), &config)
        .map_err(anyhow::Error::from_boxed)?;

    // The reward it planned with, now over what it did, with its parts.
    for rollout in &driven {
        let score = planning_reward().over_rollout(rollout, scenario.ego);
        println!("4 s of driving score {:.3}", score.total);
        for gate in &score.gates {
            println!("  times {} for {}", gate.factor, gate.name);
        }
        for term in &score.terms {
            println!("  plus {:.3} from {}", term.contribution(), term.name);
        }
    }
    Ok(())
}
