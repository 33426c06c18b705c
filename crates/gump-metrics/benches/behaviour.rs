//! The time to count the behaviour of 32 futures of 45 agents over 8 s.

use std::fmt::Write as _;
use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use gump_metrics::behaviour::Behaviour;
use gump_metrics::logged;
use gump_scene::{Rollout, Scenario, fixture};

/// Three lanes side by side, cars on them and parked beside, people who cross, and a light.
fn street() -> Scenario {
    let mut text = String::from("ego vehicle 0: 0,0 velocity 8,0\n");
    for lane in 0..3 {
        let y = 3.5 * f64::from(lane);
        let points: Vec<String> = (-50..150).map(|x| format!("{},{y}", 3 * x)).collect();
        writeln!(text, "lane {}: {}", lane + 1, points.join(" ")).expect("text grows");
    }
    writeln!(text, "light 1 red: 60,0\nlight 2 green: 60,3.5").expect("text grows");
    for i in 1..45 {
        let (x, lane) = (f64::from(9 * (i / 3)), f64::from(i % 3));
        let agent = match i % 5 {
            0 => format!("agent vehicle {i}: {x},-6"),
            1 => format!("agent pedestrian {i}: {x},-9 velocity 0,1.2"),
            _ => format!(
                "agent vehicle {i}: {x},{} velocity {},0",
                3.5 * lane,
                4.0 + lane
            ),
        };
        writeln!(text, "{agent}").expect("text grows");
    }
    fixture::scenario(&text).expect("the street is sound")
}

fn counting(criterion: &mut Criterion) {
    let scenario = street();
    let rollouts: Vec<Rollout> = vec![logged(&scenario); 32];
    criterion.bench_function("behaviour of 32 futures", |bencher| {
        bencher.iter(|| Behaviour::new(&scenario, 8).tally(black_box(&rollouts)));
    });
}

criterion_group!(benches, counting);
criterion_main!(benches);
