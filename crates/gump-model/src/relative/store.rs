//! Relative networks on disk.

use std::path::Path;

use candle_core::Device;
use gump_nn::Parameters;

use super::{RelativeConfig, RelativeNetwork};
use crate::ModelError;
use crate::checkpoint::{self, Precision, widened};
use crate::prefixes::PREFIXES;
use crate::relative::graph::EDGE_NUMBERS;
use crate::relative::weights::EDGES_IN;

/// Header entry that distinguishes the two architectures.
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
/// A file that cannot be read, is not a checkpoint, or contains another kind of network.
pub fn load(path: &Path, device: &Device) -> Result<RelativeNetwork, ModelError> {
    let archive = checkpoint::read(path)?;
    let config = config(&archive)?;
    let is_beside = |name: &str| PREFIXES.iter().any(|prefix| name.starts_with(prefix));
    let tensors = archive.tensors.into_iter();
    let tensors = tensors.filter(|(name, _)| !is_beside(name));
    let tensors = tensors.map(|(name, tensor)| {
        let tensor = match name.as_str() {
            EDGES_IN if tensor.dim(1)? < EDGE_NUMBERS => widened(&tensor, EDGE_NUMBERS)?,
            _ => tensor,
        };
        Ok((name, tensor))
    });
    let tensors = tensors.collect::<Result<_, ModelError>>()?;
    RelativeNetwork::build(config, Parameters::loaded(tensors, device))
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
    let config = serde_json::to_string(config).map_err(|e| ModelError::Config(e.to_string()))?;
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

#[cfg(test)]
mod tests {
    use gump_scene::Seed;

    use super::*;
    use crate::relative::RelativeWeights;

    #[test]
    fn files_with_fewer_numbers_of_edges_get_zeros_for_the_rest() {
        let config = RelativeConfig {
            width: 16,
            layers: 1,
            ..RelativeConfig::default()
        };
        let network = RelativeNetwork::random(config, Seed(3), &Device::Cpu).unwrap();
        let known = EDGE_NUMBERS - 9;
        let all = network.parameters().all();
        let tensors = all.map(|(name, var)| {
            let tensor = match name {
                EDGES_IN => var.narrow(1, 0, known).unwrap().contiguous().unwrap(),
                _ => var.as_tensor().clone(),
            };
            (name.to_owned(), tensor)
        });
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("older.safetensors");
        let header = header(network.config()).unwrap();
        checkpoint::write(&path, tensors.collect(), header, Precision::Full).unwrap();

        let rows = |network: &RelativeNetwork| {
            let matrix = network.parameters().find(EDGES_IN).unwrap();
            matrix.to_vec2::<f32>().unwrap()
        };
        let (before, after) = (rows(&network), rows(&load(&path, &Device::Cpu).unwrap()));
        for (before, after) in before.iter().zip(&after) {
            assert_eq!(before[..known], after[..known]);
            assert_eq!(after[known..], [0.0; 9]);
        }
        let read = RelativeWeights::read(&std::fs::read(&path).unwrap()).unwrap();
        assert_eq!(read.find(EDGES_IN).unwrap(), after.concat());
    }
}
