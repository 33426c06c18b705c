//! The relative network as a world model.
//!
//! A future stores its agents with their keys and values. The map around the ego is prepared and
//! computed once for all futures of a scene, and again for a future whose ego leaves it. Agents of
//! kinds that are not predicted continue with constant velocity; lights stay unless they are set
//! ([`Session::show`]).

mod live;

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use gump_geometry::{DVec2, Pose};
use gump_kernels::panels::Precision;
use gump_model::ModelError;
use gump_model::local_context::LaneMap;
use gump_model::relative::RelativeWeights;
use gump_model::relative::driveway::Driveways;
use gump_model::relative::graph::{Body, Lights, Shown};
use gump_model::relative::grid::{FIELDS, dequantize};
use gump_model::relative::map::{Hidden, VectorMap};
use gump_model::steps::TOKEN_DT;
use gump_rollout::{
    BoxError, PredictiveSamples, ProbeConfig, Session, SessionStats, Start, WorldModel,
};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Frame, Lane, Light, LightState, MapGraph, SceneState,
    Seed,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::EngineError;
use crate::nucleus::uniform;
use crate::relative::engine::{Draw, KEPT, MapMemory, Reach, RelativeEngine, Workspace};
use crate::relative::intent::Intent;
use crate::relative::rules::{
    Driven, HALTS, Known, RESOLVES, STARTS, Shut, StopLine, draw_again, kinematically_limited,
    obey_lines, resolve,
};
use crate::relative::seen::{FrameIndex, ObservedAgent, add_presents};
use crate::relative::turning_in::TakesWay;
use crate::relative::waiting::{
    AT_GREEN_S, INSISTS_S, Standing, has_room_behind, released, waits_if_made,
};
use crate::sampling::{Routes, SamplingConfig};

pub use live::LiveFuture;

/// Radius of the prepared map around the start, metres: 120 m are left around an ego that has gone
/// `FOLLOW_M`. Not tuned.
pub const MAP_M: f64 = 300.0;

/// Maximum known time since a light changed, seconds: the length of the training scenes.
const REMEMBERED_S: f64 = 9.0;

/// Maximum time for which an agent in a lane is shown as standing, seconds. Training scenes last
/// nine seconds: vehicles that stood throughout were usually parked, and stayed. In a long rollout
/// vehicles that wait at a junction would look like parked ones and never start. With 1 s, twice as
/// many run red lights (result 23).
const WAITED_S: f64 = 4.0;
/// An agent that has stood in a lane for longer than its patience although nothing holds it is shown
/// as seen for the first time, at [`START`], and under rules it is redrawn once if it stays. Its
/// patience is drawn evenly between these, seconds: longer than a benchmark of 8 s shows, and so
/// spread that agents that have stood since the start do not start together. Chosen on recorded/tune
/// and SUMO's scenes of a minute (result 23).
const PATIENCE_S: [f64; 2] = [9.0, 27.0];
/// A slower agent loses its patience, too, metres per second: who stands in another's way creeps by
/// centimetres now and then, and waits no less.
const CREEPS: f64 = 0.5;
/// One that rolls without a reason to slow down, and is to be slower by more than this after a step, is
/// drawn once more, metres per second. Chosen by hand.
const DAWDLES_MPS: f64 = 0.2;
/// Who goes on and stops again within this has still waited, metres: it came up to the line.
const NO_FARTHER_M: f64 = 5.0;
/// The speed of a restarted agent, metres per second. With 2 m/s vehicles start more often than in the
/// log (result 23).
const START: f64 = 1.01;
/// The same, after a benchmark's time, of one that was seen to drive: slower ones often stop again (result
/// 53).
const SETS_OFF: f64 = 3.0;
/// After as many steps, nine seconds, vehicles without a reason to slow down are shown without
/// their past (see [`View::is_free`](gump_model::relative::graph::View::is_free)), and are given
/// routes.
const LATE: usize = 18;
/// Who stands in a junction across the way of another that stands across its own backs up by so many
/// metres a step, for so many steps, and then waits for so many: two metres in two seconds, as drivers
/// do, and time for the other to pass. Chosen by hand (decision 35).
const BACK_M: f64 = 0.5;
const BACKS_UP: usize = 4;
/// Who blocks an oncoming vehicle on a road backs up for so many steps, five metres: the other has to
/// swerve. Chosen by hand.
const BACKS_ON_ROAD: usize = 10;
const WAITS_BACK: usize = 14;
/// Who goes on and stops again within so many steps has still waited for ten seconds: in a junction it
/// goes on at once, where it would creep through two phases of the lights. Chosen by hand (decision 35).
const GOES_ON: usize = 8;
/// Who insists at a junction without lights goes before those who can still stop, for so many steps, and,
/// if it has not gone by then, again after so many. Chosen by hand.
const INSISTS: usize = 8;
const AGAIN: usize = 16;
/// An agent that was faster than this is not parked, metres per second: more than the jitter of
/// recorded boxes. Chosen by hand (decision 26).
const DRIVES: f64 = 2.0;
/// An agent this near to a lane's centre, and this well aligned with it, stands in the lane:
/// metres, radians; as in `waiting`. Otherwise it is taken for parked. Chosen by hand.
const IN_LANE: (f64, f64) = (1.0, 0.35);

/// Of pedestrians who are faster than this, metres per second, and draw standing, this share is drawn once
/// more under the rules: on recorded/train as many stand after 2, 4 and 8 s as in the log (result 41).
const WALKS: f64 = 0.5;
const WALKS_ON: f64 = 0.8;
/// Of vehicles that have stood for so long, seconds, since they were first seen, farther than this from
/// the centres of lanes, metres, and draw to set off, this share. Some who stand nearer are drivers who let
/// others pass. Of 2,300 that are parked on recorded/train hardly any sets off within 8 s, of those drawn
/// 1 % (result 41).
const PARKED_S: f64 = 1.0;
const BESIDE_M: f64 = 2.2;
const STAYS: f64 = 0.8;

/// Maximum distance of the ego from the centre of the prepared map, metres: more than in 8 s of
/// city traffic.
const FOLLOW_M: f64 = 180.0;

/// Default nucleus of the distance ahead: draws are among the most likely bins that together have
/// this probability. Targets are smoothed over neighbouring bins, so the truncated part is mostly
/// smoothing: with 1, pedestrians occasionally jump. Chosen on the tuning set (result 19).
const TOP_P: f64 = 0.95;

/// Maximum number of futures that are computed together: with more, the weights are already loaded
/// rarely enough, and the data no longer fits a core's cache. Results do not depend on it.
const TOGETHER: usize = 8;

/// Separates the streams of redraws from those of fields, which are few, ...
const REDRAW: u64 = 1 << 20;
/// ... and those of predictive samples from both.
const SAMPLE_STREAMS: u64 = 1 << 40;
/// ... those of people who walk on, ...
const WALK: u64 = 1 << 43;
/// ... and of vehicles that stay parked, ...
const PARK: u64 = 1 << 44;
/// The stream of patience, ...
const PATIENCE: u64 = 1 << 41;
/// ... and that of routes.
const ROUTES: u64 = 1 << 42;

/// Settings of rollouts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RelativeSampling {
    /// Divides the logits; above 1 gives more varied draws.
    pub temperature: f64,
    /// Nucleus of the distance ahead: draws are among the most likely bins that together have this
    /// probability. Of sideways moves and turns 0.4 of that tail is cut off. Whether to stand is drawn
    /// however unlikely it is by those who are slow, and by people.
    pub top_p: f64,
    /// Maximum number of redraws of an agent that would overlap another or leave the road within
    /// 1.5 s.
    pub redraws: usize,
    /// Whether redraws also keep agents clear of an ego that is driven from outside. Without it only
    /// the network makes them react to it.
    pub yields_to_driven: bool,
    /// Whether vehicles and bicycles are prevented from turning in place and slipping sideways, and
    /// people from speeding up beyond a run.
    pub limits: bool,
    /// When vehicles are given routes, which they keep.
    pub routes: Routes,
    /// The form in which the weights are multiplied.
    pub precision: Precision,
}

impl Default for RelativeSampling {
    fn default() -> Self {
        Self {
            temperature: 1.0,
            top_p: TOP_P,
            redraws: 0,
            yields_to_driven: true,
            limits: false,
            routes: Routes::default(),
            precision: Precision::F32,
        }
    }
}

impl From<&SamplingConfig> for RelativeSampling {
    /// The settings that this network supports.
    fn from(config: &SamplingConfig) -> Self {
        let usual = Self::default();
        Self {
            temperature: config.temperature.unwrap_or(usual.temperature),
            top_p: config.top_p.unwrap_or(usual.top_p),
            redraws: config.redraws,
            yields_to_driven: config.yields_to_driven,
            limits: config.limits,
            routes: config.routes,
            precision: config.precision,
        }
    }
}

impl RelativeSampling {
    fn draw(&self) -> Draw {
        Draw {
            temperature: self.temperature,
            top_p: self.top_p,
        }
    }
}

/// A trained relative network as a world model.
#[derive(Debug)]
pub struct RelativeWorld {
    engine: RelativeEngine,
    sampling: RelativeSampling,
    /// Scenes of open sessions: further sessions from the same present share them.
    scenes: Mutex<Vec<Weak<Scene>>>,
}

impl RelativeWorld {
    /// A world with these sampling settings.
    ///
    /// # Errors
    /// A network that is not in main memory as f32.
    #[cfg(feature = "tensors")]
    pub fn new(
        network: &gump_model::relative::RelativeNetwork,
        sampling: RelativeSampling,
    ) -> Result<Self, ModelError> {
        Self::of_weights(&RelativeWeights::of(network)?, sampling)
    }

    /// As [`Self::new`], from plain weights.
    ///
    /// # Errors
    /// Weights with a missing parameter.
    pub fn of_weights(
        weights: &RelativeWeights,
        sampling: RelativeSampling,
    ) -> Result<Self, ModelError> {
        Ok(Self {
            engine: RelativeEngine::new(weights, sampling.precision)?,
            sampling,
            scenes: Mutex::default(),
        })
    }

    /// Sets the divisor of the logits; above 1 gives more varied draws.
    pub fn set_temperature(&mut self, temperature: f64) {
        self.sampling.temperature = temperature;
    }

    /// The prepared map around the ego, shared with sessions from the same present.
    fn scene(&self, state: SceneState<'_>) -> Arc<Scene> {
        let (centre, lights) = Scene::place(state);
        let known = || self.scenes.lock().unwrap_or_else(PoisonError::into_inner);
        let same = |scene: &Weak<Scene>| {
            let scene = scene.upgrade()?;
            let is_same = Arc::ptr_eq(&scene.source, state.map)
                && scene.centres == [centre]
                && scene.ego == state.ego
                && scene.lights == lights;
            is_same.then_some(scene)
        };
        if let Some(scene) = known().iter().find_map(same) {
            return scene;
        }
        let source = Arc::clone(state.map);
        let here = (state.ego, &lights[..]);
        let scene = Scene::around(&self.engine, source, vec![centre], here, &self.sampling);
        let scene = Arc::new(scene);
        let mut scenes = known();
        scenes.retain(|scene| scene.strong_count() > 0);
        scenes.push(Arc::downgrade(&scene));
        scene
    }

    /// The futures of starts from one scene, which share it.
    fn begin(&self, starts: &[Start<'_>]) -> Result<Vec<Future>, EngineError> {
        let Some(first) = starts.first() else {
            return Ok(Vec::new());
        };
        let scene = self.scene(first.scene);
        let first = Future::begin(&self.engine, &scene, first.scene)?;
        let seeds = starts
            .iter()
            .flat_map(|start| (0..start.n_futures).map(|k| start.seed.fork(k as u64)));
        let futures = seeds.map(|seed| Future {
            seed,
            ..first.clone()
        });
        let mut futures: Vec<Future> = futures.collect();
        // Who turns into a driveway now was read as one who does not. An ego may be driven from outside.
        let mut room = Workspace::default();
        for future in &mut futures {
            if future.turn_into_driveways(Some(scene.ego)) {
                future.reread(&self.engine, &mut room);
            }
        }
        Ok(futures)
    }
}

impl RelativeWorld {
    /// The inputs of the present's nodes and their final vectors, agents in the order of their ids:
    /// those of training for the same frames, up to rounding.
    ///
    /// # Errors
    /// A scene that cannot be simulated.
    pub fn read_present(&self, scene: SceneState<'_>) -> Result<(Vec<f32>, Vec<f32>), EngineError> {
        let shared = self.scene(scene);
        let future = Future::begin(&self.engine, &shared, scene)?;
        let numbers = future
            .members
            .iter()
            .flat_map(|member| member.now().numbers());
        Ok((numbers.collect(), future.hidden))
    }
}

impl WorldModel for RelativeWorld {
    fn name(&self) -> &str {
        "model"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        // Planners open the same scene for each of their candidates: it is read once.
        let groups = starts.chunk_by(|a, b| a.scene.is_same_scene(&b.scene));
        let groups: Vec<&[Start<'_>]> = groups.collect();
        let begun = groups.par_iter().map(|group| self.begin(group));
        let begun: Vec<_> = begun.collect::<Result<_, _>>()?;
        Ok(Box::new(RelativeSession {
            world: self,
            futures: begun.into_iter().flatten().collect(),
            step: 0,
            probe: ProbeConfig::default(),
            samples: Vec::new(),
        }))
    }
}

/// Data shared by all futures of a start.
#[derive(Debug)]
pub(super) struct Scene {
    source: Arc<MapGraph>,
    /// The points around which it is laid out: where the ego started, where agents keep arriving
    /// when it has gone, and where it was when the map was laid out.
    centres: Vec<DVec2>,
    map: VectorMap,
    pub memory: MapMemory,
    /// The edges of the road, for rules and for ways into driveways.
    pub lane_map: LaneMap,
    /// The ways into driveways.
    driveways: Driveways,
    ego: AgentId,
    /// The lights that it may show.
    lights: Vec<Light>,
    /// When vehicles are given routes.
    routes: Routes,
    /// Whether moves are drawn again under the rules.
    has_rules: bool,
}

impl Scene {
    /// The middle of what is laid out for a start, and the lights that may be shown.
    fn place(scene: SceneState<'_>) -> (DVec2, Vec<Light>) {
        // Lights that are not seen at the present may be shown later.
        let seen = scene.history.iter().flat_map(Frame::lights);
        let seen: BTreeMap<_, _> = seen.map(|light| (light.lane, *light)).collect();
        let centre = scene.ego_now().state.pose.position;
        (centre, seen.into_values().collect())
    }

    fn around(
        engine: &RelativeEngine,
        source: Arc<MapGraph>,
        centres: Vec<DVec2>,
        (ego, lights): (AgentId, &[Light]),
        sampling: &RelativeSampling,
    ) -> Self {
        let mut map = VectorMap::around(&source, &centres, MAP_M, Hidden::default());
        let lane_map = match (sampling.redraws, sampling.routes) {
            (0, Routes::Never) => LaneMap::default(),
            _ => LaneMap::of_curbs(&source, &centres, MAP_M),
        };
        let driveways = match sampling.routes {
            Routes::Never => Driveways::default(),
            _ => Driveways::around(&source, &lane_map, &centres, MAP_M),
        };
        map.add_driveways(&driveways, &centres, MAP_M);
        Self {
            memory: engine.remember(&map),
            map,
            lane_map,
            driveways,
            source,
            centres,
            ego,
            lights: lights.to_vec(),
            routes: sampling.routes,
            has_rules: sampling.redraws > 0,
        }
    }
}

/// An agent of a future.
#[derive(Clone, Debug)]
struct Member {
    agent: Agent,
    seen: ObservedAgent,
    /// Time that it has stood, seconds, as far as it was observed.
    waited: f64,
    /// Time for which it has been slower than [`CREEPS`], seconds, and where it was so first: who goes on
    /// a little has still waited.
    idle: f64,
    idle_at: DVec2,
    /// Whether it was faster than [`DRIVES`] in a frame since.
    has_driven: bool,
    /// Whether it stands in a lane although nothing holds it.
    could_go: bool,
    /// Whether it rolls slowly on a lane although nothing holds it.
    could_roll: bool,
    /// Steps for which it backs up for others, and waits afterwards.
    backing: usize,
    /// Steps for which it does not wait again where it could go: another has backed up for it, or it has
    /// just begun to.
    let_pass: usize,
    /// Steps for which others let it pass, because it has waited for long.
    insists: usize,
    /// Where it means to go.
    intent: Intent,
}

/// One future in progress.
#[derive(Clone, Debug)]
struct Future {
    scene: Arc<Scene>,
    seed: Seed,
    /// Frames read so far.
    frames: usize,
    /// Frames of the history.
    history: usize,
    /// Whether the scene is made rather than recorded: a scene of one frame is.
    is_made: bool,
    members: Vec<Member>,
    /// Agents that are not predicted.
    others: Vec<Agent>,
    /// Lights of the next frame.
    lights: Vec<Light>,
    /// The input of the network for them.
    shown_lights: Lights,
    /// The lines before all lights that it has shown or may show, where rules look at them.
    lines: Arc<Vec<StopLine>>,
    /// Lights of the present frame.
    lights_now: Vec<Light>,
    /// Hidden vectors of the present's nodes, `[members, C]`.
    hidden: Vec<f32>,
}

impl Future {
    /// The present of a scene, its history read.
    fn begin(
        engine: &RelativeEngine,
        scene: &Arc<Scene>,
        state: SceneState<'_>,
    ) -> Result<Self, EngineError> {
        let stride = (TOKEN_DT / state.dt).round().max(1.0) as usize;
        if (stride as f64 * state.dt - TOKEN_DT).abs() > 1e-3 {
            return Err(EngineError::TimeStep {
                dt: state.dt,
                expected: TOKEN_DT,
            });
        }
        let frames = state.strided_history(stride, KEPT);
        let (predicted, others): (Vec<Agent>, Vec<Agent>) = state
            .now()
            .agents()
            .iter()
            .partition(|agent| agent.kind.is_moving());
        let mut future = Self {
            scene: Arc::clone(scene),
            seed: Seed(0),
            frames: 0,
            history: frames.len(),
            is_made: state.history.len() == 1,
            members: Vec::new(),
            others,
            lights: state.now().lights().to_vec(),
            lights_now: state.now().lights().to_vec(),
            shown_lights: Lights::default(),
            lines: match scene.has_rules {
                true => Arc::new(StopLine::of(&scene.source, &scene.lights)),
                false => Arc::default(),
            },
            hidden: Vec::new(),
        };
        let now = state.history.len() - 1;
        let mut room = Workspace::default();
        for (i, frame) in frames.iter().enumerate() {
            let index = now - (frames.len() - 1 - i) * stride;
            future.shown_lights = lights_at(&state.history[..=index], state.dt);
            future.see(engine, frame, &predicted);
            future.read(engine, &mut room);
        }
        for member in &mut future.members {
            member.recall(state.history, stride);
        }
        if future.is_made {
            future.take_for_made();
        }
        Ok(future)
    }

    /// Who stands in a lane or a junction of a made scene waits, and what else holds after nine seconds, since nothing is
    /// known of the past by then, holds from the start.
    fn take_for_made(&mut self) {
        self.is_made = true;
        let map = &self.scene.source;
        for member in &mut self.members {
            member.has_driven |= waits_if_made(map, &member.agent);
        }
    }

    /// Reads a frame of history: the states of the present agents that are in it.
    fn see(&mut self, engine: &RelativeEngine, frame: &Frame, predicted: &[Agent]) {
        let mut before: BTreeMap<AgentId, Member> = std::mem::take(&mut self.members)
            .into_iter()
            .map(|member| (member.agent.id, member))
            .collect();
        for agent in predicted.iter().filter_map(|a| frame.agent(a.id)) {
            let state = agent.state;
            let member = match before.remove(&agent.id) {
                Some(mut member) => {
                    member.push(state);
                    member
                }
                None => Member::first(engine, agent),
            };
            self.members.push(member);
        }
    }

    /// Lets the network read the present.
    fn read(&mut self, engine: &RelativeEngine, room: &mut Workspace) {
        Self::read_all(std::slice::from_mut(self), engine, room);
    }

    /// Lets the network read the present of several futures at once: its weights are then fetched
    /// once for all of them.
    fn read_all(futures: &mut [Self], engine: &RelativeEngine, room: &mut Workspace) {
        let mut presents = Vec::new();
        for future in &mut *futures {
            let is_late = future.is_late();
            let (scene, lights) = (&future.scene, &future.shown_lights);
            let seen = future.members.iter_mut().map(|member| &mut member.seen);
            let map = (&scene.map, &scene.memory);
            let frame = FrameIndex {
                t: future.frames,
                is_late,
            };
            add_presents(map, lights, seen, frame, &mut presents);
        }
        let mut hidden = Vec::new();
        engine.read(&mut presents, room, &mut hidden);
        let c = engine.width();
        let mut rows = &hidden[..];
        for future in futures {
            let (own, rest) = rows.split_at(future.members.len() * c);
            future.hidden.clear();
            future.hidden.extend_from_slice(own);
            future.frames += 1;
            rows = rest;
        }
    }

    /// Whether it is longer than benchmarks show, or of a made scene.
    fn is_late(&self) -> bool {
        self.is_made || self.frames >= self.history + LATE
    }

    /// Lets it read the present again, after others have come or gone.
    fn reread(&mut self, engine: &RelativeEngine, room: &mut Workspace) {
        self.frames -= 1;
        self.read(engine, room);
    }

    /// Lays the map out anew once the ego has come far from the middle of what is laid out.
    fn follow(&mut self, engine: &RelativeEngine, sampling: &RelativeSampling) {
        let scene = &self.scene;
        let ego = self.members.iter().find(|m| m.agent.id == scene.ego);
        let Some(ego) = ego.map(|member| member.now().pose.position) else {
            return;
        };
        let (start, last) = (scene.centres[0], scene.centres[scene.centres.len() - 1]);
        if ego.distance(last) > FOLLOW_M {
            let source = Arc::clone(&scene.source);
            let here = (scene.ego, &self.lights[..]);
            let next = Scene::around(engine, source, vec![start, ego], here, sampling);
            self.scene = Arc::new(next);
        }
    }

    /// Advances several futures by half a second; the network computes them together, so that its
    /// weights are fetched once for all of them.
    fn step_all(
        futures: &mut [Self],
        engine: &RelativeEngine,
        sampling: &RelativeSampling,
        egos: Option<&[AgentState]>,
        room: &mut Workspace,
    ) {
        let ego = |i: usize| egos.map(|egos| egos[i]);
        let streams: Vec<Vec<Seed>> = futures.iter().map(Self::streams).collect();
        let hidden: Vec<f32> = futures.iter().flat_map(|f| &f.hidden).copied().collect();
        let reach: Vec<Reach> = futures.iter().flat_map(Self::reach).collect();
        let drawn = (&streams.concat()[..], &reach[..]);
        let drawn = engine.decide(&hidden, drawn, sampling.draw(), room);
        let mut drawn = &drawn[..];
        for (i, (future, streams)) in futures.iter_mut().zip(&streams).enumerate() {
            let (own, rest) = drawn.split_at(streams.len());
            let moves = future.moves(engine, sampling, (streams, own), ego(i), room);
            future.go(engine, &moves, ego(i));
            drawn = rest;
        }
        Self::read_all(futures, engine, room);
        for future in futures {
            future.follow(engine, sampling);
        }
    }

    /// Returns the moves of all agents in the next half second, given the state of a driven ego.
    fn decide(
        &self,
        engine: &RelativeEngine,
        sampling: &RelativeSampling,
        ego: Option<AgentState>,
        room: &mut Workspace,
    ) -> Vec<Pose> {
        let streams = self.streams();
        let reach: Vec<Reach> = self.reach().collect();
        let drawn = engine.decide(&self.hidden, (&streams, &reach), sampling.draw(), room);
        self.moves(engine, sampling, (&streams, &drawn), ego, room)
    }

    /// Returns the random stream of every agent's next move.
    fn streams(&self) -> Vec<Seed> {
        let seed = self.seed.fork(self.frames as u64);
        let stream = |member: &Member| seed.fork(member.agent.id.0 as u64);
        self.members.iter().map(stream).collect()
    }

    /// How far every agent may come in the next half second.
    fn reach(&self) -> impl Iterator<Item = Reach> + '_ {
        self.members.iter().map(|member| Reach::of(&member.now()))
    }

    /// Advances by these moves, which the network has not read yet; a driven ego takes the given
    /// state.
    fn go(&mut self, engine: &RelativeEngine, moves: &[Pose], ego: Option<AgentState>) {
        let id = self.scene.ego;
        for (member, &step) in self.members.iter_mut().zip(moves) {
            let driven = ego.filter(|_| member.agent.id == id);
            let state = driven.unwrap_or_else(|| AgentState {
                pose: member.now().pose * step,
                velocity: DVec2::ZERO,
            });
            member.push(state);
            if let Some(driven) = driven {
                member.agent.state = driven;
            }
        }
        let has_routes = match self.scene.routes {
            Routes::Never => false,
            Routes::Late => self.is_late(),
            Routes::Always => true,
        };
        self.turn_into_driveways(ego.map(|_| id));
        if has_routes {
            self.choose_ways(ego.map(|_| id));
        }
        for other in &mut self.others {
            other.state.pose.position += other.state.velocity * TOKEN_DT;
        }
        for light in &mut self.shown_lights.by_lane {
            let elapsed = light.2.map(|elapsed| elapsed + TOKEN_DT);
            light.2 = elapsed.filter(|elapsed| *elapsed <= REMEMBERED_S);
        }
        self.lights_now.clone_from(&self.lights);
        self.limit_waiting(engine, ego.map(|_| id));
    }

    /// Lets vehicles turn into driveways, but one that is driven from outside. Returns whether one has
    /// decided to, or no longer does.
    fn turn_into_driveways(&mut self, driven: Option<AgentId>) -> bool {
        let driveways = &self.scene.driveways;
        let takes_one = |member: &Member| member.intent.turns_in().is_some();
        // Who takes one of the last layout gives it up.
        if driveways.ways.is_empty() && !self.members.iter().any(takes_one) {
            return false;
        }
        let mut has_changed = false;
        let seed = self.seed.fork(ROUTES);
        let agents: Vec<Agent> = self.members.iter().map(|member| member.agent).collect();
        let members = self.members.iter_mut();
        for member in members.filter(|member| driven != Some(member.agent.id)) {
            let id = member.agent.id;
            let others = agents.iter().chain(&self.others);
            let others = others.filter(|other| other.id != id);
            let (now, stream) = (member.now(), seed.fork(id.0 as u64));
            if member.intent.turn_in(driveways, &now, stream, &others) {
                member.seen.head_for(member.intent.route().cloned());
                has_changed = true;
            }
        }
        has_changed
    }

    /// Lets vehicles keep to their routes, and gives one to those without; a driven ego has its own.
    ///
    /// Futures of a scene share its present: their routes begin half a second later.
    fn choose_ways(&mut self, driven: Option<AgentId>) {
        let (map, seed) = (&self.scene.source, self.seed.fork(ROUTES));
        let members = self.members.iter_mut();
        for member in members.filter(|member| driven != Some(member.agent.id)) {
            let stream = seed.fork(member.agent.id.0 as u64);
            let now = member.now();
            let remains = member.agent.id == self.scene.ego;
            member
                .intent
                .go_on(map, &now, (stream, remains), self.frames);
            let route = member.intent.route().cloned();
            member.seen.head_for(route);
        }
    }

    /// Time after which an agent that stands although nothing holds it goes on, seconds.
    fn patience_s(&self, member: &Member) -> f64 {
        patience_s(self.seed, member.agent.id)
    }

    /// Limits for how long agents are shown to the network as standing. One that is driven from
    /// outside is shown as it is, and keeps none of those waiting that could go.
    fn limit_waiting(&mut self, engine: &RelativeEngine, driven: Option<AgentId>) {
        let is_late = self.is_late();
        let map = &self.scene.source;
        let mut limits = Vec::with_capacity(self.members.len());
        // Late, vehicles that only roll may be in it, too.
        let mut is_one_idle = is_late;
        for member in &mut self.members {
            member.could_go = false;
            member.could_roll = false;
            member.backing = member.backing.saturating_sub(1);
            member.let_pass = member.let_pass.saturating_sub(1);
            member.insists = match is_due(member.idle, patience_s(self.seed, member.agent.id)) {
                true => INSISTS,
                false => member.insists.saturating_sub(1),
            };
            is_one_idle |= member.idle_s() > PATIENCE_S[0];
            let is_long = driven != Some(member.agent.id)
                && member.waited > WAITED_S
                && is_in_lane(map, &member.agent, IN_LANE.0);
            limits.push(is_long.then_some(WAITED_S));
        }
        if is_one_idle {
            let members = self.members.iter().map(|member| Standing {
                agent: member.agent,
                waited_s: member.idle_s(),
                patience_s: match driven == Some(member.agent.id) {
                    true => f64::INFINITY,
                    false => self.patience_s(member),
                },
                has_driven: member.has_driven,
                route: member.intent.route(),
            });
            let others = self.others.iter().map(|&agent| Standing {
                agent,
                waited_s: 0.0,
                patience_s: f64::INFINITY,
                has_driven: false,
                route: None,
            });
            let all: Vec<_> = members.chain(others).collect();
            let shown = self.shown_lights.by_lane.iter();
            let is_fresh = |elapsed: Option<f64>| elapsed.is_some_and(|s| s < AT_GREEN_S);
            let fresh = shown.filter(|light| is_fresh(light.2)).map(|light| light.0);
            let fresh: Vec<_> = fresh.collect();
            let released = released(map, &self.lights, &fresh, &all, is_late);
            let backs_up = released.back_up.into_iter();
            for one in backs_up.filter(|_| self.scene.has_rules) {
                let steps = WAITS_BACK
                    + match one.is_on_road {
                        true => BACKS_ON_ROAD,
                        false => BACKS_UP,
                    };
                self.members[one.who].backing = steps;
                for j in one.blocks {
                    if let Some(member) = self.members.get_mut(j) {
                        member.let_pass = steps;
                    }
                }
            }
            let aside = released.aside.into_iter();
            for (i, heading) in aside.filter(|_| self.scene.has_rules) {
                let member = &mut self.members[i];
                member.agent.state.pose.heading = heading;
                member.seen.turn_to(heading);
            }
            for i in released.roll {
                self.members[i].could_roll = true;
            }
            for i in released.go {
                let member = &mut self.members[i];
                if member.backing > 0 {
                    continue;
                }
                if member.agent.kind != AgentKind::Pedestrian {
                    member.let_pass = member.let_pass.max(GOES_ON);
                }
                member.could_go = true;
                limits[i] = None;
                let speed = match is_late && member.has_driven {
                    true => SETS_OFF,
                    false => START,
                };
                member.seen.restart(engine, speed);
            }
        }
        for (member, limit) in self.members.iter_mut().zip(limits) {
            if let Some(limit) = limit {
                member.seen.has_stood_at_most(limit);
            }
        }
    }

    /// The next moves of all agents, each in its own frame: those drawn from these streams, after
    /// the rules.
    fn moves(
        &self,
        engine: &RelativeEngine,
        sampling: &RelativeSampling,
        (streams, drawn): (&[Seed], &[[u16; FIELDS]]),
        ego: Option<AgentState>,
        room: &mut Workspace,
    ) -> Vec<Pose> {
        let draw = sampling.draw();
        let agents: Vec<Shown> = self.members.iter().map(Member::now).collect();
        let kept = |i: usize, bins| match sampling.limits {
            true => kinematically_limited(&agents[i], dequantize(bins)),
            false => dequantize(bins),
        };
        let mut moves: Vec<Pose> = (0..agents.len()).map(|i| kept(i, drawn[i])).collect();
        if sampling.redraws == 0 {
            return moves;
        }
        let is_ego = |member: &Member| member.agent.id == self.scene.ego;
        let driven = ego.and_then(|ego| Some((self.members.iter().position(is_ego)?, ego)));
        if let Some((i, ego)) = driven {
            moves[i] = agents[i].pose.inverse() * ego.pose;
        }
        let c = self.hidden.len() / agents.len().max(1);
        let mut again = |who: &[usize], attempt: usize| -> Vec<Pose> {
            let rows = who.iter().flat_map(|&i| &self.hidden[i * c..][..c]);
            let rows: Vec<f32> = rows.copied().collect();
            let fresh = |&i: &usize| streams[i].fork(REDRAW + attempt as u64);
            let streams: Vec<Seed> = who.iter().map(fresh).collect();
            let reach: Vec<Reach> = who.iter().map(|&i| Reach::of(&agents[i])).collect();
            let drawn = engine.decide(&rows, (&streams, &reach), draw, room);
            who.iter()
                .zip(drawn)
                .map(|(&i, bins)| kept(i, bins))
                .collect()
        };
        let (lane_map, redraws) = (&self.scene.lane_map, sampling.redraws);
        let driven = driven.map(|(i, _)| i);
        let dawdles = |i: &usize| {
            let (member, metres) = (&self.members[*i], moves[*i].position.length());
            let slower = agents[*i].velocity().length() - DAWDLES_MPS;
            let stays = member.could_go && metres == 0.0;
            driven != Some(*i) && (stays || member.could_roll && metres < TOKEN_DT * slower)
        };
        let dawdling: Vec<usize> = (0..agents.len()).filter(dawdles).collect();
        draw_again(&dawdling, STARTS, &mut moves, &mut again);
        let is_rare = |i: &usize| {
            let member = &self.members[*i];
            driven != Some(*i) && member.is_rare(&self.scene.source, moves[*i], streams[*i])
        };
        let rare: Vec<usize> = (0..agents.len()).filter(is_rare).collect();
        draw_again(&rare, HALTS, &mut moves, &mut again);
        let lines = self.lines.iter().filter_map(|line| {
            let lights = &self.lights_now;
            let i = lights.binary_search_by_key(&line.lane, |light| light.lane);
            Some((line, lights[i.ok()?].state))
        });
        let colours = Lights {
            by_lane: self
                .lights_now
                .iter()
                .map(|light| (light.lane, light.state, None))
                .collect(),
        };
        let unheeded = driven.filter(|_| !sampling.yields_to_driven);
        let driveways = &self.scene.driveways;
        let turns_in = |member: &Member| TakesWay::of(driveways, member.intent.turns_in()?);
        let known = self.members.iter().enumerate().map(|(i, member)| Known {
            is_unheeded: unheeded == Some(i),
            is_parked: member.waited > PATIENCE_S[0] && !member.has_driven,
            stands_back: member.backing > 0,
            insists: member.insists > 0 && driven != Some(i),
            route: member.intent.route(),
            turns_in: turns_in(member),
        });
        let known: Vec<Known<'_>> = known.collect();
        let shut = Shut::of(&self.scene.source, &agents, &known, lines, &colours);
        obey_lines(&agents, driven, &shut, redraws, &mut moves, &mut again);
        self.back_up(driven, &mut moves);
        // Redraws that keep agents clear of others must not make them break these rules, nor those who
        // back up do anything else.
        let before = moves.clone();
        let mut lawful = |who: &[usize], attempt: usize| -> Vec<Pose> {
            let breaks = |i: usize, step: Pose| shut.forbids(&agents, i, step);
            let length = |step: Pose| step.position.length();
            let is_held = |i: usize, step: Pose| {
                let is_bound = agents[i].body.kind == AgentKind::Vehicle;
                let backs = self.members[i].backing > 0 && driven != Some(i);
                // One that can no longer stop may at least be slower.
                let is_worse = || !breaks(i, before[i]) || length(step) >= length(before[i]);
                backs || is_bound && breaks(i, step) && is_worse()
            };
            let drawn = who.iter().zip(again(who, RESOLVES + attempt));
            let held = drawn.map(|(&i, step)| match is_held(i, step) {
                true => before[i],
                false => step,
            });
            held.collect()
        };
        let who_drives = driven;
        let driven = driven.map(|index| Driven {
            index,
            is_heeded: sampling.yields_to_driven,
        });
        let may_leave = |i: usize| {
            let way = &known[i].turns_in;
            way.is_some_and(|way| way.leaves_street(&agents[i]))
        };
        let edges = (lane_map, &may_leave as &dyn Fn(usize) -> bool);
        // Who only seems to have set off need not brake to stay.
        let agents: Vec<Shown> = self.members.iter().map(Member::as_it_moves).collect();
        resolve(&agents, driven, edges, redraws, &mut moves, &mut lawful);
        self.back_up(who_drives, &mut moves);
        moves
    }

    /// The moves of those who back up for others, or wait afterwards until these have passed.
    fn back_up(&self, driven: Option<usize>, moves: &mut [Pose]) {
        let backing = self.members.iter().enumerate();
        let backing = backing.filter(|(i, member)| member.backing > 0 && driven != Some(*i));
        for (i, member) in backing {
            let members = self.members.iter().map(|member| &member.agent);
            let all = members.chain(&self.others);
            let backs = member.backing > WAITS_BACK && has_room_behind(&member.agent, all);
            moves[i] = match backs {
                true => Pose::new(-BACK_M, 0.0, 0.0),
                false => Pose::IDENTITY,
            };
        }
    }

    /// Returns draws of the next states of all agents but the driven one, from separate streams.
    fn predictive_samples(
        &self,
        engine: &RelativeEngine,
        sampling: &RelativeSampling,
        (draws, future, step): (Range<u64>, usize, usize),
        driven: Option<AgentId>,
    ) -> Vec<PredictiveSamples> {
        let draw = sampling.draw();
        let mut room = Workspace::default();
        let seed = self.seed.fork(self.frames as u64);
        let reach: Vec<Reach> = self.reach().collect();
        let draws: Vec<_> = draws
            .map(|k| {
                let stream =
                    |member: &Member| seed.fork(member.agent.id.0 as u64).fork(SAMPLE_STREAMS + k);
                let streams: Vec<Seed> = self.members.iter().map(stream).collect();
                engine.decide(&self.hidden, (&streams, &reach), draw, &mut room)
            })
            .collect();
        let members = self.members.iter().enumerate();
        let predicted = members.filter(|(_, member)| driven != Some(member.agent.id));
        let samples_of = |(i, member): (usize, &Member)| PredictiveSamples {
            future,
            step,
            step_s: TOKEN_DT,
            agent: member.agent.id,
            draws: draws
                .iter()
                .map(|bins| {
                    let next = member.now().then(member.now().pose * dequantize(bins[i]));
                    AgentState {
                        pose: next.pose,
                        velocity: next.velocity(),
                    }
                })
                .collect(),
        };
        predicted.map(samples_of).collect()
    }

    /// Shows these lights in the next frame.
    fn show(&mut self, lights: &[Light]) {
        self.lights = lights.to_vec();
        // Looked up by lane.
        self.lights.sort_by_key(|light| light.lane);
        self.draw_lines();
        let before = std::mem::take(&mut self.shown_lights.by_lane);
        let shown = lights.iter().map(|light| {
            let known = before.iter().find(|(lane, ..)| *lane == light.lane);
            let elapsed = match known {
                Some(&(_, state, elapsed)) if state == light.state => elapsed,
                Some((_, LightState::Unknown, _)) => None,
                // None has passed once that frame is there.
                Some(_) => Some(-TOKEN_DT),
                None => None,
            };
            (light.lane, light.state, elapsed)
        });
        let mut shown: Vec<_> = shown.collect();
        // Looked up by lane.
        shown.sort_by_key(|(lane, ..)| *lane);
        self.shown_lights.by_lane = shown;
    }

    /// Adds the lines before lights that are shown for the first time: those that signals complete, or that
    /// come into sight.
    fn draw_lines(&mut self) {
        if !self.scene.has_rules {
            return;
        }
        let is_new = |light: &&Light| self.lines.iter().all(|line| line.lane != light.lane);
        let new: Vec<Light> = self.lights.iter().filter(is_new).copied().collect();
        let new = StopLine::of(&self.scene.source, &new);
        if !new.is_empty() {
            self.lines = self
                .lines
                .iter()
                .cloned()
                .chain(new)
                .collect::<Vec<_>>()
                .into();
        }
    }

    /// Lets agents go and others come, whom the network sees for the first time where they are now.
    fn exchange(
        &mut self,
        engine: &RelativeEngine,
        leave: &[AgentId],
        come: &[Agent],
        room: &mut Workspace,
    ) {
        let ego = self.scene.ego;
        let stays = |agent: &Agent| agent.id == ego || !leave.contains(&agent.id);
        self.members.retain(|member| stays(&member.agent));
        self.others.retain(stays);
        for agent in come {
            if !agent.kind.is_moving() {
                self.others.push(*agent);
                continue;
            }
            self.members.push(Member::first(engine, agent));
        }
        self.members.sort_by_key(|member| member.agent.id);
        self.reread(engine, room);
    }

    fn frame(&self) -> Frame {
        let agents = self.members.iter().map(|member| member.agent);
        let all = agents.chain(self.others.iter().copied()).collect();
        Frame::new(all, self.lights.clone())
    }
}

impl Member {
    /// An agent in its first frame.
    fn first(engine: &RelativeEngine, agent: &Agent) -> Self {
        let state = agent.state;
        Self {
            agent: *agent,
            seen: ObservedAgent::first(engine, body(agent), state.pose, state.velocity),
            waited: 0.0,
            idle: 0.0,
            idle_at: state.pose.position,
            has_driven: state.speed() > DRIVES,
            could_go: false,
            could_roll: false,
            backing: 0,
            let_pass: 0,
            insists: 0,
            intent: Intent::default(),
        }
    }

    fn now(&self) -> Shown {
        self.seen.now()
    }

    /// As it moves, also where the network is shown that it has set off.
    fn as_it_moves(&self) -> Shown {
        let (now, velocity) = (self.now(), self.agent.state.velocity);
        match self.could_go && now.velocity() != velocity {
            true => Shown::first(now.body, now.pose, velocity),
            false => now,
        }
    }

    /// Whether a move is one that the network draws too often, and is drawn once more: a pedestrian who
    /// walks comes to a halt, or a parked vehicle sets off. A part of these are kept, by the move's stream.
    fn is_rare(&self, map: &MapGraph, step: Pose, stream: Seed) -> bool {
        let halts = step.position == DVec2::ZERO;
        match self.agent.kind {
            AgentKind::Pedestrian => {
                let walks = self.now().velocity().length() > WALKS;
                halts && walks && uniform(stream.fork(WALK)) < WALKS_ON
            }
            AgentKind::Vehicle => {
                let is_parked = !self.has_driven && self.waited >= PARKED_S;
                !halts
                    && is_parked
                    && uniform(stream.fork(PARK)) < STAYS
                    && !is_in_lane(map, &self.agent, BESIDE_M)
            }
            _ => false,
        }
    }

    /// Time that it has been idle, seconds. Who backs up still stands in the junction for the others, and
    /// comes last; whom it lets pass does not wait again, nor who has begun to go.
    fn idle_s(&self) -> f64 {
        let stands = self.now().velocity().length() < CREEPS;
        let least = match (self.backing > 0, self.let_pass > 0 && stands) {
            (true, _) => PATIENCE_S[0] + TOKEN_DT,
            (_, true) => PATIENCE_S[0] + 2.0 * TOKEN_DT,
            _ => 0.0,
        };
        let idle = if stands { self.idle } else { 0.0 };
        idle.max(least)
    }

    /// What a history tells that is longer than what the network sees of it: whether the agent drove
    /// before, and for how long it has been idle.
    fn recall(&mut self, history: &[Frame], stride: usize) {
        let states = history.iter().rev().step_by(stride);
        let states = states.map_while(|frame| frame.agent(self.agent.id));
        let states: Vec<AgentState> = states.map(|agent| agent.state).collect();
        if states.len() <= KEPT {
            return;
        }
        self.has_driven |= states.iter().any(|state| state.speed() > DRIVES);
        let metres = |pair: &[AgentState]| pair[0].pose.position.distance(pair[1].pose.position);
        let idle = states.windows(2);
        let idle = idle.take_while(|pair| metres(pair) < CREEPS * TOKEN_DT);
        self.idle = self.idle.max(idle.count() as f64 * TOKEN_DT);
    }

    /// Half a second later it is here; its velocity is what it moved by.
    fn push(&mut self, state: AgentState) {
        self.seen.push(state.pose);
        self.waited = match self.now().velocity() == DVec2::ZERO {
            true => self.waited + TOKEN_DT,
            false => 0.0,
        };
        let creeps = self.now().velocity().length() < CREEPS;
        let near_m = match self.agent.kind {
            AgentKind::Vehicle => NO_FARTHER_M,
            _ => 0.0,
        };
        if self.idle == 0.0 || !creeps && self.idle_at.distance(state.pose.position) > near_m {
            self.idle = 0.0;
            self.idle_at = state.pose.position;
        }
        if creeps {
            self.idle += TOKEN_DT;
        }
        self.has_driven |= self.now().velocity().length() > DRIVES;
        self.agent.state = AgentState {
            pose: state.pose,
            velocity: self.now().velocity(),
        };
    }
}

/// Time after which an agent that stands although nothing holds it goes on, seconds.
fn patience_s(seed: Seed, agent: AgentId) -> f64 {
    let stream = seed.fork(PATIENCE).fork(agent.0 as u64);
    let [least, most] = PATIENCE_S;
    least + (most - least) * uniform(stream)
}

/// Whether one that has been idle for so long, seconds, begins to insist in this step.
fn is_due(idle_s: f64, patience_s: f64) -> bool {
    let over = ((idle_s - patience_s - INSISTS_S) / TOKEN_DT).floor();
    over >= 0.0 && (over as usize).is_multiple_of(AGAIN)
}

/// Whether a vehicle is within `reach` metres of a lane's centre, and aligned with it.
fn is_in_lane(map: &MapGraph, agent: &Agent, reach: f64) -> bool {
    let pose = agent.state.pose;
    let is_along = |lane: &Lane| lane.foot(pose).turned < IN_LANE.1;
    let mut lanes = map.lanes_near(pose.position, reach);
    agent.kind == AgentKind::Vehicle && lanes.any(|(lane, _)| is_along(lane))
}

fn body(agent: &Agent) -> Body {
    Body {
        kind: agent.kind,
        length: agent.length,
        width: agent.width,
        sized: true,
    }
}

/// The lights of the last frame, and how long they have shown their colour as far as was seen: since
/// they were first seen in it, as in training samples.
fn lights_at(history: &[Frame], dt: f64) -> Lights {
    let Some((now, before)) = history.split_last() else {
        return Lights::default();
    };
    let by_lane = now.lights().iter().map(|light| {
        let mut frames = 0;
        let changed = before.iter().rev().enumerate().find_map(|(k, frame)| {
            let then = frame.light(light.lane)?.state;
            if then == light.state {
                frames = k + 1;
            }
            (then != light.state).then_some(then)
        });
        let seen = changed.is_some_and(|then| then != LightState::Unknown);
        let elapsed = seen.then_some(frames as f64 * dt);
        (light.lane, light.state, elapsed)
    });
    Lights {
        by_lane: by_lane.collect(),
    }
}

/// Futures in progress.
struct RelativeSession<'a> {
    world: &'a RelativeWorld,
    futures: Vec<Future>,
    /// Steps made so far.
    step: usize,
    /// Settings of predictive samples, and those recorded.
    probe: ProbeConfig,
    samples: Vec<PredictiveSamples>,
}

impl Session for RelativeSession<'_> {
    fn dt(&self) -> f64 {
        TOKEN_DT
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        let (engine, sampling) = (&self.world.engine, &self.world.sampling);
        let probe = self.probe;
        if probe.futures > 0 && probe.draws > 0 {
            let probed = self.futures.iter().take(probe.futures).enumerate();
            let seen = probed.flat_map(|(i, future)| {
                let driven = ego.is_some().then_some(future.scene.ego);
                let draws = 0..probe.draws as u64;
                future.predictive_samples(engine, sampling, (draws, i, self.step), driven)
            });
            self.samples.extend(seen);
        }
        self.step += 1;
        // Enough groups that all threads end at about the same time.
        let threads = rayon::current_num_threads();
        let most = self.futures.len().div_ceil(4 * threads).clamp(1, TOGETHER);
        let groups = self.futures.par_chunks_mut(most).enumerate();
        groups.for_each_init(Workspace::default, |room, (k, futures)| {
            let egos = ego.map(|ego| &ego[k * most..][..futures.len()]);
            Future::step_all(futures, engine, sampling, egos, room);
        });
        Ok(self.futures.par_iter().map(Future::frame).collect())
    }

    fn keep(&mut self, futures: &[usize]) -> bool {
        let mut at = 0;
        self.futures.retain(|_| {
            at += 1;
            futures.binary_search(&(at - 1)).is_ok()
        });
        true
    }

    fn take_for_made(&mut self) {
        self.futures.iter_mut().for_each(Future::take_for_made);
    }

    fn probe(&mut self, config: ProbeConfig) -> bool {
        self.probe = config;
        true
    }

    fn take_predictive_samples(&mut self) -> Vec<PredictiveSamples> {
        std::mem::take(&mut self.samples)
    }

    /// A pass is a step, whatever the number of futures.
    fn stats(&self) -> SessionStats {
        SessionStats {
            passes: self.step as u64,
            ..SessionStats::default()
        }
    }

    fn show(&mut self, future: usize, lights: &[Light]) -> bool {
        self.futures[future].show(lights);
        true
    }

    fn exchange(&mut self, future: usize, leave: &[AgentId], come: &[Agent]) -> bool {
        let mut room = Workspace::default();
        let engine = &self.world.engine;
        self.futures[future].exchange(engine, leave, come, &mut room);
        true
    }

    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
        let mut fresh = self.world.begin(&[start])?;
        self.futures[future] = fresh.swap_remove(0);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
