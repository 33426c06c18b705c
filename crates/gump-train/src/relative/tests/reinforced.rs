//! Rewards in training: the divergence from the network at the start, its weight and its bound, and
//! what moves are credited with.

use std::path::Path;

use gump_scene::{Frame, LightState};

use super::*;
use crate::TrainError;

/// Two steps between changes of the weight.
fn rewards() -> RelativeRewards {
    RelativeRewards {
        rollouts: 3,
        refresh: 2,
        kl_target: Some(1e-3),
        ..RelativeRewards::default()
    }
}

fn trainer(steps: usize, rewards: RelativeRewards) -> RelativeTrainer {
    let train = RelativeTrainConfig {
        realism: Some(rewards),
        ..train_config(steps)
    };
    RelativeTrainer::new(config(), train, vec![scenario()], &Device::Cpu).unwrap()
}

fn steps(n: usize, rewards: RelativeRewards) -> Vec<RelativeStep> {
    let mut trainer = trainer(n, rewards);
    (0..n).map(|_| trainer.step().unwrap()).collect()
}

#[test]
fn the_divergence_begins_at_zero_and_its_weight_adapts() {
    let of_target = |target| RelativeRewards {
        kl_target: Some(target),
        ..rewards()
    };
    let weights = |target| -> Vec<f64> {
        let steps = steps(5, of_target(target));
        assert_eq!(steps[0].kl, Some(0.0));
        assert!(steps[1..].iter().all(|step| step.kl > Some(0.0)));
        steps.iter().map(|step| step.kl_weight.unwrap()).collect()
    };
    assert_eq!(weights(1e-9), [1.0, 1.0, 2.0, 2.0, 4.0]);
    assert_eq!(weights(1e3), [1.0, 1.0, 0.5, 0.5, 0.25]);
}

/// With weight the network stays nearer to its start; without a target nothing is computed, and
/// what is measured of the moves changes nothing.
#[test]
fn a_heavy_divergence_keeps_the_network_near() {
    let weighing = |kl_weight| RelativeRewards {
        kl_target: Some(1e-9),
        kl_weight,
        ..rewards()
    };
    let last = |kl_weight| steps(8, weighing(kl_weight)).pop().unwrap().kl.unwrap();
    let (light, heavy) = (last(1e-3), last(100.0));
    assert!(heavy < 0.5 * light, "{heavy} {light}");
    let without = RelativeRewards {
        kl_target: None,
        ..rewards()
    };
    let plain = steps(2, without);
    assert!(
        plain
            .iter()
            .all(|step| step.kl.is_none() && step.kl_weight.is_none())
    );
    // An untrained network draws all bins nearly evenly: ln 2, or that and more for the others.
    let most: f64 = grid::BINS.iter().map(|n| (*n as f64).ln()).sum();
    let entropy = plain[0].entropy.unwrap();
    assert!(entropy > 2f64.ln() && entropy < most, "{entropy}");
    assert_eq!(steps(1, rewards())[0].entropy, plain[0].entropy);
    let mut imitates =
        RelativeTrainer::new(config(), train_config(1), vec![scenario()], &Device::Cpu).unwrap();
    assert!(imitates.step().unwrap().entropy.is_none());
}

#[test]
fn a_run_that_goes_too_far_ends_before_anything_is_changed() {
    let bounded = RelativeRewards {
        kl_target: Some(1e-9),
        kl_bound: Some(2e-9),
        ..rewards()
    };
    let folder = tempfile::tempdir().unwrap();
    let saved = |trainer: &RelativeTrainer, name: &str| {
        let path = folder.path().join(name);
        trainer.save(&path).unwrap();
        std::fs::read(path).unwrap()
    };
    let mut trainer = trainer(4, bounded);
    // The first step is at the start itself.
    trainer.step().unwrap();
    let before = saved(&trainer, "before");
    for _ in 0..2 {
        let error = trainer.step().unwrap_err();
        assert!(matches!(error, TrainError::TooFar { step: 1, .. }));
        let message = error.to_string();
        let (start, end) = (
            "the divergence from the network at the start of the run is ",
            " nats a move at step 1, above kl_bound 0.000000002; the last checkpoint is intact",
        );
        assert!(
            message.starts_with(start) && message.ends_with(end),
            "{message}"
        );
        assert_eq!(trainer.steps_done(), 1);
        assert!(saved(&trainer, "after") == before);
    }
}

#[test]
fn a_resumed_run_stays_near_the_same_network() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let mut whole = trainer(6, rewards());
    // The weight is about to change: the divergence of one of two steps is known.
    (0..3).for_each(|_| _ = whole.step().unwrap());
    whole.save(&path).unwrap();
    let resume = |path: &Path| RelativeTrainer::resume(path, vec![scenario()], &Device::Cpu);
    let mut resumed = resume(&path).unwrap();
    for _ in 3..6 {
        let [one, other] = [&mut whole, &mut resumed].map(|run| run.step().unwrap());
        assert!(one.kl > Some(0.0) && one.kl_weight.is_some());
        assert_eq!(format!("{one:?}"), format!("{other:?}"));
    }
    let bytes = |trainer: &RelativeTrainer, name: &str| {
        let path = folder.path().join(name);
        trainer.save(&path).unwrap();
        std::fs::read(path).unwrap()
    };
    assert!(bytes(&whole, "whole") == bytes(&resumed, "resumed"));
    // The reference is of the start, and is beside the network that is read.
    let archive = |path: &Path| checkpoint::read(path).unwrap();
    let first = archive(&path).take(checkpoint::REFERENCE);
    let last = archive(&folder.path().join("whole")).take(checkpoint::REFERENCE);
    assert_eq!(first.len(), whole.network().parameters().all().count());
    for (name, tensor) in &first {
        let numbers = |tensor: &candle_core::Tensor| {
            let flat = tensor.flatten_all().unwrap();
            flat.to_vec1::<f32>().unwrap()
        };
        assert_eq!(numbers(tensor), numbers(&last[name]), "{name}");
    }
    assert_eq!(load(&path, &Device::Cpu).unwrap().config(), &config());
    let other = RelativeRewards {
        kl_target: None,
        ..rewards()
    };
    let plain = folder.path().join("plain");
    trainer(6, other).save(&plain).unwrap();
    assert!(archive(&plain).take(checkpoint::REFERENCE).is_empty());
}

/// Who passes at red is judged by the log's lights, which rollouts therefore show.
#[test]
fn rewarded_rollouts_show_the_lights_of_the_log() {
    let text = "lane 1: 0,0 40,0 next 2\nlane 2: 40,0 90,0\nlight 2 red: 40,0\nego vehicle 0: 30,0";
    let mut scenario = fixture::scenario(text).unwrap();
    let changes = scenario.now + 22;
    for frame in &mut scenario.log[changes..] {
        let mut lights = frame.lights().to_vec();
        lights[0].state = LightState::Green;
        *frame = Frame::new(frame.agents().to_vec(), lights);
    }
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let judged = rewards::Judged::new(&network, &rewards()).unwrap();
    let futures = judged.imagine(&scenario, Seed(2)).unwrap();
    assert_eq!(futures.len(), 3);
    for future in &futures {
        // The world steps every fifth frame.
        let steps = future.imagined().iter().zip(scenario.future()).skip(4);
        let (mut red, mut green) = (0, 0);
        for (shown, logged) in steps.step_by(5) {
            assert_eq!(shown.lights(), logged.lights());
            match shown.lights()[0].state {
                LightState::Green => green += 1,
                _ => red += 1,
            }
        }
        assert_eq!((red, green), (4, 12));
    }
}

/// The scene without lights cannot be compared with its log, so that it is counted where it is tried.
#[test]
fn groups_are_of_scenes_with_lights_where_that_is_asked() {
    let dark = fixture::scenario("lane 1: 0,0 60,0\nego vehicle 0: 10,0 velocity 8,0").unwrap();
    let text = "lane 1: 0,0 40,0 next 2\nlane 2: 40,0 90,0\nedge: 0,-3 90,-3
        light 2 red: 40,0\nego vehicle 0: 20,0 velocity 5,0";
    let lit = fixture::scenario(text).unwrap();
    let run = |share, scenes| {
        let rewards = RelativeRewards {
            lit: share,
            ..rewards()
        };
        let train = RelativeTrainConfig {
            realism: Some(rewards),
            ..train_config(3)
        };
        let mut trainer = RelativeTrainer::new(config(), train, scenes, &Device::Cpu)?;
        for _ in 0..3 {
            trainer.step()?;
        }
        Ok::<_, TrainError>(trainer.reward_exclusions().scenes)
    };
    let both = || vec![dark.clone(), dark.clone(), dark.clone(), lit.clone()];
    assert_eq!(run(1.0, both()).unwrap(), 0);
    assert!(run(0.0, both()).unwrap() > 0);
    // One in three hundred is found as well.
    let mut rare = vec![dark.clone(); 299];
    rare.push(lit.clone());
    assert_eq!(run(1.0, rare).unwrap(), 0);
    let error = run(1.0, vec![scenario()]).unwrap_err();
    assert!(matches!(error, TrainError::NoComparableScene), "{error}");
    let message = error.to_string();
    assert!(
        message.ends_with("the lights that lit asks for"),
        "{message}"
    );
}

/// All moves of a future have one weight, or each agent and move its own; a dense term lowers those
/// of agents that leave the road before they do.
#[test]
fn moves_are_weighted_as_the_settings_say() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let group = |advantage, dense| {
        let rewards = RelativeRewards {
            rollouts: 4,
            advantage,
            dense,
            ..RelativeRewards::default()
        };
        let judged = rewards::Judged::new(&network, &rewards).unwrap();
        judged.group(&scenario(), Seed(2)).unwrap().unwrap()
    };
    let weights = |advantage, dense| -> Vec<Vec<f32>> {
        let samples = group(advantage, dense).samples;
        let of = |sample: &sample::Sample| sample.targets.iter().map(|t| t.weight).collect();
        samples.iter().map(of).collect()
    };
    let scene = weights(Advantage::Scene, 0.0);
    for own in &scene {
        assert_eq!(own.len(), 5 * 16);
        assert!(own.iter().all(|weight| *weight == own[0]));
    }
    let sum: f32 = scene.iter().map(|own| own[0]).sum();
    let squares: f32 = scene.iter().map(|own| own[0] * own[0]).sum();
    assert!(
        sum.abs() < 1e-5 && (squares / 4.0 - 1.0).abs() < 1e-5,
        "{scene:?}"
    );
    let agents = weights(Advantage::Agent, 0.0);
    assert!(
        agents
            .iter()
            .any(|own| own.iter().any(|weight| *weight != own[0]))
    );
    let dense = weights(Advantage::Scene, 0.1);
    let changes: Vec<f32> = dense
        .iter()
        .zip(&scene)
        .flat_map(|(dense, plain)| dense.iter().zip(plain).map(|(dense, plain)| dense - plain))
        .collect();
    // Quarters of the weight: less than in the other futures, or more.
    assert!(changes.iter().any(|change| *change < -0.02));
    for change in changes {
        let quarters = f64::from(change) / 0.025;
        assert!((quarters - quarters.round()).abs() < 1e-3, "{change}");
    }
}

/// What an agent does in its log is no fault of its futures.
#[test]
fn who_leaves_the_road_in_the_log_may_do_so() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let text = "lane 1: 0,0 90,0\nedge: 0,-2 90,-2\nego vehicle 0: 20,0 velocity 8,0";
    let keeps = fixture::scenario(text).unwrap();
    let mut leaves = keeps.clone();
    for frame in &mut leaves.log[keeps.now + 40..] {
        let mut agents = frame.agents().to_vec();
        agents[0].state.pose.position.y -= 20.0;
        *frame = Frame::new(agents, Vec::new());
    }
    let weights = |scenario: &Scenario, dense| -> Vec<f32> {
        let rewards = RelativeRewards {
            rollouts: 6,
            dense,
            ..RelativeRewards::default()
        };
        let judged = rewards::Judged::new(&network, &rewards).unwrap();
        let samples = judged.group(scenario, Seed(2)).unwrap().unwrap().samples;
        let targets = samples.iter().flat_map(|sample| &sample.targets);
        targets.map(|target| target.weight).collect()
    };
    assert_ne!(weights(&keeps, 0.5), weights(&keeps, 0.0));
    assert_eq!(weights(&leaves, 0.5), weights(&leaves, 0.0));
}
