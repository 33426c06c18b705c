//! Rollouts as a Parquet table: every rollout, every track, every step.
//!
//! | column | type | what |
//! |---|---|---|
//! | `scenario_id` | text | |
//! | `rollout` | i64 | which future, from 0 |
//! | `step` | i64 | 0 is the present, which is recorded; from 1 on it is imagined |
//! | `time_s` | f64 | seconds from the present |
//! | `track_id` | i64 | unique within a rollout; the same agent in all |
//! | `class` | text | [`AgentKind::name`](gump_scene::AgentKind::name) |
//! | `is_ego` | bool | |
//! | `valid` | bool | whether the agent is there; if not, all below but `event` is missing |
//! | `x`, `y`, `z` | f64 | box centre, world frame, metres |
//! | `heading` | f64 | radians, counter-clockwise from +x |
//! | `vx`, `vy` | f64 | world frame, metres per second |
//! | `speed` | f64 | length of that, metres per second |
//! | `length`, `width`, `height` | f64 | metres |
//! | `event` | text | `birth` at the first step of an agent that comes after the present, `departure` at the first step without it |
//!
//! The table is a full grid: as many rows per rollout and track as there are steps, sorted in this
//! order, so that a column can be reshaped to [rollout, track, step]. A track that is in any
//! rollout of a scenario has rows in all of them.

use std::collections::BTreeMap;
use std::path::Path;

use gump_scene::{Agent, AgentId, Frame, Rollout};

use crate::DataError;
use crate::io::table::{Table, write_tables};

/// Writes the rollouts of scenarios, each by its id, as one table; the file appears when it is
/// complete.
///
/// # Errors
/// [`DataError::Io`].
pub fn write_rollouts<'a>(
    path: &Path,
    scenarios: impl IntoIterator<Item = (&'a str, &'a [Rollout])>,
) -> Result<(), DataError> {
    let tables = scenarios.into_iter().flat_map(|(id, rollouts)| {
        let tracks = tracks_of(rollouts);
        let each = rollouts.iter().enumerate();
        each.map(move |(k, rollout)| table(id, k, Some(rollout), &tracks))
    });
    write_tables(path, &table("", 0, None, &[]), tables)
}

/// Numbers of an agent that is there.
type Number = (&'static str, fn(&Agent) -> f64);

const NUMBERS: [Number; 10] = [
    ("x", |agent| agent.state.pose.position.x),
    ("y", |agent| agent.state.pose.position.y),
    ("z", |agent| agent.elevation),
    ("heading", |agent| agent.state.pose.heading),
    ("vx", |agent| agent.state.velocity.x),
    ("vy", |agent| agent.state.velocity.y),
    ("speed", |agent| agent.state.speed()),
    ("length", |agent| agent.length),
    ("width", |agent| agent.width),
    ("height", |agent| agent.height),
];

/// Every agent of any frame, by id, as it is first seen.
fn tracks_of(rollouts: &[Rollout]) -> Vec<Agent> {
    let mut tracks = BTreeMap::<AgentId, Agent>::new();
    for agent in rollouts
        .iter()
        .flat_map(frames)
        .flat_map(|frame| frame.agents())
    {
        tracks.entry(agent.id).or_insert(*agent);
    }
    tracks.into_values().collect()
}

/// The present and what was imagined.
fn frames(rollout: &Rollout) -> impl Iterator<Item = &Frame> {
    std::iter::once(rollout.start()).chain(rollout.imagined())
}

/// A track at a step.
struct Row<'a> {
    step: usize,
    time_s: f64,
    track: &'a Agent,
    is_ego: bool,
    now: Option<&'a Agent>,
    event: Option<&'static str>,
}

/// The rows of one rollout; none without one.
fn table(id: &str, k: usize, rollout: Option<&Rollout>, tracks: &[Agent]) -> Table {
    let rows: Vec<Row<'_>> = rollout.map_or_else(Vec::new, |rollout| {
        let of_track = |track| rows_of(rollout, track);
        tracks.iter().flat_map(of_track).collect()
    });
    let table = Table::default()
        .text("scenario_id", rows.iter().map(|_| Some(id)))
        .integer("rollout", rows.iter().map(|_| Some(k as i64)))
        .integer("step", rows.iter().map(|row| Some(row.step as i64)))
        .number("time_s", rows.iter().map(|row| Some(row.time_s)))
        .integer("track_id", rows.iter().map(|row| Some(row.track.id.0)))
        .text("class", rows.iter().map(|row| Some(row.track.kind.name())))
        .truth("is_ego", rows.iter().map(|row| Some(row.is_ego)))
        .truth("valid", rows.iter().map(|row| Some(row.now.is_some())));
    let table = NUMBERS.iter().fold(table, |table, (name, of)| {
        table.number(name, rows.iter().map(|row| row.now.map(of)))
    });
    table.text("event", rows.iter().map(|row| row.event))
}

fn rows_of<'a>(rollout: &'a Rollout, track: &'a Agent) -> impl Iterator<Item = Row<'a>> {
    let mut was_there = None;
    frames(rollout).enumerate().map(move |(step, frame)| {
        let now = frame.agent(track.id);
        let event = match (was_there.replace(now.is_some()), now) {
            (Some(false), Some(_)) => Some("birth"),
            (Some(true), None) => Some("departure"),
            _ => None,
        };
        Row {
            step,
            time_s: step as f64 * rollout.dt(),
            track,
            is_ego: track.id == rollout.ego(),
            now,
            event,
        }
    })
}
