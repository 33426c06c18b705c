//! Many parallel driving episodes in any world.
//!
//! `config` is the configuration, `sampler` draws scenarios, `row` is one episode in progress,
//! `traffic` moves the other agents. The rules are in `crate::episode`.

mod config;
mod row;
mod sampler;
mod traffic;

use std::sync::Arc;

use gump_scene::{Frame, Seed};
use rayon::prelude::*;

use crate::observation::Observed;
use crate::{End, EpisodeState, PreparedScenario, RlError, VectorEnv};
use row::EnvRow;
use sampler::Sampler;
use traffic::Others;

pub use config::{Autoreset, EnvConfig, TrafficSource};
pub use row::{EpisodeStart, Outcome};
pub use sampler::Sampling;

/// Rows that one thread takes at a time: a step of a row takes microseconds. Results do not depend
/// on it; not tuned.
const ROWS_PER_TASK: usize = 8;

/// Driving episodes, one per row, in borrowed buffers.
///
/// Actions drive the ego of every row, and the world drives all other agents in one batched call
/// per step. Episode `e` of row `i` depends only on the seed of the row, `e` and its actions,
/// unless scenarios are drawn by priority; other rows and the number of threads have no effect.
/// After [`VectorEnv::reset`] row `i` has the seed `seed.fork(i)`.
///
/// With [`Autoreset::SameStep`], the default, it follows the contract of [`VectorEnv`]; the other
/// modes are Gymnasium's. The front page of the crate has an example.
pub struct DrivingEnv<'w> {
    prepared: Arc<[PreparedScenario]>,
    others: Others<'w>,
    config: EnvConfig,
    sampler: Sampler,
    /// Empty before the first reset and after a step that failed.
    rows: Vec<EnvRow>,
    observations: Observed,
    finals: Observed,
    rewards: Vec<f32>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    restarted: Vec<bool>,
    finished: Vec<(usize, Outcome)>,
}

impl<'w> DrivingEnv<'w> {
    /// An environment on these prepared scenarios among `traffic`. It has no episodes before the first reset.
    ///
    /// # Errors
    /// [`RlError::NoScenario`], and [`RlError::Parameter`] for parameters out of range.
    pub fn new(
        prepared: Arc<[PreparedScenario]>,
        traffic: TrafficSource<'w>,
        config: EnvConfig,
    ) -> Result<Self, RlError> {
        if prepared.is_empty() {
            return Err(RlError::NoScenario);
        }
        config.check()?;
        let n = config.n_envs;
        let observed = || Observed::new(&config.observation, n);
        Ok(Self {
            others: Others::new(traffic, &config),
            sampler: Sampler::new(config.sampling, n, prepared.len()),
            rows: Vec::new(),
            observations: observed(),
            finals: observed(),
            rewards: vec![0.0; n],
            terminated: vec![false; n],
            truncated: vec![false; n],
            restarted: vec![false; n],
            finished: Vec::new(),
            prepared,
            config,
        })
    }

    /// Starts these episodes, one per row: to repeat some, or for a fixed list.
    ///
    /// # Errors
    /// [`RlError::Count`], [`RlError::NoSuchScenario`], and errors of the world.
    pub fn reset_to(&mut self, starts: &[EpisodeStart]) -> Result<(), RlError> {
        let (expected, found, n) = (self.config.n_envs, starts.len(), self.prepared.len());
        if expected != found {
            return Err(RlError::Count {
                who: "the list of starts",
                expected,
                found,
            });
        }
        if let Some(row) = starts.iter().position(|start| start.scenario >= n) {
            let scenario = starts[row].scenario;
            return Err(RlError::NoSuchScenario { row, scenario, n });
        }
        let blank = self.blank();
        let row = |(i, start): (usize, &EpisodeStart)| {
            // What comes after the given episodes is drawn from their seeds.
            let mut row = EnvRow::new(start.seed.fork(i as u64), &blank);
            row.n_episodes = 1;
            row.start = *start;
            row
        };
        self.rows = starts.iter().enumerate().map(row).collect();
        self.open()
    }

    /// Starts the next episode in the chosen rows, with new seeds for them if given; for use with
    /// [`Autoreset::Disabled`]. Only their observations change.
    ///
    /// Shape: `which` and `seeds` are `[n_envs]`; the seeds of other rows are ignored.
    ///
    /// # Errors
    /// [`RlError::NotReset`], [`RlError::Count`], and errors of the world.
    pub fn reset_rows(&mut self, which: &[bool], seeds: Option<&[Seed]>) -> Result<(), RlError> {
        let expected = self.live()?.len();
        for (who, found) in [
            ("the mask of rows", which.len()),
            ("the list of seeds", seeds.map_or(expected, <[Seed]>::len)),
        ] {
            if found != expected {
                return Err(RlError::Count {
                    who,
                    expected,
                    found,
                });
            }
        }
        if let Some(seeds) = seeds {
            let blank = self.blank();
            for ((row, seed), _) in self.rows.iter_mut().zip(seeds).zip(which).filter(|z| *z.1) {
                *row = EnvRow::new(*seed, &blank);
            }
        }
        let chosen: Vec<usize> = (0..expected).filter(|i| which[*i]).collect();
        self.clear_step();
        self.restart(&chosen)?;
        for row in chosen {
            self.finals.copy_row(row, &self.observations);
        }
        Ok(())
    }

    /// The actions that come nearest to the log's next states.
    ///
    /// Shape: `actions` is `[n_envs, action_len]`, row-major; it is overwritten.
    ///
    /// # Errors
    /// [`RlError::NotReset`] and [`RlError::Count`].
    pub fn expert_actions(&self, actions: &mut [f32]) -> Result<(), RlError> {
        let len = self.action_len();
        let (expected, found) = (self.live()?.len() * len, actions.len());
        if expected != found {
            return Err(RlError::Count {
                who: "the buffer for actions",
                expected,
                found,
            });
        }
        for (row, action) in self.rows.iter().zip(actions.chunks_exact_mut(len)) {
            let prepared = &self.prepared[row.start.scenario];
            self.config
                .rules
                .expert_action(prepared, &row.state, action);
        }
        Ok(())
    }

    /// The episodes that ended in the last step, by row.
    pub fn finished(&self) -> &[(usize, Outcome)] {
        &self.finished
    }

    /// Rows whose observation is the first of an episode. Shape: `[n_envs]`. In a step with
    /// [`Autoreset::NextStep`] these rows did not act: exclude them from training data.
    pub fn restarted(&self) -> &[bool] {
        &self.restarted
    }

    /// The episode in progress in a row; `None` if there is no such row or no episode yet.
    pub fn episode(&self, row: usize) -> Option<(EpisodeStart, &EpisodeState)> {
        self.rows.get(row).map(|row| (row.start, &row.state))
    }

    /// All agents of the episode in progress in a row, as they are now; `None` if there is no such row or
    /// no episode yet.
    pub fn frame(&self, row: usize) -> Option<Frame> {
        let row = self.rows.get(row)?;
        Some(row.frame(&self.prepared[row.start.scenario]))
    }

    /// [`VectorEnv::observations`] of rasters with one bit per pixel, for replay buffers; empty for
    /// vectors. Shape: `[n_envs, packed_len]`.
    pub fn packed_observations(&self) -> &[u8] {
        self.observations.packed()
    }

    /// [`VectorEnv::final_observations`] in the same form.
    pub fn packed_final_observations(&self) -> &[u8] {
        self.finals.packed()
    }

    /// The configuration.
    pub fn config(&self) -> &EnvConfig {
        &self.config
    }

    /// The prepared scenarios.
    pub fn prepared(&self) -> &Arc<[PreparedScenario]> {
        &self.prepared
    }

    /// Starts new episodes in all rows, row `i` with seed `seeds[i]`, and resets the statistics of
    /// scenarios.
    ///
    /// # Errors
    /// [`RlError::Count`], and errors of the world.
    pub fn reset_with(&mut self, seeds: &[Seed]) -> Result<(), RlError> {
        let (expected, found) = (self.config.n_envs, seeds.len());
        if expected != found {
            return Err(RlError::Count {
                who: "the list of seeds",
                expected,
                found,
            });
        }
        self.sampler = Sampler::new(self.config.sampling, expected, self.prepared.len());
        let blank = self.blank();
        self.rows = seeds
            .iter()
            .map(|seed| EnvRow::new(*seed, &blank))
            .collect();
        for (i, row) in self.rows.iter_mut().enumerate() {
            row.draw(i, &self.sampler);
        }
        self.open()
    }

    /// Placeholder state of a row until its first episode begins.
    fn blank(&self) -> EpisodeState {
        self.config.rules.reset(&self.prepared[0])
    }

    fn live(&self) -> Result<&[EnvRow], RlError> {
        if self.rows.is_empty() {
            return Err(RlError::NotReset);
        }
        Ok(&self.rows)
    }

    /// Opens the world on the starts of all rows.
    fn open(&mut self) -> Result<(), RlError> {
        self.clear_step();
        let opened = self.others.open(&self.prepared, &mut self.rows);
        if opened.is_err() {
            self.rows.clear();
        }
        opened?;
        self.restarted.fill(true);
        let all: Vec<usize> = (0..self.rows.len()).collect();
        self.observe_starts(&all);
        self.finals.clone_from(&self.observations);
        Ok(())
    }

    /// Starts the next episode in each of these rows.
    fn restart(&mut self, chosen: &[usize]) -> Result<(), RlError> {
        if chosen.is_empty() {
            return Ok(());
        }
        for &i in chosen {
            self.rows[i].draw(i, &self.sampler);
            self.restarted[i] = true;
        }
        let restarted = self.others.restart(&self.prepared, &mut self.rows, chosen);
        if restarted.is_err() {
            // The state of a world that failed halfway is unknown.
            self.rows.clear();
        }
        restarted?;
        self.observe_starts(chosen);
        Ok(())
    }

    /// Puts these rows at the start of their episodes.
    fn observe_starts(&mut self, chosen: &[usize]) {
        let (prepared, config) = (&self.prepared, &self.config);
        let mut is_chosen = vec![false; self.rows.len()];
        for &i in chosen {
            is_chosen[i] = true;
        }
        let rows = self.rows.par_iter_mut().zip(self.observations.rows_mut());
        rows.zip(is_chosen)
            .with_min_len(ROWS_PER_TASK)
            .filter(|(_, chosen)| *chosen)
            .for_each(|((row, mut out), _)| {
                let prepared = &prepared[row.start.scenario];
                row.state = config.rules.reset(prepared);
                row.observe(prepared, &config.observation, &mut out);
            });
    }

    fn clear_step(&mut self) {
        self.rewards.fill(0.0);
        self.terminated.fill(false);
        self.truncated.fill(false);
        self.restarted.fill(false);
        self.finished.clear();
    }

    /// Moves the active rows to the states that their actions and the world give.
    fn arrive(&mut self, actions: &[f32], acts: &[bool]) {
        let (prepared, config) = (&self.prepared, &self.config);
        let len = config.rules.dynamics.action_len();
        self.rows
            .par_iter_mut()
            .zip(actions.par_chunks_exact(len))
            .zip(acts)
            .zip(self.finals.rows_mut())
            .zip(self.observations.rows_mut())
            .zip(&mut self.rewards)
            .with_min_len(ROWS_PER_TASK)
            .filter(|((((_, acts), _), _), _)| **acts)
            .for_each(|(((((row, action), _), mut last), next), reward)| {
                let prepared = &prepared[row.start.scenario];
                row.arrive(prepared, &config.rules, action);
                row.observe(prepared, &config.observation, &mut last);
                next.copy_from(&last);
                *reward = row.state.reward as f32;
            });
    }

    /// Records outcomes of episodes; the rows in which they ended.
    fn conclude(&mut self, acts: &[bool]) -> Vec<usize> {
        let mut ended = Vec::new();
        for (i, row) in self.rows.iter().enumerate() {
            let Some(end) = row.state.end.filter(|_| acts[i]) else {
                continue;
            };
            let failed = matches!(end, End::Terminated(_));
            self.terminated[i] = failed;
            self.truncated[i] = !failed;
            self.sampler.note(row.start.scenario, failed);
            self.finished.push((i, row.outcome(end)));
            ended.push(i);
        }
        ended
    }
}

impl VectorEnv for DrivingEnv<'_> {
    fn n_envs(&self) -> usize {
        self.config.n_envs
    }

    fn observation_len(&self) -> usize {
        self.config.observation.len()
    }

    fn action_len(&self) -> usize {
        self.config.rules.dynamics.action_len()
    }

    /// As [`DrivingEnv::reset_with`], row `i` with `seed.fork(i)`.
    fn reset(&mut self, seed: Seed) -> Result<(), RlError> {
        let seeds: Vec<Seed> = (0..self.config.n_envs as u64)
            .map(|i| seed.fork(i))
            .collect();
        self.reset_with(&seeds)
    }

    /// # Errors
    /// [`RlError::NotReset`], [`RlError::Count`], [`RlError::NotFinite`], [`RlError::OutOfRange`]
    /// and [`RlError::Finished`] leave the episodes as they are. After any other error the
    /// environment must be reset.
    fn step(&mut self, actions: &[f32]) -> Result<(), RlError> {
        self.live()?;
        self.config
            .rules
            .check_actions(actions, self.config.n_envs)?;
        let waiting: Vec<usize> = (0..self.rows.len())
            .filter(|i| self.rows[*i].state.end.is_some())
            .collect();
        if let (Autoreset::Disabled, Some(&row)) = (self.config.autoreset, waiting.first()) {
            return Err(RlError::Finished { row });
        }
        let acts: Vec<bool> = self.rows.iter().map(|r| r.state.end.is_none()).collect();
        self.clear_step();
        let (rules, prepared) = (&self.config.rules, &self.prepared);
        let moved = self.others.step(prepared, rules, &mut self.rows, actions);
        if moved.is_err() {
            self.rows.clear();
        }
        moved?;
        self.arrive(actions, &acts);
        let ended = self.conclude(&acts);
        match self.config.autoreset {
            Autoreset::SameStep => self.restart(&ended),
            Autoreset::Disabled => Ok(()),
            Autoreset::NextStep => {
                self.restart(&waiting)?;
                for row in waiting {
                    self.finals.copy_row(row, &self.observations);
                }
                Ok(())
            }
        }
    }

    fn observations(&self) -> &[f32] {
        self.observations.numbers()
    }

    fn rewards(&self) -> &[f32] {
        &self.rewards
    }

    fn terminated(&self) -> &[bool] {
        &self.terminated
    }

    fn truncated(&self) -> &[bool] {
        &self.truncated
    }

    fn final_observations(&self) -> &[f32] {
        self.finals.numbers()
    }
}
