//! A file as a stream of its content: opened, recognised as gzip by its magic, unpacked.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;

use flate2::bufread::MultiGzDecoder;

use crate::DataError;

/// The uncompressed content of a file, buffered.
pub(crate) type Stream = Box<dyn BufRead + Send>;

/// Two bytes that start every gzip member (RFC 1952).
const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];

/// Bytes read at once; large enough that system calls do not matter.
const BUFFER_BYTES: usize = 256 * 1024;

/// Opens `path` and unpacks it if it is gzip.
///
/// Error: [`DataError::Missing`], [`DataError::Empty`], [`DataError::Io`].
pub(crate) fn open(path: &Path) -> Result<Stream, DataError> {
    let file = File::open(path).map_err(|source| match source.kind() {
        io::ErrorKind::NotFound => DataError::Missing { path: path.into() },
        _ => io_error("open", source, path),
    })?;
    unpacked(BufReader::with_capacity(BUFFER_BYTES, file), path)
}

/// The content of bytes, unpacked if they are gzip; `path` is their name.
///
/// Error: [`DataError::Empty`], [`DataError::Io`].
pub(crate) fn of_bytes(bytes: &[u8], path: &Path) -> Result<Stream, DataError> {
    unpacked(io::Cursor::new(bytes.to_vec()), path)
}

fn unpacked(mut raw: impl BufRead + Send + 'static, path: &Path) -> Result<Stream, DataError> {
    let head = raw
        .fill_buf()
        .map_err(|source| io_error("read", source, path))?;
    if head.is_empty() {
        return Err(DataError::Empty { path: path.into() });
    }
    let mut stream: Stream = if head.starts_with(&GZIP_MAGIC) {
        Box::new(BufReader::with_capacity(
            BUFFER_BYTES,
            MultiGzDecoder::new(raw),
        ))
    } else {
        Box::new(raw)
    };
    let content = stream
        .fill_buf()
        .map_err(|source| io_error("unpack", source, path))?;
    if content.is_empty() {
        return Err(DataError::Empty { path: path.into() });
    }
    Ok(stream)
}

/// The first `n` bytes of the content, fewer if it is shorter.
pub(crate) fn head(path: &Path, n: u64) -> Result<Vec<u8>, DataError> {
    let mut bytes = Vec::new();
    open(path)?
        .take(n)
        .read_to_end(&mut bytes)
        .map_err(|source| io_error("read", source, path))?;
    Ok(bytes)
}

/// The whole content, for formats that are one document.
///
/// Error: those of [`open`], and [`DataError::TooLarge`] before more than `limit` bytes are held.
pub(crate) fn content(path: &Path, what: &'static str, limit: u64) -> Result<Vec<u8>, DataError> {
    let mut bytes = Vec::new();
    open(path)?
        .take(limit + 1)
        .read_to_end(&mut bytes)
        .map_err(|source| io_error("read", source, path))?;
    if bytes.len() as u64 > limit {
        return Err(DataError::TooLarge {
            what,
            limit,
            path: path.into(),
        });
    }
    Ok(bytes)
}

/// Names the file an operating-system error belongs to.
pub(crate) fn io_error(doing: &'static str, source: io::Error, path: &Path) -> DataError {
    DataError::Io {
        doing,
        source,
        path: path.into(),
    }
}
