//! One client: handshake, then request by request.

use std::io::{BufReader, Read, Write};
use std::sync::Arc;

use super::ServerError;
use super::frame::{self, kind};
use crate::{
    Autoreset, BicycleLimits, DrivingEnv, Dynamics, EnvConfig, ObservationSpec, PoseLimits,
    PreparedScenario, RasterView, Rules, TrafficSource, VectorEnv, VectorView,
};

/// Version of the protocol; a client with another one is refused.
const VERSION: u16 = 1;
/// Bytes of a handshake, as the protocol states.
const HELLO_LEN: usize = 13;
/// A limit on rows, far above practical use and small enough not to exhaust the memory.
const MAX_ROWS: u32 = 4096;

/// The connection to one client.
#[derive(Debug)]
pub struct Connection<'a, S> {
    stream: BufReader<S>,
    prepared: &'a Arc<[PreparedScenario]>,
    traffic: TrafficSource<'a>,
    config: EnvConfig,
}

/// The end of a connection.
#[derive(Debug)]
pub struct Farewell {
    /// Episodes that ended during the connection.
    pub episodes_finished: u64,
    /// Episodes in progress when the connection ended; they are lost.
    pub episodes_lost: usize,
    /// The reason for the end; `None` if the client said goodbye.
    pub error: Option<ServerError>,
}

impl<'a, S: Read + Write> Connection<'a, S> {
    /// Creates a connection whose handshake has not begun.
    pub fn new(
        stream: S,
        prepared: &'a Arc<[PreparedScenario]>,
        traffic: TrafficSource<'a>,
        config: &EnvConfig,
    ) -> Self {
        Self {
            stream: BufReader::new(stream),
            prepared,
            traffic,
            config: *config,
        }
    }

    /// Handles requests until the client leaves or sends an invalid one.
    pub fn serve(mut self) -> Farewell {
        let mut farewell = Farewell {
            episodes_finished: 0,
            episodes_lost: 0,
            error: None,
        };
        let mut env = match self.greet() {
            Ok(env) => env,
            Err(error) => {
                self.answer_error(&error);
                farewell.error = Some(error);
                return farewell;
            }
        };
        farewell.error = loop {
            match self.request(&mut env) {
                Ok(Some((kind, body))) => {
                    if kind == kind::STEPPED {
                        farewell.episodes_finished += env.finished().len() as u64;
                    }
                    if let Err(error) = frame::write(self.stream.get_mut(), kind, &body) {
                        break Some(error);
                    }
                }
                Ok(None) => break None,
                Err(error) => {
                    let goes_on = self.answer_error(&error) && error.code() != Some(1);
                    if !goes_on {
                        break Some(error);
                    }
                }
            }
        };
        farewell.episodes_lost = (0..env.n_envs())
            .filter_map(|row| env.episode(row))
            .filter(|(_, state)| state.end.is_none() && state.steps > 0)
            .count();
        farewell
    }

    /// Sends an error to the client; false if the client is gone.
    fn answer_error(&mut self, error: &ServerError) -> bool {
        let Some(code) = error.code() else {
            return false;
        };
        let mut body = vec![code];
        body.extend(error.to_string().bytes());
        frame::write(self.stream.get_mut(), kind::ERROR, &body).is_ok()
    }

    fn greet(&mut self) -> Result<DrivingEnv<'a>, ServerError> {
        let (found, len) = frame::read_header(&mut self.stream)?;
        if found != kind::HELLO || len != HELLO_LEN {
            return Err(ServerError::Greeting { version: VERSION });
        }
        let body = frame::read_body(&mut self.stream, len)?;
        let version = VERSION.to_le_bytes();
        if body[..4] != *b"GUMP" || body[4..6] != version {
            return Err(ServerError::Greeting { version: VERSION });
        }
        let rows = u32::from_le_bytes([body[9], body[10], body[11], body[12]]);
        if rows > MAX_ROWS {
            return Err(ServerError::Choice {
                what: "number of rows",
                most: MAX_ROWS,
                found: rows,
            });
        }
        let config = EnvConfig {
            n_envs: rows as usize,
            autoreset: autoreset(body[6])?,
            observation: observation(body[7], self.config.observation)?,
            rules: Rules {
                dynamics: dynamics(body[8], self.config.rules.dynamics)?,
                ..self.config.rules
            },
            ..self.config
        };
        let env = DrivingEnv::new(Arc::clone(self.prepared), self.traffic, config)?;
        let mut body = Vec::new();
        let shape = config.observation.shape();
        body.extend(rows.to_le_bytes());
        body.extend((env.action_len() as u32).to_le_bytes());
        body.extend(self.prepared[0].dt().to_le_bytes());
        body.extend((self.prepared.len() as u32).to_le_bytes());
        frame::put_flags(&mut body, [config.observation.packed_len() > 0]);
        body.push(shape.len() as u8);
        for axis in shape {
            body.extend((axis as u32).to_le_bytes());
        }
        frame::write(self.stream.get_mut(), kind::READY, &body)?;
        Ok(env)
    }

    /// Reads and executes a request; the answer, or `None` for a goodbye.
    fn request(&mut self, env: &mut DrivingEnv<'_>) -> Result<Option<(u8, Vec<u8>)>, ServerError> {
        let (kind, len) = frame::read_header(&mut self.stream)?;
        match kind {
            kind::RESET => {
                self.reset(env, len)?;
                let mut body = Vec::new();
                put_observations(&mut body, env);
                Ok(Some((kind::OBSERVATIONS, body)))
            }
            kind::STEP => {
                let expected = 4 * env.n_envs() * env.action_len();
                frame::expect_len("step", expected, len)?;
                let body = frame::read_body(&mut self.stream, len)?;
                env.step(&frame::numbers(&body))?;
                Ok(Some((kind::STEPPED, stepped(env))))
            }
            kind::GOODBYE => {
                frame::expect_len("goodbye", 0, len)?;
                Ok(None)
            }
            found => Err(ServerError::Kind {
                expected: "reset, step or goodbye",
                found,
            }),
        }
    }

    fn reset(&mut self, env: &mut DrivingEnv<'_>, len: usize) -> Result<(), ServerError> {
        let n = env.n_envs();
        // The longest reset has seeds and a mask.
        if len == 0 || len > 1 + 9 * n {
            frame::expect_len("reset", 1 + 9 * n, len)?;
        }
        let body = frame::read_body(&mut self.stream, len)?;
        let (has_seeds, has_mask) = (body[0] & 1 != 0, body[0] & 2 != 0);
        if body[0] > 3 {
            return Err(ServerError::Choice {
                what: "content of a reset",
                most: 3,
                found: u32::from(body[0]),
            });
        }
        let seeds_len = if has_seeds { 8 * n } else { 0 };
        let expected = 1 + seeds_len + if has_mask { n } else { 0 };
        frame::expect_len("reset", expected, len)?;
        let (seeds, mask) = body[1..].split_at(seeds_len);
        let seeds = has_seeds.then(|| frame::seeds(seeds));
        match (&seeds, has_mask) {
            (Some(seeds), false) => env.reset_with(seeds)?,
            _ => {
                let mask: Vec<bool> = if has_mask {
                    mask.iter().map(|flag| *flag != 0).collect()
                } else {
                    vec![true; n]
                };
                env.reset_rows(&mask, seeds.as_deref())?;
            }
        }
        Ok(())
    }
}

fn autoreset(found: u8) -> Result<Autoreset, ServerError> {
    match found {
        0 => Ok(Autoreset::NextStep),
        1 => Ok(Autoreset::SameStep),
        2 => Ok(Autoreset::Disabled),
        _ => Err(choice("autoreset mode", 2, found)),
    }
}

/// The server's own observation form if it is of the requested kind, else the default of that kind.
fn observation(found: u8, own: ObservationSpec) -> Result<ObservationSpec, ServerError> {
    match (found, own) {
        (0, ObservationSpec::Vector(_)) | (1, ObservationSpec::Raster(_)) => Ok(own),
        (0, _) => Ok(ObservationSpec::Vector(VectorView::default())),
        (1, _) => Ok(ObservationSpec::Raster(RasterView::default())),
        _ => Err(choice("kind of observation", 1, found)),
    }
}

/// The server's own dynamics if they are of the requested kind, else the default ones.
fn dynamics(found: u8, own: Dynamics) -> Result<Dynamics, ServerError> {
    match (found, own) {
        (0, Dynamics::Bicycle(_)) | (1, Dynamics::NextPose(_)) | (2, Dynamics::Trajectory(_)) => {
            Ok(own)
        }
        (0, _) => Ok(Dynamics::Bicycle(BicycleLimits::default())),
        (1, _) => Ok(Dynamics::NextPose(PoseLimits::default())),
        (2, _) => Ok(Dynamics::Trajectory(PoseLimits::default())),
        _ => Err(choice("kind of dynamics", 2, found)),
    }
}

fn choice(what: &'static str, most: u32, found: u8) -> ServerError {
    ServerError::Choice {
        what,
        most,
        found: u32::from(found),
    }
}

fn put_observations(body: &mut Vec<u8>, env: &DrivingEnv<'_>) {
    if env.packed_observations().is_empty() {
        frame::put_numbers(body, env.observations());
    } else {
        body.extend_from_slice(env.packed_observations());
    }
}

fn stepped(env: &DrivingEnv<'_>) -> Vec<u8> {
    let mut body = Vec::new();
    put_observations(&mut body, env);
    frame::put_numbers(&mut body, env.rewards());
    for flags in [env.terminated(), env.truncated(), env.restarted()] {
        frame::put_flags(&mut body, flags.iter().copied());
    }
    let finished = env.finished();
    body.extend((finished.len() as u32).to_le_bytes());
    for (row, outcome) in finished {
        let totals = &outcome.totals;
        for number in [*row, outcome.start.scenario, outcome.steps] {
            body.extend((number as u32).to_le_bytes());
        }
        frame::put_numbers(&mut body, &[totals.reward as f32, totals.progress as f32]);
        frame::put_flags(
            &mut body,
            [totals.collided, totals.off_road, totals.uncomfortable],
        );
        let part = |len: usize| row * len / env.n_envs()..(row + 1) * len / env.n_envs();
        let packed = env.packed_final_observations();
        if packed.is_empty() {
            let all = env.final_observations();
            frame::put_numbers(&mut body, &all[part(all.len())]);
        } else {
            body.extend_from_slice(&packed[part(packed.len())]);
        }
    }
    body
}
