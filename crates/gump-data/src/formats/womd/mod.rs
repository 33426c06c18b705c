//! Waymo Open Motion Dataset: `Scenario` messages in TFRecord files.

mod map;
mod read;
mod write;
mod write_map;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use prost::Message;

use crate::io::stream::Stream;
use crate::io::tfrecord::{self, TfRecordReader};
use crate::source::{BoxedSource, Format, RecordSource};
use crate::{DataError, Problem, ReadOptions, ScenarioRecord};

pub use read::scenario_from_proto;
pub use write::{scenario_to_proto, write_scenarios};

pub(crate) const FORMAT: Format = Format {
    name: "Waymo Open Motion Dataset (TFRecord, plain or gzip)",
    recognises: tfrecord::is_tfrecord,
    open,
};

fn open(path: &Path, options: ReadOptions) -> Result<BoxedSource, DataError> {
    let records = TfRecordReader::open(path.to_path_buf())?;
    Ok(Box::new(Scenarios {
        records,
        options,
        path: Arc::new(path.to_path_buf()),
    }))
}

/// The scenarios of an opened stream.
pub(crate) fn records(content: Stream, path: &Path, options: ReadOptions) -> impl RecordSource {
    Scenarios {
        records: TfRecordReader::of(content, path.to_path_buf()),
        options,
        path: Arc::new(path.to_path_buf()),
    }
}

/// Decodes the bytes of a `Scenario` message, for callers that need more of it than
/// [`scenario_from_proto`] keeps.
///
/// # Errors
/// [`Problem::Message`].
pub fn decode_scenario(bytes: &[u8]) -> Result<gump_proto::Scenario, Problem> {
    gump_proto::Scenario::decode(bytes).map_err(|source| Problem::Message {
        message: "waymo.open_dataset.Scenario",
        source,
    })
}

struct Scenarios {
    records: TfRecordReader,
    options: ReadOptions,
    path: Arc<PathBuf>,
}

impl RecordSource for Scenarios {
    fn skip(&mut self) -> Option<Result<(), DataError>> {
        self.records.skip_record()
    }

    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>> {
        loop {
            let payload = match self.records.next()? {
                Ok(payload) => payload,
                Err(error) => return Some(Err(error)),
            };
            let place = payload.place;
            let proto = match gump_proto::Scenario::decode(payload.bytes.as_slice()) {
                Ok(proto) => proto,
                Err(source) => {
                    let message = "waymo.open_dataset.Scenario";
                    return Some(Err(DataError::Proto {
                        message,
                        source,
                        place,
                    }));
                }
            };
            if !wanted(proto.scenario_id()) {
                continue;
            }
            let offset = place.offset;
            return Some(match scenario_from_proto(&proto, self.options) {
                Ok((scenario, report)) => Ok(ScenarioRecord {
                    scenario,
                    report,
                    offset,
                    path: Arc::clone(&self.path),
                }),
                Err(problem) => Err(DataError::Scenario {
                    id: proto.scenario_id().into(),
                    problem,
                    place,
                }),
            });
        }
    }
}
