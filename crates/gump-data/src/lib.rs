//! Readers and writers of dataset formats; every reader yields a
//! [`Scenario`](gump_scene::Scenario).
//!
//! This is the only crate that knows file layouts. Values that a format states are kept. What it
//! lacks (lane widths, drivable surfaces, the ego's route) is inferred by one set of rules for all
//! formats, counted in a [`ReadReport`] and controlled by [`ReadOptions`]. The crate does not
//! simulate, score or draw.
//!
//! Start with [`open`], which detects the format of a file from its content, or [`find`], which
//! reads one scenario by a name like `FILE#3` or `FILE#637f20cafde22ff8`.
//!
//! ```
//! use gump_data::{find, open, womd};
//!
//! let text = "lane 1: 0,0 200,0\nego vehicle 0: 10,0 velocity 8,0";
//! let scenario = gump_scene::fixture::scenario(text)?;
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("one.tfrecord");
//! womd::write_scenarios(&path, [&scenario])?;
//! for record in open(&path)? {
//!     let record = record?;
//!     println!("{}: {:?}", record.scenario.id, record.report.inferred);
//! }
//! assert_eq!(find(&format!("{}#fixture", path.display()))?.log.len(), 91);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Terms
//! * **record**: one scenario's bytes in a file; **place**: which record, at which byte.
//! * **stated**: given by the format. **Inferred**: added by a reader. **Dropped**: left out by a
//!   reader because [`Scenario`](gump_scene::Scenario) cannot represent it or it is unusable.
//!
//! A new format is one file beside `womd` in `formats` and one line in the table of
//! `formats/registry.rs`.
//!
//! # Features
//! All are on by default. Without any of them the crate reads Waymo's and GPUDrive's files,
//! Scenario-JSON and the cache, and compiles neither SQLite nor Parquet nor an XML reader.
//! `argoverse2`, `commonroad`, `nuplan`, `sumo` and `taf-bw` add the formats of these names;
//! `parquet` adds writing tables and reading rollouts from them.
#![cfg_attr(
    not(all(
        feature = "argoverse2",
        feature = "commonroad",
        feature = "nuplan",
        feature = "sumo",
        feature = "taf-bw"
    )),
    allow(dead_code, reason = "what formats share is not used by each")
)]

mod complete;
mod convert;
mod error;
mod formats;
mod inspect;
mod io;
mod open;
mod parse;
mod record;
#[cfg(feature = "parquet")]
mod rollouts;
mod source;
pub mod submission;
#[cfg(feature = "parquet")]
mod tracks;
mod verify;

pub use convert::{Converted, OutputFormat, convert, groups};
pub use error::{DataError, INCOMPLETE, Problem, RecordLocation};
#[cfg(feature = "nuplan")]
pub use formats::nuplan;
#[cfg(feature = "sumo")]
pub use formats::sumo;
pub use formats::{cache, scenario_json, womd};
pub use inspect::{Summary, inspect, inspect_with};
pub use io::files::{list as list_files, list_unfinished};
#[cfg(feature = "parquet")]
pub use io::table::Table;
pub use io::tfrecord;
pub use io::write_atomically::write_atomically;
pub use open::{Reader, find, find_map, find_record, open, open_files, open_with};
pub use parse::{parse, parse_json};
pub use record::{MAX_NOTES, Note, ReadOptions, ReadReport, ScenarioRecord};
#[cfg(feature = "parquet")]
pub use rollouts::write_rollouts;
#[cfg(feature = "parquet")]
pub use tracks::write_tracks;
pub use verify::{
    Finding, FormatCounts, MAX_FINDINGS, Severity, Verification, verify, verify_one_of_many,
};
