//! Writing so that a reader finds the old file or the new one, never half of one.

use std::ffi::OsString;
use std::fs;
use std::path::Path;

use crate::VizError;

/// Writes `bytes` beside `path` and renames the result onto it.
///
/// # Errors
/// [`VizError::Write`] with the path; nothing is left beside it.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), VizError> {
    write_beside(path, |beside| {
        fs::write(beside, bytes).map_err(|source| VizError::Write {
            source,
            path: path.to_path_buf(),
        })
    })
}

/// Lets `write` fill a file beside `path` and renames it onto it.
///
/// # Errors
/// Those of `write`, [`VizError::Write`] with the path; nothing is left beside it.
pub(crate) fn write_beside(
    path: &Path,
    write: impl FnOnce(&Path) -> Result<(), VizError>,
) -> Result<(), VizError> {
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}.part", std::process::id()));
    let beside = path.with_file_name(name);
    let renamed = write(&beside).and_then(|()| {
        fs::rename(&beside, path).map_err(|source| VizError::Write {
            source,
            path: path.to_path_buf(),
        })
    });
    if renamed.is_err() {
        // The first error is the one to report; there may be nothing to remove.
        let _ = fs::remove_file(&beside);
    }
    renamed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_nothing_behind() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page.html");
        write_whole(&path, b"old").unwrap();
        write_whole(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);

        // A folder cannot be replaced by a file.
        fs::create_dir(folder.path().join("taken")).unwrap();
        let error = write_whole(&folder.path().join("taken"), b"x").unwrap_err();
        assert!(error.to_string().ends_with("taken"));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }
}
