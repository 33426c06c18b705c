//! Files of futures given by path: one file, or all of a folder.

use std::path::{Path, PathBuf};

use crate::{ArgumentError, EvalError};

/// The file, or all files of a folder with `.binproto` in their names, sorted.
///
/// Error: a folder without such files, or one that cannot be listed.
pub fn files(path: &Path) -> Result<Vec<PathBuf>, EvalError> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries = std::fs::read_dir(path);
    let entries = entries.map_err(|cause| EvalError::io("list", path, cause))?;
    let mut files = Vec::new();
    for entry in entries {
        let file = entry
            .map_err(|cause| EvalError::io("list", path, cause))?
            .path();
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        if name.contains(".binproto") && !name.ends_with(".partial") && file.is_file() {
            files.push(file);
        }
    }
    if files.is_empty() {
        let folder = path.to_owned();
        return Err(ArgumentError::NoRolloutFiles { folder }.into());
    }
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_means_its_files_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let none = files(folder.path()).unwrap_err().to_string();
        assert!(none.contains("*.binproto*"), "{none}");
        for name in ["b.binproto.gz", "a.binproto", "c.txt", "d.binproto.partial"] {
            std::fs::write(folder.path().join(name), "x").unwrap();
        }
        let found = files(folder.path()).unwrap();
        let names: Vec<_> = found
            .iter()
            .map(|f| f.file_name().unwrap().to_str().unwrap())
            .collect();
        assert_eq!(names, ["a.binproto", "b.binproto.gz"]);
        let one = folder.path().join("c.txt");
        assert_eq!(files(&one).unwrap(), [one]);
    }
}
