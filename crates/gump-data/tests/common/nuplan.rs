//! nuPlan's made-up log and map, unpacked into a folder that tests may damage.

#![allow(dead_code, reason = "each test file uses a part of this")]
#![allow(clippy::unwrap_used, reason = "a test that cannot find its data fails")]

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

pub(crate) const DATA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/nuplan");

pub(crate) fn unpacked(name: &str) -> Vec<u8> {
    let packed = fs::File::open(Path::new(DATA).join(format!("{name}.gz"))).unwrap();
    let mut bytes = Vec::new();
    flate2::read::GzDecoder::new(packed)
        .read_to_end(&mut bytes)
        .unwrap();
    bytes
}

/// A folder with the log and its map beside it.
pub(crate) struct Folder(pub(crate) tempfile::TempDir);

impl Folder {
    pub(crate) fn new() -> Self {
        let folder = Self(tempfile::tempdir().unwrap());
        fs::write(folder.log(), unpacked("log.db")).unwrap();
        fs::write(folder.map(), unpacked("map.gpkg")).unwrap();
        folder
    }

    pub(crate) fn log(&self) -> PathBuf {
        self.0.path().join("log.db")
    }

    pub(crate) fn map(&self) -> PathBuf {
        self.0.path().join("map.gpkg")
    }

    /// Changes the log or the map as the test wants.
    pub(crate) fn execute(path: &Path, sql: &str) {
        let connection = rusqlite::Connection::open(path).unwrap();
        connection.execute_batch(sql).unwrap();
    }
}
