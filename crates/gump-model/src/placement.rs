//! The placement network: how likely a vehicle is at each of the places of a scene.
//!
//! Two hidden layers turn the properties of a place into a score; the softmax of all scores is the
//! distribution of the vehicle. `gump-engine` makes the places and their properties
//! (`placement::places`), `gump-train` trains the network.

use serde::{Deserialize, Serialize};

use crate::relative::plain_numbers;
use crate::{ModelError, WeightsError};

/// Header entry that distinguishes these weights.
const ARCHITECTURE: (&str, &str) = ("architecture", "placement");

/// The layers, each a matrix and a bias, from properties to scores.
const LAYERS: [&str; 3] = ["first", "second", "score"];

/// The shape of a placement network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlacementConfig {
    /// Properties of a place.
    pub features: usize,
    /// Width of both hidden layers.
    pub hidden: usize,
}

impl PlacementConfig {
    /// Inputs and outputs of each layer.
    fn sizes(&self) -> [[usize; 2]; LAYERS.len()] {
        [
            [self.features, self.hidden],
            [self.hidden, self.hidden],
            [self.hidden, 1],
        ]
    }
}

/// The parameters of a placement network without a tensor library.
#[derive(Clone, Debug)]
pub struct PlacementWeights {
    config: PlacementConfig,
    layers: [(Vec<f32>, Vec<f32>); LAYERS.len()],
}

impl PlacementWeights {
    /// Reads the bytes of a checkpoint.
    ///
    /// # Errors
    /// [`ModelError::Weights`] for bytes that are not a checkpoint, or one of another network.
    pub fn read(bytes: &[u8]) -> Result<Self, ModelError> {
        let (_, header) =
            safetensors::SafeTensors::read_metadata(bytes).map_err(WeightsError::NotSafetensors)?;
        let entry = |key: &str| header.metadata().as_ref()?.get(key);
        if entry(ARCHITECTURE.0).map(String::as_str) != Some(ARCHITECTURE.1) {
            return Err(WeightsError::OtherNetwork {
                expected: ARCHITECTURE.1,
            }
            .into());
        }
        let text = entry("config").ok_or(WeightsError::NoConfig)?;
        let config: PlacementConfig =
            serde_json::from_str(text).map_err(WeightsError::InvalidConfig)?;
        let mut numbers = plain_numbers(bytes)?;
        let mut take = |name: String, n: usize| {
            let flat = numbers.remove(&name);
            let flat = flat.ok_or_else(|| ModelError::MissingTensor { name: name.clone() })?;
            if flat.len() == n {
                return Ok(flat);
            }
            Err(ModelError::TensorShape {
                name,
                expected: vec![n],
                found: vec![flat.len()],
            })
        };
        let mut layers = Vec::new();
        for (name, [n_in, n_out]) in LAYERS.iter().zip(config.sizes()) {
            let weight = take(format!("{name}.weight"), n_in * n_out)?;
            layers.push((weight, take(format!("{name}.bias"), n_out)?));
        }
        let layers = layers.try_into().expect("one per name");
        Ok(Self { config, layers })
    }

    /// The shape.
    pub fn config(&self) -> PlacementConfig {
        self.config
    }

    /// Matrix `[out, in]` and bias `[out]` of each layer, from properties to scores.
    pub fn layers(&self) -> &[(Vec<f32>, Vec<f32>)] {
        &self.layers
    }
}

#[cfg(feature = "tensors")]
pub use self::tensors::PlacementNetwork;

#[cfg(feature = "tensors")]
mod tensors {
    use std::collections::BTreeMap;
    use std::path::Path;

    use candle_core::{Device, Tensor};
    use gump_nn::layers::Linear;
    use gump_nn::ops;
    use gump_nn::parameters::Parameters;
    use gump_scene::Seed;

    use super::{ARCHITECTURE, LAYERS, PlacementConfig};
    use crate::checkpoint::{self, StorageType};
    use crate::{ModelConfig, ModelError};

    /// A placement network that can be trained.
    #[derive(Debug)]
    pub struct PlacementNetwork {
        config: PlacementConfig,
        parameters: Parameters,
        layers: [Linear; LAYERS.len()],
    }

    impl PlacementNetwork {
        /// An untrained network.
        ///
        /// # Errors
        /// The tensor library failed.
        pub fn random(config: PlacementConfig, seed: Seed) -> Result<Self, ModelError> {
            Self::build(config, Parameters::random(seed, &Device::Cpu))
        }

        /// The network with the given parameters.
        ///
        /// # Errors
        /// A tensor that is missing, superfluous or of another shape, by name.
        pub fn build(
            config: PlacementConfig,
            mut parameters: Parameters,
        ) -> Result<Self, ModelError> {
            let mut root = parameters.root();
            let mut layers = Vec::new();
            for (name, [n_in, n_out]) in LAYERS.iter().zip(config.sizes()) {
                layers.push(Linear::new(&mut root, name, n_in, n_out)?);
            }
            if let Some(name) = parameters.unused().first() {
                let name = (*name).to_owned();
                return Err(ModelError::UnusedTensor { name });
            }
            let layers = layers.try_into().expect("one per name");
            Ok(Self {
                config,
                parameters,
                layers,
            })
        }

        /// Reads a network.
        ///
        /// # Errors
        /// A file that cannot be read, is not a checkpoint, or contains another kind of network.
        pub fn load(path: &Path) -> Result<Self, ModelError> {
            let archive = checkpoint::read(path)?;
            let found = archive.entry(ARCHITECTURE.0).unwrap_or("sequence");
            if found != ARCHITECTURE.1 {
                let what = format!("expected the weights of a placement network, found {found}");
                return Err(archive.error(what));
            }
            let config = serde_json::from_str(archive.entry("config")?).map_err(|error| {
                archive.error(format!("its configuration is not valid ({error})"))
            })?;
            Self::build(config, Parameters::loaded(archive.tensors, &Device::Cpu))
        }

        /// Writes the network in half precision.
        ///
        /// # Errors
        /// [`ModelError::Io`] with the path; the previous file, if any, is intact.
        pub fn save(&self, path: &Path) -> Result<(), ModelError> {
            let all = self.parameters.all();
            let tensors: BTreeMap<String, Tensor> = all
                .map(|(name, var)| (name.to_owned(), var.as_tensor().clone()))
                .collect();
            checkpoint::write(path, tensors, self.header()?, StorageType::Half)
        }

        /// The header entries of its files.
        ///
        /// # Errors
        /// A shape that cannot be written as JSON.
        pub fn header(&self) -> Result<BTreeMap<String, String>, ModelError> {
            let mut header = checkpoint::header(&ModelConfig::tiny())?;
            let config = serde_json::to_string(&self.config).map_err(ModelError::Json)?;
            header.insert("config".into(), config);
            header.insert(ARCHITECTURE.0.into(), ARCHITECTURE.1.into());
            Ok(header)
        }

        /// The shape.
        pub fn config(&self) -> PlacementConfig {
            self.config
        }

        /// Its parameters.
        pub fn parameters(&self) -> &Parameters {
            &self.parameters
        }

        /// The scores `[rows]` of properties `[rows, features]`.
        ///
        /// # Errors
        /// Another number of properties.
        pub fn scores(&self, features: &Tensor) -> candle_core::Result<Tensor> {
            let [first, second, score] = &self.layers;
            let hidden = ops::gelu(&first.forward(features)?)?;
            let hidden = ops::gelu(&second.forward(&hidden)?)?;
            score.forward(&hidden)?.squeeze(1)
        }
    }
}
