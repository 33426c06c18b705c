//! One training sample: a run of frames of a scenario as a graph, and the next move of every node.

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_geometry::{DVec2, Pose, wrap_angle};
use gump_kernels::edge_attention::Edges;
use gump_scene::{AgentId, AgentKind, Frame, LaneId, LightState, MapGraph, Rng, Scenario, Seed};
use rand::Rng as _;
use serde::{Deserialize, Serialize};

use crate::relative::graph::{
    Body, EDGE_NUMBERS, EdgeRow, Lights, NODE_NUMBERS, PAST, Shown, look, misses_any, past_edge,
};
use crate::relative::grid::{FIELDS, STILL_M, quantize};
use crate::relative::map::{Hidden, PATH_M, PIECE_NUMBERS, VectorMap};
use crate::relative::returns::{Returns, steered};
use crate::relative::route::{Route, of_log};
use crate::steps::stride_of;

/// Settings of training samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SampleConfig {
    /// Maximum number of consecutive frames at 2 Hz; shorter logs give what they have.
    pub frames: usize,
    /// Maximum number of agents, those nearest to a randomly chosen one.
    pub max_agents: usize,
    /// Probability that moving agents are shown displaced from their path, with the return to it as
    /// target.
    pub perturbed: f64,
    /// Maximum sideways displacement per push, metres.
    pub push_m: f64,
    /// How they are displaced and return: with `slide` each frame displaces them anew, with `steer` they
    /// steer aside and back, so that what is shown of them before is a motion of vehicles, too. `slide` by
    /// default, as in the trainings of all published weights.
    pub returns: Returns,
    /// Probability of hiding the speed limits of lanes.
    pub hide_limits: f64,
    /// Probability of hiding stop signs.
    pub hide_stop_signs: f64,
    /// Probability of hiding lights.
    pub hide_lights: f64,
    /// Probability of hiding the size of an agent.
    pub hide_size: f64,
    /// Probability that an agent is observed late or lost early.
    pub cut_tracks: f64,
    /// Probability that an agent is shown at a frame without its past: a network that always sees it
    /// learns to repeat it.
    pub forget: f64,
    /// Probability that a vehicle that moves and sees nothing to slow down for (`View::is_free`) is shown at
    /// a frame without its past, in drives as in logs: rollouts show it so after nine seconds. From 0 to 1;
    /// 0 by default, as in the trainings of all published weights.
    pub forget_free: f64,
    /// Probability that a vehicle is shown with its route, from the first frame on or a later one.
    pub routes: f64,
    /// Whether only agents learn that see all that they would see in a rollout. Without it those at the rim
    /// of a sample learn, too, whose leader may be one of the agents left out by `max_agents`, or whose
    /// light may be beyond the prepared map: they stop for reasons that are not shown. False by default, as
    /// in the trainings of all published weights.
    pub whole_views: bool,
}

impl Default for SampleConfig {
    /// Nine seconds, as long as recorded scenes; the rest was chosen by hand and not tuned
    /// (decisions 14 and 16).
    fn default() -> Self {
        Self {
            frames: 18,
            max_agents: 64,
            perturbed: 0.5,
            push_m: 0.8,
            returns: Returns::Slide,
            hide_limits: 0.3,
            hide_stop_signs: 0.1,
            hide_lights: 0.05,
            hide_size: 0.02,
            cut_tracks: 0.1,
            forget: 0.0,
            forget_free: 0.0,
            routes: 0.0,
            whole_views: false,
        }
    }
}

impl SampleConfig {
    /// Without hiding and displacement: for validation.
    pub fn plain() -> Self {
        Self {
            perturbed: 0.0,
            hide_limits: 0.0,
            hide_stop_signs: 0.0,
            hide_lights: 0.0,
            hide_size: 0.0,
            cut_tracks: 0.0,
            forget: 0.0,
            forget_free: 0.0,
            routes: 0.0,
            ..Self::default()
        }
    }
}

/// A graph with the targets of its nodes.
#[derive(Debug, Default)]
pub struct Sample {
    /// `[nodes, NODE_NUMBERS]`
    pub nodes: Vec<f32>,
    /// `[edges, EDGE_NUMBERS]`
    pub(super) edge_numbers: Vec<f32>,
    /// Sources are nodes, then pieces.
    pub(super) edges: Arc<Edges>,
    /// `[pieces, PIECE_NUMBERS]`: those that some node sees.
    pub(super) pieces: Vec<f32>,
    /// The target moves.
    pub targets: Vec<Target>,
}

impl Sample {
    /// Number of nodes.
    pub fn n_nodes(&self) -> usize {
        self.nodes.len() / NODE_NUMBERS
    }

    /// Number of edges.
    pub fn n_edges(&self) -> usize {
        self.edges.sources.len()
    }
}

impl Sample {
    /// Sets the weight of every move to that of `weight` for its agent and frame, by index; moves
    /// of weight zero are dropped.
    pub fn weigh(&mut self, weight: impl Fn(usize, usize) -> f32) {
        for target in &mut self.targets {
            target.weight = weight(target.agent as usize, target.frame as usize);
        }
        self.targets.retain(|target| target.weight != 0.0);
    }
}

/// The target of a node.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// Index of the node.
    pub node: u32,
    /// Index of the agent among those of the sample, and of the frame.
    pub agent: u32,
    /// Index of the frame.
    pub frame: u32,
    /// The move, a bin per field.
    pub bins: [u16; FIELDS],
    /// Its weight in the loss.
    pub weight: f32,
}

// Chosen by hand with the perturbation (decision 16); none was varied.

/// Weight of the first move of an agent of which only one frame was observed: its velocity is
/// stated, not observed.
const UNTRACKED: f32 = 0.3;
/// Share of a sideways displacement that is left half a second later: back within about two
/// seconds.
const SLACK: f64 = 0.6;
/// The same of a displacement along the path, which nothing presses to make up for.
pub(super) const ALONG_SLACK: f64 = 0.8;
/// Share of its last step that an agent still moves where the log stops.
pub(super) const BRAKING: f64 = 0.6;
/// Slower agents are not displaced, metres per second: nothing moves sideways in place.
const SLOWEST: f64 = 2.0;
/// A faster agent counts as driving, metres per second.
const WALKING: f64 = 0.5;
/// Turn per metre of displacement, radians: 6 degrees.
const TURN: f64 = 0.1;
/// Radius of the prepared map, metres: the agents of a sample and what the outermost see.
const MAP_M: f64 = 180.0;

/// An agent over the frames of a sample.
pub struct Track {
    /// Its class and size.
    pub body: Body,
    /// By frame, where it is present.
    pub states: Vec<Option<State>>,
    /// By frame, where it means to go, as far as that is told; empty if it never is.
    pub routes: Vec<Option<Route>>,
    /// Whether it is an obstacle: it keeps its states, and there is nothing to learn from it.
    pub is_obstacle: bool,
}

impl Track {
    /// Where it means to go at a frame, if that is told.
    pub fn route(&self, t: usize) -> Option<&Route> {
        self.routes.get(t)?.as_ref()
    }

    /// The next pose of an agent that is off its log in frame `t` and returns to it, shown as `own`; `None`
    /// if it is not there in both frames.
    pub fn way_back(&self, t: usize, own: &Shown, returns: Returns) -> Option<Pose> {
        let state = (*self.states.get(t)?)?;
        let next = (*self.states.get(t + 1)?)?;
        let slides = || pushed(next.logged, state.off.then());
        let steers = || self.steered(t, own, 0.0);
        let steered = match returns {
            Returns::Slide => None,
            // On its log it goes on as that does.
            Returns::Steer => Some(state.off).filter(Off::is_some).and_then(|_| steers()),
        };
        Some(steered.unwrap_or_else(slides))
    }

    /// The same of a vehicle or a bicycle that aims `aside` metres to the left of its log's way.
    fn steered(&self, t: usize, own: &Shown, aside: f64) -> Option<Pose> {
        let logged = self.states.iter().map(|state| Some((*state)?.logged));
        let log: Vec<Option<Pose>> = logged.collect();
        steered(own, &log, t, aside)
    }

    /// Leads an agent aside by steering: at every frame it aims a little farther to the one or the other
    /// side of its log's way, by `reach` metres at most.
    fn swerve(&mut self, reach: f64, rng: &mut Rng) {
        let (mut before, mut aside) = (None::<Shown>, 0.0);
        for t in 0..self.states.len().saturating_sub(1) {
            let Some(state) = self.states[t] else {
                before = None;
                continue;
            };
            let own = match before {
                Some(before) => before.then(state.shown),
                None => Shown::first(self.body, state.shown, state.velocity),
            };
            before = Some(own);
            // Who is slow only returns.
            aside = match state.velocity.length() >= SLOWEST {
                true => SLACK * aside + within(reach, rng),
                false => 0.0,
            };
            let is_led = aside != 0.0 || state.off.is_some();
            let to = is_led.then(|| self.steered(t, &own, aside)).flatten();
            if let Some((next, to)) = self.states[t + 1].as_mut().zip(to) {
                *next = next.driven_to(to);
            }
        }
    }
}

/// An agent at a frame.
#[derive(Clone, Copy, Debug)]
pub struct State {
    /// Its logged pose.
    pub logged: Pose,
    /// Its displayed pose.
    pub shown: Pose,
    /// Logged velocity, world frame, metres per second.
    pub velocity: DVec2,
    /// Weight of the move to here in the loss.
    weight: f32,
    off: Off,
}

impl State {
    /// An agent that the log does not have.
    pub fn added(pose: Pose, velocity: DVec2) -> Self {
        Self {
            logged: pose,
            shown: pose,
            velocity,
            weight: 1.0,
            off: Off::default(),
        }
    }

    /// The same, for an agent that was led away from the log; its move to here has this weight in the
    /// loss.
    pub fn led_to(self, pose: Pose, weight: f32) -> Self {
        Self {
            logged: pose,
            shown: pose,
            weight,
            off: Off::default(),
            ..self
        }
    }

    /// The same, for an agent that was held at a pose although it had to come to another one, which is the
    /// target.
    pub fn held_at(self, pose: Pose, wanted: Pose) -> Self {
        Self {
            logged: wanted,
            shown: pose,
            weight: 1.0,
            off: Off::default(),
            ..self
        }
    }

    /// The same, for an agent that was driven.
    pub fn driven_to(self, shown: Pose) -> Self {
        let off = self.logged.inverse() * shown;
        Self {
            shown,
            off: Off {
                ahead_m: off.position.x,
                left_m: off.position.y,
                turn: off.heading,
            },
            ..self
        }
    }
}

/// Displacement of an agent from its path.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Off {
    ahead_m: f64,
    left_m: f64,
    turn: f64,
}

/// At which frames which vehicles are shown without their past if they see nothing to slow down for: the
/// same in a drive and in the sample that shows it.
#[derive(Clone, Copy, Debug)]
pub struct FreePasts {
    /// Probability of a vehicle at a frame.
    share: f64,
    seed: Seed,
}

impl FreePasts {
    /// Whether it is so of an agent at a frame, by index.
    pub fn is_hidden(self, agent: usize, frame: usize) -> bool {
        let stream = || self.seed.fork(agent as u64).fork(frame as u64);
        self.share > 0.0 && stream().rng().random_bool(self.share)
    }
}

/// Drives the agents of a sample away from their log.
pub trait TrackDriver {
    /// Share of samples that it drives.
    fn share(&self) -> f64;

    /// How agents that it has led away from their log return to it.
    fn returns(&self) -> Returns;

    /// Moves the tracks of a sample, which lies around `centre`, to the driven poses, and may add
    /// tracks.
    fn drive(
        &self,
        place: (&MapGraph, DVec2),
        map: &VectorMap,
        lights: &[Lights],
        tracks: &mut Vec<Track>,
        chance: (FreePasts, Seed),
    );
}

/// Draws a sample; `None` for a scenario that is too short. With a driver, its agents leave the log
/// and are driven.
pub fn draw(
    scenario: &Scenario,
    config: &SampleConfig,
    driver: Option<&dyn TrackDriver>,
    seed: Seed,
) -> Option<Sample> {
    let mut rng = seed.rng();
    let stride = stride_of(scenario.dt);
    let most = (scenario.log.len().checked_sub(1)?) / stride + 1;
    let n_frames = config.frames.min(most);
    if n_frames < 3 {
        return None;
    }
    let last_start = scenario.log.len() - 1 - (n_frames - 1) * stride;
    let start = rng.random_range(0..=last_start);
    let frames: Vec<&Frame> = (0..n_frames)
        .map(|i| &scenario.log[start + i * stride])
        .collect();
    let (ids, centre) = chosen(&frames, scenario.ego, config.max_agents, &mut rng)?;
    let hidden = Hidden {
        limits: rng.random_bool(config.hide_limits),
        stop_signs: rng.random_bool(config.hide_stop_signs),
    };
    let hides_lights = rng.random_bool(config.hide_lights);
    let map = VectorMap::new(&scenario.map, centre, MAP_M, hidden);
    let driver = driver.filter(|driver| rng.random_bool(driver.share()));
    let perturbed = if driver.is_some() {
        0.0
    } else {
        config.perturbed
    };
    let mut tracks: Vec<Track> = ids
        .iter()
        .map(|id| track(&frames, *id, config, perturbed, &mut rng))
        .collect();
    let lights = match hides_lights {
        true => vec![Lights::default(); n_frames],
        false => lights(scenario, start, stride, n_frames),
    };
    let routes = (config.routes, seed.fork(2));
    tell_routes(&scenario.map, &mut tracks, routes);
    let free_pasts = FreePasts {
        share: config.forget_free,
        seed: seed.fork(3),
    };
    if let Some(driver) = driver {
        let place = (&*scenario.map, centre);
        let chance = (free_pasts, seed.fork(0));
        driver.drive(place, &map, &lights, &mut tracks, chance);
        // Who was led away from the log may have gone another way.
        tell_routes(&scenario.map, &mut tracks, routes);
    }
    let manner = Manner {
        forget: (config.forget, seed.fork(1)),
        free_pasts,
        returns: driver.map_or(config.returns, TrackDriver::returns),
    };
    let rim = config.whole_views.then(|| Rim {
        centre,
        left_out: frames.iter().map(|frame| left_out(frame, &ids)).collect(),
    });
    Some(assemble(&map, &tracks, &lights, manner, rim.as_ref()))
}

/// What lies beyond a sample.
struct Rim {
    centre: DVec2,
    /// By frame, the agents that are not in the sample.
    left_out: Vec<Vec<Shown>>,
}

impl Rim {
    /// Whether agent `i` of those of frame `t` sees all that it would see without it.
    fn is_far_from(&self, t: usize, agents: &[Shown], i: usize) -> bool {
        let away = agents[i].pose.position.distance(self.centre);
        away + PATH_M < MAP_M && !misses_any(agents, i, &self.left_out[t])
    }
}

/// The agents of a frame that are none of these.
fn left_out(frame: &Frame, ids: &[AgentId]) -> Vec<Shown> {
    let moving = frame.agents().iter().filter(|agent| agent.kind.is_moving());
    let others = moving.filter(|agent| !ids.contains(&agent.id));
    let shown = others.map(|agent| {
        let body = Body {
            kind: agent.kind,
            length: agent.length,
            width: agent.width,
            sized: true,
        };
        Shown::first(body, agent.state.pose, agent.state.velocity)
    });
    shown.collect()
}

/// The sample of all frames of a scenario from `start` on, without hiding and displacement, of the
/// agents `ids` in their order.
pub fn whole(
    scenario: &Scenario,
    start: usize,
    ids: &[AgentId],
    map: &VectorMap,
) -> Option<Sample> {
    let stride = stride_of(scenario.dt);
    let n_frames = (scenario.log.len().checked_sub(start + 1)?) / stride + 1;
    let frames: Vec<&Frame> = (0..n_frames)
        .map(|i| &scenario.log[start + i * stride])
        .collect();
    let plain = SampleConfig::plain();
    let mut nothing = Seed(0).rng();
    let track = |id: &AgentId| track(&frames, *id, &plain, 0.0, &mut nothing);
    let tracks: Vec<Track> = ids.iter().map(track).collect();
    let lights = lights(scenario, start, stride, n_frames);
    Some(assemble(map, &tracks, &lights, Manner::default(), None))
}

/// Tells the routes of a share of the vehicles, half of them from the first frame on.
fn tell_routes(map: &MapGraph, tracks: &mut [Track], (share, seed): (f64, Seed)) {
    if share <= 0.0 {
        return;
    }
    for (a, track) in tracks.iter_mut().enumerate() {
        track.routes.clear();
        let seed = seed.fork(a as u64);
        let mut rng = seed.fork(0).rng();
        let is_told = track.body.kind == AgentKind::Vehicle && !track.is_obstacle;
        if !is_told || !rng.random_bool(share) {
            continue;
        }
        let poses = track.states.iter().map(|state| Some((*state)?.logged));
        let poses: Vec<Option<Pose>> = poses.collect();
        let from = match rng.random_bool(0.5) {
            true => 0,
            false => rng.random_range(0..poses.len()),
        };
        track.routes = of_log(map, &poses, seed.fork(1));
        track.routes[..from].fill(None);
    }
}

/// The agents of a sample, and its centre.
fn chosen(
    frames: &[&Frame],
    ego: AgentId,
    most: usize,
    rng: &mut Rng,
) -> Option<(Vec<AgentId>, DVec2)> {
    let middle = frames[frames.len() / 2].agents();
    let moving = || middle.iter().filter(|agent| agent.kind.is_moving());
    let on_their_way = || moving().filter(|agent| agent.state.speed() > WALKING);
    let (n, n_on_their_way) = (moving().count(), on_their_way().count());
    let own = moving().find(|agent| agent.id == ego);
    // Most recorded agents are parked; there is more to learn around the others.
    let centre = match rng.random_range(0..10) {
        0..6 if n_on_their_way > 0 => on_their_way().nth(rng.random_range(0..n_on_their_way))?,
        6..9 if own.is_some() => own?,
        _ => moving().nth(rng.random_range(0..n.max(1)))?,
    };
    let centre = centre.state.pose.position;
    let mut nearest: BTreeMap<AgentId, f64> = BTreeMap::new();
    for agent in frames.iter().flat_map(|frame| frame.agents()) {
        let away = agent.state.pose.position.distance(centre);
        if agent.kind.is_moving() {
            let known = nearest.entry(agent.id).or_insert(away);
            *known = known.min(away);
        }
    }
    let mut by_distance: Vec<(f64, AgentId)> = nearest.into_iter().map(|(id, d)| (d, id)).collect();
    by_distance.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    by_distance.truncate(most);
    Some((by_distance.into_iter().map(|(_, id)| id).collect(), centre))
}

fn track(
    frames: &[&Frame],
    id: AgentId,
    config: &SampleConfig,
    perturbed: f64,
    rng: &mut Rng,
) -> Track {
    let n = frames.len();
    let (mut from, mut to) = (0, n);
    if rng.random_bool(config.cut_tracks) {
        // Observed late more often than lost early; chosen by hand.
        match rng.random_bool(0.7) {
            true => from = rng.random_range(0..n),
            false => to = rng.random_range(1..=n),
        }
    }
    let sized = !rng.random_bool(config.hide_size);
    let reach = match rng.random_bool(perturbed) {
        true => config.push_m * rng.random::<f64>(),
        false => 0.0,
    };
    let slides = config.returns == Returns::Slide;
    let mut off = Off::default();
    let mut body = None;
    let states = (0..n).map(|t| {
        let agent = frames[t].agent(id).filter(|_| (from..to).contains(&t))?;
        body.get_or_insert(Body {
            kind: agent.kind,
            length: agent.length,
            width: agent.width,
            sized,
        });
        let drives = matches!(agent.kind, AgentKind::Vehicle | AgentKind::Bicycle);
        if slides && reach > 0.0 && drives && agent.state.speed() >= SLOWEST {
            off.left_m = SLACK * off.left_m + within(reach, rng);
            off.turn = SLACK * off.turn + within(TURN * reach, rng);
        } else {
            off = Off::default();
        }
        let pose = agent.state.pose;
        Some(State {
            logged: pose,
            shown: pushed(pose, off),
            velocity: agent.state.velocity,
            weight: 1.0,
            off,
        })
    });
    let states: Vec<_> = states.collect();
    let mut track = Track {
        body: body.unwrap_or(Body {
            kind: AgentKind::Vehicle,
            length: 0.0,
            width: 0.0,
            sized,
        }),
        states,
        routes: Vec::new(),
        is_obstacle: false,
    };
    if !slides && reach > 0.0 {
        track.swerve(reach, rng);
    }
    track
}

/// A random number up to a bound on both sides of zero, likelier near it.
fn within(bound: f64, rng: &mut Rng) -> f64 {
    bound * (rng.random::<f64>() + rng.random::<f64>() - 1.0)
}

/// A displaced pose.
fn pushed(pose: Pose, off: Off) -> Pose {
    Pose {
        position: pose.position + pose.rotate(DVec2::new(off.ahead_m, off.left_m)),
        heading: wrap_angle(pose.heading + off.turn),
    }
}

impl Off {
    /// Whether there is any.
    fn is_some(&self) -> bool {
        *self != Self::default()
    }

    /// The displacement that is left half a second later.
    fn then(self) -> Self {
        Self {
            ahead_m: ALONG_SLACK * self.ahead_m,
            left_m: SLACK * self.left_m,
            turn: SLACK * self.turn,
        }
    }
}

/// The lights of the frames, with the time since their last change as far as the log up to then
/// shows it.
fn lights(scenario: &Scenario, start: usize, stride: usize, n_frames: usize) -> Vec<Lights> {
    let mut known: BTreeMap<LaneId, (LightState, Option<usize>)> = BTreeMap::new();
    let mut lights = Vec::with_capacity(n_frames);
    for (i, frame) in scenario.log[..=start + (n_frames - 1) * stride]
        .iter()
        .enumerate()
    {
        for light in frame.lights() {
            let entry = known.entry(light.lane).or_insert((light.state, None));
            if entry.0 != light.state {
                let seen = entry.0 != LightState::Unknown;
                *entry = (light.state, Some(i).filter(|_| seen));
            }
        }
        if i >= start && (i - start).is_multiple_of(stride) {
            let now = frame.lights().iter().map(|light| {
                let since = known.get(&light.lane).and_then(|entry| entry.1);
                let elapsed = since.map(|since| (i - since) as f64 * scenario.dt);
                (light.lane, light.state, elapsed)
            });
            lights.push(Lights {
                by_lane: now.collect(),
            });
        }
    }
    lights
}

/// How agents are shown, and what they are to do.
#[derive(Clone, Copy)]
struct Manner {
    /// The probability that one is shown at a frame without its past, and the seed of these choices.
    forget: (f64, Seed),
    /// The same of vehicles that see nothing to slow down for.
    free_pasts: FreePasts,
    /// How those that are off their log return to it.
    returns: Returns,
}

impl Default for Manner {
    fn default() -> Self {
        Self {
            forget: (0.0, Seed(0)),
            free_pasts: FreePasts {
                share: 0.0,
                seed: Seed(0),
            },
            returns: Returns::default(),
        }
    }
}

/// With a rim, agents near it are shown and have no targets.
fn assemble(
    map: &VectorMap,
    tracks: &[Track],
    lights: &[Lights],
    manner: Manner,
    rim: Option<&Rim>,
) -> Sample {
    let n_frames = lights.len();
    let (forget, seed) = manner.forget;
    let mut rng = seed.rng();
    // Nodes frame by frame: which agents, how they are shown, and the first node of each frame.
    let mut shown: Vec<Vec<Option<Shown>>> = Vec::with_capacity(n_frames);
    let mut node_of: Vec<Vec<Option<u32>>> = Vec::with_capacity(n_frames);
    let mut n_nodes = 0;
    for t in 0..n_frames {
        let of_frame = tracks.iter().enumerate().map(|(a, track)| {
            let state = track.states[t]?;
            let before = (t > 0).then(|| shown[t - 1][a]).flatten();
            Some(match before {
                Some(before) => before.then(state.shown),
                None => Shown::first(track.body, state.shown, state.velocity),
            })
        });
        let of_frame: Vec<Option<Shown>> = of_frame.collect();
        let numbered = of_frame.iter().map(|shown| {
            shown.map(|_| {
                n_nodes += 1;
                n_nodes - 1
            })
        });
        node_of.push(numbered.collect());
        shown.push(of_frame);
    }
    let mut sample = Sample::default();
    let mut graph = Edges {
        offsets: vec![0],
        sources: Vec::new(),
    };
    let mut piece_rows: BTreeMap<u32, u32> = BTreeMap::new();
    for t in 0..n_frames {
        let present: Vec<usize> = (0..tracks.len())
            .filter(|&a| shown[t][a].is_some())
            .collect();
        let agents: Vec<Shown> = present.iter().filter_map(|&a| shown[t][a]).collect();
        for (i, &a) in present.iter().enumerate() {
            let own = &agents[i];
            sample.nodes.extend(own.numbers());
            let mut push = |source: u32, row: &EdgeRow| {
                graph.sources.push(source);
                sample.edge_numbers.extend(row);
            };
            let view = look(map, &lights[t], &agents, i, tracks[a].route(t));
            let is_forgotten = forget > 0.0 && rng.random_bool(forget);
            let is_vehicle = own.body.kind == AgentKind::Vehicle;
            let hides = is_vehicle && manner.free_pasts.is_hidden(a, t);
            let past = match is_forgotten || hides && view.is_free(own) {
                true => 0,
                false => PAST.min(t),
            };
            for ago in 0..=past {
                let (Some(then), Some(node)) = (&shown[t - ago][a], node_of[t - ago][a]) else {
                    break;
                };
                push(node, &past_edge(own, then, ago));
            }
            for (j, row) in &view.neighbours {
                let node = node_of[t][present[*j]].expect("a neighbour is present");
                push(node, row);
            }
            for (piece, row) in &view.pieces {
                let next = piece_rows.len() as u32;
                let at = *piece_rows.entry(*piece).or_insert(next);
                push(n_nodes + at, row);
            }
            graph.offsets.push(graph.sources.len() as u32);
            let sees_all = rim.is_none_or(|rim| rim.is_far_from(t, &agents, i));
            let learns = !tracks[a].is_obstacle && sees_all;
            let target = target(&tracks[a], t, own, manner.returns);
            if let Some(target) = target.filter(|target| learns && target.weight > 0.0) {
                let node = node_of[t][a].expect("the agent is present");
                let agent = a as u32;
                sample.targets.push(Target {
                    node,
                    agent,
                    ..target
                });
            }
        }
    }
    let mut by_row: Vec<(u32, u32)> = piece_rows.into_iter().map(|(p, row)| (row, p)).collect();
    by_row.sort_unstable();
    for (_, piece) in by_row {
        let at = piece as usize * PIECE_NUMBERS;
        sample.pieces.extend(&map.numbers[at..at + PIECE_NUMBERS]);
    }
    debug_assert_eq!(
        sample.edge_numbers.len(),
        graph.sources.len() * EDGE_NUMBERS
    );
    sample.edges = Arc::new(graph);
    sample
}

/// The target of an agent at frame `t`, if it is present in the next; of which node and agent it is, is
/// left open.
fn target(track: &Track, t: usize, own: &Shown, returns: Returns) -> Option<Target> {
    let states = &track.states;
    let state = states[t]?;
    let next = (*states.get(t + 1)?)?;
    let moved = state.logged.inverse() * next.logged;
    let steers =
        returns == Returns::Steer && own.body.kind != AgentKind::Pedestrian && state.off.is_some();
    let stops = moved.position.length() < STILL_M;
    let step = if stops && !steers {
        // An agent behind the log drives on to where the log stops, if that is on its way.
        let left = (-state.off.ahead_m).clamp(0.0, BRAKING * own.step.position.x.max(0.0));
        Pose::new(left, 0.0, 0.0)
    } else {
        own.pose.inverse() * track.way_back(t, own, returns)?
    };
    Some(Target {
        node: 0,
        agent: 0,
        frame: t as u32,
        bins: quantize(step),
        weight: next.weight * if own.tracked { 1.0 } else { UNTRACKED },
    })
}

#[cfg(test)]
mod tests {
    use gump_scene::fixture;

    use super::*;

    #[test]
    fn nodes_see_the_past_only() {
        let scenario = fixture::scenario(
            "lane 1: 0,0 200,0 speed 15
             ego vehicle 0: 10,0 velocity 8,0
             agent vehicle 1: 30,0 velocity 0,0
             agent pedestrian 2: 40,5 velocity 0,-1",
        )
        .unwrap();
        let sample = draw(&scenario, &SampleConfig::plain(), None, Seed(3)).unwrap();
        let (nodes, edges) = (sample.n_nodes(), &sample.edges);
        assert!(nodes % 3 == 0 && nodes >= 9, "{nodes}");
        assert_eq!(edges.n_nodes(), nodes);
        let frame = |node: usize| node / 3;
        for node in 0..nodes {
            let of = edges.offsets[node] as usize..edges.offsets[node + 1] as usize;
            for &source in &edges.sources[of] {
                let is_piece = source as usize >= nodes;
                assert!(is_piece || frame(source as usize) <= frame(node));
            }
        }
        // All agents but those of the last frame have a next move; the parked car stands.
        assert_eq!(sample.targets.len(), nodes - 3);
        let stands = |target: &&Target| target.bins[0] == crate::relative::grid::STANDS;
        let standing = sample.targets.iter().filter(stands).count();
        assert_eq!(
            standing,
            nodes / 3 - 1,
            "the parked car, at every frame but the last"
        );
    }

    #[test]
    fn told_vehicles_see_fewer_lanes_where_they_part() {
        let scenario = fixture::scenario(
            "lane 1: -60,0 60,0 speed 15 next 2,3
             lane 2: 60,0 140,0
             lane 3: 60,0 68,-2 70,-10 70,-80
             ego vehicle 0: 20,0 velocity 8,0",
        )
        .unwrap();
        let edges = |routes: f64| {
            let config = SampleConfig {
                routes,
                ..SampleConfig::plain()
            };
            let all = (0..12).map(|seed| draw(&scenario, &config, None, Seed(seed)).unwrap());
            let all = all.map(|sample| (sample.n_edges(), sample.targets.len()));
            all.collect::<Vec<_>>()
        };
        let (never, always) = (edges(0.0), edges(1.0));
        assert!(
            never
                .iter()
                .zip(&always)
                .all(|(n, a)| a.0 <= n.0 && a.1 == n.1)
        );
        // Half of them are told later than at the first frame.
        let fewer = never.iter().zip(&always).filter(|(n, a)| a.0 < n.0).count();
        assert!(fewer >= 6, "{fewer} of 12");
        assert_eq!(edges(1.0), always);
    }

    #[test]
    fn who_misses_a_neighbour_or_the_end_of_its_path_does_not_learn() {
        let cars = |places: &[i32]| {
            let cars = places.iter().enumerate();
            let lines = cars.map(|(i, x)| format!("agent vehicle {}: {x},0 velocity 8,0\n", i + 1));
            let map = "lane 1: -400,0 400,0 speed 15\nego vehicle 0: 0,0 velocity 8,0\n";
            fixture::scenario(&(map.to_owned() + &lines.collect::<String>())).unwrap()
        };
        // How many of the agents that are shown have targets. The sample lies around one of them.
        let learning = |scenario: &Scenario, max_agents: usize, whole_views: bool| {
            let config = SampleConfig {
                max_agents,
                whole_views,
                ..SampleConfig::plain()
            };
            let learning = |seed: u64| {
                let sample = draw(scenario, &config, None, Seed(seed)).unwrap();
                let agents: std::collections::BTreeSet<u32> =
                    sample.targets.iter().map(|target| target.agent).collect();
                agents.len()
            };
            (0..8).map(learning).collect::<Vec<_>>()
        };
        let queue = cars(&[12, 24, 36, 48]);
        assert_eq!(learning(&queue, 3, false), [3; 8]);
        // Any other car of the queue is within sight of all three.
        assert_eq!(learning(&queue, 3, true), [0; 8]);
        assert_eq!(learning(&queue, 64, true), [5; 8]);
        // Around one of these the map ends before the path of the other.
        let far = cars(&[200]);
        assert_eq!(learning(&far, 64, false), [2; 8]);
        assert_eq!(learning(&far, 64, true), [1; 8]);
    }

    #[test]
    fn one_seed_one_sample() {
        let scenario = fixture::scenario("ego vehicle 0: 0,0 velocity 8,0").unwrap();
        let drawn = |seed| {
            let sample = draw(&scenario, &SampleConfig::default(), None, Seed(seed)).unwrap();
            (sample.nodes, sample.edge_numbers, sample.targets.len())
        };
        assert_eq!(drawn(1), drawn(1));
        assert_ne!(drawn(1), drawn(2));
    }
}
