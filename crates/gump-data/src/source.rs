//! The interface of formats to the rest of the crate: recognition of files, and access to their
//! scenarios.
//!
//! The list of formats is in `formats/registry.rs`.

use std::path::Path;

use crate::{DataError, ReadOptions, ScenarioRecord};

// ANCHOR: format
/// A format that is recognised by content.
pub(crate) struct Format {
    /// Its name in reports and errors.
    pub(crate) name: &'static str,
    /// True if content that starts with these (up to [`HEAD_BYTES`], uncompressed) bytes is of this
    /// format.
    pub(crate) recognises: fn(&[u8]) -> bool,
    /// Starts reading a file.
    pub(crate) open: fn(&Path, ReadOptions) -> Result<BoxedSource, DataError>,
}
// ANCHOR_END: format

/// A kind of file that contains no scenarios.
pub(crate) struct Companion {
    /// Its description in reports.
    pub(crate) what: &'static str,
    /// As [`Format::recognises`].
    pub(crate) recognises: fn(&[u8]) -> bool,
}

/// Bytes of the content that a recogniser gets: far more than the marks of any format need, and
/// quick to unpack.
pub(crate) const HEAD_BYTES: u64 = 64 << 10;

/// Access to the scenarios of a file.
pub(crate) type BoxedSource = Box<dyn RecordSource>;

// ANCHOR: source
/// The scenarios of one file, in order.
pub(crate) trait RecordSource: Send {
    /// The next scenario whose id is `wanted`; the others are skipped at lower cost. `wanted` is
    /// called exactly once per record whose id can be read. After an error the next call continues
    /// with the next record where that is possible; `None` is the end.
    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>>;

    /// Skips the next record, at lower cost than reading it where that is possible.
    fn skip(&mut self) -> Option<Result<(), DataError>> {
        let record = self.next_wanted(&mut |_| true)?;
        Some(record.map(drop))
    }
}
// ANCHOR_END: source
