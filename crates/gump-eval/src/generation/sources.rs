//! Sources of scenes that are compared with recorded ones.

use std::sync::Arc;

use gump_engine::TransformerWorld;
use gump_engine::placement::object_spec::{Bounds, ObjectSpec};
use gump_generate::baseline::{random_along_lanes, retrieved};
use gump_generate::{Counts, GenerateConfig, GenerateRequest, Placement};
use gump_metrics::mmd::{MmdProtocol, scene_mmd};
use gump_scene::{Agent, AgentId, AgentKind, Frame, Scenario, Seed};
use rand::Rng as _;

/// Draws of a moment and a vehicle per scene that is to be found in a recording. Chosen by hand.
const TRIES: usize = 20;

/// A source of scenes.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum SceneSource {
    /// The model, with its own manner of drawing.
    Model(Placement),
    /// The same, vehicles placed beyond the edges of the road as well.
    OffRoad,
    /// The same, the sequence network placing vehicles.
    Sequence,
    /// The model, with the manner of drawing of the paper.
    Paper,
    /// Anywhere on lanes.
    Random,
    /// A recorded scene that the model may have learned from.
    Retrieval,
    /// Another recorded scene of those that are compared: often of the same network and day.
    Oracle,
    /// The same recording, seconds earlier or later.
    Apart,
    /// The same scene, its vehicles drawn with replacement.
    Resampled,
    /// The scene itself.
    Log,
}

impl SceneSource {
    /// All sources, those of the model first.
    pub const ALL: [Self; 11] = [
        Self::Model(Placement::Guided),
        Self::Model(Placement::Free),
        Self::OffRoad,
        Self::Sequence,
        Self::Paper,
        Self::Random,
        Self::Retrieval,
        Self::Oracle,
        Self::Apart,
        Self::Resampled,
        Self::Log,
    ];

    /// Its name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Model(Placement::Guided) => "model guided",
            Self::Model(Placement::Free) => "model free",
            Self::OffRoad => "model guided, parks off road",
            Self::Sequence => "model guided, without placement network",
            Self::Paper => "model guided, paper's draws",
            Self::Random => "random along lanes",
            Self::Retrieval => "retrieval",
            Self::Oracle => "retrieval from the tested",
            Self::Apart => "log seconds apart",
            Self::Resampled => "log resampled",
            Self::Log => "log",
        }
    }
}

/// A recorded scene to be made again.
pub struct ComparedScene {
    /// The scene is the present of this.
    pub recorded: Scenario,
    /// The frame of its recording that is farthest in time.
    apart: Frame,
    /// Index of the recording.
    pub recording: usize,
}

impl ComparedScene {
    /// The present of a recording and `further` scenes that other vehicles of it have around them at
    /// other times, as far as the protocol admits them.
    pub fn of(
        recording: usize,
        scenario: Scenario,
        further: usize,
        protocol: &MmdProtocol,
        seed: Seed,
    ) -> Vec<Self> {
        let takes_part = |scenario: &Scenario| {
            let present = scenario.present();
            scene_mmd(&present, present.now(), protocol).is_some()
        };
        let apart = |now: usize| {
            let log = &scenario.log;
            let other = if 2 * now < log.len() {
                log.len() - 1
            } else {
                0
            };
            log[other].clone()
        };
        let mut rng = seed.rng();
        let mut cases = Vec::new();
        for _ in 0..TRIES * further {
            if cases.len() == further {
                break;
            }
            let now = rng.random_range(0..scenario.log.len());
            let agents = scenario.log[now].agents().iter();
            let vehicles: Vec<AgentId> = agents
                .filter(|agent| agent.kind == AgentKind::Vehicle)
                .map(|agent| agent.id)
                .collect();
            if vehicles.is_empty() {
                continue;
            }
            let seen = Scenario {
                ego: vehicles[rng.random_range(0..vehicles.len())],
                log: vec![scenario.log[now].clone()],
                now: 0,
                route: None,
                targets: Vec::new(),
                ..scenario.clone()
            };
            if takes_part(&seen) {
                cases.push(Self {
                    recorded: seen,
                    apart: apart(now),
                    recording,
                });
            }
        }
        if takes_part(&scenario) {
            cases.push(Self {
                apart: apart(scenario.now),
                recorded: scenario,
                recording,
            });
        }
        cases
    }

    /// The ego and the vehicles near it.
    fn vehicles(&self, protocol: &MmdProtocol) -> Vec<Agent> {
        let present = self.recorded.present();
        let ego = present.ego_now();
        let ego_from_world = ego.state.pose.inverse();
        let near = |agent: &&Agent| {
            let place = ego_from_world * agent.state.pose.position;
            agent.kind == AgentKind::Vehicle
                && (agent.id == ego.id || place.abs().max_element() <= protocol.half_side)
        };
        present
            .now()
            .agents()
            .iter()
            .filter(near)
            .copied()
            .collect()
    }
}

/// Everything that scenes are made of.
pub struct SceneMakers<'a> {
    /// The world that generates.
    pub world: &'a TransformerWorld,
    /// The recorded scenes.
    pub cases: &'a [ComparedScene],
    /// Recordings that are retrieved.
    pub bank: &'a [Scenario],
    /// The vehicles that count.
    pub protocol: MmdProtocol,
}

impl SceneMakers<'_> {
    /// The scene that a source makes in place of case `i`, vehicles only; `None` if it fails.
    pub fn make(&self, source: SceneSource, i: usize, seed: Seed) -> Option<Frame> {
        let case = &self.cases[i];
        let vehicles = case.vehicles(&self.protocol);
        let n = (vehicles.len() - 1).min(self.protocol.max_vehicles);
        let present = case.recorded.present();
        match source {
            SceneSource::Log => Some(Frame::new(vehicles, Vec::new())),
            SceneSource::Apart => Some(case.apart.clone()),
            SceneSource::Resampled => Some(resampled(&vehicles, present.ego, n, seed)),
            SceneSource::Random => Some(random_along_lanes(
                &present,
                n,
                self.protocol.half_side,
                seed,
            )),
            SceneSource::Retrieval => {
                let other = pick(self.bank.iter(), seed)?;
                Some(retrieved(&present, &other.present(), n))
            }
            SceneSource::Oracle => {
                let others = self.cases.iter();
                let others = others.filter(|other| other.recording != case.recording);
                Some(retrieved(
                    &present,
                    &pick(others, seed)?.recorded.present(),
                    n,
                ))
            }
            SceneSource::Model(placement) => self.generate(
                &case.recorded,
                n,
                seed,
                GenerateConfig {
                    placement,
                    ..GenerateConfig::default()
                },
            ),
            SceneSource::OffRoad => self.generate(
                &case.recorded,
                n,
                seed,
                GenerateConfig {
                    parks_off_road: true,
                    ..GenerateConfig::default()
                },
            ),
            SceneSource::Sequence => self.generate(
                &case.recorded,
                n,
                seed,
                GenerateConfig {
                    placement_network: false,
                    ..GenerateConfig::default()
                },
            ),
            SceneSource::Paper => self.generate(&case.recorded, n, seed, GenerateConfig::paper()),
        }
    }

    fn generate(
        &self,
        recorded: &Scenario,
        n: usize,
        seed: Seed,
        config: GenerateConfig,
    ) -> Option<Frame> {
        let side = Some(Bounds::new(
            -self.protocol.half_side,
            self.protocol.half_side,
        ));
        let object = |i: usize| ObjectSpec {
            id: format!("vehicle {i}"),
            x: side,
            y: side,
            ..ObjectSpec::default()
        };
        let mut request = GenerateRequest {
            counts: Some(Counts {
                vehicles: n,
                ..Counts::default()
            }),
            objects: (0..n).map(object).collect(),
            config,
            map: Arc::clone(&recorded.map),
            ..GenerateRequest::in_place_of(recorded)
        };
        let present = recorded.present();
        let ego = present.ego_now();
        request.ego.velocity = Some(ego.state.velocity);
        let generated = gump_generate::generate(self.world, &request, &[seed]).ok()?;
        let scene = generated.into_iter().next()?.ok()?;
        // The recorded ego has its own id, by which both scenes are seen.
        let agents = scene.frame.agents().iter().map(|agent| {
            let mut agent = *agent;
            agent.id = match agent.id {
                id if id == scene.ego => ego.id,
                id => AgentId(ego.id.0.saturating_add(id.0)),
            };
            agent
        });
        let moving = agents.filter(|agent| agent.kind.is_moving());
        Some(Frame::new(moving.collect(), Vec::new()))
    }
}

/// Any of some things, the same for the same seed.
fn pick<'a, T>(things: impl Iterator<Item = &'a T>, seed: Seed) -> Option<&'a T> {
    let things: Vec<&T> = things.collect();
    let n = things.len() as u64;
    (n > 0).then(|| things[(seed.fork(1).0 % n) as usize])
}

/// The ego and `n` of the other vehicles, drawn with replacement.
fn resampled(vehicles: &[Agent], ego: AgentId, n: usize, seed: Seed) -> Frame {
    let mut rng = seed.rng();
    let (own, others): (Vec<Agent>, Vec<Agent>) =
        vehicles.iter().partition(|agent| agent.id == ego);
    let drawn = (1..=n as i64).map(|i| Agent {
        id: AgentId(ego.0.saturating_add(i)),
        ..others[rng.random_range(0..others.len())]
    });
    Frame::new(own.iter().copied().chain(drawn).collect(), Vec::new())
}

#[cfg(test)]
mod tests {
    use gump_scene::fixture;

    use super::*;

    fn protocol() -> MmdProtocol {
        MmdProtocol {
            min_vehicles: 2,
            ..MmdProtocol::gump()
        }
    }

    fn scenario() -> Scenario {
        fixture::scenario(
            "ego vehicle 0: 0,0\nagent vehicle 1: 10,0 velocity 5,0\nagent vehicle 2: 20,0\n\
             agent pedestrian 3: 5,5\nhistory 1.0 future 8.0 dt 0.1",
        )
        .unwrap()
    }

    #[test]
    fn further_scenes_are_seen_by_other_vehicles_at_other_times() {
        let cases = ComparedScene::of(7, scenario(), 5, &protocol(), Seed(1));
        assert_eq!(cases.len(), 6);
        let own = cases.last().unwrap();
        assert_eq!((own.recorded.ego, own.recorded.now), (AgentId(0), 10));
        assert_eq!(own.apart, *own.recorded.log.last().unwrap());
        assert!(cases.iter().all(|case| case.recording == 7));
        assert!(cases.iter().any(|case| case.recorded.ego != AgentId(0)));
        assert!(cases.iter().all(|case| case.recorded.ego != AgentId(3)));
        let none = MmdProtocol {
            min_vehicles: 3,
            ..protocol()
        };
        assert!(ComparedScene::of(7, scenario(), 5, &none, Seed(1)).is_empty());
    }

    #[test]
    fn resampled_scenes_have_as_many_vehicles_of_the_same_kind() {
        let cases = ComparedScene::of(0, scenario(), 0, &protocol(), Seed(1));
        let vehicles = cases[0].vehicles(&protocol());
        let frame = resampled(&vehicles, AgentId(0), 2, Seed(2));
        assert_eq!(frame.agents().len(), 3);
        let is_known = |agent: &Agent| vehicles.iter().any(|v| v.state == agent.state);
        assert!(frame.agents().iter().all(is_known));
    }
}
