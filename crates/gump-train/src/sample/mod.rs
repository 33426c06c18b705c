//! One training sample: a random centre, a random run of frames, and their targets.
//!
//! Augmentation moves and turns the *pose* that everything is expressed in, before anything is
//! drawn or tokenized, so that map and agents stay aligned. `window` selects the frames, `targets`
//! computes the targets.

#[cfg(test)]
mod driving_tests;
mod hidden;
mod targets;
#[cfg(test)]
mod tests;
mod window;

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_model::Network;
use gump_model::exact::ExactFrames;
use gump_model::local_context::LaneMap;
use gump_model::placed_slot::{PlacedSlot, place_exactly};
use gump_raster::{Raster, RasterSpec, rasterize};
use gump_scene::{Agent, AgentId, Frame, MapGraph, Rng, Scenario, ScenarioTag, SceneState, Seed};
use gump_tokenizer::{
    Field, Identities, MAX_PROMPTS, QuantizedState, Slot, TokenFrame, TokenSequence, Tokenizer,
    TokenizerConfig,
};
use rand::Rng as _;
use serde::{Deserialize, Serialize};

use self::hidden::Hidden;
pub(crate) use self::targets::{ControlTarget, StateTarget, TrajectoryTarget};
use self::targets::{class_targets, control_targets, light_targets, targets};
pub(crate) use self::window::Driven;
use self::window::{Window, choose_window};
use crate::{TrainError, perturbation};

/// Separates the random stream of hiding from those of other choices.
const HIDDEN: u64 = 1 << 32;

/// Settings of training samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SampleConfig {
    /// Number of consecutive frames at 2 Hz in a sample.
    pub frames: usize,
    /// Maximum number of agents, those nearest to the centre; fewer where the frames would not fit
    /// the network's block.
    pub max_agents: usize,
    /// Whether any frame of the log may be the present, not only the scenario's own.
    pub any_present: bool,
    /// Probability that a vehicle other than the ego is the centre (the paper re-centres too).
    pub other_centre: f64,
    /// Probability of moving and turning the frame of reference.
    pub augment: f64,
    /// Maximum turn, radians (paper: π/2).
    pub rotation: f64,
    /// Maximum move along each axis, metres (paper: 5).
    pub translation_m: f64,
    /// Probability of removing a track for a part of the window (paper: 0.1).
    pub agent_dropout: f64,
    /// Probability of blanking a frame (paper: 0.1).
    pub frame_dropout: f64,
    /// Probability that moving objects are displaced from their path, with the return to it as
    /// target.
    #[serde(alias = "sway")]
    pub lateral_perturbation: f64,
    /// Maximum sideways displacement per push, metres.
    #[serde(alias = "sway_m")]
    pub lateral_perturbation_m: f64,
    /// Probability that the last frame's values are perturbed, like surrogates in partial-AR
    /// decoding; the targets are not changed.
    pub surrogate_noise: f64,
    /// Whether the ids of each sample are drawn at random, so that every id is trained; otherwise
    /// they are ranked as in inference.
    pub shuffle_ids: bool,
    /// Probability of leaving out the prompts.
    pub prompt_dropout: f64,
    /// Probability of hiding the speed limits of the map, as for a source that states none.
    pub hide_limits: f64,
    /// Likewise of stop signs.
    pub hide_stop_signs: f64,
    /// Likewise of lights.
    pub hide_lights: f64,
    /// Likewise of sizes: all objects have the usual size of their kind.
    pub hide_sizes: f64,
    /// Probability that the window begins with the frame of reference, as in scene generation.
    pub from_reference: f64,
}

impl Default for SampleConfig {
    /// The paper's values where the fields name them; the shares of hidden inputs are from
    /// docs/decisions/0014-unknown-inputs.md, the others chosen by hand.
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
            lateral_perturbation: 0.0,
            lateral_perturbation_m: 0.8,
            surrogate_noise: 0.5,
            shuffle_ids: true,
            prompt_dropout: 0.5,
            hide_limits: 0.3,
            hide_stop_signs: 0.1,
            hide_lights: 0.1,
            hide_sizes: 0.1,
            from_reference: 0.25,
        }
    }
}

impl SampleConfig {
    /// No augmentation, no dropout, the ego as centre: for overfitting or validation.
    pub fn plain(frames: usize) -> Self {
        Self {
            frames,
            max_agents: 320,
            any_present: false,
            other_centre: 0.0,
            augment: 0.0,
            agent_dropout: 0.0,
            frame_dropout: 0.0,
            lateral_perturbation: 0.0,
            surrogate_noise: 0.0,
            shuffle_ids: false,
            prompt_dropout: 1.0,
            hide_limits: 0.0,
            hide_stop_signs: 0.0,
            hide_lights: 0.0,
            hide_sizes: 0.0,
            from_reference: 0.0,
            ..Self::default()
        }
    }

    /// Error: [`TrainError::Config`] naming the first number out of its range.
    pub(crate) fn validate(&self) -> Result<(), TrainError> {
        // A target is the frame after one that is seen.
        if self.frames < 2 || self.max_agents == 0 {
            let (key, least, found) = match self.frames < 2 {
                true => ("sample.frames", 2, self.frames),
                false => ("sample.max_agents", 1, self.max_agents),
            };
            let reason = format!("{key} must be at least {least}, found {found}");
            return Err(TrainError::Config { key, reason });
        }
        for (key, share) in [
            ("sample.other_centre", self.other_centre),
            ("sample.augment", self.augment),
            ("sample.agent_dropout", self.agent_dropout),
            ("sample.frame_dropout", self.frame_dropout),
            ("sample.lateral_perturbation", self.lateral_perturbation),
            ("sample.surrogate_noise", self.surrogate_noise),
            ("sample.prompt_dropout", self.prompt_dropout),
            ("sample.hide_limits", self.hide_limits),
            ("sample.hide_stop_signs", self.hide_stop_signs),
            ("sample.hide_lights", self.hide_lights),
            ("sample.hide_sizes", self.hide_sizes),
            ("sample.from_reference", self.from_reference),
        ] {
            if !(0.0..=1.0).contains(&share) {
                let reason = format!("{key} must be between 0 and 1, found {share}");
                return Err(TrainError::Config { key, reason });
            }
        }
        for (key, value) in [
            ("sample.rotation", self.rotation),
            ("sample.translation_m", self.translation_m),
            ("sample.lateral_perturbation_m", self.lateral_perturbation_m),
        ] {
            if !value.is_finite() || value < 0.0 {
                let reason = format!("{key} must be 0 or more, found {value}");
                return Err(TrainError::Config { key, reason });
            }
        }
        Ok(())
    }
}

/// Tokens, raster and targets of one sample.
#[derive(Debug)]
pub(crate) struct Sample {
    pub(crate) slots: Vec<PlacedSlot>,
    pub(crate) raster: Raster,
    pub(crate) lane_map: Arc<LaneMap>,
    pub(crate) states: Vec<StateTarget>,
    pub(crate) control: Vec<ControlTarget>,
    pub(crate) lights: Vec<ControlTarget>,
    pub(crate) classes: Vec<ControlTarget>,
    pub(crate) trajectories: Vec<TrajectoryTarget>,
}

/// The shapes that samples are made for.
pub(crate) struct Reader {
    pub(crate) spec: RasterSpec,
    pub(crate) tokenizer: Tokenizer,
    /// Whether chunks are expressed in the local frames of objects.
    pub(crate) local_frame: bool,
    /// Maximum number of tokens.
    pub(crate) block_size: usize,
}

impl Reader {
    /// Samples for this network.
    pub(crate) fn of(network: &Network) -> Self {
        Self {
            spec: network.raster_spec().clone(),
            tokenizer: Tokenizer::new(TokenizerConfig::default()),
            local_frame: network.config().local_frame,
            block_size: network.config().block_size,
        }
    }

    /// Agents of a frame that fit the block beside as many other frames: two tokens each, after
    /// prompts, lights and the three marks of a frame.
    fn room(&self, frame: &Frame, n_frames: usize) -> usize {
        let tokens = self.block_size.saturating_sub(MAX_PROMPTS) / n_frames.max(1);
        tokens.saturating_sub(3 + frame.lights().len()) / 2
    }
}

/// Draws a sample, from a drive of the scenario if there is one; `None` if the scenario is too
/// short.
pub(crate) fn draw(
    scenario: &Scenario,
    driven: Option<Driven<'_>>,
    reader: &Reader,
    config: &SampleConfig,
    seed: Seed,
) -> Option<Sample> {
    let mut rng = seed.rng();
    let mut window = choose_window(scenario, driven, config, &mut rng)?;
    let perturbed = if driven.is_none() && rng.random_bool(config.lateral_perturbation) {
        let (start, stride) = (window.start, window.stride);
        let drive = perturbation::lateral_perturbation(
            scenario,
            start,
            stride,
            config.frames,
            config.lateral_perturbation_m,
            &mut rng,
        );
        Some(drive)
    } else {
        None
    };
    if let Some(drive) = &perturbed {
        let slack = perturbation::SLACK;
        window.driven = Some(Driven { drive, slack });
    }
    let frames: Vec<Frame> = (0..config.frames)
        .filter_map(|i| {
            let frame = window.seen(i, 0)?;
            let most = config.max_agents.min(reader.room(frame, config.frames));
            Some(thin(frame, &window, most))
        })
        .collect();
    // A separate stream, so that hiding inputs changes nothing else of the sample.
    let hidden = Hidden::draw(config, &mut seed.fork(HIDDEN).rng());
    let frames: Vec<Frame> = frames.iter().map(|frame| hidden.frame(frame)).collect();
    let map = hidden.map(&scenario.map);
    let frames = drop_agents(&frames, window.centre, config.agent_dropout, &mut rng);
    let views: Vec<&Frame> = frames.iter().collect();
    let (centre, pose) = (window.centre, window.world_from_scene);
    let identities = if config.shuffle_ids {
        Identities::shuffled(&views, centre, pose, &mut rng)
    } else {
        Identities::ranked(&views, centre, pose)
    };
    let encoded = reader.tokenizer.encode(
        &map,
        &views,
        window.centre,
        window.world_from_scene,
        &identities,
    );
    let prompts = prompts(&window, config, &mut rng);
    let sequence = TokenSequence::new(prompts, encoded.sequence.frames().to_vec()).ok()?;
    let n = sequence.frames().len();
    let exact = ExactFrames::last(n, &frames, &identities, pose);
    let mut slots = place_exactly(&sequence, |frame, id| exact.of(frame, id));
    let (mut states, trajectories) = targets(&slots, &window, &identities, reader.local_frame);
    if hidden.sizes {
        // The network must not learn these sizes.
        states.iter_mut().for_each(StateTarget::forget_size);
    }
    let mut sample = Sample {
        raster: draw_raster(&window, &map, hidden, &reader.spec),
        lane_map: Arc::new(LaneMap::new(&map, window.world_from_scene)),
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

/// The frame with only its nearest `most` agents.
fn thin(frame: &Frame, window: &Window<'_>, most: usize) -> Frame {
    let mut agents = frame.agents().to_vec();
    if agents.len() > most {
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
        agents.truncate(most);
    }
    Frame::new(agents, frame.lights().to_vec())
}

/// Removes whole tracks for a random part of the window, which creates arrivals and departures.
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

/// Some of the tags that apply to the centre in the first presented frame, as prompts do in scene
/// generation.
fn prompts(window: &Window<'_>, config: &SampleConfig, rng: &mut Rng) -> Vec<Option<ScenarioTag>> {
    if rng.random_bool(config.prompt_dropout) {
        return Vec::new();
    }
    let scenario = window.scenario;
    let is_own = window.centre == scenario.ego && window.start == scenario.now;
    let mut tags = if is_own && !scenario.tags.is_empty() {
        scenario.tags.clone()
    } else {
        gump_metrics::tags::around(scenario, window.centre, window.start)
    };
    for i in (1..tags.len()).rev() {
        tags.swap(i, rng.random_range(0..=i));
    }
    tags.into_iter().take(MAX_PROMPTS).map(Some).collect()
}

fn draw_raster(
    window: &Window<'_>,
    map: &Arc<MapGraph>,
    hidden: Hidden,
    spec: &RasterSpec,
) -> Raster {
    let scenario = window.scenario;
    let log = &scenario.log[..=window.reference];
    let shown: Vec<Frame> = match hidden.shows_frames() {
        true => Vec::new(),
        false => log.iter().map(|frame| hidden.frame(frame)).collect(),
    };
    let scene = SceneState {
        map,
        // The route is the ego's; another centre has none.
        route: scenario
            .route
            .as_ref()
            .filter(|_| window.centre == scenario.ego),
        history: if hidden.shows_frames() { log } else { &shown },
        ego: window.centre,
        dt: scenario.dt,
    };
    rasterize(spec, &scene, window.world_from_scene)
}

/// Perturbs the last frame's values like surrogates: by a few bins.
fn perturb_last_frame(slots: &mut [PlacedSlot], frames: &[TokenFrame], rng: &mut Rng) {
    let last = frames.len() - 1;
    let scale = rng.random_range(0.0..1.0);
    for placed in slots.iter_mut().filter(|placed| placed.frame == last) {
        if let Slot::Value(state) = &mut placed.slot {
            *state = perturb(*state, scale, rng);
        }
    }
}

/// A pose off by up to a metre along and 0.4 m across the motion, growing with speed up
/// to 10 m/s. Chosen by hand.
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

/// Blanks whole frames (never the first, which all others depend on) and drops their targets.
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
