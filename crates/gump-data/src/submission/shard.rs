//! A shard of a sim agents submission, read and written one scenario at a time.
//!
//! A shard may have gigabytes, so it is never decoded as a whole: its scenarios are fields of one
//! message, which can be read and written one after another.

use std::io::{self, BufRead, Read, Write};
use std::path::PathBuf;

use prost::Message;

use crate::io::stream::io_error;
use crate::io::tfrecord::MAX_RECORD_BYTES;
use crate::{DataError, RecordLocation};
use gump_proto::{ScenarioRollouts, SimAgentsChallengeSubmission};

/// Field number of the scenarios in `SimAgentsChallengeSubmission`.
const SCENARIO_ROLLOUTS: u64 = 1;
/// Wire type of numbers of variable length.
const VARINT: u64 = 0;
/// Wire type of messages and strings.
const LENGTH_DELIMITED: u64 = 2;

/// Appends one scenario to a shard.
pub(crate) fn write_scenario(out: &mut impl Write, rollouts: &ScenarioRollouts) -> io::Result<u64> {
    let payload = rollouts.encode_to_vec();
    let mut head = Vec::new();
    write_varint(&mut head, SCENARIO_ROLLOUTS << 3 | LENGTH_DELIMITED);
    write_varint(&mut head, payload.len() as u64);
    out.write_all(&head)?;
    out.write_all(&payload)?;
    Ok((head.len() + payload.len()) as u64)
}

/// Reads the scenarios of a shard in order; other fields, such as metadata, are available at the
/// end.
pub(crate) struct ShardReader<R> {
    content: R,
    path: PathBuf,
    record: usize,
    offset: u64,
    /// Fields that are no scenarios, as they were.
    rest: Vec<u8>,
    ended: bool,
}

impl<R: BufRead> ShardReader<R> {
    /// Reads `content`; `path` names it in errors.
    pub(crate) fn new(content: R, path: PathBuf) -> Self {
        Self {
            content,
            path,
            record: 0,
            offset: 0,
            rest: Vec::new(),
            ended: false,
        }
    }

    /// The message without its scenarios, as far as it has been read.
    pub(crate) fn metadata(&self) -> Result<SimAgentsChallengeSubmission, DataError> {
        SimAgentsChallengeSubmission::decode(self.rest.as_slice()).map_err(|source| {
            DataError::Proto {
                message: "waymo.open_dataset.SimAgentsChallengeSubmission",
                source,
                place: self.place(),
            }
        })
    }

    fn place(&self) -> RecordLocation {
        RecordLocation {
            record: self.record,
            offset: self.offset,
            path: self.path.clone(),
        }
    }

    /// The next scenario; fields between are kept aside.
    fn read(&mut self) -> Result<Option<ScenarioRollouts>, DataError> {
        loop {
            let at_end = self.content.fill_buf().map(<[u8]>::is_empty);
            if at_end.map_err(|e| io_error("read", e, &self.path))? {
                return Ok(None);
            }
            let start = self.offset;
            let key = self.varint()?;
            let (field, wire_type) = (key >> 3, key & 7);
            if field == SCENARIO_ROLLOUTS && wire_type == LENGTH_DELIMITED {
                let payload = self.payload(start)?;
                let place = RecordLocation {
                    offset: start,
                    ..self.place()
                };
                self.record += 1;
                let decoded = ScenarioRollouts::decode(payload.as_slice());
                return decoded.map(Some).map_err(|source| DataError::Proto {
                    message: "waymo.open_dataset.ScenarioRollouts",
                    source,
                    place,
                });
            }
            write_varint(&mut self.rest, key);
            match wire_type {
                VARINT => {
                    let value = self.varint()?;
                    write_varint(&mut self.rest, value);
                }
                LENGTH_DELIMITED => {
                    let payload = self.payload(start)?;
                    write_varint(&mut self.rest, payload.len() as u64);
                    self.rest.extend(payload);
                }
                other => {
                    let expected = "a number or bytes";
                    return Err(self.unexpected(expected, format!("wire type {other}")));
                }
            }
        }
    }

    fn payload(&mut self, start: u64) -> Result<Vec<u8>, DataError> {
        let length = self.varint()?;
        if length > MAX_RECORD_BYTES {
            return Err(DataError::TooLong {
                limit: MAX_RECORD_BYTES,
                length,
                place: RecordLocation {
                    offset: start,
                    ..self.place()
                },
            });
        }
        let mut payload = Vec::new();
        let read = self.content.by_ref().take(length).read_to_end(&mut payload);
        let found = read.map_err(|e| io_error("read", e, &self.path))? as u64;
        if found < length {
            return Err(self.truncated("a field", length, found));
        }
        self.offset += length;
        Ok(payload)
    }

    /// A number of variable length: seven bits a byte, the lowest first.
    fn varint(&mut self) -> Result<u64, DataError> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let mut byte = [0];
            let read = self.content.read(&mut byte);
            if read.map_err(|e| io_error("read", e, &self.path))? == 0 {
                return Err(self.truncated("a number", 1, 0));
            }
            self.offset += 1;
            value |= u64::from(byte[0] & 0x7f) << shift;
            if byte[0] < 0x80 {
                return Ok(value);
            }
        }
        Err(self.unexpected("a number of at most ten bytes", "a longer one".into()))
    }

    fn unexpected(&self, expected: &'static str, found: String) -> DataError {
        DataError::Field {
            expected,
            found,
            place: self.place(),
        }
    }

    fn truncated(&self, part: &'static str, expected: u64, found: u64) -> DataError {
        DataError::Truncated {
            part,
            expected,
            found,
            place: self.place(),
        }
    }
}

impl<R: BufRead> Iterator for ShardReader<R> {
    type Item = Result<ScenarioRollouts, DataError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let next = self.read().transpose();
        self.ended = !matches!(next, Some(Ok(_)));
        next
    }
}

fn write_varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shard() -> SimAgentsChallengeSubmission {
        let rollouts = |id: &str| ScenarioRollouts {
            scenario_id: Some(id.into()),
            joint_scenes: vec![Default::default(); 300],
        };
        SimAgentsChallengeSubmission {
            scenario_rollouts: vec![rollouts("a"), rollouts("b")],
            submission_type: Some(1),
            account_name: Some("someone@example.org".into()),
            authors: vec!["A".into(), "B".into()],
            uses_lidar_data: Some(false),
            ..Default::default()
        }
    }

    fn read(
        bytes: &[u8],
    ) -> (
        Vec<Result<ScenarioRollouts, DataError>>,
        SimAgentsChallengeSubmission,
    ) {
        let mut reader = ShardReader::new(bytes, "x".into());
        let scenarios: Vec<_> = reader.by_ref().collect();
        let metadata = reader.metadata().unwrap();
        (scenarios, metadata)
    }

    #[test]
    fn fields_written_one_by_one_are_the_message_and_come_back() {
        let shard = shard();
        let metadata = SimAgentsChallengeSubmission {
            scenario_rollouts: Vec::new(),
            ..shard.clone()
        };
        let mut bytes = Vec::new();
        let mut n = 0;
        for rollouts in &shard.scenario_rollouts {
            n += write_scenario(&mut bytes, rollouts).unwrap();
        }
        assert_eq!(n, bytes.len() as u64);
        bytes.extend(metadata.encode_to_vec());
        assert_eq!(bytes, shard.encode_to_vec());
        let (scenarios, found) = read(&bytes);
        let scenarios: Vec<_> = scenarios.into_iter().map(Result::unwrap).collect();
        assert_eq!((scenarios, found), (shard.scenario_rollouts, metadata));
    }

    #[test]
    fn damage_is_an_error_that_names_its_place() {
        let bytes = shard().encode_to_vec();
        let check = |bytes: &[u8], expected: &str| {
            let mut reader = ShardReader::new(bytes, "x".into());
            let error = reader.find_map(Result::err).unwrap().to_string();
            assert!(error.contains(expected), "{error}");
            assert!(reader.next().is_none());
        };
        check(&bytes[..20], "expected 603 more bytes of a field, found 17");
        check(&bytes[..1], "expected 1 more bytes of a number, found 0");
        check(b"\x0d1234", "expected a number or bytes, found wire type 5");
        check(&[0xff; 11], "expected a number of at most ten bytes");
        check(
            &[0x0a, 0xff, 0xff, 0xff, 0xff, 0x7f],
            "expected a record of at most",
        );
        check(&[0x0a, 0x02, 0x0a, 0x05], "ScenarioRollouts");
    }
}
