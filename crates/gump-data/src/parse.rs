//! Reading of one scenario from bytes, where there are no files: in a browser, or from a message.
//!
//! Supports formats that are one document or a stream of records, not those that need several
//! files.

use std::io::{BufRead as _, Read as _};
use std::path::Path;

use gump_scene::Scenario;
use serde::de::DeserializeOwned;

use crate::formats::document::Document;
use crate::formats::{gpudrive, scenario_json, womd};
use crate::io::json::{self, MAX_BYTES};
use crate::io::{stream, tfrecord};
use crate::source::RecordSource as _;
use crate::{DataError, ReadOptions, ReadReport, RecordLocation};

/// Number of bytes from the start that distinguish the formats, as for files.
const HEAD_BYTES: usize = 64 << 10;

/// Reads the first scenario of a file's bytes: Waymo's TFRecord, Scenario-JSON or GPUDrive's JSON,
/// detected from content, plain or gzip. Gaps are filled with [`ReadOptions::ALL`].
///
/// `name` replaces the path in errors, and is the id of a scenario without one.
///
/// # Errors
/// As for [`open`](crate::open) and reading the first record.
pub fn parse(bytes: &[u8], name: &str) -> Result<Scenario, DataError> {
    let path = Path::new(name);
    let mut content = stream::of_bytes(bytes, path)?;
    let head = content
        .fill_buf()
        .map_err(|source| stream::io_error("unpack", source, path))?;
    if !tfrecord::is_tfrecord(head) {
        return parse_json(bytes, name);
    }
    let mut records = womd::records(content, path, ReadOptions::ALL);
    let first = records.next_wanted(&mut |_| true);
    let first = first.ok_or_else(|| DataError::Empty { path: path.into() })?;
    Ok(first?.scenario)
}

/// Reads a scenario of a JSON document's bytes, Scenario-JSON or GPUDrive's, plain or gzip; see
/// [`parse`].
///
/// # Errors
/// [`DataError::UnknownFormat`] for a document of another kind, and those of reading a file.
pub fn parse_json(bytes: &[u8], name: &str) -> Result<Scenario, DataError> {
    let path = Path::new(name);
    let mut content = Vec::new();
    stream::of_bytes(bytes, path)?
        .take(MAX_BYTES + 1)
        .read_to_end(&mut content)
        .map_err(|source| stream::io_error("unpack", source, path))?;
    if content.len() as u64 > MAX_BYTES {
        return Err(DataError::TooLarge {
            what: "a scenario as JSON",
            limit: MAX_BYTES,
            path: path.into(),
        });
    }
    let head = &content[..content.len().min(HEAD_BYTES)];
    if (scenario_json::FORMAT.recognises)(head) {
        document::<scenario_json::File>(&content, path)
    } else if (gpudrive::FORMAT.recognises)(head) {
        document::<gpudrive::File>(&content, path)
    } else {
        let start = String::from_utf8_lossy(&head[..head.len().min(16)]);
        Err(DataError::UnknownFormat {
            expected: "a scenario: Waymo's TFRecord, scenario JSON or GPUDrive's JSON".into(),
            found: format!("{start:?}"),
            path: path.into(),
        })
    }
}

fn document<D: Document + DeserializeOwned>(
    content: &[u8],
    path: &Path,
) -> Result<Scenario, DataError> {
    let document: D = json::parse(content, D::WHAT, path)?;
    let id = document.id(path);
    let mut report = ReadReport::default();
    let scenario = document.scenario(id.clone(), ReadOptions::ALL, &mut report);
    scenario.map_err(|problem| DataError::Scenario {
        id,
        problem,
        place: RecordLocation {
            record: 0,
            offset: 0,
            path: path.into(),
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scenario() -> Scenario {
        let text = "lane 1: 0,0 200,0\nego vehicle 0: 10,0 velocity 8,0";
        gump_scene::fixture::scenario(text).unwrap()
    }

    const GPUDRIVE: &str = r#"{
        "name": "a",
        "objects": [{"position": [{"x": 1, "y": 0}, {"x": 2, "y": 0}],
            "heading": [0, 0], "velocity": [{"x": 5, "y": 0}, {"x": 5, "y": 0}],
            "valid": [true, true], "length": 4, "width": 2, "type": "vehicle"}],
        "roads": [{"type": "lane", "geometry": [{"x": 0, "y": 0}, {"x": 90, "y": 0}]}],
        "tl_states": {}
    }"#;

    #[test]
    fn what_is_written_to_a_file_is_read_from_its_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let of = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
        let scenario = scenario();
        scenario_json::write_scenario(&folder.path().join("a.json"), &scenario).unwrap();
        womd::write_scenarios(&folder.path().join("a.tfrecord"), [&scenario]).unwrap();
        womd::write_scenarios(&folder.path().join("b.tfrecord.gz"), [&scenario]).unwrap();
        for name in ["a.json", "a.tfrecord", "b.tfrecord.gz"] {
            let read = parse(&of(name), name).unwrap();
            assert_eq!(read.log.len(), scenario.log.len(), "{name}");
            assert_eq!((read.ego, read.now), (scenario.ego, scenario.now), "{name}");
        }
        assert_eq!(parse_json(&of("a.json"), "a").unwrap().id, scenario.id);
    }

    #[test]
    fn gpudrives_documents_are_told_by_their_keys() {
        let read = parse(GPUDRIVE.as_bytes(), "dropped.json").unwrap();
        assert_eq!((read.id.as_str(), read.log.len()), ("a", 2));
    }

    #[test]
    fn bytes_that_are_no_scenario_are_told_with_their_name() {
        let check = |bytes: &[u8], expected: &str| {
            let error = parse(bytes, "dropped").unwrap_err().to_string();
            assert!(
                error.contains(expected) && error.contains("dropped"),
                "{error}"
            );
        };
        check(b"", "empty file");
        check(b"hello", "expected a scenario");
        check(br#"{"objects": 3, "roads": []}"#, "line 1 column");
        check(&[0x1f, 0x8b, 0, 1, 2, 3], "unpack");
    }
}
