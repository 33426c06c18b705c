//! One future that is advanced manually, half a second at a time.
//!
//! A [`Session`] is given the ego's next state before the other agents move. An interactive driver
//! does not know that state yet: here the other agents decide first, on the assumption of a given
//! ego state, and their motion can be displayed; the actual ego state is set afterwards.

use std::ops::Range;

use gump_geometry::Pose;
use gump_model::steps::TOKEN_DT;
use gump_rollout::{PredictiveSamples, Start};
use gump_scene::{AgentId, AgentState, Frame, Light, SceneState, Seed};

use super::{Future, RelativeWorld, Workspace};
use crate::EngineError;

#[cfg(doc)]
use gump_rollout::Session;

/// A future of a [`RelativeWorld`] that can be stored, cloned and continued in several ways.
///
/// It belongs to the world that started it, and every call takes that world. If the ego follows the
/// assumed states, it equals future 0 of a session with the same seed, bit for bit.
#[derive(Clone, Debug)]
pub struct LiveFuture {
    future: Future,
    /// The decided moves of all agents, each in its own frame.
    moves: Vec<Pose>,
}

impl LiveFuture {
    /// Seconds between its frames.
    pub const DT: f64 = TOKEN_DT;

    /// Starts from the visible part of a scene.
    ///
    /// # Errors
    /// A time step that does not divide half a second.
    pub fn begin(
        world: &RelativeWorld,
        scene: SceneState<'_>,
        seed: Seed,
    ) -> Result<Self, EngineError> {
        let start = Start {
            scene,
            n_futures: 1,
            seed,
        };
        let mut futures = world.begin(&[start])?;
        Ok(Self {
            future: futures.swap_remove(0),
            moves: Vec::new(),
        })
    }

    /// Decides the next half second of all agents and returns their next states.
    ///
    /// `ego` is the assumed next state of the ego, which others avoid. Without it the network
    /// decides for the ego as well.
    pub fn decide(&mut self, world: &RelativeWorld, ego: Option<AgentState>) -> Frame {
        let mut room = Workspace::default();
        let future = &self.future;
        self.moves = future.decide(&world.engine, &world.sampling, ego, &mut room);
        let decided = future.members.iter().zip(&self.moves);
        let agents = decided.map(|(member, &step)| {
            let next = member.now().then(member.now().pose * step);
            let predicted = AgentState {
                pose: next.pose,
                velocity: next.velocity(),
            };
            let driven = ego.filter(|_| member.agent.id == future.scene.ego);
            member.agent.with_state(driven.unwrap_or(predicted))
        });
        let others = future.others.iter().map(|other| {
            let mut other = *other;
            other.state.pose.position += other.state.velocity * TOKEN_DT;
            other
        });
        Frame::new(agents.chain(others).collect(), future.lights.clone())
    }

    /// Advances to the decided states; an ego that is given gets this actual state.
    ///
    /// Without a preceding decision no agent moves.
    pub fn go_on(&mut self, world: &RelativeWorld, ego: Option<AgentState>) -> Frame {
        let mut room = Workspace::default();
        let mut moves = std::mem::take(&mut self.moves);
        moves.resize(self.future.members.len(), Pose::IDENTITY);
        self.future.go(&world.engine, &moves, ego);
        self.future.read(&world.engine, &mut room);
        self.future.follow(&world.engine, &world.sampling);
        self.future.frame()
    }

    /// Sets the lights of the next frame. Colours that differ count as changed at that time.
    pub fn show(&mut self, lights: &[Light]) {
        self.future.show(lights);
    }

    /// Predictive samples of the next half second of all agents except `driven`, independent of the
    /// decision: this number of draws for each. The future does not change.
    pub fn predictive_samples(
        &self,
        world: &RelativeWorld,
        draws: Range<u64>,
        driven: Option<AgentId>,
    ) -> Vec<PredictiveSamples> {
        let step = self.future.frames - self.future.history;
        self.future
            .predictive_samples(&world.engine, &world.sampling, (draws, 0, step), driven)
    }

    /// The same present with another seed for what follows.
    #[must_use]
    pub fn fork(&self, seed: Seed) -> Self {
        let mut fork = self.clone();
        fork.future.seed = seed;
        fork.moves.clear();
        fork
    }
}

#[cfg(test)]
mod tests {
    use gump_geometry::DVec2;
    use gump_model::relative::RelativeWeights;
    use gump_rollout::{Start, WorldModel as _};
    use gump_scene::{Scenario, Seed, fixture};

    use super::*;
    use crate::relative::RelativeSampling;

    fn world() -> RelativeWorld {
        let path = "../../datasets/weights/gump-relative.safetensors";
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
        let weights = RelativeWeights::read(&std::fs::read(path).unwrap()).unwrap();
        let sampling = RelativeSampling {
            redraws: 4,
            limits: true,
            ..RelativeSampling::default()
        };
        RelativeWorld::of_weights(&weights, sampling).unwrap()
    }

    fn scenario() -> Scenario {
        fixture::scenario(
            "lane 1: 0,0 160,0 speed 15
             edge: 0,-3 160,-3
             ego vehicle 0: 10,0 velocity 8,0
             agent vehicle 1: 30,0 velocity 6,0
             agent bicycle 3: 20,-2 velocity 4,0
             agent pedestrian 4: 40,5 velocity 0,-1
             agent other 5: 90,3",
        )
        .unwrap()
    }

    /// The frames of future 0 of a session, and a live future of the same seed.
    #[test]
    fn led_on_as_assumed_it_is_a_sessions_future() {
        let (world, scenario) = (world(), scenario());
        for driven in [false, true] {
            let scene = scenario.present();
            let start = Start {
                scene,
                n_futures: 1,
                seed: Seed(4),
            };
            let mut session = world.open(&[start]).unwrap();
            let mut live = LiveFuture::begin(&world, scene, Seed(4)).unwrap();
            let mut ego = scene.ego_now().state;
            for _ in 0..4 {
                ego.pose.position += DVec2::new(3.0, 0.0);
                let assumed = driven.then_some(ego);
                let ahead = live.decide(&world, assumed);
                let expected = session
                    .step(assumed.as_ref().map(std::slice::from_ref))
                    .unwrap();
                assert_eq!(ahead.agents(), expected[0].agents());
                let moving = ahead.agents().iter().filter(|agent| agent.kind.is_moving());
                assert_eq!(
                    live.predictive_samples(&world, 0..2, None).len(),
                    moving.count()
                );
                assert_eq!(live.go_on(&world, assumed), expected[0]);
            }
        }
    }

    #[test]
    fn the_map_is_there_around_the_start_and_around_an_ego_that_is_far_from_it() {
        let road = "lane 1: 0,0 2000,0 speed 15\nego vehicle 0: 10,0 velocity 8,0";
        let (world, scenario) = (world(), fixture::scenario(road).unwrap());
        let scene = scenario.present();
        let mut live = LiveFuture::begin(&world, scene, Seed(4)).unwrap();
        let mut ego = scene.ego_now().state;
        for metres in [150.0, 600.0, 1200.0] {
            ego.pose.position = DVec2::new(metres, 0.0);
            live.go_on(&world, Some(ego));
            let pieces = &live.future.scene.map.pieces;
            let is_there = |x: f64| {
                let mut at = pieces.iter().map(|piece| piece.pose.position.x);
                at.any(|at| (at - x).abs() < 20.0)
            };
            assert!(is_there(20.0) && is_there(metres) && is_there(metres + 100.0));
            assert!(!is_there(metres + 400.0));
        }
        assert!(
            live.future.scene.map.pieces.len() < 200,
            "not the road between"
        );
    }

    #[test]
    fn copies_go_their_own_ways() {
        let (world, scenario) = (world(), scenario());
        let mut live = LiveFuture::begin(&world, scenario.present(), Seed(4)).unwrap();
        let mut copy = live.clone();
        let mut fork = live.fork(Seed(5));
        let ways = [&mut live, &mut copy, &mut fork].map(|future| {
            future.decide(&world, None);
            future.go_on(&world, None)
        });
        assert_eq!(ways[0], ways[1]);
        assert_ne!(ways[0], ways[2]);
    }

    #[test]
    fn an_ego_that_is_driven_is_shown_as_it_is_however_long_it_stands() {
        let road = "lane 1: 0,0 160,0 speed 15\nego vehicle 0: 10,0";
        let (world, scenario) = (world(), fixture::scenario(road).unwrap());
        let scene = scenario.present();
        let mut live = LiveFuture::begin(&world, scene, Seed(4)).unwrap();
        let stands = scene.ego_now().state;
        // Half a minute, longer than any agent's patience, on a free road.
        for _ in 0..60 {
            live.go_on(&world, Some(stands));
        }
        let ego = &live.future.members[0];
        assert!(ego.waited >= 30.0 && !ego.could_go, "{}", ego.waited);
        assert_eq!(ego.now().velocity(), DVec2::ZERO);
        // Left to the network from here on, it is one that could drive on.
        live.go_on(&world, None);
        assert!(live.future.members[0].could_go);
    }

    #[test]
    fn a_long_history_tells_who_drove_and_who_has_been_idle() {
        let road = "lane 1: 0,0 160,0 speed 15\nego vehicle 0: 50,0\nhistory 1.0 future 1.0 dt 0.5";
        let (world, mut scenario) = (world(), fixture::scenario(road).unwrap());
        let ego = *scenario.present().ego_now();
        // Two seconds at 8 m/s, then six in which it creeps by a decimetre each.
        let at = |k: i32| {
            let mut agent = ego;
            let (x, speed) = match k {
                ..=4 => (50.0 - 4.0 * f64::from(4 - k), 8.0),
                _ => (50.0 + 0.1 * f64::from(k - 4), 0.2),
            };
            agent.state.pose.position.x = x;
            agent.state.velocity.x = speed;
            Frame::new(vec![agent], Vec::new())
        };
        scenario.log = (0..=16).map(at).collect();
        scenario.now = 16;
        let live = LiveFuture::begin(&world, scenario.present(), Seed(4)).unwrap();
        let member = &live.future.members[0];
        assert!(member.has_driven);
        assert_eq!((member.idle, member.waited), (6.0, 0.0));
        scenario.log.drain(..12);
        scenario.now = 4;
        let live = LiveFuture::begin(&world, scenario.present(), Seed(4)).unwrap();
        assert!(!live.future.members[0].has_driven);
    }
}
