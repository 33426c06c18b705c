//! Frames on the wire: reading with limits, writing, and taking bodies apart.

use std::io::{self, Read, Write};

use super::ServerError;

/// Kinds of frames; see the protocol.
pub(super) mod kind {
    pub(in crate::server) const HELLO: u8 = 1;
    pub(in crate::server) const RESET: u8 = 2;
    pub(in crate::server) const STEP: u8 = 3;
    pub(in crate::server) const GOODBYE: u8 = 4;
    pub(in crate::server) const READY: u8 = 65;
    pub(in crate::server) const OBSERVATIONS: u8 = 66;
    pub(in crate::server) const STEPPED: u8 = 67;
    pub(in crate::server) const ERROR: u8 = 127;
}

/// The kind and the length of the next frame; its body is still on the wire.
///
/// # Errors
/// [`ServerError::Disconnected`] and [`ServerError::Broken`].
pub(super) fn read_header(stream: &mut impl Read) -> Result<(u8, usize), ServerError> {
    let mut header = [0; 5];
    // The first byte apart: a client may leave between requests, but not within one.
    read(stream, &mut header[..1], "between requests")?;
    read(stream, &mut header[1..], "within a request")?;
    let [a, b, c, d, kind] = header;
    Ok((kind, u32::from_le_bytes([a, b, c, d]) as usize))
}

/// A body of a length that has been checked.
///
/// # Errors
/// As [`read_header`].
pub(super) fn read_body(stream: &mut impl Read, len: usize) -> Result<Vec<u8>, ServerError> {
    let mut body = vec![0; len];
    read(stream, &mut body, "within a request")?;
    Ok(body)
}

fn read(stream: &mut impl Read, bytes: &mut [u8], during: &'static str) -> Result<(), ServerError> {
    stream
        .read_exact(bytes)
        .map_err(|error| lost(error, during))
}

/// Writes one frame.
///
/// # Errors
/// As [`read_header`].
pub(super) fn write(stream: &mut impl Write, kind: u8, body: &[u8]) -> Result<(), ServerError> {
    let len = u32::try_from(body.len()).expect("an answer has less than 4 GiB: rows are limited");
    let mut frame = Vec::with_capacity(body.len() + 5);
    frame.extend(len.to_le_bytes());
    frame.push(kind);
    frame.extend_from_slice(body);
    let written = stream.write_all(&frame).and_then(|()| stream.flush());
    written.map_err(|error| lost(error, "before it was answered"))
}

fn lost(error: io::Error, during: &'static str) -> ServerError {
    match error.kind() {
        io::ErrorKind::UnexpectedEof
        | io::ErrorKind::BrokenPipe
        | io::ErrorKind::ConnectionReset
        | io::ErrorKind::ConnectionAborted => ServerError::Disconnected { during },
        _ => ServerError::Broken(error),
    }
}

/// Refuses a frame of another length.
pub(super) fn expect_len(
    what: &'static str,
    expected: usize,
    found: usize,
) -> Result<(), ServerError> {
    if expected == found {
        return Ok(());
    }
    Err(ServerError::Length {
        what,
        expected,
        found,
    })
}

/// Numbers in a body; its length has been checked.
pub(super) fn numbers(body: &[u8]) -> Vec<f32> {
    let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    body.chunks_exact(4).map(number).collect()
}

/// Seeds in a body; its length has been checked.
pub(super) fn seeds(body: &[u8]) -> Vec<gump_scene::Seed> {
    let seed = |b: &[u8]| {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(b);
        gump_scene::Seed(u64::from_le_bytes(bytes))
    };
    body.chunks_exact(8).map(seed).collect()
}

/// Appends numbers to a body.
pub(super) fn put_numbers(body: &mut Vec<u8>, numbers: &[f32]) {
    body.reserve(numbers.len() * 4);
    for number in numbers {
        body.extend(number.to_le_bytes());
    }
}

/// Appends flags to a body.
pub(super) fn put_flags(body: &mut Vec<u8>, flags: impl IntoIterator<Item = bool>) {
    body.extend(flags.into_iter().map(u8::from));
}
