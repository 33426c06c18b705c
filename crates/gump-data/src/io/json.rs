//! Shared code of the JSON formats: bounded reading, numbers that may be missing, keys at the
//! beginning of a document.

use std::fmt;
use std::path::Path;

use serde::de::{self, Deserialize, DeserializeOwned, Deserializer, Visitor};

use super::stream;
use crate::DataError;

/// The longest document that is read, bytes after unpacking.
///
/// A scenario measures 1 to 10 MB as JSON; a parsed document takes a few times its length.
pub(crate) const MAX_BYTES: u64 = 128 << 20;

/// Reads a whole document. `NaN` and `Infinity`, which Python writes though JSON has neither, are
/// read as missing numbers.
///
/// Error: those of opening, [`DataError::TooLarge`], [`DataError::Json`] with line and column.
pub(crate) fn read<T: DeserializeOwned>(path: &Path, what: &'static str) -> Result<T, DataError> {
    let bytes = stream::content(path, what, MAX_BYTES)?;
    parse(&bytes, what, path)
}

/// Parses a document; see [`read`].
pub(crate) fn parse<T: DeserializeOwned>(
    bytes: &[u8],
    what: &'static str,
    path: &Path,
) -> Result<T, DataError> {
    let strict = serde_json::from_slice(bytes);
    let error = |source| DataError::Json {
        what,
        source,
        path: path.into(),
    };
    match strict {
        Ok(value) => Ok(value),
        Err(source) => match without_nan(bytes) {
            Some(tame) => serde_json::from_slice(&tame).map_err(error),
            None => Err(error(source)),
        },
    }
}

/// The document with numbers that JSON lacks replaced by `null`; `None` if there are none.
fn without_nan(bytes: &[u8]) -> Option<Vec<u8>> {
    const WORDS: [&[u8]; 3] = [b"NaN", b"-Infinity", b"Infinity"];
    let mut tame = Vec::with_capacity(bytes.len());
    let (mut i, mut in_string, mut found) = (0, false, false);
    while let Some(&byte) = bytes.get(i) {
        let word = WORDS
            .iter()
            .find(|w| !in_string && bytes[i..].starts_with(w));
        if let Some(word) = word {
            tame.extend_from_slice(b"null");
            i += word.len();
            found = true;
            continue;
        }
        if in_string && byte == b'\\' {
            tame.extend(bytes[i..].iter().take(2));
            i += 2;
            continue;
        }
        in_string ^= byte == b'"';
        tame.push(byte);
        i += 1;
    }
    found.then_some(tame)
}

/// A number; NaN where the document has `null`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Real(pub(crate) f64);

impl Default for Real {
    /// NaN, for a number that is not stated.
    fn default() -> Self {
        Self(f64::NAN)
    }
}

impl<'de> Deserialize<'de> for Real {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(RealVisitor)
    }
}

struct RealVisitor;

impl Visitor<'_> for RealVisitor {
    type Value = Real;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number")
    }

    fn visit_f64<E: de::Error>(self, value: f64) -> Result<Real, E> {
        Ok(Real(value))
    }

    fn visit_i64<E: de::Error>(self, value: i64) -> Result<Real, E> {
        Ok(Real(value as f64))
    }

    fn visit_u64<E: de::Error>(self, value: u64) -> Result<Real, E> {
        Ok(Real(value as f64))
    }

    fn visit_unit<E: de::Error>(self) -> Result<Real, E> {
        Ok(Real::default())
    }
}

/// Yes or no, also written as 1 or 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Flag(pub(crate) bool);

impl<'de> Deserialize<'de> for Flag {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(FlagVisitor)
    }
}

struct FlagVisitor;

impl Visitor<'_> for FlagVisitor {
    type Value = Flag;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("true, false, 1 or 0")
    }

    fn visit_bool<E: de::Error>(self, value: bool) -> Result<Flag, E> {
        Ok(Flag(value))
    }

    fn visit_u64<E: de::Error>(self, value: u64) -> Result<Flag, E> {
        Ok(Flag(value != 0))
    }

    fn visit_f64<E: de::Error>(self, value: f64) -> Result<Flag, E> {
        Ok(Flag(value != 0.0))
    }
}

/// The keys of the outermost object that begin within `head`, in order; none if it is no object.
///
/// A value that reaches beyond the head ends the list.
pub(crate) fn keys(head: &[u8]) -> Vec<String> {
    let (mut keys, mut depth) = (Vec::new(), 0_usize);
    let mut rest = head;
    let mut expects_key = false;
    while let Some((&byte, after)) = rest.split_first() {
        rest = after;
        match byte {
            b'{' | b'[' => {
                if depth == 0 && byte == b'[' {
                    return keys;
                }
                depth += 1;
                expects_key = depth == 1;
            }
            b'}' | b']' => depth = depth.saturating_sub(1),
            b',' => expects_key = depth == 1,
            b'"' => {
                let Some(length) = string_length(rest) else {
                    return keys;
                };
                if expects_key {
                    keys.push(String::from_utf8_lossy(&rest[..length]).into_owned());
                    expects_key = false;
                }
                rest = &rest[length + 1..];
            }
            _ if depth == 0 && !byte.is_ascii_whitespace() && !UTF8_MARK.contains(&byte) => {
                return keys;
            }
            _ => {}
        }
    }
    keys
}

/// The byte-order mark that some editors put in front.
const UTF8_MARK: [u8; 3] = [0xef, 0xbb, 0xbf];

/// Bytes up to the closing quote.
fn string_length(bytes: &[u8]) -> Option<usize> {
    let mut escaped = false;
    bytes.iter().position(|&byte| {
        let closes = byte == b'"' && !escaped;
        escaped = byte == b'\\' && !escaped;
        closes
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_of_the_outermost_object_are_seen_as_far_as_the_head_goes() {
        let check = |head: &str, expected: &[&str]| assert_eq!(keys(head.as_bytes()), expected);
        check(r#" {"a": [{"no": 1}], "b": "x,\"y", "c"#, &["a", "b"]);
        check(r#"{"roads": [[1, 2], [3, "#, &["roads"]);
        check(r#"[{"a": 1}]"#, &[]);
        check("<xml/>", &[]);
        check("", &[]);
    }

    #[test]
    fn numbers_that_json_lacks_are_missing_numbers() {
        let read = |text: &str| parse::<Vec<Real>>(text.as_bytes(), "numbers", Path::new("x"));
        let found = read("[1, 2.5, NaN, -Infinity, null]").unwrap();
        let finite: Vec<_> = found.iter().map(|r| r.0.is_finite()).collect();
        assert_eq!(finite, [true, true, false, false, false]);
        let error = read("[1, true]").unwrap_err().to_string();
        assert!(error.contains("line 1 column 8"), "{error}");
        let text = r#"["NaN\"NaN", NaN]"#;
        let tame = without_nan(text.as_bytes()).unwrap();
        assert_eq!(String::from_utf8(tame).unwrap(), r#"["NaN\"NaN", null]"#);
    }
}
