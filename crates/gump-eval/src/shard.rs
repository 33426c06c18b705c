//! One evaluation on many machines: which scenarios are whose.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Part `k` of `n`; scenarios are dealt out in turn, so shards are alike in size and kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Shard {
    /// From 1.
    pub k: usize,
    /// At least `k`.
    pub n: usize,
}

impl Shard {
    /// All scenarios.
    pub const WHOLE: Self = Self { k: 1, n: 1 };

    /// True if the scenario at `index` of all is this shard's.
    pub fn holds(self, index: usize) -> bool {
        index % self.n == self.k - 1
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/');
        match parts.map(|(k, n)| (k.parse(), n.parse())) {
            Some((Ok(k), Ok(n))) if 1 <= k && k <= n => Ok(Self { k, n }),
            _ => Err("expected K/N with K from 1 to N, like 2/8".into()),
        }
    }
}

impl TryFrom<String> for Shard {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.k, self.n)
    }
}

impl From<Shard> for String {
    fn from(shard: Shard) -> Self {
        shard.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_share_out_everything_once() {
        for index in 0..20 {
            let owners = (1..=3).filter(|&k| Shard { k, n: 3 }.holds(index));
            assert_eq!(owners.count(), 1);
        }
        assert!((0..9).all(|index| Shard::WHOLE.holds(index)));
    }

    #[test]
    fn shards_read_as_they_are_written() {
        assert_eq!("2/8".parse::<Shard>().unwrap().to_string(), "2/8");
        for wrong in ["", "3", "0/4", "5/4", "1/0", "a/b", "-1/2"] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }
}
