//! One scenario as JSON, for your own data: the layout of ScenarioNet's scenario descriptions.
//!
//! In Python such a description can be written with `json.dump` (arrays as lists).
//! `schema/scenario.schema.json` beside this crate's sources defines the layout; what it lacks is
//! inferred as for every format. [`write_scenario`] is the inverse of the reader.

mod map;
mod names;
mod read;
mod write;

use crate::formats::document;
use crate::io::json;
use crate::source::Format;

pub(crate) use read::File;
pub use write::write_scenario;

/// The name that the key `format` has.
const NAME: &str = "gump-scenario";
/// The layout's version.
const VERSION: i64 = 1;

pub(crate) const FORMAT: Format = Format {
    name: "scenario JSON (plain or gzip)",
    recognises,
    open: document::open::<File>,
};

fn recognises(head: &[u8]) -> bool {
    let keys = json::keys(head);
    let any = |names: &[&str]| keys.iter().any(|key| names.contains(&key.as_str()));
    any(&["tracks", "map_features", "dynamic_map_states"])
        || any(&["format"]) && String::from_utf8_lossy(&head[..head.len().min(4096)]).contains(NAME)
}
