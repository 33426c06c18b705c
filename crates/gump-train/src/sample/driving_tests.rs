//! Tests that training and driving encode the same state of an object.

use gump_engine::scene::SceneContext;
use gump_engine::{SamplingConfig, TransformerWorld};
use gump_model::ModelConfig;
use gump_model::local_context::encode_local_context;
use gump_model::local_frame::LocalFrame;
use gump_model::testing::network;
use gump_scene::{Seed, fixture};

use super::{Reader, SampleConfig, draw};

/// Training on a log and driving with a network encode the same frames in the same numbers.
#[test]
fn training_and_driving_see_the_same() {
    // Poses between the bins; the log ends with the present, so that there is one window of it.
    let scenario = fixture::scenario(
        "lane 1: -100,0 100,0 speed 15
         edge: -100,-2 100,-2
         ego vehicle 0: 0.07,0.03 heading 0.013 velocity 8.03,0.1
         agent vehicle 1: 20.09,0.31 heading 0.02 velocity 5.07,0
         agent pedestrian 7: 30.05,3.08 velocity 0,-1.03
         history 1.0 future 0.0 dt 0.1",
    )
    .unwrap();
    let network = network();
    let reader = Reader::of(&network);
    let shown = draw(&scenario, None, &reader, &SampleConfig::plain(3), Seed(3))
        .expect("the log is a window");
    let world = TransformerWorld::new(network, SamplingConfig::default());
    let driven = SceneContext::new(&world, scenario.present()).unwrap();
    let slots = driven.slots().unwrap();
    assert_eq!(shown.slots, slots);
    let seen = encode_local_context(&driven.lane_map, &slots, 0);
    assert_eq!(encode_local_context(&shown.lane_map, &shown.slots, 0), seen);
    // Each has its context in the frame of its chunk, whose pose is between the bins.
    for (i, _) in seen {
        let key = &slots[i];
        let (exact, rounded) = (key.last_pose().unwrap(), key.last.unwrap().pose());
        assert_eq!(
            driven.local_frame(key, &ModelConfig::tiny()),
            LocalFrame::at(exact)
        );
        assert!(exact.position.distance(rounded.position) > 1e-3);
        assert!(exact.position.distance(rounded.position) < 0.15);
    }
}
