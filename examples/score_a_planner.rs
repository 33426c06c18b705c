//! A planner of one's own, driven through recorded scenes among reactive traffic and scored as
//! nuPlan scores.
//!
//! `cargo run -p examples --example score_a_planner [FILE]`. The planner is the first twenty lines;
//! `main` works for any: exchange `Cruise` for `gump_planner::PdmClosed::default()`, or for
//! `Planned::new(Interactive::new(...)?, 5)` to let one imagine before it drives.

use gump_geometry::dvec2;
use gump_planner::closed_loop::drive_and_score;
use gump_rollout::BoxError;
use gump_rollout::closed_loop::{
    DriveConfig, Driver, Mission, Moment, Recording, derive_roadblocks,
};
use gump_rollout::dynamics::Trajectory;
use gump_rollout::worlds::NuplanIdm;
use gump_scene::EgoState;

/// Goes on straight at the speed it has.
struct Cruise;

impl Driver for Cruise {
    fn name(&self) -> &str {
        "cruise"
    }

    fn start(&mut self, _: &Mission<'_>) -> Result<(), BoxError> {
        Ok(())
    }

    fn drive(&mut self, moment: &Moment<'_>) -> Result<Trajectory, BoxError> {
        let after = |i: i64| {
            let mut state = EgoState {
                time_us: moment.ego.time_us + i * 100_000,
                ..*moment.ego
            };
            state.rear_axle.position = state.rear_axle * dvec2(state.speed() * 0.1 * i as f64, 0.0);
            state
        };
        Ok(Trajectory::new((0..=40).map(after).collect())?)
    }
}

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../datasets/mini/procedural.tfrecord.gz"
);

fn main() -> anyhow::Result<()> {
    let path = std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into());
    for record in gump_data::open(path.as_ref())?.take(5) {
        let mut scenario = record?.scenario;
        // Drives are judged on the map as it is; driving needs roadblocks, which not all have.
        let map = scenario.map.clone();
        derive_roadblocks(&mut scenario);
        let recording = Recording::of_boxes(scenario)?;
        let mut traffic = NuplanIdm::default();
        let config = DriveConfig::default();
        match drive_and_score(&recording, &map, &mut traffic, &mut Cruise, &config) {
            Ok(scored) => {
                println!("{}: {:.3}", recording.scenario().id, scored.score);
                for (metric, score) in scored.metrics.scores() {
                    println!(
                        "    {metric} {}",
                        score.map_or("-".into(), |s| format!("{s:.3}"))
                    );
                }
            }
            Err(error) => println!("{}: {error}", recording.scenario().id),
        }
    }
    Ok(())
}
