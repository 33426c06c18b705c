//! Tracks as a Parquet table, one row per agent and step: for looking at data with other tools.
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
//! Rows are sorted by track and time, scenarios come in the order given. Maps and lights have no
//! place here, so a table is not read back as scenarios.

use std::borrow::Borrow;
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;
use std::sync::Arc;

use arrow_array::{ArrayRef, BooleanArray, Float64Array, Int64Array, RecordBatch, StringArray};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use gump_scene::{Agent, AgentId, Scenario};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, ZstdLevel};
use parquet::file::properties::WriterProperties;

use crate::stream::io_error;
use crate::{DataError, write_atomically};

/// Writes the tracks of scenarios as one table; the file appears when it is complete.
///
/// # Errors
/// [`DataError::Io`].
pub fn write_tracks<S: Borrow<Scenario>>(
    path: &Path,
    scenarios: impl IntoIterator<Item = S>,
) -> Result<(), DataError> {
    write_atomically(path, |file| {
        let mut table = TrackTable::begin(file, path)?;
        for scenario in scenarios {
            table.write(scenario.borrow())?;
        }
        table.finish()
    })
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

/// A table being written.
pub(crate) struct TrackTable<'a, W: Write + Send> {
    writer: ArrowWriter<W>,
    schema: SchemaRef,
    path: &'a Path,
}

impl<'a, W: Write + Send> TrackTable<'a, W> {
    /// `path` is for errors only.
    pub(crate) fn begin(out: W, path: &'a Path) -> Result<Self, DataError> {
        let mut fields = vec![
            Field::new("scenario_id", DataType::Utf8, false),
            Field::new("track_id", DataType::Int64, false),
            Field::new("class", DataType::Utf8, false),
            Field::new("is_ego", DataType::Boolean, false),
        ];
        let numbers = NUMBERS.iter();
        fields.extend(numbers.map(|(name, _)| Field::new(*name, DataType::Float64, false)));
        let schema = Arc::new(Schema::new(fields));
        let properties = WriterProperties::builder()
            .set_compression(Compression::ZSTD(ZstdLevel::default()))
            .build();
        let writer = ArrowWriter::try_new(out, Arc::clone(&schema), Some(properties));
        Ok(Self {
            writer: writer.map_err(|error| failed(error, path))?,
            schema,
            path,
        })
    }

    /// Adds the tracks of a scenario.
    pub(crate) fn write(&mut self, scenario: &Scenario) -> Result<(), DataError> {
        let mut tracks: BTreeMap<AgentId, Vec<(f64, &Agent)>> = BTreeMap::new();
        for (step, frame) in scenario.log.iter().enumerate() {
            for agent in frame.agents() {
                let time = step as f64 * scenario.dt;
                tracks.entry(agent.id).or_default().push((time, agent));
            }
        }
        let rows: Vec<(f64, &Agent)> = tracks.into_values().flatten().collect();
        let agents = || rows.iter().map(|(_, agent)| *agent);
        let ids = std::iter::repeat_n(scenario.id.as_str(), rows.len());
        let is_ego: Vec<bool> = agents().map(|agent| agent.id == scenario.ego).collect();
        let mut columns: Vec<ArrayRef> = vec![
            Arc::new(StringArray::from_iter_values(ids)),
            Arc::new(Int64Array::from_iter_values(agents().map(|a| a.id.0))),
            Arc::new(StringArray::from_iter_values(
                agents().map(|a| a.kind.name()),
            )),
            Arc::new(BooleanArray::from(is_ego)),
        ];
        for (_, of) in NUMBERS {
            let values = rows.iter().map(|(time, agent)| of(agent, *time));
            columns.push(Arc::new(Float64Array::from_iter_values(values)));
        }
        RecordBatch::try_new(Arc::clone(&self.schema), columns)
            .map_err(|error| failed(error, self.path))
            .and_then(|batch| {
                let written = self.writer.write(&batch);
                written.map_err(|error| failed(error, self.path))
            })
    }

    /// Writes what is left and the table's footer.
    pub(crate) fn finish(self) -> Result<(), DataError> {
        let closed = self.writer.close();
        closed.map(drop).map_err(|error| failed(error, self.path))
    }
}

fn failed(error: impl std::error::Error + Send + Sync + 'static, path: &Path) -> DataError {
    io_error("write the table", io::Error::other(error), path)
}
