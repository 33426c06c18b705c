//! One episode in progress.

use gump_scene::{Frame, Seed};

use super::sampler::Sampler;
use crate::observation::{ObservedRow, View};
use crate::{Course, End, EpisodeState, Failure, ObservationSpec, Rules, Totals, observe};

/// The start of an episode, which together with its actions determines it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EpisodeStart {
    /// Index of the scenario.
    pub scenario: usize,
    /// The world's randomness.
    pub seed: Seed,
}

/// The outcome of an episode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// Repeats it with [`super::DrivingEnv::reset_to`].
    pub start: EpisodeStart,
    /// Steps made.
    pub steps: usize,
    /// Their totals.
    pub totals: Totals,
    /// How it ended.
    pub end: End,
}

/// A row of the batch.
#[derive(Clone, Debug)]
pub(super) struct Row {
    /// Source of the seeds of its episodes.
    seed: Seed,
    /// How many it has started.
    pub(super) n_episodes: u64,
    pub(super) start: EpisodeStart,
    pub(super) state: EpisodeState,
    /// The last two frames of the world; `None` where the log is used.
    pub(super) imagined: [Option<Frame>; 2],
    /// True if the other agents replay the log.
    pub(super) in_log: bool,
}

impl Row {
    /// A row without an episode; its state is not meaningful yet.
    pub(super) fn new(seed: Seed, blank: &EpisodeState) -> Self {
        Self {
            seed,
            n_episodes: 0,
            start: EpisodeStart { scenario: 0, seed },
            state: blank.clone(),
            imagined: [None, None],
            in_log: true,
        }
    }

    /// Chooses the next episode of row number `i`.
    pub(super) fn draw(&mut self, i: usize, sampler: &Sampler) {
        let seed = self.seed.fork(self.n_episodes);
        self.start = EpisodeStart {
            scenario: sampler.draw(i, self.n_episodes, seed.fork(0)),
            seed: seed.fork(1),
        };
        self.n_episodes += 1;
    }

    /// Moves the episode to the result of an action and the world.
    pub(super) fn arrive(&mut self, course: &Course, rules: &Rules, action: &[f32]) {
        self.state = match &self.imagined[0] {
            Some(frame) if !self.in_log => {
                let dt = course.dt();
                let ego = rules
                    .dynamics
                    .advance(&self.state.ego.state, action, dt, dt);
                rules.advance(course, &self.state, ego, frame)
            }
            _ => rules.step_in_log(course, &self.state, action),
        };
    }

    pub(super) fn observe(
        &self,
        course: &Course,
        spec: &ObservationSpec,
        out: &mut ObservedRow<'_>,
    ) {
        let steps = self.state.steps;
        let (now, before) = match &self.imagined {
            [Some(now), before] => (now, before.as_ref()),
            [None, _] => (course.logged(steps), None),
        };
        let view = View {
            course,
            state: &self.state,
            now,
            before: before.or_else(|| course.logged_before(steps)),
        };
        observe(spec, &view, out.numbers, out.packed);
    }

    pub(super) fn outcome(&self, end: End) -> Outcome {
        Outcome {
            start: self.start,
            steps: self.state.steps,
            totals: self.state.totals,
            end,
        }
    }
}

impl Outcome {
    /// True if the ego neither collided nor left the road.
    pub fn is_safe(&self) -> bool {
        !matches!(
            self.end,
            End::Terminated(Failure::Collision | Failure::OffRoad)
        )
    }
}
