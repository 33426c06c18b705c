//! One training sample: a random centre, a random run of frames, and what should be said of it.
//!
//! Augmentation moves and turns the *pose* everything is expressed in, before anything is drawn or
//! tokenized, so that map and agents cannot fall out of register.

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_geometry::{Pose, angle_difference, wrap_angle};
use gump_raster::{Raster, RasterSpec, rasterize};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Frame, Rng, Scenario, ScenarioTag, SceneState, Seed,
};
use gump_tokenizer::{
    FIRST_LIGHT, Field, Identities, Key, MAX_PROMPTS, PAD, QuantizedState, Slot, TokenFrame,
    TokenSequence, Tokenizer, TokenizerConfig, class_index, light_token,
};
use rand::Rng as _;
use serde::{Deserialize, Serialize};

use crate::anchor::Anchor;
use crate::batch::{PlacedSlot, place};
use crate::closed_loop::Drive;
use crate::decoder::{CONTROL_KEYS, STEPS};
use crate::drift;
use crate::network::Network;
use crate::surroundings::Survey;
use crate::trajectory::{FUTURE, PAST, POSE};

/// Seconds between token frames.
pub(crate) const TOKEN_DT: f64 = 0.5;
/// Frames of history a rollout starts from (paper: 3).
pub(crate) const HISTORY: usize = 3;
/// Frames a rollout may be away from its frame of reference: 8 s.
pub(crate) const LONGEST_ROLLOUT: usize = 16;
/// How far the centre may be from its own reference pose, metres; a rollout re-centres before.
const CENTRE_REACH_M: f64 = 85.0;

/// How samples are drawn from scenarios.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SampleConfig {
    /// Consecutive frames at 2 Hz a sample presents.
    pub frames: usize,
    /// Samples keep at most this many agents, those nearest to the centre.
    pub max_agents: usize,
    /// True takes any frame of the log as the present, not only the scenario's own.
    pub any_present: bool,
    /// Probability that another vehicle than the ego is the centre (the paper re-centres too).
    pub other_centre: f64,
    /// Probability of moving and turning the frame of reference.
    pub augment: f64,
    /// Largest turn, radians (paper: π/2).
    pub rotation: f64,
    /// Largest move along each axis, metres (paper: 5).
    pub translation_m: f64,
    /// Probability of removing a track for a part of the window (paper: 0.1).
    pub agent_dropout: f64,
    /// Probability of blanking a frame (paper: 0.1).
    pub frame_dropout: f64,
    /// Probability that what drives is shown a little off its way, with the way back asked for.
    pub sway: f64,
    /// The farthest that it is pushed to a side at once, metres.
    pub sway_m: f64,
    /// Probability that the last frame's values are seen perturbed, as partial-AR decoding sees
    /// surrogates; the targets stay true.
    pub surrogate_noise: f64,
    /// True draws the ids of each sample at random, so that every id is learned; false ranks them as
    /// inference does.
    pub shuffle_ids: bool,
    /// Probability of leaving out the prompts.
    pub prompt_dropout: f64,
    /// Probability that the window begins with the frame of reference, as a scene to generate does.
    pub from_reference: f64,
}

impl Default for SampleConfig {
    fn default() -> Self {
        Self {
            frames: 5,
            max_agents: 48,
            any_present: true,
            other_centre: 0.5,
            augment: 0.5,
            rotation: std::f64::consts::FRAC_PI_2,
            translation_m: 5.0,
            agent_dropout: 0.1,
            frame_dropout: 0.1,
            sway: 0.0,
            sway_m: 0.8,
            surrogate_noise: 0.5,
            shuffle_ids: true,
            prompt_dropout: 0.5,
            from_reference: 0.25,
        }
    }
}

impl SampleConfig {
    /// No augmentation, no dropout, the ego as centre: to overfit or to validate.
    pub fn plain(frames: usize) -> Self {
        Self {
            frames,
            max_agents: 320,
            any_present: false,
            other_centre: 0.0,
            augment: 0.0,
            agent_dropout: 0.0,
            frame_dropout: 0.0,
            sway: 0.0,
            surrogate_noise: 0.0,
            shuffle_ids: false,
            prompt_dropout: 1.0,
            from_reference: 0.0,
            ..Self::default()
        }
    }
}

/// Tokens, raster and targets of one sample.
#[derive(Debug)]
pub(crate) struct Sample {
    pub(crate) slots: Vec<PlacedSlot>,
    pub(crate) raster: Raster,
    pub(crate) survey: Arc<Survey>,
    pub(crate) states: Vec<StateTarget>,
    pub(crate) control: Vec<ControlTarget>,
    pub(crate) lights: Vec<ControlTarget>,
    pub(crate) classes: Vec<ControlTarget>,
    pub(crate) trajectories: Vec<TrajectoryTarget>,
}

/// What the decoder should say at a key.
#[derive(Clone, Debug)]
pub(crate) struct StateTarget {
    /// Index of the key in the slots.
    pub(crate) key: usize,
    /// Bin per step, in the object's anchor; `None` where the log has nothing.
    pub(crate) bins: [Option<u16>; STEPS.len()],
    /// False if the window has not shown the object before, so that it could be anywhere.
    pub(crate) is_known: bool,
}

impl StateTarget {
    /// The token of a step, PAD where the log has nothing.
    pub(crate) fn token(&self, step: usize) -> u32 {
        self.bins[step].map_or(PAD, |bin| STEPS[step].token(bin))
    }
}

/// What should be said of the successor at a slot: an index into the control alphabet, a light's
/// state or a class.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ControlTarget {
    pub(crate) slot: usize,
    pub(crate) successor: u32,
}

/// What a trajectory head should say of an agent.
#[derive(Clone, Debug)]
pub(crate) struct TrajectoryTarget {
    /// Index of the key in the slots; the value follows it.
    pub(crate) key: usize,
    pub(crate) past: [Option<[f32; POSE]>; PAST],
    pub(crate) future: [Option<[f32; POSE]>; FUTURE],
}

/// Index of BEGIN in the control alphabet; NEWBORN and LIGHTS_END follow.
const CONTROL_BEGIN: u32 = CONTROL_KEYS as u32;
const CONTROL_NEWBORN: u32 = CONTROL_BEGIN + 1;
const CONTROL_LIGHTS_END: u32 = CONTROL_BEGIN + 2;

/// A drive to present in place of the log, and how fast it is to come back to it.
#[derive(Clone, Copy)]
pub(crate) struct Driven<'a> {
    pub(crate) drive: &'a Drive,
    /// Share of the distance from the log that may be left after a frame.
    pub(crate) slack: f64,
}

/// The frames a sample is drawn from.
struct Window<'a> {
    scenario: &'a Scenario,
    /// What is presented in place of the log.
    driven: Option<Driven<'a>>,
    centre: AgentId,
    /// Log index of the frame of reference, which the raster shows.
    reference: usize,
    /// Log index of the first presented frame.
    start: usize,
    /// Log frames per token frame.
    stride: usize,
    world_from_scene: Pose,
}

impl Window<'_> {
    /// Log index `offset` token frames after presented frame `frame`.
    fn index(&self, frame: usize, offset: isize) -> Option<usize> {
        let index = self.start as isize + (frame as isize + offset) * self.stride as isize;
        usize::try_from(index).ok()
    }

    /// What is presented `offset` token frames after presented frame `frame`.
    fn seen(&self, frame: usize, offset: isize) -> Option<&Frame> {
        let index = self.index(frame, offset)?;
        let driven = self.driven.and_then(|driven| driven.drive.frame(index));
        driven.or_else(|| self.scenario.log.get(index))
    }

    /// Where `id` should be `ahead` frames after presented frame `frame` plus `offset`, in scene
    /// coordinates: the log, plus what is left by then of the agent's distance from it.
    fn expected(
        &self,
        frame: usize,
        offset: isize,
        ahead: usize,
        id: AgentId,
    ) -> Option<AgentState> {
        let log = |ahead: usize| {
            let index = self.index(frame, offset + ahead as isize)?;
            self.scenario.log.get(index)?.agent(id)
        };
        let mut agent = *log(ahead)?;
        let seen = self.seen(frame, offset).and_then(|frame| frame.agent(id));
        if let (Some(driven), Some(seen), Some(logged)) = (self.driven, seen, log(0)) {
            let left = driven.slack.powi(ahead as i32);
            let (pose, logged) = (seen.state.pose, logged.state.pose);
            agent.state.pose.position += (pose.position - logged.position) * left;
            agent.state.pose.heading = wrap_angle(
                agent.state.pose.heading + angle_difference(pose.heading, logged.heading) * left,
            );
        }
        Some(self.state(&agent))
    }

    /// In whose frame the chunk of an object is asked for that was last shown as `last`: where it
    /// was a frame ago, to the millimetre, as a rollout knows it.
    fn anchor(&self, last: Option<QuantizedState>, frame: usize, id: AgentId) -> Anchor {
        last.map_or(Anchor::SCENE, |last| {
            let before = self.seen(frame, -1).and_then(|frame| frame.agent(id));
            Anchor::at(before.map_or(last.pose(), |agent| self.state(agent).pose))
        })
    }

    /// An agent in scene coordinates.
    fn state(&self, agent: &Agent) -> AgentState {
        let scene_from_world = self.world_from_scene.inverse();
        AgentState {
            pose: scene_from_world * agent.state.pose,
            velocity: scene_from_world.rotate(agent.state.velocity),
        }
    }
}

/// Log frames per token frame.
pub(crate) fn stride_of(dt: f64) -> usize {
    (TOKEN_DT / dt).round().max(1.0) as usize
}

/// What samples are made for.
pub(crate) struct Reader {
    pub(crate) spec: RasterSpec,
    pub(crate) tokenizer: Tokenizer,
    /// True asks for chunks in the frames of their objects.
    pub(crate) anchored: bool,
}

impl Reader {
    /// Samples for this network.
    pub(crate) fn of(network: &Network) -> Self {
        Self {
            spec: network.raster_spec().clone(),
            tokenizer: Tokenizer::new(TokenizerConfig::default()),
            anchored: network.config().anchored,
        }
    }
}

/// Draws a sample, from a drive of the scenario if there is one; `None` if the scenario is too
/// short for one.
pub(crate) fn draw(
    scenario: &Scenario,
    driven: Option<Driven<'_>>,
    reader: &Reader,
    config: &SampleConfig,
    seed: Seed,
) -> Option<Sample> {
    let mut rng = seed.rng();
    let mut window = choose_window(scenario, driven, config, &mut rng)?;
    let swaying = if driven.is_none() && rng.random_bool(config.sway) {
        let (start, stride) = (window.start, window.stride);
        let drive = drift::sway(
            scenario,
            start,
            stride,
            config.frames,
            config.sway_m,
            &mut rng,
        );
        Some(drive)
    } else {
        None
    };
    if let Some(drive) = &swaying {
        let slack = drift::SLACK;
        window.driven = Some(Driven { drive, slack });
    }
    let frames: Vec<Frame> = (0..config.frames)
        .filter_map(|i| Some(thin(window.seen(i, 0)?, &window, config)))
        .collect();
    let frames = drop_agents(&frames, window.centre, config.agent_dropout, &mut rng);
    let views: Vec<&Frame> = frames.iter().collect();
    let (centre, pose) = (window.centre, window.world_from_scene);
    let identities = if config.shuffle_ids {
        Identities::shuffled(&views, centre, pose, &mut rng)
    } else {
        Identities::ranked(&views, centre, pose)
    };
    let encoded = reader.tokenizer.encode(
        &scenario.map,
        &views,
        window.centre,
        window.world_from_scene,
        &identities,
    );
    let prompts = prompts(&window, config, &mut rng);
    let sequence = TokenSequence::new(prompts, encoded.sequence.frames().to_vec()).ok()?;
    let mut slots = place(&sequence);
    let (states, trajectories) = targets(&slots, &window, &identities, reader.anchored);
    let mut sample = Sample {
        raster: draw_raster(&window, &reader.spec),
        survey: Arc::new(Survey::new(&scenario.map, window.world_from_scene)),
        slots: Vec::new(),
        states,
        control: control_targets(&slots),
        lights: light_targets(&slots),
        classes: class_targets(&slots),
        trajectories,
    };
    if rng.random_bool(config.surrogate_noise) {
        perturb_last_frame(&mut slots, sequence.frames(), &mut rng);
    }
    sample.slots = slots;
    blank_frames(&mut sample, config, &mut rng);
    Some(sample)
}

/// A frame of reference and a run of frames expressed in it.
///
/// The run starts up to [`LONGEST_ROLLOUT`] frames after the reference, because a rollout keeps the
/// frame of reference (and the raster) of its start while its window slides on.
fn choose_window<'a>(
    scenario: &'a Scenario,
    driven: Option<Driven<'a>>,
    config: &SampleConfig,
    rng: &mut Rng,
) -> Option<Window<'a>> {
    let stride = stride_of(scenario.dt);
    let span = (config.frames - 1) * stride;
    let lead = (config.frames.min(HISTORY) - 1) * stride;
    let end = driven.map_or(scenario.log.len(), |Driven { drive, .. }| {
        drive.present + drive.frames.len() * stride + 1
    });
    let last_start = end.checked_sub(span + 1)?;
    let reference = if let Some(driven) = driven {
        driven.drive.present
    } else if config.any_present {
        rng.random_range(lead.min(scenario.log.len() - 1)..=last_start + lead)
    } else {
        scenario.now
    };
    let first_start = reference.checked_sub(lead)?;
    let latest = last_start.checked_sub(first_start)? / stride;
    let drawn = rng.random_range(0..=latest.min(LONGEST_ROLLOUT));
    let lead_frames = lead / stride;
    // Scene generation begins with the very frame that the raster shows.
    let frames_on = if lead_frames <= latest && rng.random_bool(config.from_reference) {
        lead_frames
    } else {
        drawn
    };
    let start = first_start + stride * frames_on;
    let seen = |index: usize| {
        let drive = driven.and_then(|driven| driven.drive.frame(index));
        drive.unwrap_or(&scenario.log[index])
    };
    let at = |index: usize, id: AgentId| Some(seen(index).agent(id)?.state.pose);
    // The centre is there all the time and never leaves the window of tokens.
    let stays = |id: AgentId| {
        at(reference, id).is_some_and(|origin| {
            (start..=start + span).step_by(stride).all(|index| {
                at(index, id)
                    .is_some_and(|pose| pose.position.distance(origin.position) < CENTRE_REACH_M)
            })
        })
    };
    let mut centre = scenario.ego;
    if rng.random_bool(config.other_centre) || !stays(centre) {
        let moves = |agent: &&Agent| agent.kind == AgentKind::Vehicle && stays(agent.id);
        let others: Vec<_> = seen(start).agents().iter().filter(moves).collect();
        if !others.is_empty() {
            centre = others[rng.random_range(0..others.len())].id;
        }
    }
    if !stays(centre) {
        return None;
    }
    let augment = rng.random_bool(config.augment);
    let mut within = |bound: f64| {
        if augment && bound > 0.0 {
            rng.random_range(-bound..bound)
        } else {
            0.0
        }
    };
    let shift = Pose::new(
        within(config.translation_m),
        within(config.translation_m),
        within(config.rotation),
    );
    Some(Window {
        scenario,
        driven,
        centre,
        reference,
        start,
        stride,
        world_from_scene: at(reference, centre)? * shift,
    })
}

/// The frame with only its nearest `max_agents` agents.
fn thin(frame: &Frame, window: &Window<'_>, config: &SampleConfig) -> Frame {
    let mut agents = frame.agents().to_vec();
    if agents.len() > config.max_agents {
        let centre = window.world_from_scene.position;
        agents.sort_by(|a, b| {
            let key = |agent: &Agent| {
                if agent.id == window.centre {
                    -1.0
                } else {
                    agent.state.pose.position.distance(centre)
                }
            };
            key(a).total_cmp(&key(b)).then(a.id.cmp(&b.id))
        });
        agents.truncate(config.max_agents);
    }
    Frame::new(agents, frame.lights().to_vec())
}

/// Removes whole tracks for a random part of the window, which makes births and disappearances.
fn drop_agents(frames: &[Frame], centre: AgentId, probability: f64, rng: &mut Rng) -> Vec<Frame> {
    let mut ids: Vec<AgentId> = frames
        .iter()
        .flat_map(|f| f.agents().iter().map(|a| a.id))
        .collect();
    ids.sort();
    ids.dedup();
    ids.retain(|&id| id != centre);
    let n = frames.len();
    let gaps: BTreeMap<AgentId, std::ops::Range<usize>> = ids
        .into_iter()
        .filter_map(|id| {
            let (dropped, a, b) = (
                rng.random_bool(probability),
                rng.random_range(0..=n),
                rng.random_range(0..=n),
            );
            dropped.then(|| (id, a.min(b)..a.max(b)))
        })
        .collect();
    let keep = |i: usize, id: AgentId| gaps.get(&id).is_none_or(|gap| !gap.contains(&i));
    let kept = frames.iter().enumerate().map(|(i, frame)| {
        let agents = frame
            .agents()
            .iter()
            .copied()
            .filter(|agent| keep(i, agent.id))
            .collect();
        Frame::new(agents, frame.lights().to_vec())
    });
    kept.collect()
}

/// Some of the tags that hold for the centre in the first presented frame, which is what prompts of
/// a scene to generate are about.
fn prompts(window: &Window<'_>, config: &SampleConfig, rng: &mut Rng) -> Vec<Option<ScenarioTag>> {
    if rng.random_bool(config.prompt_dropout) {
        return Vec::new();
    }
    let scenario = window.scenario;
    let is_own = window.centre == scenario.ego && window.start == scenario.now;
    let mut tags = if is_own && !scenario.tags.is_empty() {
        scenario.tags.clone()
    } else {
        let seen = Scenario {
            now: window.start,
            ego: window.centre,
            route: None,
            ..scenario.clone()
        };
        gump_metrics::tags::mine(&seen)
    };
    for i in (1..tags.len()).rev() {
        tags.swap(i, rng.random_range(0..=i));
    }
    tags.into_iter().take(MAX_PROMPTS).map(Some).collect()
}

fn draw_raster(window: &Window<'_>, spec: &RasterSpec) -> Raster {
    let scenario = window.scenario;
    let scene = SceneState {
        map: &scenario.map,
        // The route is the ego's; another centre has none.
        route: scenario
            .route
            .as_ref()
            .filter(|_| window.centre == scenario.ego),
        history: &scenario.log[..=window.reference],
        ego: window.centre,
        dt: scenario.dt,
    };
    rasterize(spec, &scene, window.world_from_scene)
}

/// Targets of every key, from the log and not from the presented (thinned, perturbed) tokens.
fn targets(
    slots: &[PlacedSlot],
    window: &Window<'_>,
    identities: &Identities,
    anchored: bool,
) -> (Vec<StateTarget>, Vec<TrajectoryTarget>) {
    let mut states = Vec::new();
    let mut trajectories = Vec::new();
    for (i, placed) in slots.iter().enumerate() {
        let (Slot::Key(key), Some(next)) = (placed.slot, slots.get(i + 1)) else {
            continue;
        };
        let Slot::Value(value) = next.slot else {
            continue;
        };
        let Some(id) = identities.agent(key.id) else {
            continue;
        };
        let frame = placed.frame;
        let anchor = match anchored {
            true => window.anchor(placed.last, frame, id),
            false => Anchor::SCENE,
        };
        let mut chunk = std::array::from_fn(|pose| window.expected(frame, -1, pose + 1, id));
        chunk[0] = chunk[0].or(Some(value.to_agent_state()));
        states.push(StateTarget {
            key: i,
            bins: anchor.bins(value, chunk),
            is_known: placed.last.is_some(),
        });
        let seen = |offset: isize| {
            let agent = window.seen(frame, offset)?.agent(id)?;
            Some(window.state(agent))
        };
        if let Some(present) = seen(0) {
            let relative = |state: AgentState| {
                let moved = state.pose.position - present.pose.position;
                let (sin, cos) = state.pose.heading.sin_cos();
                [moved.x as f32, moved.y as f32, sin as f32, cos as f32]
            };
            trajectories.push(TrajectoryTarget {
                key: i,
                past: std::array::from_fn(|m| seen(-(m as isize) - 1).map(relative)),
                future: std::array::from_fn(|m| window.expected(frame, 0, m + 1, id).map(relative)),
            });
        }
    }
    (states, trajectories)
}

/// At every control or value slot, what follows it (model.md 10.1).
fn control_targets(slots: &[PlacedSlot]) -> Vec<ControlTarget> {
    let mut targets = Vec::new();
    for (slot, placed) in slots.iter().enumerate() {
        if matches!(placed.slot, Slot::Key(_) | Slot::Prompt(_) | Slot::Pad) {
            continue;
        }
        let successor = match slots.get(slot + 1).map(|next| next.slot) {
            Some(Slot::Key(Key { id, .. })) => u32::from(id),
            Some(Slot::Begin) => CONTROL_BEGIN,
            Some(Slot::Newborn) => CONTROL_NEWBORN,
            Some(Slot::LightsEnd) => CONTROL_LIGHTS_END,
            _ => continue,
        };
        targets.push(ControlTarget { slot, successor });
    }
    targets
}

/// Before every light, the state it will have: of those of the same frame, the ones before it are
/// seen.
fn light_targets(slots: &[PlacedSlot]) -> Vec<ControlTarget> {
    let successor = |next: &PlacedSlot| match next.slot {
        Slot::Light(light) => Some(light_token(light.state) - FIRST_LIGHT),
        _ => None,
    };
    successors(slots, successor)
}

/// Before every agent that the window has not had yet, its class; the ego's is known.
fn class_targets(slots: &[PlacedSlot]) -> Vec<ControlTarget> {
    let successor = |next: &PlacedSlot| match next.slot {
        Slot::Key(key) if !key.is_ego() && next.last.is_none() => {
            Some(class_index(key.kind) as u32)
        }
        _ => None,
    };
    successors(slots, successor)
}

/// A target at every slot for whose successor `say` has a word.
fn successors(
    slots: &[PlacedSlot],
    say: impl Fn(&PlacedSlot) -> Option<u32>,
) -> Vec<ControlTarget> {
    let pairs = slots.windows(2).enumerate();
    let target = |(slot, pair): (usize, &[PlacedSlot])| {
        let successor = say(&pair[1])?;
        Some(ControlTarget { slot, successor })
    };
    pairs.filter_map(target).collect()
}

/// Replaces the last frame's values by what a surrogate might have said: off by a few bins.
fn perturb_last_frame(slots: &mut [PlacedSlot], frames: &[TokenFrame], rng: &mut Rng) {
    let last = frames.len() - 1;
    let scale = rng.random_range(0.0..1.0);
    for placed in slots.iter_mut().filter(|placed| placed.frame == last) {
        if let Slot::Value(state) = &mut placed.slot {
            *state = perturb(*state, scale, rng);
        }
    }
}

/// A pose off by up to a metre along and 0.4 m across the motion, growing with speed.
fn perturb(state: QuantizedState, scale: f64, rng: &mut Rng) -> QuantizedState {
    let (pose, velocity) = (state.pose(), state.velocity());
    let reach = scale * (velocity.length() * 0.1).min(1.0);
    let mut within = |bound: f64| bound * (rng.random::<f64>() + rng.random::<f64>() - 1.0);
    let offset = pose.rotate(gump_geometry::dvec2(within(reach), within(0.4 * reach)));
    let mut moved = state;
    moved.x = Field::X.quantize(pose.position.x + offset.x).bin;
    moved.y = Field::Y.quantize(pose.position.y + offset.y).bin;
    moved.heading = Field::Heading
        .quantize(pose.heading + within(0.1 * reach))
        .bin;
    moved
}

/// Blanks whole frames (never the first, which everything builds on) and forgets their targets.
fn blank_frames(sample: &mut Sample, config: &SampleConfig, rng: &mut Rng) {
    let blanked: Vec<bool> = (0..config.frames)
        .map(|frame| rng.random_bool(config.frame_dropout) && frame > 0)
        .collect();
    let is_blank = |slot: usize| blanked[sample.slots[slot].frame.min(blanked.len() - 1)];
    sample.states.retain(|target| !is_blank(target.key));
    sample.trajectories.retain(|target| !is_blank(target.key));
    for targets in [&mut sample.control, &mut sample.lights, &mut sample.classes] {
        targets.retain(|target| !is_blank(target.slot));
    }
    for placed in &mut sample.slots {
        if blanked[placed.frame.min(blanked.len() - 1)] && !matches!(placed.slot, Slot::Prompt(_)) {
            placed.slot = Slot::Pad;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::fixture;

    fn reader() -> Reader {
        Reader {
            spec: RasterSpec::full(16, 12.0),
            tokenizer: Tokenizer::new(TokenizerConfig::default()),
            anchored: false,
        }
    }

    fn scenario() -> Scenario {
        fixture::scenario(
            "lane 1: -100,0 100,0
             lane 2: 30,0 100,0
             light 2 red: 60,0
             ego vehicle 0: 0,0 velocity 8,0
             agent vehicle 1: 20,0 velocity 5,0
             agent pedestrian 7: 30,3 velocity 0,-1",
        )
        .unwrap()
    }

    fn sample(config: &SampleConfig, seed: u64) -> Sample {
        (0..64)
            .find_map(|i| draw(&scenario(), None, &reader(), config, Seed(seed).fork(i)))
            .expect("a sample can be drawn")
    }

    #[test]
    fn every_control_target_is_the_successor() {
        let sample = sample(&SampleConfig::plain(4), 1);
        let expected = |slot: Slot| match slot {
            Slot::Key(key) => u32::from(key.id),
            Slot::Begin => CONTROL_BEGIN,
            Slot::Newborn => CONTROL_NEWBORN,
            Slot::LightsEnd => CONTROL_LIGHTS_END,
            other => panic!("{other:?} is no successor"),
        };
        for target in &sample.control {
            assert_eq!(
                target.successor,
                expected(sample.slots[target.slot + 1].slot)
            );
        }
        // Every value but the very last, every mark: LIGHTS_END, NEWBORN, the light before LIGHTS_END.
        let values = sample
            .slots
            .iter()
            .filter(|p| matches!(p.slot, Slot::Value(_)))
            .count();
        assert_eq!(sample.control.len(), values + 4 * 3 - 1);
    }

    #[test]
    fn lights_and_classes_are_told_before_they_come() {
        let sample = sample(&SampleConfig::plain(4), 1);
        let successor = |target: &ControlTarget| sample.slots[target.slot + 1].slot;
        // One light per frame, seen from its BEGIN.
        assert_eq!(sample.lights.len(), 4);
        for target in &sample.lights {
            assert!(matches!(sample.slots[target.slot].slot, Slot::Begin));
            assert!(matches!(successor(target), Slot::Light(_)));
            assert_eq!(target.successor, 2, "the light is red");
        }
        let classes: Vec<u32> = sample.classes.iter().map(|t| t.successor).collect();
        // The vehicle and the pedestrian of the first frame; nobody is new after it.
        assert_eq!(classes, [0, 1]);
    }

    #[test]
    fn a_window_may_begin_with_its_reference() {
        let config = SampleConfig {
            from_reference: 1.0,
            prompt_dropout: 0.0,
            ..SampleConfig::plain(4)
        };
        let sample = sample(&config, 1);
        let value = sample.slots.iter().find_map(|placed| match placed.slot {
            Slot::Value(state) => Some(state.pose()),
            _ => None,
        });
        let ego = value.expect("the ego has a value");
        assert!(ego.position.length() < 0.2 && ego.heading.abs() < 0.02);
        // 8 m/s behind a vehicle: what the tags say of it is the prompt.
        assert!(matches!(sample.slots[0].slot, Slot::Prompt(Some(_))));
    }

    #[test]
    fn targets_are_the_log_and_missing_frames_are_ignored() {
        let sample = sample(&SampleConfig::plain(4), 1);
        for target in &sample.states {
            let (Slot::Key(_), Slot::Value(state)) = (
                sample.slots[target.key].slot,
                sample.slots[target.key + 1].slot,
            ) else {
                panic!("a target stands at a key");
            };
            for (step, field) in STEPS.iter().enumerate().take(7) {
                assert_eq!(target.bins[step], Some(state.get(*field)));
            }
        }
        assert!(sample.states.iter().any(|target| target.bins[15].is_some()));
        assert_eq!(sample.states[0].token(0), Field::Width.token(4));
    }

    #[test]
    fn one_seed_one_sample() {
        let config = SampleConfig::default();
        let (a, b) = (sample(&config, 3), sample(&config, 3));
        assert_eq!(format!("{:?}", a.slots), format!("{:?}", b.slots));
        assert_eq!(a.raster, b.raster);
        assert_ne!(
            format!("{:?}", a.slots),
            format!("{:?}", sample(&config, 4).slots)
        );
    }

    #[test]
    fn perturbed_values_keep_true_targets() {
        let config = SampleConfig {
            surrogate_noise: 1.0,
            ..SampleConfig::plain(4)
        };
        let differs = |seed| {
            let sample = sample(&config, seed);
            sample
                .states
                .iter()
                .any(|target| match sample.slots[target.key + 1].slot {
                    Slot::Value(state) => target.bins[4] != Some(state.x),
                    _ => false,
                })
        };
        assert!((0..8).any(differs));
    }

    #[test]
    fn a_drive_is_shown_and_the_way_back_is_asked_for() {
        let scenario = scenario();
        let stride = stride_of(scenario.dt);
        let present = (HISTORY - 1) * stride;
        let off = gump_geometry::dvec2(0.0, 2.0);
        let driven = |index: usize| {
            let agents = scenario.log[index].agents().iter().map(|agent| {
                let mut state = agent.state;
                state.pose.position += off;
                agent.with_state(state)
            });
            Frame::new(agents.collect(), Vec::new())
        };
        let drive = Drive {
            scenario: 0,
            present,
            stride,
            frames: (1..=4).map(|i| driven(present + i * stride)).collect(),
        };
        let way = Driven {
            drive: &drive,
            slack: 0.5,
        };
        let config = SampleConfig::plain(4);
        let sample = (0..64).find_map(|i| {
            let seed = Seed(i);
            draw(&scenario, Some(way), &reader(), &config, seed)
                // The last two of four frames are driven ones.
                .filter(|sample| sample.states.len() == 12)
        });
        let sample = sample.expect("a sample can be drawn");
        let of_last_agent = |frame: usize| {
            let states = sample.states.iter();
            states
                .filter(|target| sample.slots[target.key].frame == frame)
                .map(|target| (target, sample.slots[target.key + 1].slot))
                .next_back()
                .expect("every frame has agents")
        };
        let lateral = |bin: Option<u16>| Field::Y.dequantize(bin.expect("a bin is asked for"));
        let frames = sample.slots.last().expect("slots").frame;
        let (target, Slot::Value(seen)) = of_last_agent(frames) else {
            panic!("a target stands at a key");
        };
        // Half of the two metres are left after one frame, a quarter after two.
        let asked = [target.bins[5], target.bins[8]].map(lateral);
        let back = seen.pose().position.y - asked[0];
        assert!((back - 1.0).abs() < 0.25, "{back}");
        // The pedestrian itself walks half a metre to the right in a frame.
        let then = asked[0] - asked[1];
        assert!((then - 1.0).abs() < 0.25, "{then}");
    }

    #[test]
    fn blanked_frames_have_no_targets() {
        let config = SampleConfig {
            frame_dropout: 1.0,
            ..SampleConfig::plain(4)
        };
        let sample = sample(&config, 2);
        assert!(
            sample
                .states
                .iter()
                .all(|target| sample.slots[target.key].frame == 0)
        );
        assert!(
            sample
                .slots
                .iter()
                .all(|p| p.frame == 0 || matches!(p.slot, Slot::Pad))
        );
    }
}
