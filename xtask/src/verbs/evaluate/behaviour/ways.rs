//! Worlds and how they decode: a learned one as it is used and without its rules.

use gump_model::SamplingConfig;

use super::Named;
use crate::worlds::{Sampling, WorldName};

/// One column of the table.
pub(super) struct Way {
    pub(super) world: WorldName,
    /// `ruled` or `raw`; of worlds that decode nothing none.
    decoding: Option<&'static str>,
    pub(super) sampling: SamplingConfig,
}

/// Every way that the table shows of some worlds: of a network with rules also the network alone.
///
/// Error: a sampling flag out of its range.
pub(super) fn ways(worlds: &[WorldName], sampling: &Sampling) -> anyhow::Result<Vec<Way>> {
    let asked = sampling.resolve()?;
    let raw = SamplingConfig {
        redraws: 0,
        limits: false,
        ..asked.clone()
    };
    let has_rules = asked != raw;
    let mut ways = Vec::new();
    for world in worlds {
        let mut add = |decoding, sampling: &SamplingConfig| {
            ways.push(Way {
                world: world.clone(),
                decoding,
                sampling: sampling.clone(),
            });
        };
        match world {
            WorldName::Model(_) if has_rules => {
                add(Some("ruled"), &asked);
                add(Some("raw"), &raw);
            }
            WorldName::Model(_) => add(Some("raw"), &raw),
            _ => add(None, &asked),
        }
    }
    Ok(ways)
}

impl Way {
    /// How many futures are imagined where `n` are asked for: worlds without chance have one.
    pub(super) fn futures(&self, n: usize) -> usize {
        match self.world {
            WorldName::Log | WorldName::ConstantVelocity => 1,
            WorldName::Idm | WorldName::Model(_) => n,
        }
    }

    pub(super) fn named(&self) -> Named {
        Named {
            world: self.world.to_string(),
            decoding: self.decoding.map(Into::into),
        }
    }
}
