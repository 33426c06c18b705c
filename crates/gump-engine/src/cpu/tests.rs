//! The engine compared with the reference implementation, and its caches compared with none.

use gump_model::placed_slot::PlacedSlot;
use gump_model::testing::{hidden, memory, network, scenario, slots};
use gump_rollout::{Start, WorldModel};
use gump_scene::{AgentState, Frame, Scenario, Seed, fixture};
use gump_tokenizer::Slot;

use super::*;
use crate::sampling::{CacheMode, Mode};
use crate::world::TransformerWorld;

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let differences = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    differences.fold(0.0, f32::max)
}

/// Hidden vectors of all tokens of a sequence, in one pass over what `kv_cache` does not hold.
fn all(
    engine: &Engine,
    memory: &SceneMemory,
    slots: &[PlacedSlot],
    kv_cache: &mut KvCache,
) -> Vec<f32> {
    let held = kv_cache.common(slots);
    engine.run(&mut [Job {
        slots,
        wanted: (held..slots.len()).collect(),
        memory,
        kv_cache,
        keep: true,
    }])
}

#[test]
fn the_engine_says_what_the_network_says() {
    let (network, scenario) = (network(), scenario());
    let (slots, memory) = (slots(&scenario), memory(&network, &scenario));
    let engine = Engine::new(&network, Precision::F32).unwrap();
    let packed = engine.remember(&memory).unwrap();
    let expected = hidden(&network, &[&slots], &memory).concat().concat();
    let found = all(&engine, &packed, &slots, &mut KvCache::default());
    assert!(largest_difference(&found, &expected) < 1e-4);
}

#[test]
fn lower_precision_says_nearly_the_same() {
    let (network, scenario) = (network(), scenario());
    let (slots, memory) = (slots(&scenario), memory(&network, &scenario));
    let read_with = |precision| {
        let engine = Engine::new(&network, precision).unwrap();
        let packed = engine.remember(&memory).unwrap();
        let vectors = all(&engine, &packed, &slots, &mut KvCache::default());
        (vectors, engine.weight_bytes())
    };
    let (exact, bytes) = read_with(Precision::F32);
    for (precision, tolerance, least) in [(Precision::Bf16, 0.05, 1.9), (Precision::Int8, 0.2, 3.2)]
    {
        let (rounded, fewer) = read_with(precision);
        let difference = largest_difference(&exact, &rounded);
        assert!(
            0.0 < difference && difference < tolerance,
            "{precision:?}: {difference}"
        );
        assert!(bytes as f64 / fewer as f64 > least, "{precision:?}");
    }
}

#[test]
fn weights_without_end_are_refused_by_name() {
    let network = network();
    let name = "mct.blocks.0.qkv.weight";
    let weight = network.parameters().find(name).unwrap();
    let mut numbers = weight.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    // The largest f32 is beyond the largest bfloat16.
    numbers[7] = f32::MAX;
    let set = |numbers: &[f32]| {
        let tensor = candle_core::Tensor::from_slice(numbers, weight.shape(), weight.device());
        weight.set(&tensor.unwrap()).unwrap();
    };
    set(&numbers);
    let refused = |precision| Engine::new(&network, precision).unwrap_err().to_string();
    assert!(Engine::new(&network, Precision::Int8).is_ok());
    assert!(refused(Precision::Bf16).contains(name));
    numbers[7] = f32::INFINITY;
    set(&numbers);
    for (precision, form) in [(Precision::Bf16, "bfloat16"), (Precision::Int8, "8 bits")] {
        let why = refused(precision);
        assert!(
            why.contains(name) && why.contains("inf") && why.contains(form),
            "{why}"
        );
    }
}

#[test]
fn a_context_changes_no_bit() {
    Precision::ALL.into_iter().for_each(check_contexts);
}

fn check_contexts(precision: Precision) {
    let (network, scenario) = (network(), scenario());
    let (slots, memory) = (slots(&scenario), memory(&network, &scenario));
    let engine = Engine::new(&network, precision).unwrap();
    let memory = engine.remember(&memory).unwrap();
    let whole = all(&engine, &memory, &slots, &mut KvCache::default());
    let mut kv_cache = KvCache::default();
    let mut pieces = Vec::new();
    for end in [11, 12, slots.len()] {
        pieces.extend(all(&engine, &memory, &slots[..end], &mut kv_cache));
        assert_eq!(kv_cache.slots.len(), end);
    }
    assert_eq!(pieces, whole);
    // Another value in the middle: only the tokens before it are kept, by this future alone.
    let shared = kv_cache.clone();
    let value = slots.iter().rposition(|p| matches!(p.slot, Slot::Value(_)));
    let mut changed = slots.clone();
    if let Slot::Value(state) = &mut changed[value.unwrap()].slot {
        state.x += 7;
    }
    let after = all(&engine, &memory, &changed, &mut kv_cache);
    let afresh = all(&engine, &memory, &changed, &mut KvCache::default());
    assert_eq!(after, afresh[afresh.len() - after.len()..]);
    let mut other = shared.clone();
    assert_eq!(other.common(&slots), slots.len());
    other.slots.truncate(value.unwrap());
    let again = all(&engine, &memory, &slots, &mut other);
    assert_eq!(again, whole[whole.len() - again.len()..]);
}

#[test]
fn pages_of_slots_hold_what_a_list_would() {
    let slots = slots(&scenario()).repeat(4);
    let mut pages = kv_cache::SlotPages::default();
    let mut list: Vec<PlacedSlot> = Vec::new();
    // Extended and cut within pages, at their ends and beyond them.
    let cuts = [0, 5, 16, 50, 32, 7, 7, 99, 0];
    let additions = [5, 11, 40, 1, 20, 0, 9, 3, 2];
    for (k, (cut, add)) in cuts.into_iter().zip(additions).enumerate() {
        let before = (pages.clone(), list.clone());
        pages.truncate(cut);
        list.truncate(cut);
        // Other slots each time, so that what was cut does not come back unnoticed.
        let added = &slots[list.len() + k..][..add];
        pages.extend(added);
        list.extend_from_slice(added);
        assert_eq!(pages.len(), list.len());
        assert!(pages.iter().eq(&list));
        assert!(before.0.iter().eq(&before.1), "a clone has changed");
    }
}

#[test]
fn sequences_do_not_know_their_neighbours_or_the_threads() {
    let (network, scenario) = (network(), scenario());
    let (slots, memory) = (slots(&scenario), memory(&network, &scenario));
    let engine = Engine::new(&network, Precision::F32).unwrap();
    let memory = engine.remember(&memory).unwrap();
    let alone = all(&engine, &memory, &slots, &mut KvCache::default());
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build().unwrap().install(|| {
            let mut kv_caches: Vec<KvCache> = (0..9).map(|_| KvCache::default()).collect();
            let mut jobs: Vec<Job<'_>> = kv_caches
                .iter_mut()
                .enumerate()
                .map(|(i, kv_cache)| Job {
                    slots: &slots[..slots.len() - i],
                    wanted: vec![3, slots.len() - i - 1],
                    memory: &memory,
                    kv_cache,
                    keep: i % 2 == 0,
                })
                .collect();
            let together = engine.run(&mut jobs);
            let c = engine.width;
            for (i, pair) in together.chunks_exact(2 * c).enumerate() {
                assert_eq!(pair[..c], alone[3 * c..4 * c]);
                let last = (slots.len() - i - 1) * c;
                assert_eq!(pair[c..], alone[last..last + c]);
            }
        });
    }
}

#[test]
fn a_probe_is_the_same_by_engine_and_by_tensors() {
    let scenario = scenario();
    let sampling = SamplingConfig::default();
    let fused = TransformerWorld::new(network(), sampling.clone());
    let plain = TransformerWorld::reference(network(), sampling);
    let outputs = [fused, plain].map(|world| world.probe(scenario.present()).unwrap());
    assert!(outputs[0].len() > 32);
    assert!(largest_difference(&outputs[0], &outputs[1]) < 1e-4);
}

/// Conditions of a rollout whose results must be exact.
struct Course<'a> {
    scenario: &'a Scenario,
    steps: usize,
    /// Distance that the ego is moved ahead in each step, metres; `None` if it is not driven.
    ego: Option<f64>,
}

/// The frames of `n` futures; `forget` drops every cache before every step.
fn imagine(
    course: &Course<'_>,
    n: usize,
    sampling: &SamplingConfig,
    engine: bool,
    forget: bool,
) -> Vec<Vec<Frame>> {
    let world = if engine {
        TransformerWorld::new(network(), sampling.clone())
    } else {
        TransformerWorld::reference(network(), sampling.clone())
    };
    let start = Start {
        scene: course.scenario.present(),
        n_futures: n,
        seed: Seed(5),
    };
    let mut session = world.open_session(&[start]).unwrap();
    let mut ego = course.scenario.present().ego_now().state;
    let step = |_| {
        if forget {
            session.forget();
        }
        let states: Option<Vec<AgentState>> = course.ego.map(|ahead| {
            ego.pose.position.x += ahead;
            vec![ego; n]
        });
        gump_rollout::Session::step(&mut session, states.as_deref()).unwrap()
    };
    (0..course.steps).map(step).collect()
}

/// Every cache, with and without, in both modes, alone and among 32, by engine and by tensors.
fn check(course: &Course<'_>) {
    for mode in [Mode::PartialAr, Mode::FullAr] {
        for cache in [CacheMode::Window, CacheMode::Growing] {
            let sampling = SamplingConfig {
                mode,
                cache,
                ..SamplingConfig::default()
            };
            let cached = imagine(course, 3, &sampling, true, false);
            let afresh = imagine(course, 3, &sampling, true, true);
            assert_eq!(cached, afresh, "{mode:?} {cache:?}: cached against not");
            let plain = imagine(course, 3, &sampling, false, false);
            assert_eq!(cached, plain, "{mode:?} {cache:?}: engine against tensors");
        }
    }
}

#[test]
fn caches_are_exact_after_slides() {
    check(&Course {
        scenario: &scenario(),
        steps: 6,
        ego: None,
    });
}

#[test]
fn caches_are_exact_when_the_window_overflows() {
    // 15 agents are 33 slots a frame: the block of 512 slots overflows after 15 frames.
    let mut text = String::from("lane 1: -100,0 100,0\nego vehicle 0: 0,0 velocity 3,0\n");
    for i in 1..15 {
        text += &format!(
            "agent vehicle {i}: {},{} velocity 1,0\n",
            8 * i - 60,
            i % 3 * 4
        );
    }
    let scenario = fixture::scenario(&text).unwrap();
    let sampling = SamplingConfig {
        cache: CacheMode::Growing,
        ..SamplingConfig::default()
    };
    let course = Course {
        scenario: &scenario,
        steps: 20,
        ego: None,
    };
    let cached = imagine(&course, 2, &sampling, true, false);
    assert_eq!(cached, imagine(&course, 2, &sampling, true, true));
    let window = SamplingConfig::default();
    assert_ne!(cached, imagine(&course, 2, &window, true, false));
}

#[test]
fn caches_are_exact_where_traffic_comes_and_goes() {
    let mut text = String::from("lane 1: -200,0 200,0\nego vehicle 0: 0,0\n");
    for i in 1..12 {
        let (x, velocity) = (91.0 + 0.4 * f64::from(i), 4.0 * f64::from(i % 5 - 2));
        text += &format!(
            "agent vehicle {i}: {x},{} velocity {velocity},0\n",
            5 * i - 30
        );
    }
    check(&Course {
        scenario: &fixture::scenario(&text).unwrap(),
        steps: 5,
        ego: None,
    });
}

#[test]
fn caches_are_exact_for_a_driven_ego_that_leaves_its_window() {
    check(&Course {
        scenario: &scenario(),
        steps: 5,
        ego: Some(16.0),
    });
}

#[test]
fn many_futures_equal_as_many_single_ones() {
    let scenario = scenario();
    for (mode, cache) in [
        (Mode::PartialAr, CacheMode::Window),
        (Mode::PartialAr, CacheMode::Growing),
        (Mode::FullAr, CacheMode::Growing),
    ] {
        let sampling = SamplingConfig {
            mode,
            cache,
            ..SamplingConfig::default()
        };
        let world = TransformerWorld::new(network(), sampling);
        let start = |n_futures, seed| Start {
            scene: scenario.present(),
            n_futures,
            seed,
        };
        let seed = Seed(11);
        let mut together = world.open(&[start(32, seed)]).unwrap();
        // Future k of a start is drawn from `seed.fork(k)`; as a separate start it would be drawn
        // from that seed's fork 0, so each is the last future of a batch of another length.
        let mut alone: Vec<_> = (1..=32)
            .step_by(7)
            .map(|n| (n - 1, world.open(&[start(n, seed)]).unwrap()))
            .collect();
        for _ in 0..3 {
            let frames = together.step(None).unwrap();
            for (k, session) in &mut alone {
                assert_eq!(session.step(None).unwrap()[*k], frames[*k], "{mode:?} {k}");
            }
        }
    }
}
