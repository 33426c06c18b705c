//! Worlds and how they decode: a learned one as it is used and without its rules.

use gump_eval::decoding::Decoding;
use gump_eval::worlds::WorldName;
use serde::{Deserialize, Serialize};

use crate::charts;
use crate::sampling::Sampling;

/// A world and how it decodes, as ledgers name it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Named {
    pub(super) world: String,
    /// `ruled`, `raw` or `paper`; `-` for worlds that decode nothing.
    pub(super) decoding: String,
}

impl Named {
    /// What it is called beside the others.
    pub(super) fn label(&self) -> String {
        let world = charts::legend(&self.world);
        match self.decoding.as_str() {
            Decoding::NONE if world == "log" => "log replayed".into(),
            Decoding::NONE => world,
            decoding => format!("{world} ({decoding})"),
        }
    }
}

/// One column of the table.
pub(super) struct Way {
    pub(super) world: WorldName,
    pub(super) decoding: Decoding,
}

/// Every way that the table shows of some worlds.
///
/// Error: sampling flags that do not fit.
pub(super) fn ways(worlds: &[WorldName], sampling: &Sampling) -> anyhow::Result<Vec<Way>> {
    let mut ways = Vec::new();
    for world in worlds {
        let decodings = sampling.decodings(world)?.into_iter();
        ways.extend(decodings.map(|decoding| Way {
            world: world.clone(),
            decoding,
        }));
    }
    Ok(ways)
}

impl Way {
    /// How many futures are imagined where `n` are asked for: worlds without chance have one.
    pub(super) fn futures(&self, n: usize) -> usize {
        self.world.distinct_futures(n)
    }

    pub(super) fn named(&self) -> Named {
        Named {
            world: self.world.to_string(),
            decoding: self.decoding.name.into(),
        }
    }
}
