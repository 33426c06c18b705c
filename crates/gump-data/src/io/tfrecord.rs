//! TFRecord framing: length, masked CRC-32C of the length, payload, masked CRC-32C of the payload.
//!
//! Payloads are not interpreted. Start with [`TfRecordReader`].
//!
//! Source: section "TFRecords format details" of the TensorFlow documentation; checked against
//! the checksums of real files.

use std::io::{self, BufRead, Read, Write};
use std::path::PathBuf;

use super::stream::{Stream, io_error};
use crate::{DataError, RecordLocation};

/// The maximum length of a payload, bytes.
///
/// Scenario records have about 1 MB without and 25 MB with lidar; a length beyond this is treated
/// as damage.
pub const MAX_RECORD_BYTES: u64 = 256 << 20;

/// Bytes of a record's header: length and its checksum.
const HEADER_BYTES: usize = 12;

/// The masked CRC-32C of `bytes`.
pub fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes)
        .rotate_right(15)
        .wrapping_add(0xa282_ead8)
}

/// True if `head` starts like a TFRecord: a length whose checksum matches.
pub fn is_tfrecord(head: &[u8]) -> bool {
    head.first_chunk::<HEADER_BYTES>()
        .is_some_and(|header| header_length(header).is_ok())
}

/// Reads payloads one at a time; memory is bounded by one record.
///
/// After an invalid payload checksum, reading continues with the next record; after any other error
/// the position is lost and the iterator ends.
pub struct TfRecordReader {
    stream: Stream,
    path: PathBuf,
    record: usize,
    offset: u64,
    lost: bool,
}

/// One payload and where its record starts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Payload {
    /// The bytes inside the frame.
    pub bytes: Vec<u8>,
    /// The record it came from.
    pub place: RecordLocation,
}

impl TfRecordReader {
    /// Opens a file, plain or gzip.
    ///
    /// # Errors
    /// [`DataError::Missing`], [`DataError::Empty`], [`DataError::Io`].
    pub fn open(path: PathBuf) -> Result<Self, DataError> {
        Ok(Self::of(crate::io::stream::open(&path)?, path))
    }

    /// Reads records of this content.
    pub(crate) fn of(stream: Stream, path: PathBuf) -> Self {
        Self {
            stream,
            path,
            record: 0,
            offset: 0,
            lost: false,
        }
    }

    fn place(&self) -> RecordLocation {
        RecordLocation {
            record: self.record,
            offset: self.offset,
            path: self.path.clone(),
        }
    }

    /// Skips the next record without checking its payload.
    ///
    /// # Errors
    /// Those of reading, without that of the payload's checksum.
    pub fn skip_record(&mut self) -> Option<Result<(), DataError>> {
        if self.lost {
            return None;
        }
        self.pass_over().transpose()
    }

    fn pass_over(&mut self) -> Result<Option<()>, DataError> {
        let Some(length) = self.header()? else {
            return Ok(None);
        };
        let rest = &mut self.stream.by_ref().take(length + 4);
        let found = io::copy(rest, &mut io::sink()).map(|n| n as usize);
        self.expect_all("the payload", length + 4, found)?;
        self.end_record(length);
        Ok(Some(()))
    }

    fn read(&mut self) -> Result<Option<Payload>, DataError> {
        let Some(length) = self.header()? else {
            return Ok(None);
        };
        // `take` grows the buffer as bytes arrive: a false length allocates no more than is there.
        let mut bytes = Vec::new();
        let found = self.stream.by_ref().take(length).read_to_end(&mut bytes);
        self.expect_all("the payload", length, found)?;
        let mut stored = [0; 4];
        let found = read_full(&mut self.stream, &mut stored);
        self.expect_all("the payload checksum", 4, found)?;
        let place = self.place();
        self.end_record(length);
        let (expected, found) = (u32::from_le_bytes(stored), masked_crc(&bytes));
        if expected != found {
            return Err(DataError::Checksum {
                part: "the payload",
                expected,
                found,
                place,
            });
        }
        Ok(Some(Payload { bytes, place }))
    }

    fn end_record(&mut self, length: u64) {
        self.lost = false;
        self.record += 1;
        self.offset += HEADER_BYTES as u64 + length + 4;
    }

    /// The length of the next payload, checked; `None` at the end. Until [`Self::end_record`] the
    /// position counts as lost.
    fn header(&mut self) -> Result<Option<u64>, DataError> {
        if self.at_end()? {
            return Ok(None);
        }
        self.lost = true;
        let mut header = [0; HEADER_BYTES];
        let found = read_full(&mut self.stream, &mut header);
        self.expect_all("the record header", HEADER_BYTES as u64, found)?;
        let length = header_length(&header).map_err(|(expected, found)| DataError::Checksum {
            part: "the record length",
            expected,
            found,
            place: self.place(),
        })?;
        if length > MAX_RECORD_BYTES {
            return Err(DataError::TooLong {
                limit: MAX_RECORD_BYTES,
                length,
                place: self.place(),
            });
        }
        Ok(Some(length))
    }

    fn at_end(&mut self) -> Result<bool, DataError> {
        match self.stream.fill_buf() {
            Ok(rest) => Ok(rest.is_empty()),
            Err(source) => {
                self.lost = true;
                Err(io_error("read", source, &self.path))
            }
        }
    }

    fn expect_all(
        &self,
        part: &'static str,
        expected: u64,
        found: io::Result<usize>,
    ) -> Result<(), DataError> {
        let found = found.map_err(|source| io_error("read", source, &self.path))? as u64;
        if found == expected {
            return Ok(());
        }
        Err(DataError::Truncated {
            part,
            expected,
            found,
            place: self.place(),
        })
    }
}

impl Iterator for TfRecordReader {
    type Item = Result<Payload, DataError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.lost {
            return None;
        }
        self.read().transpose()
    }
}

/// Writes one record.
///
/// # Errors
/// Those of `out`.
pub fn write_record(out: &mut impl Write, payload: &[u8]) -> io::Result<()> {
    let length = (payload.len() as u64).to_le_bytes();
    out.write_all(&length)?;
    out.write_all(&masked_crc(&length).to_le_bytes())?;
    out.write_all(payload)?;
    out.write_all(&masked_crc(payload).to_le_bytes())
}

/// The length in a header, or (stored, computed) checksums that differ.
fn header_length(header: &[u8; HEADER_BYTES]) -> Result<u64, (u32, u32)> {
    let [a, b, c, d, e, f, g, h, s @ ..] = *header;
    let length = [a, b, c, d, e, f, g, h];
    let (stored, computed) = (u32::from_le_bytes(s), masked_crc(&length));
    if stored == computed {
        Ok(u64::from_le_bytes(length))
    } else {
        Err((stored, computed))
    }
}

/// Fills `buffer` as far as the stream reaches; returns how far.
fn read_full(stream: &mut impl Read, buffer: &mut [u8]) -> io::Result<usize> {
    let mut filled = 0;
    while filled < buffer.len() {
        match stream.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(filled)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_castagnoli_masked() {
        // The published check value, and a checksum TensorFlow wrote into a file.
        assert_eq!(crc32c::crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(masked_crc(&86_019_u64.to_le_bytes()), 3_905_923_129);
    }

    #[test]
    fn records_come_back_with_their_places_plain_and_packed() {
        let folder = tempfile::tempdir().unwrap();
        let mut plain = Vec::new();
        for payload in [&b"one"[..], b"", b"three"] {
            write_record(&mut plain, payload).unwrap();
        }
        let mut packer = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        packer.write_all(&plain).unwrap();
        let packed = packer.finish().unwrap();
        for bytes in [plain, packed] {
            let path = folder.path().join("file");
            std::fs::write(&path, bytes).unwrap();
            let records = TfRecordReader::open(path).unwrap();
            let found: Vec<_> = records
                .map(|record| {
                    let payload = record.unwrap();
                    (payload.bytes, payload.place.record, payload.place.offset)
                })
                .collect();
            let expected = [
                (b"one".to_vec(), 0, 0),
                (b"".to_vec(), 1, 19),
                (b"three".to_vec(), 2, 35),
            ];
            assert_eq!(found, expected);
        }
    }
}
