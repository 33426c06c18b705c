//! Learning as a test: a network overfits one scene, and a resumed run is the unbroken run.

use candle_core::Device;
use gump_rollout::{Start, WorldModel};
use gump_scene::{Scenario, Seed, fixture};

use crate::closed_loop::ClosedLoopConfig;
use crate::config::{ModelConfig, VisualConfig};
use crate::sample::SampleConfig;
use crate::sampling::{Mode, SamplingConfig};
use crate::train::{TrainConfig, Trainer};
use crate::world::TransformerWorld;
use crate::{LossParts, OptimizerConfig, checkpoint};

/// A scene that can be presented in one window only, or with `future_s` in several.
fn scenario(future_s: f64) -> Scenario {
    let text = format!(
        "lane 1: -100,0 100,0 speed 15
         edge: -100,-2 100,-2
         ego vehicle 0: 0,0 velocity 8,0
         agent vehicle 1: 20,0 velocity 5,0
         agent pedestrian 7: 30,3 velocity 0,-1
         agent bicycle 4: 10,5 velocity 3,0.5
         history 1.0 future {future_s} dt 0.1"
    );
    fixture::scenario(&text).unwrap()
}

fn model() -> ModelConfig {
    let visual = VisualConfig {
        side_px: 104,
        metres_per_px: 2.0,
        ..ModelConfig::tiny().visual
    };
    ModelConfig {
        width: 64,
        layers: 2,
        heads: 2,
        trajectory_heads: vec![1],
        block_size: 512,
        visual,
        ..ModelConfig::tiny()
    }
}

fn config(steps: usize) -> TrainConfig {
    let mut config = TrainConfig {
        steps,
        batch: 2,
        ..TrainConfig::default()
    };
    config.sample = SampleConfig::plain(4);
    config.optimizer = OptimizerConfig {
        learning_rate: 3e-3,
        warmup: 10,
        ..OptimizerConfig::default()
    };
    config
}

fn trainer(steps: usize, future_s: f64) -> Trainer {
    Trainer::new(
        model(),
        config(steps),
        vec![scenario(future_s)],
        &Device::Cpu,
    )
    .unwrap()
}

#[test]
fn a_resumed_run_is_the_unbroken_run() {
    let path = std::env::temp_dir().join(format!("gump-resume-{}.safetensors", std::process::id()));
    let mut unbroken = trainer(6, 2.0);
    let mut broken = trainer(6, 2.0);
    (0..3).for_each(|_| drop(broken.step().unwrap()));
    broken.save(&path).unwrap();
    drop(broken);
    let mut resumed = Trainer::resume(&path, vec![scenario(2.0)], &Device::Cpu).unwrap();
    assert_eq!(resumed.steps_done(), 3);
    let losses: Vec<f64> = (0..6)
        .map(|_| unbroken.step().unwrap().loss.total)
        .collect();
    let after: Vec<f64> = (0..3).map(|_| resumed.step().unwrap().loss.total).collect();
    assert_eq!(losses[3..], after);
    for ((name, a), (_, b)) in unbroken
        .network()
        .parameters()
        .all()
        .zip(resumed.network().parameters().all())
    {
        let bits = |v: &candle_core::Var| v.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert!(bits(a) == bits(b), "{name}");
    }
    // The same file serves as weights.
    checkpoint::load(&path, &Device::Cpu).unwrap();
    std::fs::remove_file(path).unwrap();
}

#[test]
fn a_resumed_run_drives_the_same_scenes() {
    let path = std::env::temp_dir().join(format!("gump-driven-{}.safetensors", std::process::id()));
    let network = trainer(1, 2.0).into_network();
    let mut config = config(4);
    config.closed_loop = Some(ClosedLoopConfig {
        drives: 2,
        candidates: 2,
        share: 0.9,
        ..ClosedLoopConfig::default()
    });
    let mut run = Trainer::continuing(network, config, vec![scenario(4.0)]).unwrap();
    run.step().unwrap();
    run.save(&path).unwrap();
    let mut resumed = Trainer::resume(&path, vec![scenario(4.0)], &Device::Cpu).unwrap();
    for _ in 0..3 {
        assert_eq!(
            run.step().unwrap().loss.total,
            resumed.step().unwrap().loss.total
        );
    }
    checkpoint::load(&path, &Device::Cpu).unwrap();
    std::fs::remove_file(path).unwrap();
}

#[test]
fn threads_do_not_change_what_is_learned() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| {
            let mut trainer = trainer(3, 2.0);
            (0..3)
                .map(|_| trainer.step().unwrap().loss.total)
                .collect::<Vec<_>>()
        })
    };
    assert_eq!(run(1), run(3));
}

/// Trains for `steps` on one scene; the loss at the end.
fn overfit(trainer: &mut Trainer, steps: usize) -> LossParts {
    let mut last = LossParts::default();
    for _ in 0..steps {
        last = trainer.step().unwrap().loss;
    }
    last
}

#[test]
fn a_network_overfits_one_window() {
    let last = overfit(&mut trainer(300, 0.5), 300);
    assert!(last.state < 0.05, "{last:?}");
}

#[test]
fn a_network_reproduces_the_scene_it_learned() {
    let scenario = scenario(2.0);
    let mut trainer = trainer(400, 2.0);
    overfit(&mut trainer, 400);
    let path =
        std::env::temp_dir().join(format!("gump-overfit-{}.safetensors", std::process::id()));
    trainer.save(&path).unwrap();
    for mode in [Mode::PartialAr, Mode::FullAr] {
        let sampling = SamplingConfig {
            mode,
            temperature: 0.0,
            redraws: 0,
            ..SamplingConfig::default()
        };
        let world = TransformerWorld::new(checkpoint::load(&path, &Device::Cpu).unwrap(), sampling);
        let start = Start {
            scene: scenario.present(),
            n_futures: 1,
            seed: Seed(0),
        };
        let mut session = world.open(&[start]).unwrap();
        for step in 1..=4 {
            let frames = session.step(None).unwrap();
            let logged = &scenario.log[scenario.now + 5 * step];
            for agent in frames[0].agents() {
                let expected = logged.agent(agent.id).unwrap().state.pose.position;
                let off = (agent.state.pose.position - expected).abs().max_element();
                assert!(
                    off <= 0.2,
                    "{mode:?}: agent {} is {off:.2} m off after {step} frames",
                    agent.id
                );
            }
        }
    }
    std::fs::remove_file(path).unwrap();
}
