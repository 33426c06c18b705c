//! The frames of a sample: their range, their centre, and drives in place of the log.

use gump_geometry::{Pose, angle_difference, wrap_angle};
use gump_model::steps::{HISTORY, LONGEST_ROLLOUT, stride_of};
use gump_scene::{Agent, AgentId, AgentKind, AgentState, Frame, Rng, Scenario};
use rand::Rng as _;

use super::SampleConfig;
use crate::closed_loop_samples::DrivenScenario;

/// Maximum distance of the centre from its reference pose, metres: with the 5 m of augmentation it
/// stays within the grid of 100 m. A rollout re-centres before.
const CENTRE_REACH_M: f64 = 85.0;

/// A drive to present in place of the log, and the rate of the return to the log.
#[derive(Clone, Copy)]
pub(crate) struct Driven<'a> {
    pub(crate) drive: &'a DrivenScenario,
    /// Share of the distance from the log that may be left after a frame.
    pub(crate) slack: f64,
}

/// The frames a sample is drawn from.
pub(super) struct Window<'a> {
    pub(super) scenario: &'a Scenario,
    /// The drive to present in place of the log.
    pub(super) driven: Option<Driven<'a>>,
    pub(super) centre: AgentId,
    /// Log index of the frame of reference, which the raster shows.
    pub(super) reference: usize,
    /// Log index of the first presented frame.
    pub(super) start: usize,
    /// Log frames per token frame.
    pub(super) stride: usize,
    pub(super) world_from_scene: Pose,
}

impl Window<'_> {
    /// Log index `offset` token frames after presented frame `frame`.
    fn index(&self, frame: usize, offset: isize) -> Option<usize> {
        let index = self.start as isize + (frame as isize + offset) * self.stride as isize;
        usize::try_from(index).ok()
    }

    /// The presented frame, `offset` token frames after presented frame `frame`.
    pub(super) fn seen(&self, frame: usize, offset: isize) -> Option<&Frame> {
        let index = self.index(frame, offset)?;
        let driven = self.driven.and_then(|driven| driven.drive.frame(index));
        driven.or_else(|| self.scenario.log.get(index))
    }

    /// The target pose of `id`, `ahead` frames after presented frame `frame` plus `offset`, in
    /// scene coordinates: the log, plus the part of the agent's distance from it that is left by
    /// then.
    pub(super) fn expected(
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

    /// An agent in scene coordinates.
    pub(super) fn state(&self, agent: &Agent) -> AgentState {
        let scene_from_world = self.world_from_scene.inverse();
        AgentState {
            pose: scene_from_world * agent.state.pose,
            velocity: scene_from_world.rotate(agent.state.velocity),
        }
    }
}

/// A frame of reference and a run of frames expressed in it.
///
/// The run starts up to [`LONGEST_ROLLOUT`] frames after the reference, because a rollout keeps the
/// frame of reference (and the raster) of its start while its window advances.
pub(super) fn choose_window<'a>(
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
