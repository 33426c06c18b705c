//! Reads every scenario of a file with these bytes; what every target does.

use std::fs;

/// Writes the bytes to a file of this name and reads it to the end.
pub(crate) fn read(name: &str, bytes: &[u8]) {
    let folder = tempfile::tempdir().expect("there is a temporary folder");
    let path = folder.path().join(name);
    fs::write(&path, bytes).expect("the temporary folder is writable");
    if let Ok(reader) = gump_data::open(&path) {
        reader.for_each(|record| drop(record));
    }
}
