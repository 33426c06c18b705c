//! A seed gives the same scenes today as when its version of the generator was new.
//!
//! Frozen sets of scenes (`datasets/benchmarks`) rest on it. If a test here fails, the change made
//! other scenes of old seeds: either undo that, or keep what was under its version and raise
//! `GENERATOR_VERSION`.

use std::path::Path;

use gump_data::sumo::Network;
use gump_geometry::angle_difference;
use gump_scene::{Agent, AgentKind, Scenario, Seed};
use gump_synthesis::{
    GENERATOR_VERSION, RoadFamily, SumoDemand, SynthesisConfig, draw_sumo_demand, synthesize,
};

/// 64-bit FNV-1a over numbers and names.
struct Sum(u64);

impl Sum {
    fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    fn bytes(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }

    /// To a hundredth: the last bits of a sine differ between machines.
    fn number(&mut self, x: f64) {
        self.bytes(&((x * 100.0).round() as i64).to_le_bytes());
    }

    fn scene(&mut self, scene: &Scenario) {
        self.bytes(scene.id.as_bytes());
        for frame in &scene.log {
            for agent in frame.agents() {
                self.bytes(&agent.id.0.to_le_bytes());
                let state = &agent.state;
                let [p, v] = [state.pose.position, state.velocity];
                for x in [p.x, p.y, v.x, v.y, agent.length, agent.width] {
                    self.number(x);
                }
            }
            for light in frame.lights() {
                self.bytes(format!("{light:?}").as_bytes());
            }
        }
        for lane in scene.map.lanes() {
            for p in lane.centerline.points() {
                self.number(p.x);
                self.number(p.y);
            }
        }
    }
}

#[test]
fn version_1_makes_the_scenes_it_always_made() {
    let mut sum = Sum::new();
    for (k, family) in (0_u64..).zip(RoadFamily::ALL) {
        let config = SynthesisConfig {
            family: Some(family),
            ..SynthesisConfig::of_version(1).unwrap()
        };
        sum.scene(&synthesize(&config, Seed(41).fork(k)));
    }
    assert_eq!(format!("{:016x}", sum.0), "5387d87bc366abaa");
}

#[test]
fn version_2_differs_by_the_headings_of_vehicles_alone() {
    let mut turned = 0;
    for (k, family) in (0_u64..).zip(RoadFamily::ALL) {
        let [before, now] = [1, 2].map(|version| {
            let config = SynthesisConfig {
                family: Some(family),
                ..SynthesisConfig::of_version(version).unwrap()
            };
            synthesize(&config, Seed(41).fork(k))
        });
        let agents = |scene: &Scenario| -> Vec<Agent> {
            let frames = scene.log.iter();
            frames.flat_map(|frame| frame.agents().to_vec()).collect()
        };
        for (a, b) in agents(&before).into_iter().zip(agents(&now)) {
            assert_eq!(a.state.pose.position, b.state.pose.position);
            assert_eq!(a.state.velocity, b.state.velocity);
            let by = angle_difference(a.state.pose.heading, b.state.pose.heading).abs();
            assert!(by == 0.0 || a.kind == AgentKind::Vehicle);
            turned += usize::from(by > 0.03);
        }
    }
    assert!(turned > 500, "{turned}");
}

#[test]
fn version_1_draws_the_trips_it_always_drew() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../gump-data/tests/sumo/small.net.xml.gz"
    );
    let network = Network::read(Path::new(path)).unwrap();
    let demand = SumoDemand::of_version(1).unwrap();
    let drawn = draw_sumo_demand(&network, &demand, Seed(41));
    let mut sum = Sum::new();
    for kind in &drawn.types {
        sum.bytes(format!("{kind:?}").as_bytes());
    }
    for trip in &drawn.trips {
        sum.number(trip.depart_s);
        sum.bytes(format!("{} {} {} {:?}", trip.from, trip.to, trip.kind, trip.on).as_bytes());
    }
    assert_eq!(format!("{:016x}", sum.0), "f235041b5ecf3636");
}

#[test]
fn scenes_are_made_by_the_newest_version_unless_told_otherwise() {
    let newest = GENERATOR_VERSION;
    let standard = Some(SynthesisConfig::standard());
    assert_eq!(SynthesisConfig::of_version(newest), standard);
    assert_eq!(SumoDemand::of_version(newest), Some(SumoDemand::standard()));
    assert_eq!(SynthesisConfig::of_version(newest + 1), None);
    assert_eq!(SumoDemand::of_version(newest + 1), None);
}
