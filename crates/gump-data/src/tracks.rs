//! Tracks as a Parquet table, one row per agent and step, for analysis with other tools.
//!
//! | column | type | what |
//! |---|---|---|
//! | `scenario_id` | text | |
//! | `track_id` | i64 | unique within the scenario |
//! | `class` | text | [`AgentKind::name`](gump_scene::AgentKind::name) |
//! | `is_ego` | bool | |
//! | `time_s` | f64 | seconds from the scenario's first frame |
//! | `x`, `y` | f64 | box centre, world frame, metres |
//! | `heading` | f64 | radians, counter-clockwise from +x |
//! | `vx`, `vy` | f64 | world frame, metres per second |
//! | `length`, `width` | f64 | metres |
//!
//! Rows are sorted by track and time, scenarios come in the order given. Maps and lights are not
//! included, so a table is not read back as scenarios.

use std::borrow::Borrow;
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

use gump_scene::{Agent, AgentId, Scenario};

use crate::DataError;
use crate::io::table::{Sheet, Table, write_tables};

/// Writes the tracks of scenarios as one table; the file appears when it is complete.
///
/// # Errors
/// [`DataError::Io`].
pub fn write_tracks<S: Borrow<Scenario>>(
    path: &Path,
    scenarios: impl IntoIterator<Item = S>,
) -> Result<(), DataError> {
    let tables = scenarios.into_iter().map(|s| tracks_of(Some(s.borrow())));
    write_tables(path, &tracks_of(None), tables)
}

/// A column of numbers and where they come from: the agent, and seconds from the first frame.
type Number = (&'static str, fn(&Agent, f64) -> f64);

const NUMBERS: [Number; 8] = [
    ("time_s", |_, time| time),
    ("x", |agent, _| agent.state.pose.position.x),
    ("y", |agent, _| agent.state.pose.position.y),
    ("heading", |agent, _| agent.state.pose.heading),
    ("vx", |agent, _| agent.state.velocity.x),
    ("vy", |agent, _| agent.state.velocity.y),
    ("length", |agent, _| agent.length),
    ("width", |agent, _| agent.width),
];

/// The rows of a scenario; none without one.
fn tracks_of(scenario: Option<&Scenario>) -> Table {
    let mut tracks: BTreeMap<AgentId, Vec<(f64, &Agent)>> = BTreeMap::new();
    let (id, ego) = scenario.map_or(("", None), |s| (s.id.as_str(), Some(s.ego)));
    if let Some(scenario) = scenario {
        for (step, frame) in scenario.log.iter().enumerate() {
            for agent in frame.agents() {
                let time = step as f64 * scenario.dt;
                tracks.entry(agent.id).or_default().push((time, agent));
            }
        }
    }
    let rows: Vec<(f64, &Agent)> = tracks.into_values().flatten().collect();
    let agents = || rows.iter().map(|(_, agent)| *agent);
    let table = Table::default()
        .text("scenario_id", agents().map(|_| Some(id)))
        .integer("track_id", agents().map(|agent| Some(agent.id.0)))
        .text("class", agents().map(|agent| Some(agent.kind.name())))
        .truth("is_ego", agents().map(|agent| Some(Some(agent.id) == ego)));
    NUMBERS.iter().fold(table, |table, (name, of)| {
        table.number(
            name,
            rows.iter().map(|(time, agent)| Some(of(agent, *time))),
        )
    })
}

/// A table of tracks being written.
pub(crate) struct TrackTable<'a, W: Write + Send>(Sheet<'a, W>);

impl<'a, W: Write + Send> TrackTable<'a, W> {
    /// `path` is for errors only.
    pub(crate) fn begin(out: W, path: &'a Path) -> Result<Self, DataError> {
        Sheet::begin(out, &tracks_of(None), path).map(Self)
    }

    /// Adds the tracks of a scenario.
    pub(crate) fn write(&mut self, scenario: &Scenario) -> Result<(), DataError> {
        self.0.write(tracks_of(Some(scenario)))
    }

    /// Writes what is left and the table's footer.
    pub(crate) fn finish(self) -> Result<(), DataError> {
        self.0.finish()
    }
}
