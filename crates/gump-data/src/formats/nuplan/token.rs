//! Identities of nuPlan's rows: binary in the database, hexadecimal as text.

use std::fmt;
use std::str::FromStr;

/// Identity of a row; a scenario is named by that of its event's point cloud.
///
/// Eight bytes in recorded logs; shorter ones, as the official test databases have, are kept as
/// they are.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Token {
    bytes: [u8; Self::MAX_BYTES],
    len: u8,
}

impl Token {
    const MAX_BYTES: usize = 8;

    /// The token with these bytes; `None` for none or more than eight.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let mut padded = [0; Self::MAX_BYTES];
        padded.get_mut(..bytes.len())?.copy_from_slice(bytes);
        let len = u8::try_from(bytes.len()).ok()?;
        (len > 0).then_some(Self { bytes: padded, len })
    }

    /// The bytes as the database has them.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.as_bytes()
            .iter()
            .try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Token({self})")
    }
}

/// The error of reading a [`Token`]: the text is not hexadecimal digits of one to eight bytes.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected a token of 16 hexadecimal digits, found \"{0}\"")]
pub struct ParseTokenError(String);

impl FromStr for Token {
    type Err = ParseTokenError;

    /// Reads hexadecimal digits, two a byte.
    ///
    /// # Errors
    /// Other characters, an odd number of digits, none, or more than 16.
    fn from_str(text: &str) -> Result<Self, ParseTokenError> {
        let digits: Option<Vec<u8>> = text
            .chars()
            .map(|c| c.to_digit(16).map(|digit| digit as u8))
            .collect();
        digits
            .filter(|digits| digits.len() % 2 == 0)
            .map(|digits| {
                digits
                    .chunks(2)
                    .map(|d| d[0] << 4 | d[1])
                    .collect::<Vec<_>>()
            })
            .and_then(|bytes| Self::from_bytes(&bytes))
            .ok_or_else(|| ParseTokenError(text.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_read_as_they_are_shown() {
        let token: Token = "af6639f0bc724ead".parse().unwrap();
        assert_eq!(token.as_bytes()[0], 0xaf);
        assert_eq!(token.to_string(), "af6639f0bc724ead");
        let short: Token = "00000100".parse().unwrap();
        assert_eq!(
            (short.as_bytes().len(), short.to_string()),
            (4, "00000100".into())
        );
    }

    #[test]
    fn what_is_no_token_is_named() {
        for text in ["", "af6", "not hexadecimal!", "af6639f0bc724eadaf", "é"] {
            let error = text.parse::<Token>().unwrap_err().to_string();
            assert!(error.contains(&format!("\"{text}\"")), "{error}");
        }
    }
}
