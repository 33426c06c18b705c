//! The parameters of a relative network, without a tensor library.

use std::collections::BTreeMap;

use safetensors::SafeTensors;
use safetensors::tensor::Dtype;

use super::RelativeConfig;
use crate::prefixes::PREFIXES;
use crate::{ModelError, WeightsError};

/// The parameters of a trained relative network by name, row-major f32, with its shape.
///
/// Used by rollouts, which then need neither tensors nor files.
#[derive(Clone, Debug)]
pub struct RelativeWeights {
    config: RelativeConfig,
    numbers: BTreeMap<String, Vec<f32>>,
}

impl RelativeWeights {
    /// Reads the bytes of a checkpoint; additional tensors of a training run are ignored.
    ///
    /// # Errors
    /// [`ModelError::Weights`] for bytes that are not a checkpoint, or one of another network.
    pub fn read(bytes: &[u8]) -> Result<Self, ModelError> {
        let (_, header) =
            SafeTensors::read_metadata(bytes).map_err(WeightsError::NotSafetensors)?;
        let entry = |key: &str| {
            header
                .metadata()
                .as_ref()
                .and_then(|entries| entries.get(key))
        };
        if entry("architecture").map(String::as_str) != Some("relative") {
            return Err(WeightsError::OtherNetwork {
                expected: "relative",
            }
            .into());
        }
        let text = entry("config").ok_or(WeightsError::NoConfig)?;
        let config: RelativeConfig =
            serde_json::from_str(text).map_err(WeightsError::InvalidConfig)?;
        config.validate()?;
        let numbers = plain_numbers(bytes)?;
        Ok(Self { config, numbers })
    }

    /// The parameters of a network.
    ///
    /// # Errors
    /// A network that is not f32.
    #[cfg(feature = "tensors")]
    pub fn of(network: &super::RelativeNetwork) -> Result<Self, ModelError> {
        let all = network.parameters().all();
        let numbers = all.map(|(name, var)| {
            let flat = var.flatten_all()?.to_vec1::<f32>()?;
            Ok((name.to_owned(), flat))
        });
        Ok(Self {
            config: network.config().clone(),
            numbers: numbers.collect::<Result<_, ModelError>>()?,
        })
    }

    /// The shape of the network.
    pub fn config(&self) -> &RelativeConfig {
        &self.config
    }

    /// The values of a parameter, row-major, if there is one of this name.
    pub fn find(&self, name: &str) -> Option<&[f32]> {
        self.numbers.get(name).map(Vec::as_slice)
    }

    /// The `n` numbers of a parameter.
    ///
    /// # Errors
    /// One that is missing, or has another number of them.
    pub fn get(&self, name: &str, n: usize) -> Result<&[f32], ModelError> {
        let numbers = self.find(name).ok_or_else(|| ModelError::MissingTensor {
            name: name.to_owned(),
        })?;
        if numbers.len() == n {
            return Ok(numbers);
        }
        Err(ModelError::TensorShape {
            name: name.to_owned(),
            expected: vec![n],
            found: vec![numbers.len()],
        })
    }
}

/// The tensors of a checkpoint by name, row-major f32, without those of a training run.
pub(crate) fn plain_numbers(bytes: &[u8]) -> Result<BTreeMap<String, Vec<f32>>, ModelError> {
    let file = SafeTensors::deserialize(bytes).map_err(WeightsError::Damaged)?;
    let mut numbers = BTreeMap::new();
    for (name, view) in file.tensors() {
        if PREFIXES.iter().any(|prefix| name.starts_with(prefix)) {
            continue;
        }
        let data = view.data();
        let flat: Vec<f32> = match view.dtype() {
            Dtype::F32 => data
                .as_chunks::<4>()
                .0
                .iter()
                .map(|b| f32::from_le_bytes(*b))
                .collect(),
            Dtype::F16 => data
                .as_chunks::<2>()
                .0
                .iter()
                .map(|b| half::f16::from_le_bytes(*b).to_f32())
                .collect(),
            found => return Err(WeightsError::TensorType { name, found }.into()),
        };
        numbers.insert(name, flat);
    }
    Ok(numbers)
}
