//! The relative network: training against rollouts, resumed against uninterrupted runs.

use std::sync::Arc;

use candle_core::Device;
use gump_engine::relative::{RelativeSampling, RelativeWorld};
use gump_geometry::{Pose, dvec2};
use gump_model::checkpoint;
use gump_model::relative::graph::{Body, NODE_NUMBERS, Shown};
use gump_model::relative::returns::Returns;
use gump_model::relative::sample::{SampleConfig, State, Track, draw};
use gump_model::relative::{RelativeConfig, RelativeNetwork, grid, is_relative, load, sample};
use gump_nn::OptimizerConfig;
use gump_nn::optimizer::AdamW;
use gump_rollout::{SimulateConfig, Start, WorldModel as _, simulate};
use gump_scene::{MapGraph, Scenario, Seed, fixture};

use super::*;
use crate::gradients::Gradients;
use crate::learner::Update;

mod reinforced;

fn config() -> RelativeConfig {
    RelativeConfig {
        width: 32,
        layers: 2,
        heads: 2,
        edge_width: 16,
        edge_hidden: 24,
    }
}

fn scenario() -> Scenario {
    fixture::scenario(
        "lane 1: 0,0 60,0 speed 15 next 2,3
         lane 2: 60,0 140,0
         lane 3: 60,0 75,5 80,20 80,60
         edge: 0,-3 140,-3
         ego vehicle 0: 10,0 velocity 8,0
         agent vehicle 1: 30,0 velocity 0,0
         agent vehicle 2: 50,0 velocity 6,0
         agent bicycle 3: 20,-2 velocity 4,0
         agent pedestrian 4: 40,5 velocity 0,-1",
    )
    .unwrap()
}

/// The scenario up to its present, and nothing hidden or pushed: both sides see the same frames.
#[test]
fn rolled_out_it_computes_what_it_computes_in_training() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let whole = scenario();
    let mut seen = whole.clone();
    seen.log.truncate(whole.now + 1);
    let sample = draw(&seen, &SampleConfig::plain(), None, Seed(1)).unwrap();
    let trained = network.hidden(&sample).unwrap().to_vec2::<f32>().unwrap();
    let world = RelativeWorld::new(&network, RelativeSampling::default()).unwrap();
    let (numbers, hidden) = world.read_present(whole.present()).unwrap();
    let n = numbers.len() / NODE_NUMBERS;
    assert_eq!(n, 5);
    let last = &sample.nodes[sample.nodes.len() - n * NODE_NUMBERS..];
    for (i, own) in numbers.chunks_exact(NODE_NUMBERS).enumerate() {
        let same = |row: &[f32]| row.iter().zip(own).all(|(a, b)| (a - b).abs() < 1e-5);
        let row = last.chunks_exact(NODE_NUMBERS).position(same);
        let row = trained.len() - n + row.expect("the same agents are shown alike");
        for (a, b) in trained[row].iter().zip(&hidden[i * 32..]) {
            assert!((a - b).abs() < 1e-3, "agent {i}: {a} {b}");
        }
    }
}

#[test]
fn a_mean_lies_between_networks_of_one_shape() {
    let [one, other] =
        [4, 5].map(|seed| RelativeNetwork::random(config(), Seed(seed), &Device::Cpu).unwrap());
    let numbers = |network: &RelativeNetwork| {
        let var = network.parameters().find("layers.0.out.weight").unwrap();
        var.flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    let (a, b) = (numbers(&one), numbers(&other));
    let deeper = one.deepened(4, Seed(9)).unwrap();
    let mean = RelativeNetwork::mean(&[one, other]).unwrap();
    for ((a, b), mean) in a.iter().zip(&b).zip(numbers(&mean)) {
        assert!((f32::midpoint(*a, *b) - mean).abs() < 1e-6);
    }
    assert!(RelativeNetwork::mean(&[]).is_err());
    assert!(RelativeNetwork::mean(&[mean, deeper]).is_err());
}

/// Added layers change nothing at first, and learn.
#[test]
fn a_deeper_network_goes_on_from_what_it_said() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let deeper = network.deepened(4, Seed(9)).unwrap();
    assert_eq!(deeper.config().layers, 4);
    let sample = draw(&scenario(), &SampleConfig::plain(), None, Seed(1)).unwrap();
    let hidden = |network: &RelativeNetwork| network.hidden(&sample).unwrap().to_vec2::<f32>();
    assert_eq!(hidden(&network).unwrap(), hidden(&deeper).unwrap());
    assert!(network.deepened(1, Seed(9)).is_err());
    let train = RelativeTrainConfig {
        batch: 1,
        ..RelativeTrainConfig::default()
    };
    let before = hidden(&deeper).unwrap();
    let mut trainer = RelativeTrainer::continuing(deeper, train, vec![scenario()]).unwrap();
    trainer.step().unwrap();
    trainer.step().unwrap();
    let name = "layers.3.out.weight";
    let added = trainer.network().parameters().find(name).unwrap();
    let sum = added.abs().unwrap().sum_all().unwrap();
    assert!(sum.to_scalar::<f32>().unwrap() > 0.0);
    assert_ne!(before, hidden(trainer.network()).unwrap());
}

#[test]
fn probabilities_of_samples_are_checked() {
    let wrong = |sample: SampleConfig| {
        let config = RelativeTrainConfig {
            sample,
            ..RelativeTrainConfig::default()
        };
        config.validate().map_err(|error| error.to_string())
    };
    let routes = |routes: f64| {
        wrong(SampleConfig {
            routes,
            ..SampleConfig::default()
        })
    };
    assert!(routes(0.0).is_ok() && routes(1.0).is_ok());
    for value in [-0.1, 1.5, f64::NAN] {
        let why = routes(value).unwrap_err();
        assert!(
            why.contains("sample.routes must be between 0 and 1"),
            "{why}"
        );
    }
    let forget = wrong(SampleConfig {
        forget: 2.0,
        ..SampleConfig::default()
    });
    assert!(forget.unwrap_err().contains("sample.forget"));
    let forget_free = wrong(SampleConfig {
        forget_free: -0.5,
        ..SampleConfig::default()
    });
    assert!(forget_free.unwrap_err().contains("sample.forget_free"));
}

#[test]
fn a_gradient_without_end_changes_nothing() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let parameters = network.parameters();
    let (name, var) = parameters.trainable().next().unwrap();
    let numbers = || var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let (before, mut step) = (numbers(), 3);
    let mut state = AdamW::new(parameters).unwrap();
    let update = Update {
        parameters,
        average: None,
        optimizer: &OptimizerConfig::default(),
        steps: 10,
    };
    let gradient = (var.zeros_like().unwrap() + f64::INFINITY).unwrap();
    let gradients = Gradients::from([(name.to_owned(), gradient)]);
    let error = update.learn(&mut state, &mut step, &gradients).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the gradient is not a number at step 3; the last checkpoint is intact"
    );
    assert_eq!((step, numbers()), (3, before));
}

#[test]
fn futures_are_seeded_and_a_driven_ego_is_where_it_is_driven() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let world = RelativeWorld::new(&network, RelativeSampling::default()).unwrap();
    let scenario = scenario();
    let start = |n_futures, seed| Start {
        scene: scenario.present(),
        n_futures,
        seed: Seed(seed),
    };
    let config = SimulateConfig {
        seconds: 2.0,
        ..SimulateConfig::default()
    };
    let run = |n, seed| simulate(&world, &[start(n, seed)], None, &config).unwrap();
    let states = |rollout: &gump_scene::Rollout| format!("{:?}", rollout.last().now());
    let (two, three) = (run(2, 7), run(3, 7));
    assert_eq!(states(&two[1]), states(&three[1]));
    assert_ne!(states(&three[0]), states(&three[1]));
    let mut session = world.open(&[start(2, 0)]).unwrap();
    let mut ego = scenario.present().ego_now().state;
    ego.pose.position.x += 3.0;
    let frames = session.step(Some(&[ego, ego])).unwrap();
    assert_eq!(frames[1].agent(scenario.ego).unwrap().state, ego);
    assert!(session.keep(&[1]));
    assert_eq!(session.step(None).unwrap().len(), 1);
}

fn train_config(steps: usize) -> RelativeTrainConfig {
    RelativeTrainConfig {
        steps,
        batch: 2,
        optimizer: OptimizerConfig {
            learning_rate: 3e-3,
            warmup: 5,
            ..OptimizerConfig::default()
        },
        ..RelativeTrainConfig::default()
    }
}

#[test]
fn it_learns_a_scene() {
    let trainer = |steps| {
        RelativeTrainer::new(
            config(),
            train_config(steps),
            vec![scenario()],
            &Device::Cpu,
        )
        .unwrap()
    };
    let mut trainer = trainer(120);
    let first = trainer.step().unwrap().loss;
    let last = (1..120)
        .map(|_| trainer.step().unwrap().loss)
        .last()
        .unwrap();
    assert!(last < 0.5 * first, "{first} to {last}");
    let fields = trainer.validate(&[scenario()]).unwrap();
    assert!(fields.iter().sum::<f64>() < first, "{fields:?}");
}

#[test]
fn half_precision_finds_nearly_the_same_losses() {
    let losses = |mixed_precision| {
        let config = RelativeTrainConfig {
            mixed_precision,
            ..train_config(10)
        };
        let new = RelativeTrainer::new(self::config(), config, vec![scenario()], &Device::Cpu);
        let mut trainer = new.unwrap();
        (0..10)
            .map(|_| trainer.step().unwrap().loss)
            .collect::<Vec<_>>()
    };
    let (exact, rounded) = (losses(false), losses(true));
    assert_ne!(exact, rounded);
    for (a, b) in exact.iter().zip(&rounded) {
        assert!((a - b).abs() < 0.03 * a, "{exact:?} {rounded:?}");
    }
}

/// Agents that are driven are somewhere else than logged, near enough to come back, and what they
/// learn leads back.
#[test]
fn driven_agents_leave_the_log_and_learn_the_way_back() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let drives = |candidates| {
        let config = RelativeDrives {
            share: 1.0,
            candidates,
            ..RelativeDrives::default()
        };
        drives::NetworkDriver::new(&network, &config).unwrap()
    };
    let far = |driver: Option<&drives::NetworkDriver>| {
        let driver = driver.map(|driver| driver as _);
        let sample = draw(&scenario(), &SampleConfig::plain(), driver, Seed(1)).unwrap();
        let plain = draw(&scenario(), &SampleConfig::plain(), None, Seed(1)).unwrap();
        assert_eq!(sample.targets.len(), plain.targets.len());
        let differ = sample
            .nodes
            .iter()
            .zip(&plain.nodes)
            .filter(|(a, b)| a != b);
        let bins =
            |sample: &sample::Sample| -> Vec<_> { sample.targets.iter().map(|t| t.bins).collect() };
        (differ.count(), bins(&sample) != bins(&plain))
    };
    assert_eq!(far(None), (0, false));
    let (one, many) = (far(Some(&drives(1))), far(Some(&drives(64))));
    assert!(one.0 > 0 && one.1, "{one:?}");
    assert!(many.0 > 0, "{many:?}");
}

/// The way back of vehicles that steer is one that vehicles drive, whether a network drove them away from
/// their log or they were pushed; and where they were pushed, so is what is shown of them.
#[test]
fn who_steers_back_does_not_slide() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let text = "lane 1: 0,0 300,0\nego vehicle 0: 10,0 velocity 12,0";
    let alone = fixture::scenario(text).unwrap();
    // What the rear axle moves across the mean of its headings, metres.
    let slides = |x: f64, y: f64, turn: f64| (y - (0.5 * x + 1.4) * turn).abs();
    // The most in the targets, and in the steps that are shown.
    let most = |returns: Returns, is_driven: bool| {
        let drives = RelativeDrives {
            share: 1.0,
            candidates: 16,
            tolerance_m: 3.0,
            returns,
            ..RelativeDrives::default()
        };
        let sample = SampleConfig {
            perturbed: 1.0,
            returns,
            ..SampleConfig::plain()
        };
        let driver = drives::NetworkDriver::new(&network, &drives).unwrap();
        let driver = is_driven.then_some(&driver as _);
        let of_seed = |seed| {
            let sample = draw(&alone, &sample, driver, Seed(seed)).unwrap();
            let targets = sample.targets.iter().map(|target| {
                let step = grid::dequantize(target.bins);
                slides(step.position.x, step.position.y, step.heading)
            });
            let shown = sample.nodes.chunks_exact(NODE_NUMBERS).skip(1);
            let shown = shown.map(|n| {
                let [x, y, turn] = [5.0 * n[8], n[10], 0.5 * n[12]].map(f64::from);
                slides(x, y, turn)
            });
            let worst = [targets.fold(0.0, f64::max), shown.fold(0.0, f64::max)];
            (worst, sample.nodes)
        };
        let all: Vec<_> = (0..12).map(of_seed).collect();
        let worst = [0, 1].map(|k| all.iter().map(|(worst, _)| worst[k]).fold(0.0, f64::max));
        (worst, all)
    };
    for is_driven in [false, true] {
        let (slid, _) = most(Returns::Slide, is_driven);
        assert!(slid[0] > 0.3, "{is_driven}: {slid:?}");
        let (steered, all) = most(Returns::Steer, is_driven);
        assert!(steered[0] < 0.08, "{is_driven}: {steered:?}");
        // They were led away: there are sideways moves.
        let aside = all
            .iter()
            .flat_map(|(_, nodes)| nodes.chunks_exact(NODE_NUMBERS));
        assert!(aside.map(|n| n[10].abs()).fold(0.0, f32::max) > 0.05);
    }
    assert!(most(Returns::Steer, false).0[1] < 0.02);
    assert!(most(Returns::Slide, false).0[1] > 0.3);
}

/// Under the rules agents deviate from the log, and their own moves are the targets.
#[test]
fn agents_that_go_their_own_ways_learn_what_they_did() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let text = "lane 1: 0,0 300,0\nego vehicle 0: 10,0 velocity 8,0";
    let alone = fixture::scenario(text).unwrap();
    let drawn = |ruled| {
        let config = RelativeDrives {
            share: 1.0,
            ruled,
            ..RelativeDrives::default()
        };
        let driver = drives::NetworkDriver::new(&network, &config).unwrap();
        draw(&alone, &SampleConfig::plain(), Some(&driver), Seed(3)).unwrap()
    };
    // Metres ahead in the step that led to a node, and in the target of the node before; the first
    // target is of the warm-up.
    let differences = |sample: &sample::Sample| -> Vec<f64> {
        let targets = sample.targets.iter().skip(1);
        let difference = |target: &sample::Target| {
            let node = target.node as usize + 1;
            let done = 5.0 * f64::from(sample.nodes[node * NODE_NUMBERS + 8]);
            (done - grid::dequantize(target.bins).position.x).abs()
        };
        targets.map(difference).collect()
    };
    let worst = |sample: &sample::Sample| differences(sample).into_iter().fold(0.0, f64::max);
    let (ruled, led_back) = (drawn(1.0), drawn(0.0));
    assert!(worst(&ruled) < 1e-4, "{:?}", differences(&ruled));
    assert_ne!(ruled.nodes, led_back.nodes);
    assert_eq!(drawn(1.0).nodes, ruled.nodes);
}

/// Of free drives only moves that were redrawn, or given by the log, can be left to learn from.
#[test]
fn moves_that_nothing_changed_can_be_left_out() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let text = "lane 1: 0,0 300,0\nego vehicle 0: 10,0 velocity 8,0\nagent vehicle 1: 60,4";
    let scenario = fixture::scenario(text).unwrap();
    let drawn = |unchanged, ruled, seed| {
        let config = RelativeDrives {
            share: 1.0,
            ruled,
            unchanged,
            ..RelativeDrives::default()
        };
        let driver = drives::NetworkDriver::new(&network, &config).unwrap();
        draw(&scenario, &SampleConfig::plain(), Some(&driver), Seed(seed)).unwrap()
    };
    let bins = |sample: &sample::Sample| -> Vec<_> {
        let targets = sample.targets.iter();
        targets
            .map(|t| (t.node, t.bins, t.weight.to_bits()))
            .collect()
    };
    let mut n_left_out = 0;
    for seed in 0..8 {
        let (all, changed) = (drawn(1.0, 1.0, seed), drawn(0.0, 1.0, seed));
        assert_eq!(all.nodes, changed.nodes, "they drive alike");
        let (all, changed) = (bins(&all), bins(&changed));
        assert!(changed.iter().all(|target| all.contains(target)));
        // The parked vehicle's standing is of the log.
        let parked = |targets: &[(u32, [u16; grid::FIELDS], u32)]| {
            let stands = targets.iter().filter(|t| t.1[0] == grid::STANDS);
            stands.count()
        };
        assert!(parked(&changed) > 0);
        n_left_out += all.len() - changed.len();
        let led_back = [1.0, 0.0].map(|unchanged| bins(&drawn(unchanged, 0.0, seed)));
        assert_eq!(led_back[0], led_back[1], "returns to the log count in full");
    }
    assert!(n_left_out > 0);
}

/// A random network that drives under the rules.
fn under_the_rules() -> drives::NetworkDriver {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let config = RelativeDrives {
        share: 1.0,
        ruled: 1.0,
        ..RelativeDrives::default()
    };
    drives::NetworkDriver::new(&network, &config).unwrap()
}

/// A random network moves whoever it may; parked vehicles stay, and that they do is learned.
#[test]
fn parked_vehicles_stay_where_the_log_has_them() {
    let driver = under_the_rules();
    let scenario = fixture::scenario(
        "lane 1: 0,0 200,0
         ego vehicle 0: 10,0 velocity 8,0
         agent vehicle 1: 40,4
         agent vehicle 2: 90,0
         agent pedestrian 3: 60,9
         agent vehicle 4: 180,0",
    )
    .unwrap();
    // Agents are numbered by their distance to one of them.
    let moving = |seed: u64| {
        let sample = draw(&scenario, &SampleConfig::plain(), Some(&driver), Seed(seed)).unwrap();
        let last = sample.targets.iter().map(|target| target.agent).max();
        assert_eq!(last, Some(4));
        let starts = |agent| {
            let own = sample.targets.iter().filter(|t| t.agent == agent).skip(1);
            let moves: Vec<_> = own.map(|t| t.bins[0] != grid::STANDS).collect();
            assert!(!moves.is_empty());
            moves.contains(&true)
        };
        (0..5).filter(|agent| starts(*agent)).count()
    };
    // The one at the end of its lane may have stopped for it; it stands in most samples: who starts is
    // not to jump.
    let most = (0..20).map(moving).max();
    assert_eq!(
        most,
        Some(3),
        "all but the one beside the lane and the one on a free road"
    );
}

/// A random network does not wait at lights; a vehicle whose log does is held there. At the end of a road
/// it drives on.
#[test]
fn vehicles_that_wait_at_lights_do_not_learn_to_start() {
    let driver = under_the_rules();
    let starts = |light: &str| {
        let text = format!(
            "lane 1: 0,0 40,0
             lane 2: 40,0 55,0
             {light}
             ego vehicle 0: 30,0"
        );
        let scenario = fixture::scenario(&text).unwrap();
        let sample = draw(&scenario, &SampleConfig::plain(), Some(&driver), Seed(3)).unwrap();
        let own = sample.targets.iter().skip(1);
        own.filter(|t| t.bins[0] != grid::STANDS).count()
    };
    assert_eq!(starts("light 2 red: 40,0"), 0);
    assert_eq!(starts("light 2 green: 40,0"), 0);
    assert!(starts("") > 0);
}

/// Who could start at green is held, and the target is the start all the same.
#[test]
fn who_misses_the_start_at_green_learns_to_start() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let text = |colour: &str| {
        format!(
            "lane 1: 0,0 40,0 next 2\nlane 2: 40,0 60,0 next 3\nlane 3: 60,0 200,0
             light 2 {colour}: 40,0\nego vehicle 0: 30,0 velocity 0.5,0"
        )
    };
    // Steps in which it stands although the target is to move.
    let held = |held: f64, colour: &str| {
        let mut scenario = fixture::scenario(&text(colour)).unwrap();
        let mut parts = scenario.map.parts().clone();
        parts.lanes[1].in_intersection = true;
        scenario.map = Arc::new(MapGraph::new(parts).unwrap());
        let config = RelativeDrives {
            share: 1.0,
            ruled: 1.0,
            held,
            ..RelativeDrives::default()
        };
        let driver = drives::NetworkDriver::new(&network, &config).unwrap();
        let of_seed = |seed| {
            let sample = draw(&scenario, &SampleConfig::plain(), Some(&driver), Seed(seed));
            let sample = sample.unwrap();
            let is_held = |target: &&sample::Target| {
                let led = (target.node as usize + 1) * NODE_NUMBERS + 8;
                sample.nodes[led] == 0.0 && grid::dequantize(target.bins).position.x > 0.1
            };
            sample.targets.iter().skip(1).filter(is_held).count()
        };
        (0..12).map(of_seed).sum::<usize>()
    };
    assert!(held(0.75, "green") > 10, "{}", held(0.75, "green"));
    assert_eq!(held(0.0, "green"), 0);
    assert_eq!(held(0.75, "red"), 0);
    let never = RelativeDrives {
        held: 1.0,
        ..RelativeDrives::default()
    };
    let message = never.validate().unwrap_err().to_string();
    assert!(message.contains("held must be at least 0"), "{message}");
}

/// A random network changes its speed by whatever it draws; tyres do not.
#[test]
fn free_drives_can_be_held_to_the_limits_of_rollouts() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let text = "lane 1: 0,0 300,0\nego vehicle 0: 10,0 velocity 8,0";
    let alone = fixture::scenario(text).unwrap();
    // Of the moves that follow each other, the greatest change of length, metres, and the number of those
    // to learn from.
    let drawn = |limits, unchanged, seed| {
        let config = RelativeDrives {
            share: 1.0,
            ruled: 1.0,
            unchanged,
            limits,
            ..RelativeDrives::default()
        };
        let driver = drives::NetworkDriver::new(&network, &config).unwrap();
        let sample = draw(&alone, &SampleConfig::plain(), Some(&driver), Seed(seed)).unwrap();
        let steps = sample.nodes.chunks_exact(NODE_NUMBERS);
        let steps: Vec<f32> = steps.map(|n| (5.0 * n[8]).hypot(n[10])).collect();
        let changes = steps.windows(2).map(|pair| (pair[1] - pair[0]).abs());
        (changes.fold(0.0, f32::max), sample.targets.len())
    };
    let most = |limits| {
        let changes = (0..6).map(|seed| drawn(limits, 1.0, seed).0);
        changes.fold(0.0, f32::max)
    };
    // 8 m/s² are 2 m.
    assert!(most(true) < 2.05, "{}", most(true));
    assert!(most(false) > 2.5, "{}", most(false));
    // A move that was limited is no longer the network's own.
    let changed = |limits| (0..6).map(|seed| drawn(limits, 0.0, seed).1).sum::<usize>();
    assert!(changed(true) > 0 && changed(false) > 0);
}

/// To stand in a queue does not count more than to leave it, if so asked.
#[test]
fn own_starts_can_count_as_much_as_standing_in_the_log() {
    use drives::Origin::{Changed, Faulty, FirstDraw, Log};
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let weights = |starts| {
        let config = RelativeDrives {
            unchanged: 0.25,
            starts,
            ..RelativeDrives::default()
        };
        let driver = drives::NetworkDriver::new(&network, &config).unwrap();
        // A start and another move of its own; standing queued and parked; changed; no move of drivers.
        [
            driver.weight(FirstDraw, false, true),
            driver.weight(FirstDraw, false, false),
            driver.weight(Log, true, false),
            driver.weight(Log, false, false),
            driver.weight(Changed, false, false),
            driver.weight(Faulty, false, true),
        ]
    };
    assert_eq!(weights(false), [0.25, 0.25, 1.0, 1.0, 1.0, 0.0]);
    assert_eq!(weights(true), [1.0, 0.25, 0.25, 1.0, 1.0, 0.0]);
    let body = |kind| Body {
        kind,
        length: 4.5,
        width: 1.9,
        sized: true,
    };
    let starts = |kind, speed: f64, step: f64| {
        let now = Shown::first(body(kind), Pose::IDENTITY, dvec2(speed, 0.0));
        drives::sets_off(&now, &Pose::new(step, 0.0, 0.0))
    };
    use gump_scene::AgentKind::{Pedestrian, Vehicle};
    assert!(starts(Vehicle, 0.0, 0.3) && !starts(Vehicle, 0.0, 0.0));
    assert!(!starts(Vehicle, 2.0, 1.0) && !starts(Pedestrian, 0.0, 0.3));
}

#[test]
fn no_redraw_may_be_worse_unless_it_is_slower() {
    let at = |x: f64| Pose::new(x, 0.0, 0.0);
    // Beyond 3 m it runs a light, up to 1 m it stands in the way.
    let fault = |step: &Pose| match step.position.x {
        x if x > 3.0 => x - 3.0,
        x if x < 1.0 => 0.3,
        _ => 0.0,
    };
    let worse = |step: f64, before: f64| drives::is_worse(fault, &at(step), &at(before));
    assert!(worse(4.0, 2.0) && worse(5.0, 4.0) && worse(3.5, 0.5));
    assert!(!worse(0.5, 2.0) && !worse(3.5, 4.0) && !worse(2.5, 2.0) && !worse(2.0, 0.5));
}

#[test]
fn who_waits_in_a_queue_stays_where_its_log_does() {
    let at = |x: f64| Pose::new(x, 0.0, 0.0);
    let waits = |here, [now, next]: [f64; 2], line: f64| {
        drives::is_queued(at(here), [Some(at(now)), Some(at(next))], &[at(line)])
    };
    assert!(waits(30.0, [30.0, 30.0], 35.0) && waits(30.1, [30.0, 30.0], 35.0));
    // Its log starts, or it is not where its log is.
    assert!(!waits(30.0, [30.0, 31.0], 35.0) && !waits(29.0, [30.0, 30.0], 35.0));
    // The line is behind it, far away, or of another direction.
    assert!(!waits(30.0, [30.0, 30.0], 25.0) && !waits(30.0, [30.0, 30.0], 100.0));
    let (here, aside) = (at(30.0), Pose::new(35.0, 0.0, 1.5));
    assert!(!drives::is_queued(here, [Some(here); 2], &[aside]));
    assert!(!drives::is_queued(here, [Some(here), None], &[at(35.0)]));
}

/// A crowd joins samples under the rules, in which nobody stands inside another at first.
#[test]
fn a_crowd_stands_and_walks_in_the_way() {
    let crowd = Crowd {
        standing: 4,
        people: 4,
        vehicles: 4,
    };
    let whole = scenario();
    let agents = |crowd: &Crowd, ruled, seed| {
        let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
        let config = RelativeDrives {
            share: 1.0,
            ruled,
            crowd: crowd.clone(),
            ..RelativeDrives::default()
        };
        let driver = drives::NetworkDriver::new(&network, &config).unwrap();
        let sample = draw(&whole, &SampleConfig::plain(), Some(&driver), Seed(seed));
        let targets = sample.unwrap().targets;
        targets.iter().map(|target| target.agent).max().unwrap() + 1
    };
    let seeds = 0..12;
    let most = seeds.clone().map(|seed| agents(&crowd, 1.0, seed)).max();
    assert!(most > Some(8) && most <= Some(5 + 12), "{most:?}");
    assert!(seeds.clone().all(|seed| agents(&crowd, 0.0, seed) == 5));
    assert!(
        seeds
            .clone()
            .all(|seed| agents(&Crowd::default(), 1.0, seed) == 5)
    );
    let joined = |seed| {
        let mut tracks = tracks(&whole);
        let (centre, n) = (whole.present().ego_now().state.pose.position, 18);
        crowd.join(&whole.map, centre, &mut tracks, n, Seed(seed));
        tracks
    };
    for seed in seeds {
        let tracks = joined(seed);
        assert_eq!(tracks.len(), joined(seed).len());
        for (i, track) in tracks.iter().enumerate().skip(5) {
            assert!(track.states.len() == 18 && track.states.iter().all(Option::is_some));
            let [first, later] = [0, 1].map(|t| track.states[t].unwrap().shown);
            assert_eq!(track.is_obstacle, first == later);
            for t in 0..drives::WARM_UP {
                let shape = |track: &Track| gump_geometry::OrientedBox {
                    pose: track.states[t].unwrap().shown,
                    length: track.body.length,
                    width: track.body.width,
                };
                let own = shape(track);
                assert!(!tracks[..i].iter().any(|other| own.overlaps(&shape(other))));
            }
        }
    }
    let too_many = RelativeDrives {
        crowd: Crowd {
            people: 65,
            ..Crowd::default()
        },
        ..RelativeDrives::default()
    };
    let message = too_many.validate().unwrap_err().to_string();
    assert!(message.contains("a crowd of 65"), "{message}");
}

#[test]
fn who_has_no_log_walks_on() {
    let step = Pose::new(0.6, 0.0, 0.02);
    let first = Pose::new(3.0, 4.0, 1.0);
    let mut log = vec![Some(first); 6];
    log[1] = Some(first * step);
    drives::walk_on(&mut log);
    let mut pose = first;
    for found in log {
        let found = found.unwrap();
        assert!(found.position.distance(pose.position) < 1e-9, "{found:?}");
        assert!((found.heading - pose.heading).abs() < 1e-9, "{found:?}");
        pose = pose * step;
    }
    // Who is there for a moment only has no way.
    let mut short = vec![Some(first), None, None];
    drives::walk_on(&mut short);
    assert_eq!(short, [Some(first), None, None]);
}

/// The tracks of a scenario at 2 Hz.
fn tracks(scenario: &Scenario) -> Vec<Track> {
    let agents = scenario.log[0].agents();
    let of = |first: &gump_scene::Agent| {
        let frames = scenario.log.iter().step_by(5);
        let states = frames.map(|frame| {
            let state = frame.agent(first.id)?.state;
            Some(State::added(state.pose, state.velocity))
        });
        Track {
            body: Body {
                kind: first.kind,
                length: first.length,
                width: first.width,
                sized: true,
            },
            states: states.collect(),
            routes: Vec::new(),
            is_obstacle: false,
        }
    };
    agents.iter().map(of).collect()
}

#[test]
fn nobody_appears_where_another_was_driven_to() {
    let body = Body {
        kind: gump_scene::AgentKind::Vehicle,
        length: 4.0,
        width: 2.0,
        sized: true,
    };
    let at = |x: f64, speed: f64| State::added(Pose::new(x, 0.0, 0.0), dvec2(speed, 0.0));
    let track = |states: [Option<State>; 4]| Track {
        body,
        states: states.to_vec(),
        routes: Vec::new(),
        is_obstacle: false,
    };
    // Whether one that appears in frame 2 at 0 m and so many m/s is left there, with another that was
    // driven to one place and is logged at another.
    let is_left = |speed: f64, driven: f64, logged: Option<f64>| {
        let mut tracks = [
            track([Some(at(driven, 0.0)); 4]),
            track([
                None,
                None,
                Some(at(0.0, speed)),
                Some(at(speed / 2.0, speed)),
            ]),
        ];
        let log = |_: usize, _: &State| logged.map(|x| Pose::new(x, 0.0, 0.0));
        drives::drop_blocked(&mut tracks, 2, log);
        assert!(tracks[0].states.iter().all(Option::is_some));
        let left = tracks[1].states.iter().flatten().count();
        assert!(left == 0 || left == 2);
        left == 2
    };
    assert!(!is_left(0.0, 3.0, Some(30.0)) && is_left(0.0, 5.0, Some(30.0)));
    // Eight metres ahead, at 8 m/s: unless its log is as near, or the other was not driven.
    assert!(!is_left(8.0, 8.0, Some(30.0)) && !is_left(8.0, 8.0, None));
    assert!(is_left(2.0, 8.0, None) && is_left(8.0, 8.0, Some(9.0)));
    assert!(!is_left(8.0, 3.0, Some(9.0)) && is_left(8.0, 3.0, Some(3.0)));
}

/// An agent shown without its past has fewer edges and the same targets.
#[test]
fn the_past_is_forgotten_as_often_as_asked() {
    let drawn = |forget| {
        let config = SampleConfig {
            forget,
            ..SampleConfig::plain()
        };
        draw(&scenario(), &config, None, Seed(1)).unwrap()
    };
    let bins = |sample: &sample::Sample| -> Vec<_> {
        let targets = sample.targets.iter();
        targets.map(|target| (target.node, target.bins)).collect()
    };
    let n_edges = |sample: &sample::Sample| sample.n_edges() as i64;
    let (all, some, none) = (drawn(0.0), drawn(0.5), drawn(1.0));
    assert!(bins(&all) == bins(&some) && bins(&all) == bins(&none));
    assert_eq!(all.nodes, none.nodes);
    // Half as many are left out, but for chance.
    let (half, whole) = (
        n_edges(&all) - n_edges(&some),
        n_edges(&all) - n_edges(&none),
    );
    assert!(
        whole > 0 && (half - whole / 2).abs() < whole / 5,
        "{half} of {whole}"
    );
}

/// Vehicles on a free road lose their past, in drives as in logs; who stands or walks keeps it.
#[test]
fn free_vehicles_are_shown_without_their_past_as_often_as_asked() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let closed_loop = RelativeDrives {
        share: 1.0,
        ruled: 1.0,
        ..RelativeDrives::default()
    };
    let driver = drives::NetworkDriver::new(&network, &closed_loop).unwrap();
    let drawn = |text: &str, forget_free, is_driven: bool| {
        let config = SampleConfig {
            forget_free,
            ..SampleConfig::plain()
        };
        let driver = is_driven.then_some(&driver as _);
        let scenario = fixture::scenario(text).unwrap();
        let sample = draw(&scenario, &config, driver, Seed(1)).unwrap();
        (sample.nodes.clone(), sample.n_edges() as i64)
    };
    let road = "lane 1: 0,0 400,0\nego vehicle 0: 10,0 velocity 8,0";
    let [all, some, none] = [0.0, 0.5, 1.0].map(|share| drawn(road, share, false));
    assert!(all.0 == some.0 && all.0 == none.0);
    assert!(all.1 > some.1 && some.1 > none.1);
    // The only vehicle is free at every frame: an edge to itself is left of each past.
    let n = (all.0.len() / NODE_NUMBERS) as i64;
    let pasts: i64 = (0..n).map(|t| t.min(6)).sum();
    assert_eq!(all.1 - none.1, pasts);
    // The drive is shown what the sample shows: another past, other draws.
    assert_ne!(drawn(road, 0.0, true).0, drawn(road, 1.0, true).0);
    let others = "lane 1: 0,0 400,0\nego vehicle 0: 10,0\nagent pedestrian 1: 20,9 velocity 1,0";
    assert_eq!(drawn(others, 0.0, false).1, drawn(others, 1.0, false).1);
}

#[test]
fn a_resumed_run_ends_in_the_same_weights() {
    let closed_loop = RelativeDrives {
        refresh: 2,
        ruled: 0.5,
        ..RelativeDrives::default()
    };
    let realism = RelativeRewards {
        rollouts: 3,
        refresh: 2,
        ..RelativeRewards::default()
    };
    let closed_loop = Some(closed_loop);
    for (closed_loop, realism) in [
        (None, None),
        (closed_loop.clone(), None),
        (closed_loop, Some(realism)),
    ] {
        resumes(&RelativeTrainConfig {
            closed_loop,
            realism,
            ..train_config(6)
        });
    }
}

/// The rewards are for every move that the futures made, and for no other.
#[test]
fn rollouts_are_judged_by_the_moves_they_made() {
    let network = RelativeNetwork::random(config(), Seed(4), &Device::Cpu).unwrap();
    let config = RelativeRewards {
        rollouts: 4,
        ..RelativeRewards::default()
    };
    let judged = rewards::Judged::new(&network, &config).unwrap();
    let group = judged.group(&scenario(), Seed(2)).unwrap().unwrap();
    assert_eq!(group.samples.len(), 4);
    assert!(group.realism > 0.0 && group.realism < 1.0);
    let (mut sum, mut n) = (0.0, 0);
    for sample in &group.samples {
        for target in &sample.targets {
            // Five agents are there at every frame; the present is the third.
            assert_eq!(target.node, 5 * target.frame + target.agent);
            assert!((2..18).contains(&target.frame));
            let next = target.node as usize + 5;
            let done = 5.0 * f64::from(sample.nodes[next * NODE_NUMBERS + 8]);
            let expected = grid::dequantize(target.bins).position.x;
            assert!((done - expected).abs() < 1e-4, "{done} {expected}");
            sum += f64::from(target.weight);
            n += 1;
        }
    }
    // Each move is compared with those of the other futures.
    assert!(n > 100 && (sum / f64::from(n)).abs() < 0.1, "{sum} of {n}");
    let too_short = fixture::scenario(
        "lane 1: 0,0 60,0\nego vehicle 0: 10,0 velocity 8,0\nhistory 1.0 future 2.0 dt 0.1",
    )
    .unwrap();
    assert!(judged.group(&too_short, Seed(2)).unwrap().is_none());
    // Scenes that are of no use are counted; all five agents of the other one are scored.
    let scenes = vec![too_short.clone(), too_short, scenario()];
    let train = RelativeTrainConfig {
        realism: Some(config.clone()),
        ..train_config(4)
    };
    let mut trainer = RelativeTrainer::new(self::config(), train, scenes, &Device::Cpu).unwrap();
    (0..4).for_each(|_| _ = trainer.step().unwrap());
    let excluded = trainer.reward_exclusions();
    assert!(excluded.scenes > 0, "{excluded:?}");
    assert_eq!(excluded.agents, 0);
    let alone = RelativeRewards {
        rollouts: 1,
        ..RelativeRewards::default()
    };
    let message = alone.validate().unwrap_err().to_string();
    assert!(message.contains("rollouts must be at least 2"), "{message}");
}

fn resumes(config: &RelativeTrainConfig) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let steps = config.steps;
    let new = || {
        RelativeTrainer::new(
            self::config(),
            config.clone(),
            vec![scenario()],
            &Device::Cpu,
        )
        .unwrap()
    };
    let mut whole = new();
    (0..steps).for_each(|_| _ = whole.step().unwrap());
    let mut broken = new();
    (0..steps / 2).for_each(|_| _ = broken.step().unwrap());
    broken.save(&path).unwrap();
    let mut resumed = RelativeTrainer::resume(&path, vec![scenario()], &Device::Cpu).unwrap();
    assert_eq!(resumed.steps_done(), steps / 2);
    (steps / 2..steps).for_each(|_| _ = resumed.step().unwrap());
    let weights = |trainer: &RelativeTrainer| {
        let all = trainer.network().parameters().all();
        all.map(|(_, var)| var.flatten_all().unwrap().to_vec1::<f32>().unwrap())
            .collect::<Vec<_>>()
    };
    assert_eq!(weights(&whole), weights(&resumed));
    assert!(is_relative(&path).unwrap());
    assert_eq!(load(&path, &Device::Cpu).unwrap().config(), &self::config());
    // The other architecture refuses the file with a sentence.
    let error = checkpoint::load(&path, &Device::Cpu).unwrap_err();
    assert!(
        error.to_string().contains("configuration is not valid"),
        "{error}"
    );
}
