//! What a format is to the rest of the crate: how its files are recognised, and how they hand over
//! their scenarios.
//!
//! Which formats there are stands in `formats/registry.rs`.

use std::path::Path;

use crate::{DataError, ReadOptions, ScenarioRecord};

// ANCHOR: format
/// A format that content can be recognised as.
pub(crate) struct Format {
    /// Its name in reports and errors.
    pub(crate) name: &'static str,
    /// True if content that starts with these (up to [`HEAD_BYTES`], uncompressed) bytes is of
    /// this format.
    pub(crate) recognises: fn(&[u8]) -> bool,
    /// Starts reading a file.
    pub(crate) open: fn(&Path, ReadOptions) -> Result<BoxedSource, DataError>,
}
// ANCHOR_END: format

/// A kind of file without scenarios of its own.
pub(crate) struct Companion {
    /// What it is, in reports.
    pub(crate) what: &'static str,
    /// As [`Format::recognises`].
    pub(crate) recognises: fn(&[u8]) -> bool,
}

/// How much of the content a recogniser sees.
pub(crate) const HEAD_BYTES: u64 = 64 << 10;

/// How a format hands over its scenarios.
pub(crate) type BoxedSource = Box<dyn Source>;

// ANCHOR: source
/// The scenarios of one file, in order.
pub(crate) trait Source: Send {
    /// The next scenario whose id is `wanted`; the others are skipped at less cost. `wanted` is
    /// asked exactly once per record whose id can be read. After an error the next call goes on
    /// with the next record where that is possible; `None` is the end.
    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>>;

    /// Passes over the next record, at less cost than reading it where that is possible.
    fn skip(&mut self) -> Option<Result<(), DataError>> {
        let record = self.next_wanted(&mut |_| true)?;
        Some(record.map(drop))
    }
}
// ANCHOR_END: source
