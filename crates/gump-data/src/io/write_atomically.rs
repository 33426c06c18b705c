//! Atomic writing of files.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;

use super::stream::io_error;
use crate::DataError;

/// Writes a file as `NAME.partial` beside `path` and renames it once it is complete.
///
/// Missing directories are created. If `write` fails, the partial file is removed and an existing
/// file at `path` is kept.
///
/// # Errors
/// Errors of `write`, and [`DataError::Io`] for the file itself.
pub fn write_atomically<T, E: From<DataError>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<T, E>,
) -> Result<T, E> {
    let mut name = path.file_name().map(OsString::from).unwrap_or_default();
    name.push(".partial");
    let partial = path.with_file_name(name);
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(|e| io_error("create the folder of", e, path))?;
    }
    let file = File::create(&partial).map_err(|e| io_error("create", e, &partial))?;
    let mut buffered = BufWriter::new(file);
    let finished = write(&mut buffered).and_then(|value| {
        buffered
            .flush()
            .and_then(|()| buffered.get_ref().sync_all())
            .map_err(|e| io_error("write", e, &partial))?;
        fs::rename(&partial, path).map_err(|e| io_error("rename", e, &partial))?;
        Ok(value)
    });
    if finished.is_err() {
        // The first error is the one to report; a leftover `.partial` is harmless.
        let _ = fs::remove_file(&partial);
    }
    finished
}
