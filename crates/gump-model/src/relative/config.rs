//! The shape of the relative network.

use serde::{Deserialize, Serialize};

use crate::ModelError;

/// The shape of the network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RelativeConfig {
    /// Model width, the `C` of every shape.
    pub width: usize,
    /// Layers of attention along edges.
    pub layers: usize,
    /// Attention heads; must divide the width.
    pub heads: usize,
    /// Features of an edge that attention uses.
    pub edge_width: usize,
    /// Width of the layer that computes them.
    pub edge_hidden: usize,
}

impl Default for RelativeConfig {
    /// 1.5 million parameters, which a core trains in hours (result 19). No other size was tried.
    fn default() -> Self {
        Self {
            width: 128,
            layers: 4,
            heads: 4,
            edge_width: 32,
            edge_hidden: 48,
        }
    }
}

impl RelativeConfig {
    /// Checks that the numbers fit together.
    ///
    /// # Errors
    /// [`ModelError::Config`] naming the first contradiction.
    pub fn validate(&self) -> Result<(), ModelError> {
        let fail = |key: &'static str, reason: String| Err(ModelError::Config { key, reason });
        if self.heads == 0 || !self.width.is_multiple_of(self.heads) {
            return fail(
                "heads",
                format!(
                    "width {} is not a multiple of {} heads",
                    self.width, self.heads
                ),
            );
        }
        for (key, value) in [
            ("layers", self.layers),
            ("edge_width", self.edge_width),
            ("edge_hidden", self.edge_hidden),
        ] {
            if value == 0 {
                let reason = "layers, edge_width and edge_hidden must be at least 1";
                return fail(key, reason.into());
            }
        }
        Ok(())
    }
}
