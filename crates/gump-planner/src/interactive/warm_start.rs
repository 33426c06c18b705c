//! Warm starts: what the last decision spares this one.
//!
//! Decisions are half a second apart, so a candidate that was far behind is rarely ahead now.
//! [`Imagination::resting`] says who need not be simulated, [`Imagination::woken`] who has to be after
//! all. Nobody rests for long, and nobody rests who might win by what is known of the present.

use std::fmt;
use std::str::FromStr;

use gump_scene::{EgoState, Frame, SceneState};
use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

use super::choice::{Judged, Tally, half};
use super::imagine::{CandidateFuture, DECISION, DECISION_S, Imagination};
use crate::ProposalKind;

/// What a decision takes over from the one before it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum WarmStart {
    /// Nothing: every decision simulates every candidate.
    #[default]
    Off,
    /// Policies that dropped out after their first future with a value at least 0.1 (of 1) below
    /// that of the choice are not simulated in the world for up to three decisions in a row, as long
    /// as they remain that much worse: than the best of the others, and by the score among agents
    /// that keep their velocity, which costs no pass of the network. Others are simulated after all,
    /// with the random numbers that they would have had.
    Rest,
}

impl WarmStart {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 2] = [Self::Off, Self::Rest];
}

impl fmt::Display for WarmStart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for WarmStart {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// Difference of values, of 1, from which a candidate is clearly worse. Chosen by hand: it is the
/// worth of a third of the progress, and several times what a value changes by from one future to
/// another on a quiet road.
const CLEARLY: f64 = 0.1;
/// Decisions in a row for which a candidate may rest, 1.5 s at the usual rate: a fraction of the 4 s
/// that are imagined, chosen by hand.
const MOST_RESTS: usize = 3;

/// A candidate that rests.
pub(super) struct Rest {
    pub(super) candidate: usize,
    /// Number of decisions in a row, with this one.
    rests: usize,
    /// Its value when it was simulated last.
    value: f64,
}

impl Imagination<'_> {
    /// The candidates that need not be simulated, in their order; less than half of them. Turns are
    /// taken: of four that could rest, one does not.
    pub(super) fn resting(&self, kinds: &[ProposalKind]) -> Vec<Rest> {
        // After a brake or in a change of lane the last values say little of the present.
        let Some(last) = self.last.filter(|last| !last.brakes) else {
            return Vec::new();
        };
        let chosen = &last.candidates[last.chosen];
        let changes = matches!(chosen.kind, ProposalKind::LaneChange { .. });
        if self.config.warm_start == WarmStart::Off || changes {
            return Vec::new();
        }
        let rest = |(candidate, kind): (usize, &ProposalKind)| {
            // Modes and imitation are drawn anew, and gaps beside the ego open and close.
            let stays = matches!(
                kind,
                ProposalKind::Idm { .. }
                    | ProposalKind::Brisk { .. }
                    | ProposalKind::Yielding { .. }
            );
            let before = last.candidates.iter().find(|before| before.kind == *kind)?;
            let dropped = !before.finalist && before.futures.len() == 1;
            let worse = before.value < chosen.value - CLEARLY;
            let may = before.rests < MOST_RESTS;
            let turn = (candidate + self.n_decisions).is_multiple_of(MOST_RESTS + 1);
            (stays && dropped && worse && may && !turn).then_some(Rest {
                candidate,
                rests: before.rests + 1,
                value: before.value,
            })
        };
        let mut resting: Vec<Rest> = kinds.iter().enumerate().filter_map(rest).collect();
        // As many have to be left as the first cut leaves.
        resting.truncate(kinds.len().saturating_sub(half(kinds.len())));
        resting
    }

    /// Those of the resting ones that are not clearly worse than the best that was simulated: by
    /// their last value, or by the score among agents that keep their velocity now. `scores` are of
    /// those simulated, `hedged` of all candidates.
    pub(super) fn woken(
        &self,
        resting: &[Rest],
        simulated: &[usize],
        scores: &[Judged],
        hedged: &[(CandidateFuture, Judged)],
        cost: impl Fn(usize) -> f64,
    ) -> Vec<usize> {
        let hedge = |candidate: usize| hedged[candidate].1.total();
        let value = |(&candidate, score): (&usize, &Judged)| {
            let own = score.total();
            own + self.config.hedge * (hedge(candidate) - own) - cost(candidate)
        };
        let values = simulated.iter().zip(scores).map(value);
        let best = values.fold(f64::NEG_INFINITY, f64::max);
        let could_win = |rest: &&Rest| rest.value.max(hedge(rest.candidate)) >= best - CLEARLY;
        let woken = resting.iter().filter(could_win);
        woken.map(|rest| rest.candidate).collect()
    }

    /// Hands the scores among agents that keep their velocity to the candidates; to those that rest
    /// with the future itself.
    pub(super) fn settle(
        &self,
        hedged: Vec<(CandidateFuture, Judged)>,
        resting: &[Rest],
        scene: SceneState<'_>,
        tallies: &mut [Tally],
    ) {
        for (i, (mut future, score)) in hedged.into_iter().enumerate() {
            if let Some(rest) = resting.iter().find(|rest| rest.candidate == i) {
                future.frames = self.coasting(scene, &future.drive);
                tallies[i].rest(future, score.clone(), rest.rests, rest.value);
            }
            if self.config.hedge > 0.0 {
                tallies[i].hedge(score);
            }
        }
    }

    /// Frames every half second in which the others keep their velocity.
    fn coasting(&self, scene: SceneState<'_>, drive: &[EgoState]) -> Vec<Frame> {
        let frame = |(i, ego): (usize, &EgoState)| {
            let agents = scene.now().agents().iter().map(|agent| {
                if agent.id == scene.ego {
                    return agent.with_state(ego.agent_state(&self.state.vehicle));
                }
                let mut state = agent.state;
                state.pose.position += state.velocity * (i as f64 * DECISION_S);
                agent.with_state(state)
            });
            Frame::new(agents.collect(), scene.now().lights().to_vec())
        };
        let moments = drive.iter().step_by(DECISION).enumerate();
        moments.skip(1).map(frame).collect()
    }
}
