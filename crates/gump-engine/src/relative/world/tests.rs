//! Futures of the shipped weights: routes.

use gump_model::relative::route::Route;
use gump_scene::{LaneId, Scenario, fixture};

use super::*;

fn world(routes: Routes) -> RelativeWorld {
    let path = "../../datasets/weights/gump-relative.safetensors";
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
    let weights = RelativeWeights::read(&std::fs::read(path).unwrap()).unwrap();
    let sampling = RelativeSampling {
        routes,
        ..RelativeSampling::default()
    };
    RelativeWorld::of_weights(&weights, sampling).unwrap()
}

/// A vehicle that comes to a place where it may go on or turn to either side.
fn fork() -> Scenario {
    fixture::scenario(
        "lane 1: -80,0 0,0 speed 13 next 2,3,4
         lane 2: 0,0 30,0 speed 13 next 5
         lane 3: 0,0 6,1 11,4 14,9 15,15 speed 8 next 6
         lane 4: 0,0 4,-0.7 8,-3 10.5,-6.5 11.5,-11 speed 8 next 7
         lane 5: 30,0 120,0 speed 13
         lane 6: 15,15 15,100 speed 13
         lane 7: 11.5,-11 11.5,-100 speed 13
         ego vehicle 0: -32,0 velocity 6,0",
    )
    .unwrap()
}

/// A future of a scene after so many steps, and the route that its first agent had after one.
fn future(
    world: &RelativeWorld,
    scenario: &Scenario,
    seed: u64,
    steps: usize,
) -> (Future, Option<Route>) {
    let start = Start {
        scene: scenario.present(),
        n_futures: 1,
        seed: Seed(seed),
    };
    let mut future = world.begin(&[start]).unwrap().remove(0);
    let mut room = Workspace::default();
    let mut meant = None;
    for step in 0..steps {
        let all = std::slice::from_mut(&mut future);
        Future::step_all(all, &world.engine, &world.sampling, None, &mut room);
        if step == 0 {
            meant = future.members[0].intent.route().cloned();
        }
    }
    (future, meant)
}

#[test]
fn vehicles_follow_their_routes() {
    let (world, scenario) = (world(Routes::Always), fork());
    let mut followed = [(0, 0); 2];
    for seed in 0..64 {
        let (future, meant) = future(&world, &scenario, seed, 18);
        let meant = meant.expect("the vehicle is on a lane");
        let turns = usize::from(!meant.lanes().contains(&LaneId(2)));
        let away = meant.offset_m(&scenario.map, future.members[0].now().pose);
        followed[turns].0 += usize::from(away < 3.0);
        followed[turns].1 += 1;
    }
    for (on, of) in followed {
        assert!(of > 5 && 10 * on >= 9 * of, "{followed:?}");
    }
}

#[test]
fn without_routes_there_are_none() {
    let (future, meant) = future(&world(Routes::Never), &fork(), 1, 6);
    assert_eq!(meant, None);
    assert_eq!(future.members[0].intent.route(), None);
}
