//! Finds the scenes of a file or folder in which the ego comes closest to another agent.
//!
//! `cargo run -p gump-data --example closest_calls [PATH]`, in any readable format.

use std::error::Error;
use std::path::PathBuf;

use gump_scene::{AgentKind, Scenario};

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../../datasets/mini/sumo-peachtree.tfrecord.gz"
);

/// The smallest gap between the boxes of the ego and of anyone else, metres; when it is, seconds
/// from now; and what the other is.
fn closest(scenario: &Scenario) -> Option<(f64, f64, AgentKind)> {
    let mut closest: Option<(f64, f64, AgentKind)> = None;
    for (step, frame) in scenario.log.iter().enumerate() {
        let Some(ego) = frame.agent(scenario.ego) else {
            continue; // An absent agent is absent: there are no validity masks.
        };
        let time = (step as f64 - scenario.now as f64) * scenario.dt;
        for other in frame.agents().iter().filter(|other| other.id != ego.id) {
            let gap = ego.oriented_box().signed_distance(&other.oriented_box());
            if closest.is_none_or(|(least, ..)| gap < least) {
                closest = Some((gap, time, other.kind));
            }
        }
    }
    closest
}

fn main() -> Result<(), Box<dyn Error>> {
    let path = PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into()));
    let mut found = Vec::new();
    // ANCHOR: read
    for record in gump_data::open(&path)? {
        let scenario = record?.scenario;
        if let Some((gap, time, kind)) = closest(&scenario) {
            found.push((gap, time, kind, scenario.id));
        }
    }
    // ANCHOR_END: read
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    println!("{} scenes, the closest calls first", found.len());
    for (gap, time, kind, id) in found.iter().take(5) {
        println!("{gap:6.2} m to a {} at {time:+.1} s in {id}", kind.name());
    }
    Ok(())
}
