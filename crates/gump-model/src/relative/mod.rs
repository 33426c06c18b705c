//! A traffic model with relative attention throughout.
//!
//! Each agent at each frame is one node. It attends to its own past, to its nearest neighbours and to
//! the nearest pieces of the map, by relative pose and time alone: no place of a scene's frame enters
//! anywhere, so nothing is re-centred, and what is kept of a node stays true for as long as it is
//! kept. What a node ends with says the next half second of its agent, in the agent's own frame.
//!
//! `map` cuts the map into pieces, `graph` makes nodes and edges, `grid` has the bins of a move, `net`
//! the network, `sample`, `drives`, `rewards` and `train` how it learns, `seen` what is kept of an agent meanwhile, `world` how it is rolled out and `rules` what then corrects it.

mod drives;
mod engine;
mod graph;
mod grid;
mod map;
mod net;
mod rewards;
mod rules;
mod sample;
mod seen;
#[cfg(test)]
mod tests;
mod train;
mod world;

use std::path::Path;

use candle_core::Device;
use serde::{Deserialize, Serialize};

pub use self::drives::RelativeDrives;
pub use self::net::RelativeNetwork;
pub use self::rewards::RelativeRewards;
pub use self::sample::SampleConfig as RelativeSampleConfig;
pub use self::train::{RelativeStep, RelativeTrainConfig, RelativeTrainer};
pub use self::world::{RelativeSampling, RelativeWorld};
use crate::ModelError;
use crate::checkpoint::{self, Precision};
use crate::parameters::Parameters;

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
    /// Features of an edge that attention sees.
    pub edge_width: usize,
    /// Width of the layer that makes them.
    pub edge_hidden: usize,
}

impl Default for RelativeConfig {
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
        let fail = |what: String| Err(ModelError::Config(what));
        if self.heads == 0 || !self.width.is_multiple_of(self.heads) {
            return fail(format!(
                "width {} is not a multiple of {} heads",
                self.width, self.heads
            ));
        }
        if self.layers == 0 || self.edge_width == 0 || self.edge_hidden == 0 {
            return fail("layers, edge_width and edge_hidden must be at least 1".into());
        }
        Ok(())
    }
}

/// Header entry that tells the two architectures apart.
const ARCHITECTURE: (&str, &str) = ("architecture", "relative");

/// Writes a network.
///
/// # Errors
/// [`ModelError::Io`] with the path; the previous file, if any, is intact.
pub fn save(
    network: &RelativeNetwork,
    path: &Path,
    precision: Precision,
) -> Result<(), ModelError> {
    let all = network.parameters().all();
    let tensors = all.map(|(name, var)| (name.to_owned(), var.as_tensor().clone()));
    checkpoint::write(
        path,
        tensors.collect(),
        header(network.config())?,
        precision,
    )
}

/// Reads a network.
///
/// # Errors
/// A file that cannot be read, is no checkpoint, or holds another kind of network.
pub fn load(path: &Path, device: &Device) -> Result<RelativeNetwork, ModelError> {
    let archive = checkpoint::read(path)?;
    let config = config(&archive)?;
    let weights = archive.tensors.into_iter();
    let weights = weights.filter(|(name, _)| !name.starts_with(checkpoint::OPTIMIZER));
    let tensors = weights.filter(|(name, _)| {
        !name.starts_with(checkpoint::TRAINED) && !name.starts_with(train::DRIVER)
    });
    RelativeNetwork::build(config, Parameters::loaded(tensors.collect(), device))
}

/// Whether a file of weights holds a network of this kind.
///
/// # Errors
/// A file that cannot be read or is no checkpoint.
pub fn is_relative(path: &Path) -> Result<bool, ModelError> {
    let archive = checkpoint::read(path)?;
    Ok(archive.metadata.get(ARCHITECTURE.0).map(String::as_str) == Some(ARCHITECTURE.1))
}

fn header(
    config: &RelativeConfig,
) -> Result<std::collections::BTreeMap<String, String>, ModelError> {
    let mut header = checkpoint::header(&crate::ModelConfig::tiny())?;
    let config = serde_json::to_string(config).map_err(|e| ModelError::Config(e.to_string()))?;
    header.insert("config".into(), config);
    header.insert(ARCHITECTURE.0.into(), ARCHITECTURE.1.into());
    Ok(header)
}

fn config(archive: &checkpoint::Archive) -> Result<RelativeConfig, ModelError> {
    let text = archive.entry("config")?;
    serde_json::from_str(text)
        .map_err(|error| archive.error(format!("its configuration is not valid ({error})")))
}
