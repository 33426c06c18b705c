//! One episode in progress.

use gump_scene::{Agent, Frame, SceneState, Seed};

use super::sampler::Sampler;
use crate::observation::{ObservedRow, View};
use crate::{
    End, EpisodeState, Failure, ObservationSpec, PreparedScenario, Rules, Totals, observe,
};

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
    /// Number of steps.
    pub steps: usize,
    /// Totals of these steps.
    pub totals: Totals,
    /// The end of the episode.
    pub end: End,
}

/// A row of the batch: an environment with its episode in progress.
#[derive(Clone, Debug)]
pub(super) struct EnvRow {
    /// Source of the seeds of its episodes.
    seed: Seed,
    /// Number of episodes the row has started.
    pub(super) n_episodes: u64,
    pub(super) start: EpisodeStart,
    pub(super) state: EpisodeState,
    /// The last two frames of the world; `None` where the log is used.
    pub(super) imagined: [Option<Frame>; 2],
    /// True if the other agents replay the log.
    pub(super) in_log: bool,
    /// Past and present of the agents that the world simulates; empty if it simulates all.
    pub(super) history: Vec<Frame>,
}

impl EnvRow {
    /// A row without an episode; its state is not meaningful yet.
    pub(super) fn new(seed: Seed, blank: &EpisodeState) -> Self {
        Self {
            seed,
            n_episodes: 0,
            start: EpisodeStart { scenario: 0, seed },
            state: blank.clone(),
            imagined: [None, None],
            in_log: true,
            history: Vec::new(),
        }
    }

    /// Limits the world to the `n` agents that come nearest to the ego in the log.
    pub(super) fn limit(&mut self, prepared: &PreparedScenario, n: Option<usize>) {
        self.history.clear();
        let Some(nearest) = n.and_then(|n| prepared.by_distance().get(..n)) else {
            return;
        };
        let ego = prepared.scenario().ego;
        let kept = |agent: &&Agent| agent.id == ego || nearest.contains(&agent.id);
        let past = prepared.scenario().present().history.iter();
        self.history.extend(past.map(|frame| {
            let agents = frame.agents().iter().filter(kept).copied().collect();
            Frame::new(agents, frame.lights().to_vec())
        }));
    }

    /// The scene as the world is to see it.
    pub(super) fn scene<'a>(&'a self, prepared: &'a PreparedScenario) -> SceneState<'a> {
        let scene = prepared.scenario().present();
        match self.history.is_empty() {
            true => scene,
            false => SceneState {
                history: &self.history,
                ..scene
            },
        }
    }

    /// The world's frame together with the agents that follow the log.
    pub(super) fn complete(&self, prepared: &PreparedScenario, frame: Frame) -> Frame {
        let Some(present) = self.history.last() else {
            return frame;
        };
        let logged = prepared.logged(self.state.steps + 1).agents().iter();
        let follows_log = |agent: &&Agent| {
            let id = agent.id;
            present.agent(id).is_none() && prepared.logged(0).agent(id).is_some()
        };
        let agents = logged.filter(follows_log).chain(frame.agents()).copied();
        Frame::new(agents.collect(), frame.lights().to_vec())
    }

    /// All agents now, the ego where its episode has it.
    pub(super) fn frame(&self, prepared: &PreparedScenario) -> Frame {
        let logged = || prepared.logged(self.state.steps);
        let now = self.imagined[0].as_ref().unwrap_or_else(logged);
        let ego = self.state.ego;
        let others = now.agents().iter().filter(|agent| agent.id != ego.id);
        let agents = others.copied().chain([ego]).collect();
        Frame::new(agents, now.lights().to_vec())
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
    pub(super) fn arrive(&mut self, prepared: &PreparedScenario, rules: &Rules, action: &[f32]) {
        self.state = match &self.imagined {
            [Some(after), before] if !self.in_log => {
                let before = before.as_ref().unwrap_or(prepared.logged(self.state.steps));
                rules.advance(prepared, &self.state, action, [before, after])
            }
            _ => rules.step_in_log(prepared, &self.state, action),
        };
    }

    pub(super) fn observe(
        &self,
        prepared: &PreparedScenario,
        spec: &ObservationSpec,
        out: &mut ObservedRow<'_>,
    ) {
        let steps = self.state.steps;
        let (now, before) = match &self.imagined {
            [Some(now), before] => (now, before.as_ref()),
            [None, _] => (prepared.logged(steps), None),
        };
        let view = View {
            prepared,
            state: &self.state,
            now,
            before: before.or_else(|| prepared.logged_before(steps)),
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use super::*;
    use gump_scene::{AgentId, fixture};

    #[test]
    fn what_is_not_simulated_follows_the_log() {
        // The second is nearer at first, but drives away; the third comes.
        let text = "lane 1: 0,0 400,0 speed 15\nroute 1\nego vehicle 0: 10,0 velocity 10,0\n
            agent vehicle 1: 60,9\nagent vehicle 2: 0,5 velocity -10,0\n
            agent vehicle 3: 120,5 velocity -10,0\n";
        let prepared = PreparedScenario::new(fixture::scenario(text).unwrap(), 0.5).unwrap();
        let rules = Rules::default();
        let mut row = EnvRow::new(Seed(0), &rules.reset(&prepared));
        let ids = |frame: &Frame| -> Vec<i64> { frame.agents().iter().map(|a| a.id.0).collect() };

        row.limit(&prepared, Some(2));
        let seen = row.scene(&prepared);
        assert_eq!(
            seen.history.len(),
            prepared.scenario().present().history.len()
        );
        assert_eq!(ids(seen.now()), [0, 1, 3]);
        // The world leaves all agents in place.
        let frame = row.complete(&prepared, seen.now().clone());
        assert_eq!(ids(&frame), [0, 1, 2, 3]);
        let x = |id| frame.agent(AgentId(id)).unwrap().state.pose.position.x;
        assert_eq!((x(2), x(3)), (-5.0, 120.0));

        for n in [Some(3), Some(7), None] {
            row.limit(&prepared, n);
            assert_eq!(ids(row.scene(&prepared).now()), [0, 1, 2, 3]);
        }
    }
}
