//! Every way in which a file can be wrong is an error with a sentence, never a panic.

mod common;

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use gump_data::tfrecord::{MAX_RECORD_BYTES, masked_crc, write_record};
use gump_data::womd::{scenario_from_proto, scenario_to_proto};
use gump_data::{DataError, Problem, ReadOptions, open};
use gump_proto::{self as proto, FeatureData};
use prost::Message;
use tempfile::TempDir;

fn message() -> proto::Scenario {
    let written = scenario_to_proto(&common::crossing()).map(|(message, _)| message);
    written.expect("the fixture fits Waymo's message")
}

fn bytes_of(messages: &[proto::Scenario]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for message in messages {
        write_record(&mut bytes, &message.encode_to_vec()).expect("memory takes all bytes");
    }
    bytes
}

fn file(folder: &TempDir, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join("some.tfrecord");
    fs::write(&path, bytes).expect("the temporary folder is writable");
    path
}

/// The first error of a file with these bytes.
fn error_of(bytes: &[u8]) -> DataError {
    let folder = TempDir::new().expect("there is a temporary folder");
    let path = file(&folder, bytes);
    let first_error = match open(&path) {
        Err(error) => Some(error),
        Ok(reader) => reader.filter_map(Result::err).next(),
    };
    let error = first_error.expect("the file is broken");
    let text = error.to_string();
    assert!(text.ends_with("some.tfrecord"), "no path last: {text}");
    error
}

/// The problem of the fixture after `damage`.
fn problem_of(damage: impl FnOnce(&mut proto::Scenario)) -> Problem {
    let mut message = message();
    damage(&mut message);
    match error_of(&bytes_of(&[message])) {
        DataError::Scenario { problem, .. } => problem,
        other => panic!("expected a problem of the scenario, found {other}"),
    }
}

#[test]
fn a_missing_file() {
    let error = open(Path::new("no/such.tfrecord")).err().unwrap();
    assert!(matches!(error, DataError::Missing { .. }));
    let text = "expected a file or directory, found none: no/such.tfrecord";
    assert_eq!(error.to_string(), text);
}

#[test]
fn an_empty_file() {
    assert!(matches!(error_of(b""), DataError::Empty { .. }));
}

#[test]
fn an_empty_directory() {
    let folder = TempDir::new().unwrap();
    let error = open(folder.path()).err().unwrap();
    assert!(matches!(error, DataError::NoFiles { .. }));
}

#[test]
fn not_a_tfrecord() {
    let error = error_of(b"{\"agents\": []}");
    assert!(matches!(error, DataError::UnknownFormat { .. }));
    assert!(
        error
            .to_string()
            .contains("found a file that starts with {"),
        "{error}"
    );
}

#[test]
fn a_truncated_record() {
    let bytes = bytes_of(&[message(), message()]);
    let first = bytes.len() / 2;
    for cut in [first + 5, first + 12, first + 1000, bytes.len() - 1] {
        let error = error_of(&bytes[..cut]);
        let DataError::Truncated {
            place,
            expected,
            found,
            ..
        } = error
        else {
            panic!("expected a truncated record, found {error}");
        };
        assert_eq!((place.record, place.offset), (1, first as u64));
        assert!(found < expected);
    }
}

#[test]
fn a_truncated_gzip_file() {
    let mut packer = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packer.write_all(&bytes_of(&[message()])).unwrap();
    let packed = packer.finish().unwrap();
    let error = error_of(&packed[..packed.len() / 2]);
    assert!(matches!(error, DataError::Io { .. }), "{error}");
    assert!(matches!(error_of(&packed[..15]), DataError::Io { .. }));
}

#[test]
fn a_wrong_checksum_names_the_record_and_spares_the_next() {
    let mut bytes = bytes_of(&[message(), message()]);
    bytes[500] ^= 1;
    let error = error_of(&bytes);
    assert!(matches!(
        &error,
        DataError::Checksum { part: "the payload", place, .. } if place.record == 0
    ));
    let folder = TempDir::new().unwrap();
    let reader = open(&file(&folder, &bytes)).unwrap();
    assert_eq!(reader.map(|r| r.is_ok()).collect::<Vec<_>>(), [false, true]);
}

#[test]
fn an_absurd_length_is_refused_before_memory_is_taken() {
    let header = |length: u64| {
        let length = length.to_le_bytes();
        [&length[..], &masked_crc(&length).to_le_bytes()].concat()
    };
    let error = error_of(&header(1 << 60));
    assert!(matches!(error, DataError::TooLong { length, .. } if length == 1 << 60));
    // Within the limit but beyond the file: only what is there is read.
    let error = error_of(&[header(MAX_RECORD_BYTES), vec![0; 10]].concat());
    assert!(matches!(error, DataError::Truncated { found: 10, .. }));
}

#[test]
fn a_record_that_is_no_message() {
    let mut bytes = Vec::new();
    write_record(&mut bytes, b"\x0a\xff\xff\xff\xff").unwrap();
    assert!(matches!(error_of(&bytes), DataError::Proto { .. }));
}

#[test]
fn a_scenario_without_a_map() {
    assert_eq!(problem_of(|m| m.map_features.clear()), Problem::NoMap);
}

#[test]
fn a_scenario_without_an_ego() {
    assert_eq!(problem_of(|m| m.sdc_track_index = None), Problem::NoEgo);
    let problem = problem_of(|m| m.sdc_track_index = Some(99));
    assert_eq!(
        problem.to_string(),
        "expected the index of the ego's track below 5, found 99"
    );
    let problem = problem_of(|m| {
        let ego = m.sdc_track_index() as usize;
        let now = m.current_time_index() as usize;
        m.tracks[ego].states[now].valid = Some(false);
    });
    let text = "the ego (agent 10) is absent in the present frame";
    assert_eq!(problem.to_string(), text);
}

#[test]
fn states_that_are_not_numbers() {
    let problem = problem_of(|m| m.tracks[1].states[20].center_y = Some(f64::NAN));
    assert!(matches!(
        problem,
        Problem::State {
            track: 7,
            step: 20,
            field: "center_y",
            ..
        }
    ));
    let problem = problem_of(|m| m.tracks[0].states[3].velocity_x = Some(f32::INFINITY));
    assert!(matches!(
        problem,
        Problem::State {
            track: 3,
            step: 3,
            field: "velocity_x",
            ..
        }
    ));
    let problem = problem_of(|m| m.tracks[0].states[3].center_x = Some(1e200));
    assert!(matches!(problem, Problem::State { .. }));
    // An invalid state may hold anything.
    let mut message = message();
    message.tracks[1].states[20] = proto::ObjectState {
        center_x: Some(f64::NAN),
        valid: Some(false),
        ..proto::ObjectState::default()
    };
    assert!(scenario_from_proto(&message, ReadOptions::ALL).is_ok());
}

#[test]
fn map_points_that_are_not_numbers() {
    let problem = problem_of(|m| {
        for feature in &mut m.map_features {
            if let Some(FeatureData::Lane(lane)) = &mut feature.feature_data {
                lane.polyline[1].x = Some(f64::NAN);
            }
        }
    });
    assert!(matches!(
        problem,
        Problem::MapPoint {
            feature: 1,
            point: 1,
            ..
        }
    ));
}

#[test]
fn no_agents() {
    assert_eq!(problem_of(|m| m.tracks.clear()), Problem::NoAgents);
}

#[test]
fn five_hundred_agents_are_fine() {
    let mut message = message();
    for id in 1000..1500 {
        let mut track = message.tracks[0].clone();
        track.id = Some(id);
        message.tracks.push(track);
    }
    let (scenario, _) = scenario_from_proto(&message, ReadOptions::ALL).unwrap();
    assert_eq!(scenario.present().now().agents().len(), 505);
}

#[test]
fn tracks_of_the_wrong_length_and_doubled_tracks() {
    let problem = problem_of(|m| m.tracks[2].states.truncate(90));
    let expected = Problem::StateCount {
        track: 8,
        expected: 91,
        found: 90,
    };
    assert_eq!(problem, expected);
    let problem = problem_of(|m| m.tracks[2].id = m.tracks[0].id);
    assert_eq!(problem, Problem::DuplicateTrack(3));
}

#[test]
fn lights_for_the_wrong_number_of_steps() {
    let problem = problem_of(|m| m.dynamic_map_states.truncate(7));
    assert!(matches!(
        problem,
        Problem::LightCount {
            expected: 91,
            found: 7
        }
    ));
}

#[test]
fn doubled_lanes() {
    let problem = problem_of(|m| m.map_features[1].id = m.map_features[0].id);
    assert_eq!(problem.to_string(), "lane id 1 occurs twice");
}

#[test]
fn a_target_without_a_track() {
    let problem = problem_of(|m| m.tracks_to_predict[0].track_index = Some(-1));
    assert!(matches!(problem, Problem::Index { index: -1, .. }));
}

#[test]
fn a_lost_step() {
    let problem = problem_of(|m| {
        m.timestamps_seconds[50..]
            .iter_mut()
            .for_each(|t| *t += 0.1);
    });
    assert!(
        matches!(problem, Problem::TimeStep { step: 50, .. }),
        "{problem}"
    );
    let problem = problem_of(|m| m.timestamps_seconds[0] = f64::NAN);
    assert!(matches!(problem, Problem::TimeStep { .. }));
}

#[test]
fn a_box_without_extent() {
    let problem = problem_of(|m| m.tracks[0].states[4].length = Some(0.0));
    assert!(
        problem
            .to_string()
            .contains("has size 0 x 2.25 m in frame 4"),
        "{problem}"
    );
}

#[test]
fn a_flipped_bit_anywhere_in_a_file_is_noticed() {
    let bytes = bytes_of(&[message()]);
    let folder = TempDir::new().unwrap();
    for position in (0..bytes.len()).step_by(61) {
        let mut damaged = bytes.clone();
        damaged[position] ^= 1 << (position % 8);
        let path = file(&folder, &damaged);
        let first = open(&path).and_then(|mut reader| reader.next().transpose());
        assert!(first.is_err(), "bit flip at byte {position} went unnoticed");
    }
}

#[test]
fn damage_behind_a_good_checksum_never_panics() {
    let bytes = message().encode_to_vec();
    let (mut read, mut refused) = (0, 0);
    for position in (0..bytes.len()).step_by(23) {
        for value in [0x00, 0xff, bytes[position] ^ 0x80] {
            let mut damaged = bytes.clone();
            damaged[position] = value;
            let decoded = proto::Scenario::decode(damaged.as_slice());
            let scenario = decoded.map(|m| scenario_from_proto(&m, ReadOptions::ALL));
            match scenario {
                Ok(Ok(_)) => read += 1,
                _ => refused += 1,
            }
        }
    }
    // Both happen: the damage reaches values as well as structure.
    assert!(
        read > 100 && refused > 100,
        "{read} read, {refused} refused"
    );
}
