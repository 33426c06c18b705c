//! Gradient steps per second: `cargo bench -p gump-rl --bench sac`.

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use gump_rl::sac::{Batch, Learner, SacConfig};
use gump_scene::Seed;
use rand::Rng as _;

/// Numbers of an observation: those of the first vector views. Kept, so that times stay comparable;
/// today's default has 164.
const OBSERVATION: usize = 114;

fn batch(n: usize) -> Batch {
    let mut rng = Seed(0).rng();
    let mut draw = |n: usize| (0..n).map(|_| rng.random_range(-1.0..1.0)).collect();
    Batch {
        observations: draw(n * OBSERVATION),
        actions: draw(n * 2),
        rewards: draw(n),
        nexts: draw(n * OBSERVATION),
        terminated: vec![false; n],
        n_imitated: n / 5,
    }
}

fn updates(c: &mut Criterion) {
    let mut group = c.benchmark_group("sac update, batch 256");
    group.sample_size(20);
    let batch = batch(256);
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let one = one.expect("a pool of one thread starts");
    for width in [64, 128, 256] {
        let config = SacConfig {
            hidden: vec![width, width],
            actor_on_next: false,
            ..SacConfig::default()
        };
        let mut learner = Learner::new(config, OBSERVATION, 2, Seed(0));
        let mut step = 0;
        group.bench_function(BenchmarkId::new("one thread", width), |b| {
            b.iter(|| {
                step += 1;
                one.install(|| learner.update(&batch, Seed(step)))
            });
        });
    }
    group.finish();
}

criterion_group!(benches, updates);
criterion_main!(benches);
