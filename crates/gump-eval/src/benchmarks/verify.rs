//! Verifies scenes against the checksums of a list.

use std::path::{Path, PathBuf};

use gump_data::tfrecord::TfRecordReader;
use gump_data::womd::decode_scenario;

use super::{BenchmarkList, GeneratedPart, RecordedPart, RecordedScene, checksum};
use crate::{BenchmarkError, EvalError, Monitor, digest};

/// Verifies the file of a part below `folder` against the checksums of the list.
///
/// # Errors
/// A file that is missing, or the first scene that differs.
pub fn verify_generated(
    list: &BenchmarkList,
    part: &GeneratedPart,
    folder: &Path,
    monitor: &dyn Monitor,
) -> Result<(), EvalError> {
    let (path, list_path) = (list.file(folder, part), list.path().to_owned());
    if part.scenes.is_empty() {
        return Err(BenchmarkError::NoChecksums {
            part: part.file.clone(),
            list: list_path,
        }
        .into());
    }
    let found = checksums(&path, monitor)?;
    let differs = part.scenes.iter().zip(&found).position(|(a, b)| a != b);
    if let Some(k) = differs {
        return Err(BenchmarkError::SceneChecksum {
            part: part.file.as_str().into(),
            index: k,
            expected: part.scenes[k].as_str().into(),
            found: found[k].as_str().into(),
            list: list_path,
            path,
        }
        .into());
    }
    if found.len() != part.kept() || part.scenes.len() != part.kept() {
        return Err(BenchmarkError::SceneCount {
            expected: part.kept(),
            found: found.len(),
            list: list_path,
            path,
        }
        .into());
    }
    Ok(())
}

/// Checksum and id of every scene of a TFRecord file, as lists have them.
///
/// # Errors
/// A file that cannot be read.
pub fn checksums(path: &Path, monitor: &dyn Monitor) -> Result<Vec<String>, EvalError> {
    let sum = |payload: Result<gump_data::tfrecord::Payload, _>| {
        monitor.check()?;
        let payload = payload?;
        let message = decode_scenario(&payload.bytes).map_err(|problem| {
            let place = payload.place.clone();
            BenchmarkError::Unreadable { problem, place }
        })?;
        let id = message.scenario_id();
        Ok(format!("{} {id}", checksum(&message)))
    };
    TfRecordReader::open(path.to_owned())?.map(sum).collect()
}

/// The files of a part below the folder of recorded data, each once, verified against their
/// checksums.
///
/// # Errors
/// A file that is missing or differs.
pub fn verify_recorded(
    list: &BenchmarkList,
    part: &RecordedPart,
    data: &Path,
    monitor: &dyn Monitor,
) -> Result<Vec<PathBuf>, EvalError> {
    let mut files = Vec::new();
    for line in &part.scenes {
        monitor.check()?;
        let scene = RecordedScene::parse(line)?;
        let path = data.join(&part.folder).join(scene.file);
        if !path.is_file() {
            return Err(BenchmarkError::NotRecorded {
                scene: scene.id.unwrap_or(scene.file).into(),
                name: list.name.clone(),
                path,
            }
            .into());
        }
        let found = sha256(&path)?;
        if found != scene.sha256 {
            return Err(BenchmarkError::FileChecksum {
                expected: scene.sha256.into(),
                found: found.into(),
                list: list.path().to_owned(),
                path,
            }
            .into());
        }
        files.push(path);
    }
    Ok(files)
}

/// SHA-256 of a file, lower-case hexadecimal.
///
/// # Errors
/// A file that cannot be read.
pub fn sha256(path: &Path) -> Result<String, EvalError> {
    let bytes = std::fs::read(path).map_err(|cause| EvalError::io("read", path, cause))?;
    Ok(digest::of_bytes(&bytes))
}
