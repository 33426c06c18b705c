//! Conversion of rows of a table to tracks.

use std::collections::BTreeMap;

use gump_geometry::{dvec2, dvec3};
use gump_scene::AgentKind;

use crate::complete::recording::{MAX_STEPS, Recording};
use crate::complete::track::{self, State, Track, UNSTATED};
use crate::{Problem, ReadReport};

/// A time stamp may stray from the nearest step by this fraction of one: rounding, not another
/// rate.
const TIME_TOLERANCE: f64 = 0.1;

/// True for a table of tracks.
pub(super) fn is_table(head: &[u8]) -> bool {
    let line = head.split(|&byte| byte == b'\n').next().unwrap_or_default();
    let line = String::from_utf8_lossy(line);
    let has = |name: &str| line.split(',').any(|column| column.trim() == name);
    ["track_id", "timestamp_ms", "agent_type"]
        .into_iter()
        .all(has)
}

/// All tracks of a table; times count from the earliest.
///
/// Error: a missing column, or a table without a single time.
pub(super) fn recording(
    table: &str,
    id: String,
    rate_hz: f64,
    report: &mut ReadReport,
) -> Result<Recording, Problem> {
    let mut lines = table.lines();
    let header: Vec<&str> = lines.next().unwrap_or_default().split(',').collect();
    let column = |name: &'static str| header.iter().position(|column| column.trim() == name);
    let need = |name: &'static str| {
        column(name).ok_or_else(|| Problem::Unexpected {
            expected: name,
            found: header.join(",").into(),
            place: "the columns".into(),
        })
    };
    let (track, time, kind) = (
        need("track_id")?,
        need("timestamp_ms")?,
        need("agent_type")?,
    );
    let (x, y) = (need("x")?, need("y")?);
    let others = ["vx", "vy", "psi_rad", "length", "width"].map(column);
    let mut rows: Vec<(f64, i64, AgentKind, State)> = Vec::new();
    for (i, line) in lines
        .enumerate()
        .filter(|(_, line)| !line.trim().is_empty())
    {
        let fields: Vec<&str> = line.split(',').collect();
        let text = |column: usize| fields.get(column).copied().unwrap_or_default().trim();
        let number = |column: usize| text(column).parse::<f64>().unwrap_or(UNSTATED);
        let (Ok(id), ms) = (text(track).parse(), number(time)) else {
            report.drop_damaged("row without the number of a track", || row(i));
            continue;
        };
        if ms.is_nan() || ms.abs() > 1e15 {
            report.drop_damaged("row without a time", || row(i));
            continue;
        }
        let [vx, vy, heading, length, width] = others.map(|column| column.map_or(UNSTATED, number));
        let state = State {
            step: 0,
            position: dvec3(number(x), number(y), UNSTATED),
            heading,
            velocity: dvec2(vx, vy),
            size: [length, width, UNSTATED],
        };
        rows.push((ms, id, agent_kind(text(kind)), state));
    }
    let first = rows.iter().map(|row| row.0).fold(f64::INFINITY, f64::min);
    let mut tracks: BTreeMap<i64, Track> = BTreeMap::new();
    let mut steps = 0;
    for (ms, id, kind, state) in rows {
        let exact = (ms - first) * 1e-3 * rate_hz;
        let step = exact.round();
        if (exact - step).abs() > TIME_TOLERANCE {
            report.drop_damaged("state between two time steps", || {
                format!("track {id} at {ms} ms")
            });
            continue;
        }
        let step = step as usize;
        steps = steps.max(step.saturating_add(1));
        let track = tracks.entry(id).or_insert_with(|| Track {
            id,
            kind,
            usual_size: kind.usual_size(),
            states: Vec::new(),
        });
        track.states.push(State { step, ..state });
    }
    let now = present(tracks.values(), steps.min(MAX_STEPS), rate_hz);
    report.infer(
        "present one second after the vehicle seen longest appears",
        1,
    );
    Ok(Recording {
        id,
        dt: 1.0 / rate_hz,
        steps,
        now,
        ego: None,
        tracks: tracks.into_values().collect(),
        lights: Vec::new(),
        targets: None,
        objects_of_interest: Vec::new(),
        tags: Vec::new(),
        route: None,
    })
}

/// One second after the vehicle that is seen longest appears: roadside cameras often see none at
/// first. A second in where there is no vehicle.
fn present<'t>(tracks: impl Iterator<Item = &'t Track>, steps: usize, rate_hz: f64) -> usize {
    let usual = track::usual_present(steps, 1.0 / rate_hz);
    let vehicles = tracks.filter(|track| track.kind == AgentKind::Vehicle);
    let seen: Vec<Vec<usize>> = vehicles
        .map(|track| {
            let mut seen: Vec<usize> = track.states.iter().map(|state| state.step).collect();
            seen.sort_unstable();
            seen
        })
        .collect();
    let longest = seen.iter().rev().max_by_key(|seen| seen.len());
    let later = |seen: &Vec<usize>| {
        let second_in = seen.partition_point(|&step| step < seen[0] + usual);
        seen.get(second_in).or(seen.last()).copied()
    };
    longest.and_then(later).unwrap_or(usual)
}

/// Rows as editors count them: the header is the first.
fn row(i: usize) -> String {
    format!("line {}", i + 2)
}

fn agent_kind(name: &str) -> AgentKind {
    match name.to_lowercase().as_str() {
        "car" | "truck" | "van" | "bus" | "motorcycle" | "trailer" => AgentKind::Vehicle,
        "bike" | "bicycle" | "cyclist" => AgentKind::Bicycle,
        "pedestrian" => AgentKind::Pedestrian,
        _ => AgentKind::Other,
    }
}
