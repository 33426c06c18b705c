//! Prints statistics of procedural scenes: sizes, speeds, turns, accelerations, and the speed of
//! generation. `cargo run -p gump-synthesis --example statistics -- [SCENES] [SEED]`, or the same of
//! the scenes in a file: `... -- FILE`

use std::collections::BTreeMap;

use gump_geometry::angle_difference;
use gump_scene::{AgentKind, Scenario, Seed};
use gump_synthesis::{SynthesisConfig, synthesize_many};

fn main() {
    let file = std::env::args().nth(1).map(std::path::PathBuf::from);
    if let Some(file) = file.filter(|file| file.exists()) {
        let records = gump_data::open(&file).expect("the file holds scenarios");
        let scenes: Vec<_> = records.flatten().map(|record| record.scenario).collect();
        print(&scenes);
        return;
    }
    let mut args = std::env::args()
        .skip(1)
        .filter_map(|arg| arg.parse::<u64>().ok());
    let (n, seed) = (args.next().unwrap_or(100), args.next().unwrap_or(0));
    let scenes = synthesize_many(&SynthesisConfig::standard(), Seed(seed), n as usize);
    print(&scenes);
}

fn print(scenes: &[Scenario]) {
    let n = scenes.len();
    let mut families: BTreeMap<&str, usize> = BTreeMap::new();
    for scene in scenes {
        let family = scene.id.rsplit_once('-').map_or("", |(family, _)| family);
        *families.entry(family).or_default() += 1;
    }
    println!("scenes {n}: {families:?}");
    for kind in AgentKind::MOVING {
        println!(
            "{} per scene: {}",
            kind.name(),
            quantiles(count(scenes, kind))
        );
    }
    let mut steps = Steps::default();
    for scene in scenes {
        steps.add(scene);
    }
    println!(
        "stationary share of vehicle steps: {:.3}",
        steps.stationary / steps.total
    );
    println!("length, m: {}", quantiles(steps.lengths));
    println!("speed of moving vehicles, m/s: {}", quantiles(steps.speeds));
    println!(
        "yaw rate of moving vehicles, rad/s: {}",
        quantiles(steps.yaw_rates)
    );
    println!("acceleration, m/s2: {}", quantiles(steps.accelerations));
}

#[derive(Default)]
struct Steps {
    total: f64,
    stationary: f64,
    lengths: Vec<f64>,
    speeds: Vec<f64>,
    yaw_rates: Vec<f64>,
    accelerations: Vec<f64>,
}

impl Steps {
    fn add(&mut self, scene: &Scenario) {
        for triple in scene.log.windows(3) {
            for middle in triple[1]
                .agents()
                .iter()
                .filter(|a| a.kind == AgentKind::Vehicle)
            {
                let (Some(before), Some(after)) =
                    (triple[0].agent(middle.id), triple[2].agent(middle.id))
                else {
                    continue;
                };
                self.total += 1.0;
                self.lengths.push(middle.length);
                if middle.state.speed() < 0.5 {
                    self.stationary += 1.0;
                    continue;
                }
                let turn = angle_difference(after.state.pose.heading, before.state.pose.heading);
                self.yaw_rates.push((turn / (2.0 * scene.dt)).abs());
                self.speeds.push(middle.state.speed());
                let gain = after.state.speed() - before.state.speed();
                self.accelerations.push(gain / (2.0 * scene.dt));
            }
        }
    }
}

fn count(scenes: &[Scenario], kind: AgentKind) -> Vec<f64> {
    let of = |scene: &Scenario| {
        let agents = scene.present().now().agents();
        agents.iter().filter(|agent| agent.kind == kind).count() as f64
    };
    scenes.iter().map(of).collect()
}

fn quantiles(mut values: Vec<f64>) -> String {
    values.sort_by(f64::total_cmp);
    let at = |q: f64| {
        values
            .get((q * (values.len() as f64 - 1.0)) as usize)
            .copied()
    };
    let names = [
        ("min", 0.0),
        ("p1", 0.01),
        ("p10", 0.1),
        ("median", 0.5),
        ("p90", 0.9),
        ("p99", 0.99),
        ("max", 1.0),
    ];
    names
        .map(|(name, q)| format!("{name} {:.3}", at(q).unwrap_or(f64::NAN)))
        .join("  ")
}
