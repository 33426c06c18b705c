//! The source of the other agents: the log, at no cost, or a session of a world.

use gump_rollout::{BoxError, Session, Start, WorldModel};
use gump_scene::{AgentState, Frame};

use super::row::EnvRow;
use super::{EnvConfig, TrafficSource};
use crate::{PreparedScenario, RlError, Rules};

/// The other agents of all rows.
pub(super) struct Others<'w> {
    world: Option<&'w dyn WorldModel>,
    /// As in [`crate::EnvConfig::nearest`].
    nearest: Option<usize>,
    /// As in [`crate::EnvConfig::live_lights`].
    live_lights: bool,
    session: Option<Box<dyn Session + 'w>>,
}

impl<'w> Others<'w> {
    pub(super) fn new(traffic: TrafficSource<'w>, config: &EnvConfig) -> Self {
        Self {
            nearest: config.nearest,
            live_lights: config.live_lights,
            world: match traffic {
                TrafficSource::Log => None,
                TrafficSource::World(world) => Some(world),
            },
            session: None,
        }
    }

    /// Begins the episodes of all rows.
    pub(super) fn open(
        &mut self,
        prepared: &[PreparedScenario],
        rows: &mut [EnvRow],
    ) -> Result<(), RlError> {
        self.session = None;
        for row in rows.iter_mut() {
            row.imagined = [None, None];
            row.in_log = self.world.is_none();
        }
        let Some(world) = self.world else {
            return Ok(());
        };
        for row in rows.iter_mut() {
            row.limit(&prepared[row.start.scenario], self.nearest);
        }
        let starts: Vec<Start<'_>> = rows.iter().map(|row| start(prepared, row)).collect();
        let session = world.open(&starts).map_err(|e| failed(world, e))?;
        frames_per_step(prepared[rows[0].start.scenario].dt(), session.dt())?;
        self.session = Some(session);
        Ok(())
    }

    /// Begins new episodes in some rows.
    pub(super) fn restart(
        &mut self,
        prepared: &[PreparedScenario],
        rows: &mut [EnvRow],
        chosen: &[usize],
    ) -> Result<(), RlError> {
        if chosen.len() == rows.len() {
            // All at once is cheaper, and nothing is lost.
            return self.open(prepared, rows);
        }
        for &i in chosen {
            rows[i].imagined = [None, None];
        }
        if let (Some(world), Some(session)) = (self.world, &mut self.session) {
            for &i in chosen {
                rows[i].limit(&prepared[rows[i].start.scenario], self.nearest);
                let start = start(prepared, &rows[i]);
                session.replace(i, start).map_err(|e| failed(world, e))?;
            }
        }
        Ok(())
    }

    /// Moves all agents except the egos, which `actions` drive. Egos whose episode has ended stay
    /// in place.
    ///
    /// The session is put back only on success: one that failed halfway cannot be used.
    pub(super) fn step(
        &mut self,
        prepared: &[PreparedScenario],
        rules: &Rules,
        rows: &mut [EnvRow],
        actions: &[f32],
    ) -> Result<(), RlError> {
        let Some(world) = self.world else {
            return Ok(());
        };
        if rows.iter().all(|row| row.state.end.is_some()) {
            return Ok(());
        }
        let mut session = self.session.take().ok_or(RlError::NotReset)?;
        let dt = prepared[rows[0].start.scenario].dt();
        let n = frames_per_step(dt, session.dt())?;
        let len = rules.dynamics.action_len();
        let mut frames = Vec::new();
        for k in 1..=n {
            let elapsed = dt * k as f64 / n as f64;
            let drive = |(row, action): (&EnvRow, &[f32])| {
                let now = row.state.ego.state;
                match row.state.end {
                    Some(_) => now,
                    None => rules.dynamics.advance(&now, action, dt, elapsed),
                }
            };
            let egos: Vec<AgentState> = rows
                .iter()
                .zip(actions.chunks_exact(len))
                .map(drive)
                .collect();
            if self.live_lights {
                for (i, row) in rows.iter().enumerate() {
                    let lights = prepared[row.start.scenario].lights(row.state.steps, elapsed);
                    // A world with lights of its own keeps them, and its agents obey those.
                    let _ = session.show(i, lights);
                }
            }
            frames = session.step(Some(&egos)).map_err(|e| failed(world, e))?;
        }
        check(rows, &frames)?;
        for (row, frame) in rows.iter_mut().zip(frames) {
            let before = row.imagined[0].take();
            let frame = row.complete(&prepared[row.start.scenario], frame);
            row.imagined = [Some(frame), before];
        }
        self.session = Some(session);
        Ok(())
    }
}

fn check(rows: &[EnvRow], frames: &[Frame]) -> Result<(), RlError> {
    if frames.len() != rows.len() {
        return Err(RlError::Count {
            who: "the world",
            expected: rows.len(),
            found: frames.len(),
        });
    }
    let lost = |(row, frame): (&EnvRow, &Frame)| frame.agent(row.state.ego.id).is_none();
    match rows.iter().zip(frames).position(lost) {
        Some(row) => Err(RlError::EgoVanished {
            ego: rows[row].state.ego.id,
            row,
        }),
        None => Ok(()),
    }
}

fn start<'a>(prepared: &'a [PreparedScenario], row: &'a EnvRow) -> Start<'a> {
    Start {
        scene: row.scene(&prepared[row.start.scenario]),
        n_futures: 1,
        seed: row.start.seed,
    }
}

/// Frames of a world in a step.
fn frames_per_step(step: f64, frames: f64) -> Result<usize, RlError> {
    let n = (step / frames).round();
    if n >= 1.0 && (step / frames - n).abs() < 1e-6 {
        Ok(n as usize)
    } else {
        Err(RlError::TimeStep { step, frames })
    }
}

fn failed(world: &dyn WorldModel, source: BoxError) -> RlError {
    RlError::World {
        world: world.name().to_owned(),
        source,
    }
}
