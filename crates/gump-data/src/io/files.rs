//! Lists of files: those of a folder and its subfolders, in a fixed order.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use super::stream::io_error;
use crate::error::{DataError, INCOMPLETE};

/// Every file that `open` would read: the file itself, or those of a directory and its
/// subdirectories in order of their paths. Files being written (`*.partial`) and hidden ones are
/// left out; links are followed, but into no directory twice.
///
/// # Errors
/// [`DataError::Missing`], [`DataError::Incomplete`] for a directory with a file [`INCOMPLETE`] in
/// it, and [`DataError::Io`] for one that cannot be listed.
pub fn list(path: &Path) -> Result<Vec<PathBuf>, DataError> {
    let files = list_unfinished(path)?;
    let mark = files.iter().find(|file| is_mark(file));
    match mark.and_then(|mark| mark.parent()) {
        Some(folder) if path.is_dir() => Err(DataError::Incomplete {
            path: folder.into(),
        }),
        _ => Ok(files),
    }
}

fn is_mark(file: &Path) -> bool {
    file.file_name().is_some_and(|name| name == INCOMPLETE)
}

/// As [`list`], but also in folders whose creation has not finished, for the code that creates
/// them. The mark is among the files.
///
/// # Errors
/// [`DataError::Missing`], and [`DataError::Io`] for a directory that cannot be listed.
pub fn list_unfinished(path: &Path) -> Result<Vec<PathBuf>, DataError> {
    if !path.exists() {
        return Err(DataError::Missing { path: path.into() });
    }
    if !path.is_dir() {
        return Ok(vec![path.into()]);
    }
    let (mut files, mut seen) = (Vec::new(), BTreeSet::new());
    let mut folders = vec![path.to_path_buf()];
    while let Some(folder) = folders.pop() {
        let real = fs::canonicalize(&folder).map_err(|e| io_error("list", e, &folder))?;
        if !seen.insert(real) {
            continue;
        }
        for entry in fs::read_dir(&folder).map_err(|e| io_error("list", e, &folder))? {
            let path = entry.map_err(|e| io_error("list", e, &folder))?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if name.starts_with('.') || name.ends_with(".partial") {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else {
                files.push(path);
            }
        }
    }
    files.sort();
    Ok(files)
}
