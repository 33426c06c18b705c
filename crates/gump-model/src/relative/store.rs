//! Relative networks on disk.

use std::path::Path;

use candle_core::Device;
use gump_nn::Parameters;

use super::{RelativeConfig, RelativeNetwork};
use crate::ModelError;
use crate::checkpoint::{self, StorageType};
use crate::prefixes::PREFIXES;

/// Header entry that distinguishes the two architectures.
const ARCHITECTURE: (&str, &str) = ("architecture", "relative");

/// Writes a network.
///
/// # Errors
/// [`ModelError::Io`] with the path; the previous file, if any, is intact.
pub fn save(
    network: &RelativeNetwork,
    path: &Path,
    storage: StorageType,
) -> Result<(), ModelError> {
    let all = network.parameters().all();
    let tensors = all.map(|(name, var)| (name.to_owned(), var.as_tensor().clone()));
    checkpoint::write(path, tensors.collect(), header(network.config())?, storage)
}

/// Reads a network.
///
/// # Errors
/// A file that cannot be read, is not a checkpoint, or contains another kind of network.
pub fn load(path: &Path, device: &Device) -> Result<RelativeNetwork, ModelError> {
    let archive = checkpoint::read(path)?;
    let config = config(&archive)?;
    let is_beside = |name: &str| PREFIXES.iter().any(|prefix| name.starts_with(prefix));
    let tensors = archive.tensors.into_iter();
    let tensors = tensors.filter(|(name, _)| !is_beside(name));
    RelativeNetwork::build(config, Parameters::loaded(tensors.collect(), device))
}

/// Whether a file of weights contains a network of this kind.
///
/// # Errors
/// A file that cannot be read or is not a checkpoint.
pub fn is_relative(path: &Path) -> Result<bool, ModelError> {
    let archive = checkpoint::read(path)?;
    Ok(archive.metadata.get(ARCHITECTURE.0).map(String::as_str) == Some(ARCHITECTURE.1))
}

/// Header entries of a file that holds a network of this shape.
///
/// # Errors
/// A shape that cannot be written as JSON.
pub fn header(
    config: &RelativeConfig,
) -> Result<std::collections::BTreeMap<String, String>, ModelError> {
    let mut header = checkpoint::header(&crate::ModelConfig::tiny())?;
    let config = serde_json::to_string(config).map_err(ModelError::Json)?;
    header.insert("config".into(), config);
    header.insert(ARCHITECTURE.0.into(), ARCHITECTURE.1.into());
    Ok(header)
}

/// The shape of the network that a file holds.
///
/// # Errors
/// A file without one, or with another kind of network.
pub fn config(archive: &checkpoint::Archive) -> Result<RelativeConfig, ModelError> {
    let text = archive.entry("config")?;
    serde_json::from_str(text)
        .map_err(|error| archive.error(format!("its configuration is not valid ({error})")))
}
