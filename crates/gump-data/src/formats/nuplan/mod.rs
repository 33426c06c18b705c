//! nuPlan: logs in SQLite, maps in GeoPackage, scenarios by query.
//!
//! A log of gigabytes is never loaded: [`Log`] queries the rows it needs. A scenario is the 15 s
//! around a tagged event, at 10 Hz, with 2.2 s of history. Like any format, [`crate::open`] reads
//! it as [`gump_scene::Scenario`]; a simulation in nuPlan's sense needs [`NuplanScenario`], which
//! keeps exact times, the ego at its rear axle and the expert's future.
//!
//! ```no_run
//! use std::path::Path;
//! use std::sync::Arc;
//! use gump_data::nuplan::{Extraction, Log, Maps, NuplanScenario, Split};
//!
//! let mut maps = Maps::default();
//! let logs = vec![Log::open(Path::new("2021.06.09.17.23.18_veh-38_00773_01140.db"))?];
//! for selected in Split::Val14.filter().select(&logs)? {
//!     let log = &logs[selected.log];
//!     let map = Arc::clone(&maps.of(log)?.graph);
//!     let extraction = Extraction::default();
//!     let kind = &selected.scenario_type;
//!     let scenario = NuplanScenario::read(log, &selected.event, kind, &map, &extraction)?;
//!     println!("{}: {} iterations", scenario.token, scenario.iterations.len());
//! }
//! # Ok::<(), gump_data::DataError>(())
//! ```
//!
//! # Terms
//! * **row**: one sweep of the merged lidar, every 50 ms. **Event**: a row that is tagged.
//! * **iteration**: a frame of the simulation, every second row; iteration 0 lies 3 s before the
//!   event that names the scenario.
//! * **connector**: a lane or roadblock inside an intersection.

mod database;
mod filter;
mod geopackage;
mod log;
mod map;
mod maps;
mod route;
mod scenario;
mod token;
mod utm;
mod wkb;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::source::{BoxedSource, Companion, Format, RecordSource};
use crate::{DataError, ReadOptions, ReadReport, RecordLocation, ScenarioRecord};

pub use filter::{CHALLENGE_TYPES, ParseSplitError, ScenarioFilter, Selected, Split};
pub use log::{Census, Event, Log, LogBox, LogRow};
pub use map::{CityMap, read_map};
pub use maps::{MAPS_VARIABLE, Maps, find_map};
pub use scenario::{DT, EGO, Extraction, LogFrame, NuplanScenario};
pub use token::{ParseTokenError, Token};
pub use utm::Utm;

pub(crate) const FORMAT: Format = Format {
    name: "nuPlan log (SQLite)",
    recognises: |head| head.starts_with(database::MAGIC) && !is_geopackage(head) && !is_other(head),
    open,
};

/// Databases of other programs.
pub(crate) const OTHER: Companion = Companion {
    what: "other SQLite database",
    recognises: |head| head.starts_with(database::MAGIC) && !is_geopackage(head) && is_other(head),
};

/// Maps, which are read along with the logs of their location.
pub(crate) const MAP: Companion = Companion {
    what: "nuPlan map (GeoPackage)",
    recognises: |head| head.starts_with(database::MAGIC) && is_geopackage(head),
};

/// True for a GeoPackage: by the id in its header, or by the table of contents in its schema.
fn is_geopackage(head: &[u8]) -> bool {
    const ID: std::ops::Range<usize> = 68..72;
    const TABLE: &[u8] = b"gpkg_contents";
    let id = head.get(ID);
    id.is_some_and(|id| matches!(id, b"GPKG" | b"GP10" | b"GP11"))
        || head.windows(TABLE.len()).any(|window| window == TABLE)
}

/// True for a schema without any of a log's tables. A log that lacks one of them is still a log,
/// and so is a file whose schema cannot be seen: reading it reports what is wrong.
fn is_other(head: &[u8]) -> bool {
    let has = |name: &str| {
        head.windows(name.len())
            .any(|window| window.eq_ignore_ascii_case(name.as_bytes()))
    };
    has("CREATE TABLE")
        && !["lidar_pc", "ego_pose", "scenario_tag"]
            .into_iter()
            .any(has)
}

fn open(path: &Path, options: ReadOptions) -> Result<BoxedSource, DataError> {
    let log = Log::open(path)?;
    let filter = ScenarioFilter::default();
    let events = log.events(filter.untagged)?;
    if events.is_empty() {
        return Err(DataError::NoScenarios {
            expected: "a tagged row that a scenario can be taken from",
            found: filter.explain(&log.census()?),
            path: path.into(),
        });
    }
    let map = Maps::default().of(&log)?;
    Ok(Box::new(Scenarios {
        log,
        map_report: Some(map.report.clone()),
        map,
        events: events.into_iter().enumerate(),
        options,
        path: Arc::new(path.into()),
    }))
}

struct Scenarios {
    log: Log,
    map: Arc<CityMap>,
    /// The report of reading the map, until the first scenario takes it along.
    map_report: Option<ReadReport>,
    events: std::iter::Enumerate<std::vec::IntoIter<Event>>,
    options: ReadOptions,
    path: Arc<PathBuf>,
}

impl Scenarios {
    fn read(&mut self, record: usize, event: &Event) -> Result<ScenarioRecord, DataError> {
        let (kind, extraction) = (event.scenario_type(None), Extraction::default());
        let read = NuplanScenario::read(&self.log, event, kind, &self.map.graph, &extraction)?;
        let converted = read.to_scenario(self.options);
        let (scenario, mut report) = converted.map_err(|problem| DataError::Scenario {
            id: event.token.to_string(),
            problem,
            place: RecordLocation {
                record,
                offset: 0,
                path: self.path.to_path_buf(),
            },
        })?;
        if let Some(of_map) = self.map_report.take() {
            report.merge(&of_map);
        }
        Ok(ScenarioRecord {
            scenario,
            report,
            offset: 0,
            path: Arc::clone(&self.path),
        })
    }
}

impl RecordSource for Scenarios {
    fn skip(&mut self) -> Option<Result<(), DataError>> {
        self.events.next().map(|_| Ok(()))
    }

    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>> {
        loop {
            let (record, event) = self.events.next()?;
            if wanted(&event.token.to_string()) {
                return Some(self.read(record, &event));
            }
        }
    }
}
