//! The game: one drive through one scene, a tenth of a second at a time.
//!
//! The network runs every half second: at the start of each, all agents decide, on the assumption
//! that the ego continues as before; during it, the ego goes where it is driven; at its end, the
//! network gets the ego's actual state. The inputs are kept, so a drive can be rewound to any
//! moment, continued from there in eight ways, or shared as a link and replayed to the bit.
//!
//! Start with [`Game::open`], then [`Game::tick`].

use std::f64::consts::PI;

use gump_geometry::{Pose, wrap_angle};
use gump_metrics::{Metric as _, OffRoad, RedLight, overlapping};
use gump_nuplan::closed_loop::{Recording, derive_roadblocks};
use gump_rollout::{SimulateConfig, dynamics, fill};
use gump_scene::{AgentId, AgentState, EgoState, Frame, Rollout, Scenario, SceneState, Seed};

use crate::GameError;
use crate::branches::Branches;
use crate::drivers::{self, PlanningContext, ego_state};
use crate::engine::{self, LiveFuture, RelativeWorld};
use crate::signals::Signals;
use crate::tape::{EgoDriver, Input};

/// Seconds between frames.
pub const DT: f64 = 0.1;
/// Frames in a half second of the network.
pub(crate) const STRIDE: usize = 5;
/// Frames of the longest drive, five minutes. Chosen by hand: its states stay in memory.
pub const MAX_FRAMES: usize = 3000;
/// Agents that a scene may have at its start: three times those of the shipped scenes, which take
/// 36 ms per half second on a desktop (docs/results/0022-live-page.md). Phones were not measured.
pub const MAX_AGENTS: usize = 128;
/// Points that a map may have; a scene of Waymo's has some ten thousand. Chosen by hand, against
/// files that would fill the memory.
pub const MAX_POINTS: usize = 200_000;
/// Half seconds between two kept copies of the network's state; states in between are computed
/// again from the copy before them. A copy for 40 agents takes a megabyte.
const COPY_EVERY: usize = 16;

/// Hardest braking and acceleration, metres per second squared: what a family car does on a dry
/// road when pressed, not what is comfortable.
const PEDAL: [f64; 2] = [-7.0, 3.0];
/// Sharpest turn, radians per metre: a radius of 5 m, as passenger cars have.
const MAX_CURVATURE: f64 = 0.2;
/// Sharpest turn at speed, metres per second squared across: near what tyres hold on a dry road.
/// Chosen by hand.
const MAX_LATERAL: f64 = 6.0;
/// Highest speed, metres per second (144 km/h). Chosen by hand.
const MAX_SPEED: f64 = 40.0;
/// Hardest acceleration in reverse, metres per second squared, and highest speed in reverse, metres
/// per second (18 km/h). Chosen by hand.
const REVERSE: (f64, f64) = (2.0, 5.0);
/// Deceleration when no pedal is pressed, metres per second squared. Chosen by feel.
const ROLLING: f64 = 0.3;

/// Settings of a drive. The temperature is an input instead, since it may change during the drive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Seed of all randomness.
    pub seed: u64,
    /// Share of the other agents that are kept, 0 to 1.
    pub density: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            seed: 1,
            density: 1.0,
        }
    }
}

/// Something that happened to the ego.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Event {
    /// Frames after the start.
    pub frame: usize,
    /// Kind of the event.
    pub kind: EventKind,
}

/// Kinds of events of the ego.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EventKind {
    /// Its box began to overlap that of another agent.
    Collision(AgentId),
    /// A corner of it left the road.
    OffRoad,
    /// It drove past a red light.
    RedLight,
}

/// State kept for a half second.
#[derive(Clone, Debug)]
pub(crate) struct Knot {
    driver: EgoDriver,
    temperature: f64,
    /// Assumed state of the ego at its end; `None` if the network decides.
    assumed: Option<AgentState>,
    /// State of the network at its start, where a copy is kept.
    copy: Option<LiveFuture>,
}

/// One drive through one scene.
#[derive(Debug)]
pub struct Game {
    world: RelativeWorld,
    settings: Settings,
    /// The scene, thinned.
    scenario: Scenario,
    recording: Recording,
    signals: Signals,
    /// History and drive, ten frames a second; the first `scenario.now + 1` were recorded.
    frames: Vec<Frame>,
    /// The ego at each frame of the drive, the start included.
    ego: Vec<EgoState>,
    inputs: Vec<Input>,
    /// One for each half second that has begun.
    knots: Vec<Knot>,
    /// State of the network at the start of the last half second that has begun, or of the next.
    live: LiveFuture,
    /// The frames of the half second that has begun.
    ahead: Vec<Frame>,
    /// States that rule-based drivers plan for the ego in them.
    planned: Vec<AgentState>,
    events: Vec<Event>,
    /// Agents that overlapped the ego at the start, which is not a collision.
    entangled: Vec<AgentId>,
    branches: Option<Branches>,
}

impl Game {
    /// Opens a scene to drive in: the bytes of a file (scenario JSON, GPUDrive's JSON or Waymo's
    /// TFRecord, of which the first) and of the network's weights.
    ///
    /// # Errors
    /// [`GameError`] for bytes that are neither, and for scenes that the page cannot take.
    pub fn open(
        scene: &[u8],
        name: &str,
        weights: &[u8],
        settings: Settings,
    ) -> Result<Self, GameError> {
        let scenario = gump_data::parse(scene, name);
        let scenario = scenario.map_err(|error| GameError::Scene(error.to_string()))?;
        let world = engine::world(weights).map_err(GameError::Weights)?;
        Self::new(scenario, world, settings)
    }

    /// A game in a scenario.
    fn new(
        scenario: Scenario,
        mut world: RelativeWorld,
        settings: Settings,
    ) -> Result<Self, GameError> {
        check(&scenario, settings)?;
        let scenario = thinned(scenario, settings.density);
        let found = scenario.present().now().agents().len();
        if found > MAX_AGENTS {
            return Err(GameError::TooManyAgents {
                found,
                limit: MAX_AGENTS,
            });
        }
        world.set_temperature(1.0);
        let start = scenario.present().unguided();
        let live = LiveFuture::begin(&world, start, Seed(settings.seed));
        let live = live.map_err(|error| GameError::Scene(error.to_string()))?;
        let mut driven = scenario.clone();
        derive_roadblocks(&mut driven);
        let recording = Recording::of_boxes(driven);
        let recording = recording.map_err(|error| GameError::Scene(error.to_string()))?;
        let ego = scenario.present().ego_now();
        let entangled = overlapping(scenario.present().now(), ego).collect();
        Ok(Self {
            world,
            settings,
            signals: Signals::of(&scenario),
            frames: scenario.log[..=scenario.now].to_vec(),
            ego: vec![ego_state(&recording, None, &ego.state, DT)],
            inputs: Vec::new(),
            knots: Vec::new(),
            live,
            ahead: Vec::new(),
            planned: Vec::new(),
            events: Vec::new(),
            entangled,
            branches: None,
            recording,
            scenario,
        })
    }

    /// The same scene from its start, with other settings.
    ///
    /// # Errors
    /// As [`Game::open`].
    pub fn restarted(
        self,
        scene: &[u8],
        name: &str,
        settings: Settings,
    ) -> Result<Self, GameError> {
        let scenario = gump_data::parse(scene, name);
        let scenario = scenario.map_err(|error| GameError::Scene(error.to_string()))?;
        Self::new(scenario, self.world, settings)
    }

    /// Drives for a tenth of a second.
    ///
    /// # Errors
    /// [`GameError::Over`] after five minutes; [`GameError::Driver`] for a driver that cannot drive
    /// here, after which another may continue.
    pub fn tick(&mut self, input: Input) -> Result<(), GameError> {
        let input = input.held();
        let (frame, into) = (self.driven(), self.driven() % STRIDE);
        if frame >= MAX_FRAMES {
            return Err(GameError::Over(MAX_FRAMES / 600));
        }
        if into == 0 {
            self.begin_knot(input)?;
        }
        let now = self.scene().ego_now().state;
        let ego = self.scenario.ego;
        let driver = self.knots.last().map_or(input.driver, |knot| knot.driver);
        let decided = self.ahead[into].agent(ego).map(|agent| agent.state);
        let next = match driver {
            EgoDriver::Hand => by_hand(&now, input, DT),
            EgoDriver::Network => decided.unwrap_or(now),
            EgoDriver::Idm | EgoDriver::Pdm => self.planned.get(into).copied().unwrap_or(now),
        };
        let shown = &self.ahead[into];
        let agents = shown.agents().iter().map(|agent| match agent.id == ego {
            true => agent.with_state(next),
            false => *agent,
        });
        let lights = self.signals.at(frame + 1);
        self.frames.push(Frame::new(agents.collect(), lights));
        let state = ego_state(&self.recording, self.ego.last(), &next, DT);
        self.ego.push(state);
        // A link stores the inputs as given: a change of driver is stored when it was made, not
        // when it took effect.
        self.inputs.push(input);
        self.note();
        if into + 1 == STRIDE {
            let actual = (driver != EgoDriver::Network).then_some(next);
            self.live.go_on(&self.world, actual);
            self.ahead.clear();
        }
        Ok(())
    }

    /// Lets all agents decide on the next half second.
    fn begin_knot(&mut self, input: Input) -> Result<(), GameError> {
        let frame = self.driven();
        let now = self.scene().ego_now().state;
        let context = PlanningContext {
            recording: &self.recording,
            scene: SceneState {
                map: &self.recording.scenario().map,
                route: self.recording.scenario().route.as_ref(),
                history: &self.frames,
                ego: self.scenario.ego,
                dt: DT,
            },
            ego: &self.ego,
        };
        self.planned = drivers::plan(input.driver, &context, STRIDE)?;
        let assumed = match input.driver {
            EgoDriver::Hand => Some(by_hand(&now, input, DT * STRIDE as f64)),
            EgoDriver::Network => None,
            EgoDriver::Idm | EgoDriver::Pdm => Some(self.planned.last().copied().unwrap_or(now)),
        };
        let index = frame / STRIDE;
        self.knots.truncate(index);
        self.live.show(&self.signals.at(frame + STRIDE));
        let knot = Knot {
            driver: input.driver,
            temperature: f64::from(input.temperature) / Input::PER_UNIT,
            assumed,
            copy: index.is_multiple_of(COPY_EVERY).then(|| self.live.clone()),
        };
        self.decide(&knot)?;
        self.knots.push(knot);
        Ok(())
    }

    /// The decisions of a half second that begins now, as frames.
    fn decide(&mut self, knot: &Knot) -> Result<(), GameError> {
        self.world.set_temperature(knot.temperature);
        let next = self.live.decide(&self.world, knot.assumed);
        let begun = self.scenario.now + 1 + self.driven() / STRIDE * STRIDE;
        let scene = self.scene();
        let scene = SceneState {
            history: &scene.history[..begun],
            ..scene
        };
        let filled = fill(scene, &next, LiveFuture::DT, &SimulateConfig::default());
        self.ahead = filled.map_err(|error| GameError::Scene(error.to_string()))?;
        Ok(())
    }

    /// Records the events of the last frame.
    fn note(&mut self) {
        let frame = self.driven();
        let scene = self.scene();
        let Some(ego) = scene.now().agent(scene.ego) else {
            return;
        };
        let before = &scene.history[scene.history.len() - 2];
        let was = before.agent(scene.ego);
        let mut kinds: Vec<EventKind> = overlapping(scene.now(), ego)
            .filter(|other| !self.entangled.contains(other))
            .filter(|other| {
                let overlapped =
                    was.is_some_and(|ego| overlapping(before, ego).any(|o| o == *other));
                !overlapped
            })
            .map(EventKind::Collision)
            .collect();
        if is_off_road(&scene) && !is_off_road(&self.before()) {
            kinds.push(EventKind::OffRoad);
        }
        if RedLight.at(&scene, ego) == Some(1.0) {
            kinds.push(EventKind::RedLight);
        }
        let events = kinds.into_iter().map(|kind| Event { frame, kind });
        self.events.extend(events.collect::<Vec<_>>());
    }

    /// Rewinds the drive to so many frames after its start.
    ///
    /// # Errors
    /// [`GameError::NotDriven`] for a moment that has not been driven.
    pub fn rewind(&mut self, frame: usize) -> Result<(), GameError> {
        self.check_moment(frame)?;
        let knot = frame / STRIDE;
        self.live = self.live_at(knot);
        self.frames.truncate(self.scenario.now + 1 + frame);
        self.ego.truncate(frame + 1);
        self.inputs.truncate(frame);
        self.events.retain(|event| event.frame <= frame);
        self.ahead.clear();
        self.branches = None;
        if frame.is_multiple_of(STRIDE) {
            self.knots.truncate(knot);
            return Ok(());
        }
        self.knots.truncate(knot + 1);
        let begun = self.knots[knot].clone();
        self.decide(&begun)?;
        self.planned = match begun.assumed {
            Some(_) if begun.driver != EgoDriver::Hand => self.rest_of_plan(knot),
            _ => Vec::new(),
        };
        Ok(())
    }

    /// Computes again what a rule-based driver had planned for a half second that has begun.
    fn rest_of_plan(&mut self, knot: usize) -> Vec<AgentState> {
        let frame = knot * STRIDE;
        let context = PlanningContext {
            recording: &self.recording,
            scene: SceneState {
                map: &self.recording.scenario().map,
                route: self.recording.scenario().route.as_ref(),
                history: &self.frames[..self.scenario.now + 1 + frame],
                ego: self.scenario.ego,
                dt: DT,
            },
            ego: &self.ego[..=frame],
        };
        let driver = self.knots[knot].driver;
        let planned = drivers::plan(driver, &context, STRIDE);
        planned.unwrap_or_default()
    }

    /// State of the network at the start of a half second that has been driven.
    pub(crate) fn live_at(&mut self, knot: usize) -> LiveFuture {
        if knot == self.driven() / STRIDE {
            return self.live.clone();
        }
        let copies = self.knots[..=knot].iter().enumerate();
        let mut kept = copies.filter_map(|(i, k)| Some((i, k.copy.clone()?)));
        let (first, mut live) = kept
            .next_back()
            .expect("the first half second always has a copy");
        for i in first..knot {
            let Knot {
                driver,
                temperature,
                assumed,
                ..
            } = self.knots[i];
            self.world.set_temperature(temperature);
            live.show(&self.signals.at((i + 1) * STRIDE));
            live.decide(&self.world, assumed);
            let end = &self.frames[self.scenario.now + (i + 1) * STRIDE];
            let ego = end.agent(self.scenario.ego).map(|agent| agent.state);
            live.go_on(&self.world, ego.filter(|_| driver != EgoDriver::Network));
        }
        live
    }

    /// Begins eight futures from so many frames after the start, at the half second before it.
    ///
    /// # Errors
    /// [`GameError::NotDriven`] for a moment that has not been driven.
    pub fn branch(&mut self, frame: usize) -> Result<(), GameError> {
        self.check_moment(frame)?;
        let knot = frame / STRIDE;
        let temperature = self
            .inputs
            .get(frame.saturating_sub(1))
            .map_or(1.0, |input| f64::from(input.temperature) / Input::PER_UNIT);
        let live = self.live_at(knot);
        let frames = self.frames[..=self.scenario.now + knot * STRIDE].to_vec();
        self.branches = Some(Branches::new(
            &live,
            &frames,
            self.settings.seed,
            knot,
            temperature,
        ));
        Ok(())
    }

    /// Advances one of the eight futures by half a second; false once all are done.
    pub fn go_on_branching(&mut self) -> bool {
        let Some(mut branches) = self.branches.take() else {
            return false;
        };
        self.world.set_temperature(branches.temperature());
        let context = SceneState {
            history: &[],
            ..self.scene()
        };
        let more = branches.step(&self.world, &self.signals, context);
        self.branches = Some(branches);
        more
    }

    /// The eight futures, if any were begun.
    pub fn branches(&self) -> Option<&Branches> {
        self.branches.as_ref()
    }

    /// Frames driven so far.
    pub fn driven(&self) -> usize {
        self.inputs.len()
    }

    /// The scene as it was so many frames after the start.
    ///
    /// # Errors
    /// [`GameError::NotDriven`] for a moment that has not been driven.
    pub fn at(&self, frame: usize) -> Result<SceneState<'_>, GameError> {
        self.check_moment(frame)?;
        let scene = self.scene();
        Ok(SceneState {
            history: &scene.history[..=self.scenario.now + frame],
            ..scene
        })
    }

    /// The scene up to now.
    pub fn scene(&self) -> SceneState<'_> {
        SceneState {
            history: &self.frames,
            ..self.scenario.present()
        }
    }

    fn before(&self) -> SceneState<'_> {
        let scene = self.scene();
        SceneState {
            history: &scene.history[..scene.history.len() - 1],
            ..scene
        }
    }

    /// The scene as it was opened, without the agents that were removed by the density.
    pub fn scenario(&self) -> &Scenario {
        &self.scenario
    }

    /// Events of the ego so far.
    pub fn events(&self) -> &[Event] {
        &self.events
    }

    /// Inputs, one per frame.
    pub fn inputs(&self) -> &[Input] {
        &self.inputs
    }

    /// Settings of the drive.
    pub fn settings(&self) -> Settings {
        self.settings
    }

    /// The drive as a rollout.
    pub(crate) fn rollout(&self, frames: usize) -> Rollout {
        let mut rollout = Rollout::begin(self.scenario.present());
        let first = self.scenario.now + 1;
        for frame in &self.frames[first..first + frames.min(self.driven())] {
            rollout.push(frame.clone());
        }
        rollout
    }

    /// Possible motions of the other agents from the start of this half second on: the draws with
    /// these numbers for each moving agent, as positions over the following second and a half. The
    /// network gives the first half second; the rest continues that motion.
    pub fn fans(&self, draws: std::ops::Range<u64>) -> Vec<Fan> {
        let knot = self.driven() / STRIDE * STRIDE;
        let start = &self.frames[self.scenario.now + knot];
        let predicted = self
            .live
            .predictive_samples(&self.world, draws, Some(self.scenario.ego));
        let fans = predicted.into_iter().filter_map(|samples| {
            let from = start.agent(samples.agent)?.state.pose;
            let way = |state: &AgentState| {
                let step = from.inverse() * state.pose;
                let mut at = from;
                [(); FAN_STEPS].map(|()| {
                    at = at * step;
                    [at.position.x, at.position.y]
                })
            };
            Some(Fan {
                agent: samples.agent,
                from: [from.position.x, from.position.y],
                ways: samples.draws.iter().map(way).collect(),
            })
        });
        fans.collect()
    }

    fn check_moment(&self, frame: usize) -> Result<(), GameError> {
        if frame <= self.driven() {
            return Ok(());
        }
        Err(GameError::NotDriven {
            asked: frame as f64 * DT,
            driven: self.driven() as f64 * DT,
        })
    }
}

/// Half seconds that a fan shows. Chosen by eye.
pub const FAN_STEPS: usize = 3;

/// Possible next motions of an agent.
#[derive(Clone, Debug)]
pub struct Fan {
    /// Id of the agent.
    pub agent: AgentId,
    /// Position at the start of this half second, world frame, metres.
    pub from: [f64; 2],
    /// Possible positions after each of the next half seconds, world frame, metres.
    pub ways: Vec<[[f64; 2]; FAN_STEPS]>,
}

/// Whether a corner of the ego is off the road now.
pub(crate) fn is_off_road(scene: &SceneState<'_>) -> bool {
    let ego = scene.now().agent(scene.ego);
    ego.is_some_and(|ego| OffRoad.at(scene, ego) == Some(1.0))
}

/// State after `dt` seconds with this pedal and wheel.
fn by_hand(now: &AgentState, input: Input, dt: f64) -> AgentState {
    let speed = now.velocity.dot(now.pose.direction());
    // A car that still rolls forwards is braked first, whatever the gear.
    if input.reverse && speed <= 0.0 {
        return backwards(now, -speed, input, dt);
    }
    let share = f64::from(input.pedal) / 100.0;
    let wanted = match input.pedal {
        0 => -ROLLING,
        1.. => share * PEDAL[1],
        _ => -share * PEDAL[0],
    };
    // A car that rolls backwards, as some recorded ones do, comes to rest first.
    let wanted = if speed < 0.0 { PEDAL[1] } else { wanted };
    let acceleration = wanted.min((MAX_SPEED - speed) / dt);
    dynamics::drive(now, acceleration, curvature(speed, input), dt)
}

/// The same in reverse gear for a car that stands or drives backwards at `speed`.
fn backwards(now: &AgentState, speed: f64, input: Input, dt: f64) -> AgentState {
    let share = f64::from(input.pedal) / 100.0;
    let wanted = match input.pedal {
        0 => -ROLLING,
        1.. => share * PEDAL[0],
        _ => -share * REVERSE.0,
    };
    let acceleration = wanted.min((REVERSE.1 - speed) / dt);
    // The dynamics know no car that sets off backwards: one that is turned round sets off, and the
    // same wheel bends its way to the other side.
    let turned = |state: &AgentState| AgentState {
        pose: Pose {
            heading: wrap_angle(state.pose.heading + PI),
            ..state.pose
        },
        ..*state
    };
    let bend = -curvature(speed, input);
    turned(&dynamics::drive(&turned(now), acceleration, bend, dt))
}

/// Curvature of the path at a speed, radians per metre, positive to the left.
fn curvature(speed: f64, input: Input) -> f64 {
    let sharpest = (MAX_LATERAL / (speed * speed).max(1e-6)).min(MAX_CURVATURE);
    f64::from(input.wheel) / 100.0 * sharpest
}

fn check(scenario: &Scenario, settings: Settings) -> Result<(), GameError> {
    if !(0.0..=1.0).contains(&settings.density) {
        return Err(GameError::Setting {
            name: "density",
            from: 0.0,
            to: 1.0,
            found: settings.density,
        });
    }
    if (scenario.dt - DT).abs() > 1e-6 {
        return Err(GameError::Clock(scenario.dt));
    }
    let present = scenario.log[scenario.now].agent(scenario.ego);
    if present.is_none_or(|ego| ego.kind != gump_scene::AgentKind::Vehicle) {
        return Err(GameError::NoEgo(scenario.id.clone()));
    }
    if scenario.map.lanes().is_empty() {
        return Err(GameError::NoLanes(scenario.id.clone()));
    }
    let lines = scenario.map.road_lines().iter().map(|line| &line.line);
    let edges = scenario.map.road_edges().iter().map(|edge| &edge.line);
    let lanes = scenario.map.lanes().iter().map(|lane| &lane.centerline);
    let points = lines
        .chain(edges)
        .chain(lanes)
        .map(|line| line.points().len());
    let found = points.sum();
    if found > MAX_POINTS {
        return Err(GameError::TooLargeMap {
            found,
            limit: MAX_POINTS,
        });
    }
    Ok(())
}

/// The scene with a share of the other agents, the same ones for the same share.
fn thinned(mut scenario: Scenario, density: f64) -> Scenario {
    if density >= 1.0 {
        return scenario;
    }
    let ego = scenario.ego;
    let stays = |id: AgentId| {
        // A number between 0 and 1 that belongs to the agent, whatever the density.
        let own = Seed(0).fork(id.0 as u64).0 >> 11;
        id == ego || (own as f64) < density * (1_u64 << 53) as f64
    };
    for frame in &mut scenario.log {
        let kept = frame.agents().iter().filter(|agent| stays(agent.id));
        *frame = Frame::new(kept.copied().collect(), frame.lights().to_vec());
    }
    scenario.targets.retain(|&id| stays(id));
    scenario.objects_of_interest.retain(|&id| stays(id));
    scenario
}
