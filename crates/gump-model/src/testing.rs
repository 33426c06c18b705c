//! A small network and scene for tests of this crate and of those above.

use std::sync::Arc;

use candle_core::Device;
use gump_scene::{Frame, Scenario, Seed, fixture};
use gump_tokenizer::{Identities, Tokenizer, TokenizerConfig};

use crate::Network;
use crate::config::{Gate, ModelConfig, VisualConfig};
use crate::exact::ExactFrames;
use crate::local_context::LaneMap;
use crate::mct::VisualMemory;
use crate::placed_slot::{PlacedSlot, place_exactly};

/// A network small enough for tests, with gates open so that the map matters.
pub fn network() -> Network {
    let config = ModelConfig {
        width: 32,
        layers: 4,
        heads: 2,
        block_size: 512,
        gate: Gate::Released,
        visual: VisualConfig {
            side_px: 104,
            metres_per_px: 2.0,
            ..ModelConfig::tiny().visual
        },
        ..ModelConfig::tiny()
    };
    Network::random(config, Seed(1), &Device::Cpu)
        .expect("the test's network and scene fit together")
}

pub fn scenario() -> Scenario {
    fixture::scenario(
        "lane 1: -100,0 100,0 speed 15
         edge: -100,-2 100,-2
         light 1 red: 60,0
         ego vehicle 0: 0,0 velocity 8,0
         agent vehicle 1: 20,0 velocity 5,0
         agent vehicle 2: -20,0 velocity 5,0
         agent pedestrian 7: 30,3 velocity 0,-1
         agent bicycle 4: 10,5 velocity 3,0.5",
    )
    .expect("the test's network and scene fit together")
}

/// Three frames of the scenario as slots.
pub fn slots(scenario: &Scenario) -> Vec<PlacedSlot> {
    let scene = scenario.present();
    let frames = scene.strided_history(5, 3);
    let pose = scene.ego_now().state.pose;
    let identities = Identities::ranked(&frames, scene.ego, pose);
    let encoded = Tokenizer::new(TokenizerConfig::default()).encode(
        scene.map,
        &frames,
        scene.ego,
        pose,
        &identities,
    );
    let frames: Vec<Frame> = frames.into_iter().cloned().collect();
    let exact = ExactFrames::last(frames.len(), &frames, &identities, pose);
    place_exactly(&encoded.sequence, |frame, id| exact.of(frame, id))
}

pub fn memory(network: &Network, scenario: &Scenario) -> VisualMemory {
    let scene = scenario.present();
    let raster = gump_raster::rasterize(network.raster_spec(), &scene, scene.ego_now().state.pose);
    let lane_map = LaneMap::new(scene.map, scene.ego_now().state.pose);
    network
        .look(&[raster], vec![Arc::new(lane_map)])
        .expect("the test's network and scene fit together")
}

/// Hidden vectors, one row per token.
pub fn hidden(
    network: &Network,
    sequences: &[&[PlacedSlot]],
    memory: &VisualMemory,
) -> Vec<Vec<Vec<f32>>> {
    let batch = network
        .pack(sequences, 0, memory)
        .expect("the test's network and scene fit together");
    network
        .mct
        .forward(&batch, memory, None, None)
        .expect("the test's network and scene fit together")
        .hidden
        .to_vec3()
        .expect("the test's network and scene fit together")
}
