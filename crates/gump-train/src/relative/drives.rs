//! Drives in training: the network's own draws lead agents away from the log, and the targets lead
//! back.
//!
//! A network trained on logs only does not see its own small errors until it is rolled out. Here it
//! draws several next moves of every agent and takes the one nearest to the log (as CAT-K does,
//! Zhang et al., "Closed-Loop Supervised Fine-Tuning of Tokenized Traffic Models", 2024), so that
//! agents stay near enough to the log for its next states to be their targets.
//!
//! In a share of drives the agents move freely instead, under the rules of
//! `gump_engine::relative::rules`: draws that would overlap an agent or leave the road are redrawn.
//! The resulting motion is the target, so that the network learns to follow the rules itself. Its
//! own draws do not say how often parked vehicles start, nor how often somebody starts at red or at a
//! stop sign, so these stay where the log has them. Nor do they say where vehicles slow down: rules
//! prefer slow draws, which the network would learn from everywhere. Nor that no way out is left to a
//! vehicle that comes to a bend too fast, or to a junction before others. So moves with such faults
//! are drawn again (`faults`, `right_of_way`, `pace`), and those into a junction that is occupied.

use gump_engine::relative::approach::before_line;
use gump_engine::relative::engine::{Draw, Reach, RelativeEngine, Workspace};
use gump_engine::relative::keep_clear::closed_entry;
use gump_engine::relative::right_of_way::{Course, courses, yielding_speed};
use gump_engine::relative::rules::{kinematically_limited, resolve};
use gump_engine::relative::seen::{FrameIndex, ObservedAgent, add_presents};
use gump_geometry::{DVec2, OrientedBox, Pose, angle_difference};
use gump_kernels::panels::Precision;
use gump_model::local_context::LaneMap;
use gump_model::relative::graph::{Lights, Shown, look};
use gump_model::relative::grid::dequantize;
use gump_model::relative::map::VectorMap;
use gump_model::relative::returns::Returns;
use gump_model::relative::route::{Route, Traveller};
use gump_model::relative::sample::{FreePasts, State, Track, TrackDriver};
use gump_model::relative::{RelativeNetwork, RelativeWeights};
use gump_model::steps::TOKEN_DT;
use gump_scene::{AgentKind, MapGraph, Seed};
use rand::Rng as _;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::relative::crowd::{Crowd, HEADWAY_S, shape};
use crate::relative::faults::{CREEPS_M, Road, sign_lines};
use crate::relative::pace::Pace;

/// Frames that are shown as logged before the network drives: one move, so that it has seen agents
/// move.
pub(super) const WARM_UP: usize = 2;
/// Weight of a radian, in metres, in choosing the move nearest to the log: about half a car's
/// length, by which its corners move then. Chosen by hand.
const METRES_PER_RADIAN: f64 = 2.0;

/// A vehicle is parked if its log stays within this of its first pose, metres, ...
const PARKED_M: f64 = 0.5;
/// ... off lanes: farther than this from their centre lines, metres. Both were chosen by hand. On a
/// lane it is parked where nothing could have held it.
const OFF_LANE_M: f64 = 1.5;
/// A vehicle waits in a queue if its log moves no farther than this in a step, metres, it is itself as
/// near to its log, ...
const WAITS_M: f64 = 0.2;
/// ... and the line of a light or a stop sign is ahead of it, this far at most, and this far aside,
/// metres. All were chosen by hand.
const LINE_AHEAD_M: f64 = 60.0;
const LINE_ASIDE_M: f64 = 6.0;
/// Distance within which a vehicle slows down before an occupied junction, metres: what `faults` needs
/// to stop from 15 m/s. Chosen by hand.
const ENTRY_M: f64 = 40.0;
/// A move with a fault is drawn again so many times. Chosen by hand.
const FAULT_REDRAWS: usize = 6;
/// A fault is none up to this, metres per second: rounding.
const NO_FAULT: f64 = 1e-6;
/// Moves are the same up to this, metres and radians: rounding; bins are a thousand times as wide.
const SAME: f64 = 1e-6;
/// Radius around a sample in which road edges are considered, metres. Chosen by hand.
const EDGES_M: f64 = 150.0;
/// Separates the choice of how a sample is driven from its draws.
const RULED: u64 = 1 << 32;
/// Separates redraws of moves with faults from those of the rules.
const FAULT: usize = 1 << 16;
/// Separates agents that are added to a sample from its draws.
const CROWD: u64 = 1 << 33;
/// Separates the stream of those that are held at a green light.
const HOLD: u64 = 1 << 35;

/// Separates routes beyond the log from its draws.
const ROUTE: u64 = 1 << 34;
/// A vehicle that was led away from its log by more than this keeps the route that it has, metres: one
/// into the lane beside it is nearer.
const NEAR_ROUTE_M: f64 = 5.5;

/// Settings of drives by the network in training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RelativeDrives {
    /// Share of samples whose agents are driven; the others show the log.
    pub share: f64,
    /// Draws per agent and step, of which the nearest to the log is used.
    pub candidates: usize,
    /// If even the nearest draw is farther than this from the target path back to the log, metres,
    /// the agent moves along that path instead: a vehicle that stays at a light that has turned
    /// green gives no information on how to catch up.
    pub tolerance_m: f64,
    /// How driven agents return to their log. With `slide` a share of their offset is gone after half a
    /// second, in position and heading apart, at any speed: a motion that no vehicle makes. With `steer`
    /// vehicles and bicycles aim at a place on their log's way 1.2 s ahead and take the arc of a bicycle
    /// towards it, gain or lose 4 m/s² at most unless the log does, and reverse only with the log. `slide`
    /// by default, as in the trainings of all published weights.
    pub returns: Returns,
    /// Divides the logits of the draws.
    pub temperature: f64,
    /// Steps after which the driving network is updated; with rewards, the smaller of both.
    pub refresh: usize,
    /// Share of the driven samples whose agents move freely under the rules.
    pub ruled: f64,
    /// Maximum number of redraws of a move in those samples.
    pub redraws: usize,
    /// Nucleus of the draws in those samples: the most likely bins that together have this
    /// probability. Targets are smoothed, and without truncation draws would spread a little more
    /// with each update.
    pub top_p: f64,
    /// Weight in those samples of moves that were neither redrawn nor given by the log. They are the
    /// network's own: it learns from them to do what it does, without the tail that was cut off, so
    /// that people turn and vehicles change lane less with every update.
    pub unchanged: f32,
    /// Whether in those samples a vehicle's own start counts in full, and standing in a queue, which the log
    /// gives, as `unchanged`. Without it, with `unchanged` below 1, to stand there counts more than to start,
    /// and the network learns to start more rarely. Vehicles that are parked count in full either way.
    /// False by default, as in the trainings of all published weights.
    pub starts: bool,
    /// How often in those samples a vehicle that stands at a green light, and could start, is held there
    /// for a step, with its start as the target. In logs nobody who has the way free stands at a light
    /// that has been green for a second: a network that misses its start has never seen that, and stands
    /// on (docs/results/0047-missed-starts.md). Above 0, to slow down before a green light is a fault, too.
    pub held: f64,
    /// Whether moves in those samples are held to what rollouts under rules do with them. Without it what
    /// rollouts forbid becomes a target there. With it (a) moves that tyres, steering or legs do not allow
    /// are limited (`gump_engine::relative::rules::kinematically_limited`), and count as changed; (b) no
    /// redraw that clears others has a greater fault than the move before, unless it is slower; (c) a
    /// vehicle all draws of which are faulty brakes where it is too fast for a bend, a light, a sign or
    /// others' right of way, and a move that still has a fault has no weight. And in all drives an agent
    /// that the log has appear where another was driven to does not appear. False by default, as in the
    /// trainings of all published weights.
    pub limits: bool,
    /// Agents that are added to those samples.
    pub crowd: Crowd,
}

impl Default for RelativeDrives {
    /// Without a limit of 0.6 m targets ask agents to jump, and without a cut of 5 % collisions are
    /// more frequent (docs/results/0019-relative-network.md); the others are chosen by hand.
    fn default() -> Self {
        Self {
            share: 0.5,
            candidates: 4,
            tolerance_m: 0.6,
            returns: Returns::Slide,
            temperature: 1.0,
            refresh: 50,
            ruled: 0.0,
            redraws: 8,
            top_p: 0.95,
            unchanged: 1.0,
            starts: false,
            held: 0.0,
            limits: false,
            crowd: Crowd::default(),
        }
    }
}

impl RelativeDrives {
    /// Error: [`TrainError::Config`] naming the first number out of its range.
    pub(super) fn validate(&self) -> Result<(), TrainError> {
        let fail = |key: &'static str, what: &str| {
            let reason = format!("closed_loop: {what}");
            Err(TrainError::Config { key, reason })
        };
        let shares = [
            ("closed_loop.share", "share", self.share),
            ("closed_loop.ruled", "ruled", self.ruled),
        ];
        for (key, name, share) in shares {
            if !(0.0..=1.0).contains(&share) {
                return fail(key, &format!("{name} must be between 0 and 1"));
            }
        }
        if !(0.0..1.0).contains(&self.held) {
            return fail("closed_loop.held", "held must be at least 0 and below 1");
        }
        if !(0.0..=1.0).contains(&self.unchanged) {
            let what = "unchanged must be between 0 and 1";
            return fail("closed_loop.unchanged", what);
        }
        if !(self.top_p > 0.0 && self.top_p <= 1.0) {
            return fail("closed_loop.top_p", "top_p must be above 0 and at most 1");
        }
        if self.candidates == 0 || self.refresh == 0 {
            let key = match self.candidates {
                0 => "closed_loop.candidates",
                _ => "closed_loop.refresh",
            };
            return fail(key, "candidates and refresh must be at least 1");
        }
        if !self.tolerance_m.is_finite() || self.tolerance_m < 0.0 {
            return fail("closed_loop.tolerance_m", "tolerance_m must be 0 or more");
        }
        if !self.temperature.is_finite() || self.temperature <= 0.0 {
            return fail("closed_loop.temperature", "temperature must be above 0");
        }
        self.crowd.validate()
    }
}

/// By how much a move of an agent, given by its index, is beyond what drivers do.
type Fault<'a> = dyn Fn(usize, &Pose) -> f64 + 'a;

/// The move of an agent that has drawn none without a fault, if there is one that drivers make.
type WayOut<'a> = dyn Fn(usize) -> Option<Pose> + 'a;

/// The same move of an agent that brakes, if it is too fast for what is ahead.
type Braked<'a> = dyn Fn(usize, &Pose) -> Option<Pose> + 'a;

/// What judges moves, and makes those that nobody has drawn.
#[derive(Clone, Copy)]
struct Judge<'a> {
    fault: &'a Fault<'a>,
    way_out: &'a WayOut<'a>,
    braked: &'a Braked<'a>,
}

/// Where a move under the rules comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    /// The log has it.
    Log,
    /// It is the network's first draw.
    FirstDraw,
    /// It was drawn again, limited or braked.
    Changed,
    /// It is no move that drivers make, but no better one was found.
    Faulty,
}

/// A snapshot of the network at a step, which drives.
pub(crate) struct NetworkDriver {
    engine: RelativeEngine,
    config: RelativeDrives,
}

impl NetworkDriver {
    pub(super) fn new(
        network: &RelativeNetwork,
        config: &RelativeDrives,
    ) -> Result<Self, TrainError> {
        Ok(Self {
            engine: RelativeEngine::new(&RelativeWeights::of(network)?, Precision::F32)?,
            config: config.clone(),
        })
    }
}

impl TrackDriver for NetworkDriver {
    fn share(&self) -> f64 {
        self.config.share
    }

    fn returns(&self) -> Returns {
        self.config.returns
    }

    /// Moves the agents of a sample, which lies around `centre`, to the poses that the network
    /// drives to.
    fn drive(
        &self,
        (streets, centre): (&MapGraph, DVec2),
        map: &VectorMap,
        lights: &[Lights],
        tracks: &mut Vec<Track>,
        (free_pasts, seed): (FreePasts, Seed),
    ) {
        let ruled = seed.fork(RULED).rng().random_bool(self.config.ruled);
        let n_logged = tracks.len();
        if ruled {
            let n_frames = lights.len();
            self.config
                .crowd
                .join(streets, centre, tracks, n_frames, seed.fork(CROWD));
        }
        let lane_map = ruled.then(|| LaneMap::of_curbs(streets, &[centre], EDGES_M));
        let stays = |track: &Track| track.is_obstacle || is_parked(track, streets);
        // Of drives under the rules alone: the others return to the log anyway.
        let (stays, stood): (Vec<bool>, Vec<bool>) = match ruled {
            true => tracks
                .iter()
                .map(|track| (stays(track), stands_throughout(track)))
                .unzip(),
            false => (Vec::new(), Vec::new()),
        };
        let signs: Vec<Pose> = sign_lines(streets).collect();
        // Agents that are led away take their own poses for logged ones.
        let mut logs: Vec<Vec<Option<Pose>>> = match ruled {
            true => tracks.iter().map(log_of).collect(),
            false => Vec::new(),
        };
        for (newcomer, track) in logs.iter_mut().zip(tracks.iter()).skip(n_logged) {
            match (track.body.kind, track.is_obstacle) {
                (AgentKind::Pedestrian, false) => walk_on(newcomer),
                // Else a moving one would stop dead before a line: its later poses are placeholders.
                _ => newcomer.fill(None),
            }
        }
        let memory = self.engine.remember(map);
        let mut members: Vec<Option<ObservedAgent>> = tracks.iter().map(|_| None).collect();
        let (mut room, mut hidden) = (Workspace::default(), Vec::new());
        for (t, lights) in lights.iter().enumerate().take(lights.len().max(1) - 1) {
            if self.config.limits && t >= WARM_UP {
                // Under the rules tracks have their driven poses for logged ones.
                let log = |a: usize, state: &State| match ruled {
                    true => logs[a][t],
                    false => Some(state.logged),
                };
                drop_blocked(tracks, t, log);
            }
            for (a, (track, member)) in tracks.iter().zip(&mut members).enumerate() {
                match (track.states[t], &mut *member) {
                    (None, _) => *member = None,
                    (Some(state), Some(seen)) => seen.push(state.shown),
                    (Some(state), None) => {
                        let (pose, velocity) = (state.shown, state.velocity);
                        *member = Some(ObservedAgent::first(
                            &self.engine,
                            track.body,
                            pose,
                            velocity,
                        ));
                    }
                }
                if let Some(seen) = member {
                    let route = told_route(streets, track.route(t), seen, seed.fork(ROUTE));
                    seen.head_for(route);
                    seen.hide_free_past(free_pasts.is_hidden(a, t));
                }
            }
            let agents: Vec<Shown> = members.iter().flatten().map(ObservedAgent::now).collect();
            let mut read = Vec::new();
            let seen = members.iter_mut().flatten();
            let frame = FrameIndex { t, is_late: false };
            add_presents((map, &memory), lights, seen, frame, &mut read);
            self.engine.read(&mut read, &mut room, &mut hidden);
            if t + 1 < WARM_UP {
                continue;
            }
            let here: Vec<usize> = (0..tracks.len())
                .filter(|&a| members[a].is_some())
                .collect();
            let seed = seed.fork(t as u64);
            if let Some(lane_map) = &lane_map {
                let signs = signs.iter().copied();
                let lines: Vec<Pose> = lit_lanes(lights, streets).chain(signs).collect();
                let is_queued = |a: usize, now: &Shown| {
                    let log = [logs[a][t], logs[a][t + 1]];
                    now.body.kind == AgentKind::Vehicle && is_queued(now.pose, log, &lines)
                };
                let has_room = |i: usize| look(map, lights, &agents, i, None).has_room(&agents[i]);
                let ways = |now: &Shown| match now.body.kind {
                    AgentKind::Vehicle | AgentKind::Bicycle => courses(streets, lights, now, None),
                    _ => Vec::new(),
                };
                let ways: Vec<Vec<Course>> = agents.iter().map(ways).collect();
                let yields = |i: usize| {
                    let others = ways.iter().enumerate();
                    let others = others.filter(|(j, _)| *j != i && !stays[here[*j]]);
                    yielding_speed(&ways[i], &others.map(|(_, way)| &way[..]))
                };
                let is_lit = |lane| lights.colour(lane).is_some();
                let keeps_clear = |i: usize| {
                    let closed = closed_entry(streets, &agents, (i, None), ENTRY_M, is_lit, |j| {
                        !stays[here[j]]
                    });
                    closed.map_or(f64::INFINITY, |(_, m)| before_line(&agents[i], m, 0.0))
                };
                let mut given = Vec::new();
                let (mut roads, mut paces) = (Vec::new(), Vec::new());
                let mut queued = Vec::with_capacity(here.len());
                for (i, (&a, now)) in here.iter().zip(&agents).enumerate() {
                    queued.push(!stays[a] && is_queued(a, now));
                    let stays = stays[a] || queued[i];
                    let mut road = Road::ahead_of(now, stays, streets, lights);
                    if self.config.held == 0.0 {
                        road = road.blind_to_green();
                    }
                    if !stays {
                        road = road.yielding(yields(i).min(keeps_clear(i)));
                    }
                    let is_parked = || stood[a] && road.is_away_from_junctions() && has_room(i);
                    let stays = stays || is_parked();
                    given.push(stays.then_some(Pose::IDENTITY));
                    paces.push(match stays {
                        true => None,
                        false => Pace::of_log(&logs[a], t, now, road.calm()),
                    });
                    roads.push(road);
                }
                let crowd = (&agents[..], &given[..]);
                let fault = |i: usize, step: &Pose| match given[i] {
                    Some(_) => 0.0,
                    None => {
                        let (own, others) = (&agents[i], || {
                            let others = agents.iter().zip(&paces).enumerate();
                            let others = others.filter(|(j, _)| *j != i);
                            others.map(|(_, (other, pace))| (other, pace.as_ref()))
                        });
                        let pace = paces[i].as_ref();
                        let logged = pace.map(Pace::logged);
                        let pace = pace.map_or(0.0, |pace| pace.fault(own, step, others()));
                        roads[i].fault(own, step, logged, || has_room(i)) + pace
                    }
                };
                let way_out = |i: usize| roads[i].starts(&agents[i], || has_room(i));
                let judge = Judge {
                    fault: &fault,
                    way_out: &way_out,
                    braked: &|i: usize, step: &Pose| roads[i].braked(&agents[i], step),
                };
                let ground = (lane_map, judge);
                let moves = self.moves_by_the_rules(crowd, ground, &hidden, seed, &mut room);
                let held = self.config.held;
                let each = here.iter().zip(&agents).zip(moves).enumerate();
                for (i, ((&a, now), (step, origin))) in each {
                    if let Some(next) = tracks[a].states[t + 1].as_mut().filter(|_| !stays[a]) {
                        let starts = step.position.length() > CREEPS_M
                            && given[i].is_none()
                            && way_out(i).is_some();
                        if starts && seed.fork(HOLD).fork(i as u64).rng().random_bool(held) {
                            *next = next.held_at(now.pose, now.pose * step);
                            continue;
                        }
                        let weight = self.weight(origin, queued[i], sets_off(now, &step));
                        *next = next.led_to(now.pose * step, weight);
                    }
                }
                continue;
            }
            let moves = self.draws(&hidden, &agents, seed, &mut room);
            for (i, &a) in here.iter().enumerate() {
                let wanted = tracks[a].way_back(t, &agents[i], self.config.returns);
                let (Some(wanted), Some(next)) = (wanted, tracks[a].states[t + 1]) else {
                    continue;
                };
                let candidates = moves.iter().map(|of_draw| agents[i].pose * of_draw[i]);
                let nearest =
                    candidates.min_by(|a, b| far(*a, next.logged).total_cmp(&far(*b, next.logged)));
                let nearest = nearest.expect("there is at least one candidate");
                let shown = match far(nearest, wanted) < self.config.tolerance_m {
                    true => nearest,
                    false => wanted,
                };
                tracks[a].states[t + 1] = Some(next.driven_to(shown));
            }
        }
    }
}

impl NetworkDriver {
    /// The weight in the loss of a move under the rules, of an agent that is queued in its log or not, and
    /// sets off with it or does not.
    pub(super) fn weight(&self, origin: Origin, is_queued: bool, sets_off: bool) -> f32 {
        let (unchanged, starts) = (self.config.unchanged, self.config.starts);
        match origin {
            Origin::Log if starts && is_queued => unchanged,
            Origin::FirstDraw if starts && sets_off => 1.0,
            Origin::FirstDraw => unchanged,
            Origin::Log | Origin::Changed => 1.0,
            Origin::Faulty => 0.0,
        }
    }

    /// A move of every agent in its own frame, redrawn where it has a fault and where the rules
    /// forbid it; some are given. With each, where it comes from.
    fn moves_by_the_rules(
        &self,
        (agents, given): (&[Shown], &[Option<Pose>]),
        (lane_map, judge): (&LaneMap, Judge<'_>),
        hidden: &[f32],
        seed: Seed,
        room: &mut Workspace,
    ) -> Vec<(Pose, Origin)> {
        let (fault, limits) = (judge.fault, self.config.limits);
        let draw = Draw {
            temperature: self.config.temperature,
            top_p: self.config.top_p,
        };
        let c = hidden.len() / agents.len().max(1);
        let mut raw = |who: &[usize], attempt: usize| -> Vec<Pose> {
            let rows: Vec<f32> = who
                .iter()
                .flat_map(|&i| &hidden[i * c..][..c])
                .copied()
                .collect();
            let of_draw = seed.fork(attempt as u64);
            let streams: Vec<Seed> = who.iter().map(|&i| of_draw.fork(i as u64)).collect();
            let reach: Vec<Reach> = who.iter().map(|&i| Reach::of(&agents[i])).collect();
            let bins = self.engine.decide(&rows, (&streams, &reach), draw, room);
            let drawn = who.iter().zip(bins);
            drawn
                .map(|(&i, bins)| given[i].unwrap_or_else(|| dequantize(bins)))
                .collect()
        };
        let possible = |i: usize, step: Pose| match limits && given[i].is_none() {
            true => limited(&agents[i], step),
            false => step,
        };
        let all: Vec<usize> = (0..agents.len()).collect();
        let first = raw(&all, 0);
        let mut moves: Vec<Pose> = all.iter().map(|&i| possible(i, first[i])).collect();
        let mut drawn = |who: &[usize], attempt: usize| -> Vec<Pose> {
            let steps = who.iter().zip(raw(who, attempt));
            steps.map(|(&i, step)| possible(i, step)).collect()
        };
        let faults = all.iter().map(|&i| (i, fault(i, &moves[i])));
        let mut faulty: Vec<(usize, f64)> = faults.filter(|(_, fault)| *fault > 0.0).collect();
        for attempt in 0..FAULT_REDRAWS {
            let who: Vec<usize> = faulty.iter().map(|(i, _)| *i).collect();
            for ((i, least), step) in faulty.iter_mut().zip(drawn(&who, FAULT + attempt)) {
                let found = fault(*i, &step);
                if found < *least {
                    (moves[*i], *least) = (step, found);
                }
            }
            faulty.retain(|(_, least)| *least > 0.0);
        }
        let mut is_lost = vec![false; agents.len()];
        for (i, mut least) in faulty {
            let brakes = match limits {
                true => (judge.braked)(i, &moves[i]),
                false => None,
            };
            for step in (judge.way_out)(i).into_iter().chain(brakes) {
                let found = fault(i, &step);
                if found < least {
                    (moves[i], least) = (step, found);
                }
            }
            is_lost[i] = limits && least > NO_FAULT;
        }
        // As in rollouts: redraws that keep agents clear of others must not make them run a light. One that
        // can do nothing else may at least be slower.
        let before = moves.clone();
        let mut again = |who: &[usize], attempt: usize| -> Vec<Pose> {
            let mut steps = drawn(who, attempt + 1);
            for (&i, step) in who.iter().zip(&mut steps) {
                if limits && is_worse(|step| fault(i, step), step, &before[i]) {
                    *step = before[i];
                }
            }
            steps
        };
        let redraws = self.config.redraws;
        resolve(
            agents,
            None,
            (lane_map, &|_| false),
            redraws,
            &mut moves,
            &mut again,
        );
        let origin = |i: usize, step: &Pose| match given[i] {
            Some(_) => Origin::Log,
            None if is_lost[i] && fault(i, step) > NO_FAULT => Origin::Faulty,
            None if *step == first[i] => Origin::FirstDraw,
            None => Origin::Changed,
        };
        let moves = moves.into_iter().enumerate();
        moves.map(|(i, step)| (step, origin(i, &step))).collect()
    }

    /// The candidates' moves of all agents, in the agents' frames.
    fn draws(
        &self,
        hidden: &[f32],
        agents: &[Shown],
        seed: Seed,
        room: &mut Workspace,
    ) -> Vec<Vec<Pose>> {
        let n = agents.len();
        let reach: Vec<Reach> = agents.iter().map(Reach::of).collect();
        let draw = Draw {
            temperature: self.config.temperature,
            top_p: 1.0,
        };
        let candidates = (0..self.config.candidates).map(|k| {
            let of_draw = seed.fork(k as u64);
            let streams: Vec<Seed> = (0..n).map(|i| of_draw.fork(i as u64)).collect();
            let bins = self.engine.decide(hidden, (&streams, &reach), draw, room);
            bins.into_iter().map(dequantize).collect()
        });
        candidates.collect()
    }
}

/// Continues a log straight on after its first step: who has no log walks on.
pub(super) fn walk_on(log: &mut [Option<Pose>]) {
    let [Some(from), Some(to), ..] = *log else {
        return;
    };
    let step = from.inverse() * to;
    let mut pose = to;
    for next in &mut log[WARM_UP..] {
        pose = pose * step;
        *next = Some(pose);
    }
}

/// Takes out of a sample, from frame `t` on, who appears there where another was driven to: whose box
/// touches it, or would within a second, though it would not touch that agent where `log` has it then.
pub(super) fn drop_blocked(
    tracks: &mut [Track],
    t: usize,
    log: impl Fn(usize, &State) -> Option<Pose>,
) {
    let appears = |track: &Track| t > 0 && track.states[t - 1].is_none();
    let driven = tracks.iter().enumerate().filter_map(|(a, track)| {
        let state = track.states[t].filter(|_| !appears(track))?;
        let logged = log(a, &state);
        let is_led = logged.is_none_or(|logged| far(logged, state.shown) > SAME);
        is_led.then(|| {
            let logged = logged.map(|pose| shape(track.body, pose));
            (shape(track.body, state.shown), logged)
        })
    });
    let driven: Vec<(OrientedBox, Option<OrientedBox>)> = driven.collect();
    for track in tracks.iter_mut() {
        let Some(state) = track.states[t].filter(|_| appears(track)) else {
            continue;
        };
        let own = shape(track.body, state.shown);
        let ahead = HEADWAY_S * state.velocity.length();
        let soon = OrientedBox {
            pose: own.pose * Pose::new(0.5 * ahead, 0.0, 0.0),
            length: own.length + ahead,
            ..own
        };
        let is_blocked = driven.iter().any(|(here, logged)| {
            let follows_in_log = || logged.is_some_and(|logged| soon.overlaps(&logged));
            own.overlaps(here) || soon.overlaps(here) && !follows_in_log()
        });
        if is_blocked {
            track.states[t..].fill(None);
        }
    }
}

/// Whether a vehicle stands, and starts with this move.
pub(super) fn sets_off(now: &Shown, step: &Pose) -> bool {
    now.body.kind == AgentKind::Vehicle
        && now.velocity().length() * TOKEN_DT <= CREEPS_M
        && step.position.length() > CREEPS_M
}

/// Whether a move is no slower than the one before, and has a greater fault.
pub(super) fn is_worse(fault: impl Fn(&Pose) -> f64, step: &Pose, before: &Pose) -> bool {
    let is_slower = step.position.length() < before.position.length();
    !is_slower && fault(step) > fault(before) + NO_FAULT
}

/// A drawn move within the limits of rollouts; exactly as drawn if it is within them.
fn limited(now: &Shown, step: Pose) -> Pose {
    let kept = kinematically_limited(now, step);
    let turned = angle_difference(kept.heading, step.heading).abs();
    match kept.position.distance(step.position).max(turned) > SAME {
        true => kept,
        false => step,
    }
}

/// The route of a vehicle: that of its log, as long as it is near it, else the one it has.
fn told_route(
    streets: &MapGraph,
    logged: Option<&Route>,
    seen: &ObservedAgent,
    seed: Seed,
) -> Option<Route> {
    let now = seen.now();
    let is_near = |route: &&Route| route.offset_m(streets, now.pose) < NEAR_ROUTE_M;
    let who = Traveller {
        pose: now.pose,
        speed: now.velocity().length(),
        seed,
        remains: false,
    };
    let kept = || seen.route()?.from_there(streets, who, true);
    logged.filter(is_near).cloned().or_else(kept)
}

/// Whether a vehicle stands beside the lanes throughout its log.
fn is_parked(track: &Track, streets: &MapGraph) -> bool {
    let first = track.states.iter().flatten().next();
    let is_off = first.is_some_and(|first| {
        let mut near = streets.lanes_near(first.logged.position, OFF_LANE_M);
        near.next().is_none()
    });
    is_off && stands_throughout(track)
}

/// Whether a vehicle stands throughout its log.
fn stands_throughout(track: &Track) -> bool {
    let mut logged = track.states.iter().flatten().map(|state| state.logged);
    let Some(first) = logged.next() else {
        return false;
    };
    let stays = |pose: Pose| pose.position.distance(first.position) < PARKED_M;
    track.body.kind == AgentKind::Vehicle && logged.all(stays)
}

/// Where lanes with lights start.
fn lit_lanes(lights: &Lights, streets: &MapGraph) -> impl Iterator<Item = Pose> {
    let start = |id| Some(streets.lane(id)?.centerline.pose_at(0.0));
    let lit = lights.by_lane.iter();
    lit.filter_map(move |(id, ..)| start(*id))
}

/// The logged poses of a track.
fn log_of(track: &Track) -> Vec<Option<Pose>> {
    let states = track.states.iter();
    states.map(|state| Some((*state)?.logged)).collect()
}

/// Whether a vehicle that is `here` waits in a queue: where its log stands, `now` and `next`, behind a
/// line ahead, at which a light or a stop sign holds.
pub(super) fn is_queued(here: Pose, [now, next]: [Option<Pose>; 2], lines: &[Pose]) -> bool {
    let near = |a: Pose, b: Pose| a.position.distance(b.position) < WAITS_M;
    let ahead = |line: &Pose| {
        let local = here.inverse() * *line;
        (0.0..LINE_AHEAD_M).contains(&local.position.x)
            && local.position.y.abs() < LINE_ASIDE_M
            && local.heading.cos() > 0.7
    };
    let waits = |(now, next): (Pose, Pose)| near(here, now) && near(now, next);
    now.zip(next).is_some_and(waits) && lines.iter().any(ahead)
}

/// Distance between two poses, metres.
fn far(a: Pose, b: Pose) -> f64 {
    a.position.distance(b.position)
        + METRES_PER_RADIAN * angle_difference(a.heading, b.heading).abs()
}
