//! One state of an object, wherever it is looked at: in training and driving, place and velocity.

use gump_scene::{Seed, fixture};

use crate::ModelConfig;
use crate::anchor::Anchor;
use crate::sample::{Reader, SampleConfig, TOKEN_DT, draw};
use crate::sampling::SamplingConfig;
use crate::scene::Scene;
use crate::surroundings::look_around;
use crate::tests::{imagine, network, scenario};
use crate::world::TransformerWorld;

/// What the log says and what a network says of one and the same frames is told in the same numbers.
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
    let driven = Scene::new(&world, scenario.present()).unwrap();
    let slots = driven.slots().unwrap();
    assert_eq!(shown.slots, slots);
    let seen = look_around(&driven.survey, &slots, 0);
    assert_eq!(look_around(&shown.survey, &shown.slots, 0), seen);
    // Each looks from where its chunk is said, which is between the bins.
    for (i, _) in seen {
        let key = &slots[i];
        let (exact, rounded) = (key.last_pose().unwrap(), key.last.unwrap().pose());
        assert_eq!(driven.anchor(key, &ModelConfig::tiny()), Anchor::at(exact));
        assert!(exact.position.distance(rounded.position) > 1e-3);
        assert!(exact.position.distance(rounded.position) < 0.15);
    }
}

#[test]
fn velocities_agree_with_displacements() {
    let scenario = scenario();
    let sampling = SamplingConfig {
        temperature: Some(1.5),
        ..SamplingConfig::default()
    };
    let (steps, _) = imagine(sampling, &scenario, 4, 6, None);
    let mut before = vec![scenario.present().now().clone(); 4];
    for frames in &steps {
        for (frame, before) in frames.iter().zip(&before) {
            for agent in frame.agents() {
                let was = before.agent(agent.id).expect("nobody comes");
                let moved = agent.state.pose.position - was.state.pose.position;
                let (mean, speed) = (moved.length() / TOKEN_DT, agent.state.speed());
                assert!(
                    (mean - speed).abs() < 2.31,
                    "{mean} m/s on the way, {speed} at its end"
                );
                assert!(
                    speed < 2.0 * mean + 0.31,
                    "{mean} m/s on the way, {speed} at its end"
                );
                assert!(mean > 0.0 || speed == 0.0, "what stands has no speed");
            }
        }
        before.clone_from(frames);
    }
}
