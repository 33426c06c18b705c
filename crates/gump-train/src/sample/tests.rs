//! Inputs and targets of samples.

use gump_model::decoder::STEPS;
use gump_model::steps::{HISTORY, stride_of};
use gump_raster::Layer;
use gump_scene::fixture;

use super::targets::{CONTROL_BEGIN, CONTROL_LIGHTS_END, CONTROL_NEWBORN};
use super::*;
use crate::closed_loop_samples::DrivenScenario;

fn reader() -> Reader {
    Reader {
        spec: RasterSpec::full(16, 12.0),
        tokenizer: Tokenizer::new(TokenizerConfig::default()),
        block_size: 2048,
        local_frame: false,
    }
}

fn scenario() -> Scenario {
    fixture::scenario(
        "lane 1: -100,0 100,0
         lane 2: 30,0 100,0
         light 2 red: 60,0
         ego vehicle 0: 0,0 velocity 8,0
         agent vehicle 1: 20,0 velocity 5,0
         agent pedestrian 7: 30,3 velocity 0,-1",
    )
    .unwrap()
}

fn sample(config: &SampleConfig, seed: u64) -> Sample {
    (0..64)
        .find_map(|i| draw(&scenario(), None, &reader(), config, Seed(seed).fork(i)))
        .expect("a sample can be drawn")
}

#[test]
fn every_control_target_is_the_successor() {
    let sample = sample(&SampleConfig::plain(4), 1);
    let expected = |slot: Slot| match slot {
        Slot::Key(key) => u32::from(key.id),
        Slot::Begin => CONTROL_BEGIN,
        Slot::Newborn => CONTROL_NEWBORN,
        Slot::LightsEnd => CONTROL_LIGHTS_END,
        other => panic!("{other:?} is no successor"),
    };
    for target in &sample.control {
        assert_eq!(
            target.successor,
            expected(sample.slots[target.slot + 1].slot)
        );
    }
    // Every value but the very last, every mark: LIGHTS_END, NEWBORN, the light before LIGHTS_END.
    let values = sample
        .slots
        .iter()
        .filter(|p| matches!(p.slot, Slot::Value(_)))
        .count();
    assert_eq!(sample.control.len(), values + 4 * 3 - 1);
}

#[test]
fn lights_and_classes_are_told_before_they_come() {
    let sample = sample(&SampleConfig::plain(4), 1);
    let successor = |target: &ControlTarget| sample.slots[target.slot + 1].slot;
    // One light per frame, seen from its BEGIN.
    assert_eq!(sample.lights.len(), 4);
    for target in &sample.lights {
        assert!(matches!(sample.slots[target.slot].slot, Slot::Begin));
        assert!(matches!(successor(target), Slot::Light(_)));
        assert_eq!(target.successor, 2, "the light is red");
    }
    let classes: Vec<u32> = sample.classes.iter().map(|t| t.successor).collect();
    // The vehicle and the pedestrian of the first frame; no agent enters after it.
    assert_eq!(classes, [0, 1]);
}

#[test]
fn a_window_may_begin_with_its_reference() {
    let config = SampleConfig {
        from_reference: 1.0,
        prompt_dropout: 0.0,
        ..SampleConfig::plain(4)
    };
    let sample = sample(&config, 1);
    let value = sample.slots.iter().find_map(|placed| match placed.slot {
        Slot::Value(state) => Some(state.pose()),
        _ => None,
    });
    let ego = value.expect("the ego has a value");
    assert!(ego.position.length() < 0.2 && ego.heading.abs() < 0.02);
    // 8 m/s behind a vehicle: the matching tag is the prompt.
    assert!(matches!(sample.slots[0].slot, Slot::Prompt(Some(_))));
}

#[test]
fn targets_are_the_log_and_missing_frames_are_ignored() {
    let sample = sample(&SampleConfig::plain(4), 1);
    for target in &sample.states {
        let (Slot::Key(_), Slot::Value(state)) = (
            sample.slots[target.key].slot,
            sample.slots[target.key + 1].slot,
        ) else {
            panic!("a target stands at a key");
        };
        for (step, field) in STEPS.iter().enumerate().take(7) {
            assert_eq!(target.bins[step], Some(state.get(*field)));
        }
    }
    assert!(sample.states.iter().any(|target| target.bins[15].is_some()));
    assert_eq!(sample.states[0].token(0), Field::Width.token(4));
}

#[test]
fn one_seed_one_sample() {
    let config = SampleConfig::default();
    let (a, b) = (sample(&config, 3), sample(&config, 3));
    assert_eq!(format!("{:?}", a.slots), format!("{:?}", b.slots));
    assert_eq!(a.raster, b.raster);
    assert_ne!(
        format!("{:?}", a.slots),
        format!("{:?}", sample(&config, 4).slots)
    );
}

#[test]
fn perturbed_values_keep_true_targets() {
    let config = SampleConfig {
        surrogate_noise: 1.0,
        ..SampleConfig::plain(4)
    };
    let differs = |seed| {
        let sample = sample(&config, seed);
        sample
            .states
            .iter()
            .any(|target| match sample.slots[target.key + 1].slot {
                Slot::Value(state) => target.bins[4] != Some(state.x),
                _ => false,
            })
    };
    assert!((0..8).any(differs));
}

#[test]
fn a_drive_is_shown_and_the_way_back_is_asked_for() {
    let scenario = scenario();
    let stride = stride_of(scenario.dt);
    let present = (HISTORY - 1) * stride;
    let off = gump_geometry::dvec2(0.0, 2.0);
    let driven = |index: usize| {
        let agents = scenario.log[index].agents().iter().map(|agent| {
            let mut state = agent.state;
            state.pose.position += off;
            agent.with_state(state)
        });
        Frame::new(agents.collect(), Vec::new())
    };
    let drive = DrivenScenario {
        scenario: 0,
        present,
        stride,
        frames: (1..=4).map(|i| driven(present + i * stride)).collect(),
    };
    let way = Driven {
        drive: &drive,
        slack: 0.5,
    };
    let config = SampleConfig::plain(4);
    let sample = (0..64).find_map(|i| {
        let seed = Seed(i);
        draw(&scenario, Some(way), &reader(), &config, seed)
            // The last two of four frames are driven ones.
            .filter(|sample| sample.states.len() == 12)
    });
    let sample = sample.expect("a sample can be drawn");
    let of_last_agent = |frame: usize| {
        let states = sample.states.iter();
        states
            .filter(|target| sample.slots[target.key].frame == frame)
            .map(|target| (target, sample.slots[target.key + 1].slot))
            .next_back()
            .expect("every frame has agents")
    };
    let lateral = |bin: Option<u16>| Field::Y.dequantize(bin.expect("a bin is asked for"));
    let frames = sample.slots.last().expect("slots").frame;
    let (target, Slot::Value(seen)) = of_last_agent(frames) else {
        panic!("a target stands at a key");
    };
    // Half of the two metres are left after one frame, a quarter after two.
    let ys = [target.bins[5], target.bins[8]].map(lateral);
    let back = seen.pose().position.y - ys[0];
    assert!((back - 1.0).abs() < 0.25, "{back}");
    // The pedestrian itself walks half a metre to the right in a frame.
    let then = ys[0] - ys[1];
    assert!((then - 1.0).abs() < 0.25, "{then}");
}

#[test]
fn blanked_frames_have_no_targets() {
    let config = SampleConfig {
        frame_dropout: 1.0,
        ..SampleConfig::plain(4)
    };
    let sample = sample(&config, 2);
    assert!(
        sample
            .states
            .iter()
            .all(|target| sample.slots[target.key].frame == 0)
    );
    assert!(
        sample
            .slots
            .iter()
            .all(|p| p.frame == 0 || matches!(p.slot, Slot::Pad))
    );
}

#[test]
fn what_is_hidden_is_unknown_and_what_is_asked_stays() {
    let mut scenario = scenario();
    let mut parts = scenario.map.parts().clone();
    parts.lanes[0].speed_limit = Some(10.0);
    parts.stop_signs.push(gump_scene::StopSign {
        id: 90,
        position: gump_geometry::dvec3(30.0, 2.0, 0.0),
        lanes: vec![gump_scene::LaneId(1)],
    });
    scenario.map = Arc::new(MapGraph::new(parts).unwrap());
    let drawn = |share: f64| {
        let config = SampleConfig {
            hide_limits: share,
            hide_stop_signs: share,
            hide_lights: share,
            hide_sizes: share,
            ..SampleConfig::plain(4)
        };
        draw(&scenario, None, &reader(), &config, Seed(1)).expect("a sample can be drawn")
    };
    let (visible, hidden) = (drawn(0.0), drawn(1.0));
    let lights = |sample: &Sample| {
        let is_light = |placed: &&PlacedSlot| matches!(placed.slot, Slot::Light(_));
        sample.slots.iter().filter(is_light).count()
    };
    assert_eq!((lights(&visible), lights(&hidden)), (4, 0));
    assert!(hidden.lights.is_empty());
    let layers = reader().spec.layers;
    let most = |sample: &Sample, layer: Layer| {
        let plane = layers.iter().position(|one| *one == layer).unwrap();
        let plane = sample.raster.data.chunks(16 * 16).nth(plane).unwrap();
        plane.iter().copied().fold(0.0, f32::max)
    };
    for layer in [Layer::StopLine, Layer::TrafficLightOccupancy] {
        assert_eq!(
            (most(&visible, layer), most(&hidden, layer)),
            (1.0, 0.0),
            "{layer}"
        );
    }
    // Lane 2 states no limit, and hidden ones look the same.
    let typical = (gump_scene::TYPICAL_SPEED_LIMIT / 24.0) as f32;
    assert_eq!(most(&hidden, Layer::SpeedLimit), typical);
    let unstated = scenario.map.unstated();
    assert!(
        !unstated.stop_signs && !unstated.lights,
        "the scene itself stays"
    );
    let sizes = |sample: &Sample| {
        let exact = sample.slots.iter().filter_map(|placed| placed.exact);
        exact.filter(|exact| exact.has_size).count()
    };
    assert!(sizes(&visible) > 0);
    assert_eq!(sizes(&hidden), 0);
    // Without the lights, every target comes earlier; its bins are the same except sizes, which
    // must not be learned.
    assert_eq!(visible.states.len(), hidden.states.len());
    for (visible, hidden) in visible.states.iter().zip(&hidden.states) {
        assert_eq!(visible.bins[2..], hidden.bins[2..]);
        assert_eq!(hidden.bins[..2], [None, None]);
    }
}

#[test]
fn old_configurations_hide_what_new_ones_do() {
    let config: SampleConfig = toml::from_str("frames = 4").unwrap();
    assert_eq!((config.hide_limits, config.hide_lights), (0.3, 0.1));
}
