//! One file of the cache: records back to back, and an index at its end.
//!
//! ```text
//! "GUMPDATA", version            12 bytes
//! record, record, ...
//! index: of each record its id, length and CRC-32C
//! trailer: offset and length of the index, its CRC-32C, the CRC-32C of these 20 bytes
//! ```

use std::borrow::Borrow;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crc32c::crc32c;
use gump_scene::Scenario;

use super::bytes::{Damage, Decoded, Decoder, Encoder};
use super::log;
use crate::io::stream::io_error;
use crate::{DataError, RecordLocation, write_atomically};

/// The first bytes of every shard.
pub(super) const MAGIC: &[u8; 8] = b"GUMPDATA";
/// The version of the layout; other versions are refused, and the source has to be converted again.
const VERSION: u32 = 1;

const HEADER_BYTES: u64 = 12;
const TRAILER_BYTES: u64 = 24;

/// A shard whose index has been read.
#[derive(Clone)]
pub(super) struct Shard {
    pub(super) path: Arc<PathBuf>,
    pub(super) records: Vec<Entry>,
}

/// The location of a record in its shard.
#[derive(Clone)]
pub(super) struct Entry {
    /// The scenario's id.
    pub(super) id: Box<str>,
    /// Bytes from the start of the file.
    pub(super) offset: u64,
    length: usize,
    crc: u32,
}

/// Writes scenarios as one shard and returns its bytes; the file appears when it is complete.
///
/// # Errors
/// [`DataError::Unwritable`] for a log beyond the maximum length (180,000 frames),
/// [`DataError::Io`].
pub fn write_shard<S: Borrow<Scenario>>(
    path: &Path,
    scenarios: impl IntoIterator<Item = S>,
) -> Result<u64, DataError> {
    write_atomically(path, |file| {
        let mut shard = ShardWriter::begin(file, path)?;
        for scenario in scenarios {
            shard.write(scenario.borrow())?;
        }
        shard.finish()
    })
}

/// A shard being written.
pub(crate) struct ShardWriter<'a, W> {
    out: W,
    path: &'a Path,
    offset: u64,
    n_records: usize,
    index: Encoder,
}

impl<'a, W: Write> ShardWriter<'a, W> {
    /// `path` is for errors only.
    pub(crate) fn begin(out: W, path: &'a Path) -> Result<Self, DataError> {
        let mut shard = Self {
            out,
            path,
            offset: 0,
            n_records: 0,
            index: Encoder::default(),
        };
        shard.put(MAGIC)?;
        shard.put(&VERSION.to_le_bytes())?;
        Ok(shard)
    }

    /// Adds a scenario. After [`DataError::Unwritable`] the shard is as before.
    pub(crate) fn write(&mut self, scenario: &Scenario) -> Result<(), DataError> {
        let bytes = log::encode(scenario)?;
        self.put(&bytes)?;
        self.n_records += 1;
        self.index.text(&scenario.id);
        self.index.count(bytes.len());
        self.index.crc(crc32c(&bytes));
        Ok(())
    }

    /// Writes the index and returns the bytes of the whole shard.
    pub(crate) fn finish(mut self) -> Result<u64, DataError> {
        let mut index = Encoder::default();
        index.count(self.n_records);
        index.bytes.append(&mut self.index.bytes);
        let mut trailer = Vec::with_capacity(TRAILER_BYTES as usize);
        trailer.extend(self.offset.to_le_bytes());
        trailer.extend((index.bytes.len() as u64).to_le_bytes());
        trailer.extend(crc32c(&index.bytes).to_le_bytes());
        trailer.extend(crc32c(&trailer).to_le_bytes());
        self.put(&index.bytes)?;
        self.put(&trailer)?;
        Ok(self.offset)
    }

    fn put(&mut self, bytes: &[u8]) -> Result<(), DataError> {
        let written = self.out.write_all(bytes);
        written.map_err(|error| io_error("write", error, self.path))?;
        self.offset += bytes.len() as u64;
        Ok(())
    }
}

impl Shard {
    /// Reads and checks the index; no record is touched.
    ///
    /// Error: [`DataError::Cache`], [`DataError::Io`], [`DataError::Missing`].
    pub(super) fn open(path: &Path) -> Result<Self, DataError> {
        let mut file = open_file(path)?;
        let damaged = |expected: &str, found: String, offset| DataError::Cache {
            expected: expected.into(),
            found,
            offset,
            path: path.into(),
        };
        let metadata = file.metadata();
        let size = metadata.map_err(|e| io_error("read", e, path))?.len();
        let mut part = |offset, n| read_at(&mut file, offset, n, path);
        let header = part(0, HEADER_BYTES.min(size) as usize)?;
        let Some(version) = header.strip_prefix(MAGIC) else {
            let found = header.escape_ascii().to_string();
            return Err(damaged("a shard of the cache", found, 0));
        };
        if version != VERSION.to_le_bytes() {
            let found = <[u8; 4]>::try_from(version).map(u32::from_le_bytes);
            let found = found.map_or("the end of the file".into(), |v| format!("version {v}"));
            let expected = format!("version {VERSION} of the cache");
            return Err(damaged(&expected, found, MAGIC.len() as u64));
        }
        if size < HEADER_BYTES + TRAILER_BYTES {
            return Err(damaged(
                "an index at the end",
                format!("{size} bytes"),
                size,
            ));
        }
        let end = size - TRAILER_BYTES;
        let trailer = part(end, TRAILER_BYTES as usize)?;
        let (sums, last) = trailer.split_at(TRAILER_BYTES as usize - 4);
        if last != crc32c(sums).to_le_bytes() {
            return Err(damaged(
                "the trailer of a complete shard",
                "other bytes: the file is cut off or damaged".into(),
                end,
            ));
        }
        let (at, length, crc) = read_trailer(sums).map_err(|damage| in_file(damage, end, path))?;
        if at < HEADER_BYTES || at.checked_add(length) != Some(end) {
            let found = format!("one of {length} bytes at byte {at}");
            return Err(damaged("an index before the trailer", found, end));
        }
        let index = part(at, length as usize)?;
        if crc32c(&index) != crc {
            let found = format!("{:#010x}", crc32c(&index));
            return Err(damaged(
                &format!("an index with checksum {crc:#010x}"),
                found,
                at,
            ));
        }
        let records = read_index(&index, at).map_err(|damage| in_file(damage, at, path))?;
        Ok(Self {
            path: Arc::new(path.into()),
            records,
        })
    }

    /// Reads one record, nothing else.
    ///
    /// Error: [`DataError::Checksum`], [`DataError::Cache`], [`DataError::Scenario`],
    /// [`DataError::Io`].
    pub(super) fn read(&self, record: usize) -> Result<Scenario, DataError> {
        let entry = &self.records[record];
        let path = self.path.as_path();
        let bytes = read_at(&mut open_file(path)?, entry.offset, entry.length, path)?;
        let place = || RecordLocation {
            record,
            offset: entry.offset,
            path: path.into(),
        };
        let found = crc32c(&bytes);
        if found != entry.crc {
            return Err(DataError::Checksum {
                part: "the record",
                expected: entry.crc,
                found,
                place: place(),
            });
        }
        let decoded = log::decode(&bytes);
        let scenario = decoded.map_err(|damage| in_file(damage, entry.offset, path))?;
        scenario.validate().map_err(|error| DataError::Scenario {
            id: scenario.id.clone(),
            problem: error.into(),
            place: place(),
        })?;
        Ok(scenario)
    }
}

/// Offset, length and checksum of the index.
fn read_trailer(bytes: &[u8]) -> Decoded<(u64, u64, u32)> {
    let from = &mut Decoder::new(bytes);
    Ok((from.long()?, from.long()?, from.crc()?))
}

fn read_index(bytes: &[u8], end: u64) -> Decoded<Vec<Entry>> {
    // Length of the id, length of the record, checksum.
    const LEAST: usize = 6;
    let from = &mut Decoder::new(bytes);
    let mut offset = HEADER_BYTES;
    let records = from.list(LEAST, |from| {
        let id = from.text()?.into();
        let (length, crc) = (from.count()?, from.crc()?);
        let entry = Entry {
            id,
            offset,
            length,
            crc,
        };
        offset = offset.saturating_add(length as u64);
        if offset > end {
            return Err(from.damage(format!("records up to byte {end}"), &offset));
        }
        Ok(entry)
    })?;
    from.end()?;
    if offset != end {
        return Err(from.damage(format!("records up to byte {end}"), &offset));
    }
    Ok(records)
}

fn in_file(damage: Damage, start: u64, path: &Path) -> DataError {
    DataError::Cache {
        expected: damage.expected,
        found: damage.found,
        offset: start + damage.offset as u64,
        path: path.into(),
    }
}

fn open_file(path: &Path) -> Result<File, DataError> {
    File::open(path).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => DataError::Missing { path: path.into() },
        _ => io_error("open", source, path),
    })
}

/// `n` bytes that are known to lie in the file.
fn read_at(file: &mut File, offset: u64, n: usize, path: &Path) -> Result<Vec<u8>, DataError> {
    let mut bytes = vec![0; n];
    file.seek(SeekFrom::Start(offset))
        .and_then(|_| file.read_exact(&mut bytes))
        .map_err(|error| io_error("read", error, path))?;
    Ok(bytes)
}
