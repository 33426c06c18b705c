//! Networks and runs on disk: safetensors with the configuration in the header.
//!
//! A file contains everything needed to load it. It is written under a temporary name and then
//! renamed, so that a crash leaves the previous file intact.

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use gump_nn::parameters::Parameters;
use gump_tokenizer::VOCABULARY_SIZE;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde::{Deserialize, Serialize};

use crate::ModelError;
use crate::config::ModelConfig;
use crate::local_context::n_numbers;
use crate::network::Network;
use crate::prefixes::PREFIXES;
pub use crate::prefixes::{DRIVER, OPTIMIZER, REFERENCE, TRAINED};

/// Version of the layout of names and metadata.
const FORMAT: &str = "gump-1";

/// The matrix that reads local contexts, marks last.
const LOCAL_CONTEXT_IN: &str = "mct.surroundings.in.weight";

/// The type of stored numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum StorageType {
    /// Half precision, for shipping.
    Half,
    /// Full precision, for resuming.
    Full,
}

/// Tensors and header entries of a file.
#[derive(Debug)]
pub struct Archive {
    /// By name.
    pub tensors: BTreeMap<String, Tensor>,
    pub(crate) metadata: BTreeMap<String, String>,
    pub(crate) path: PathBuf,
}

/// Writes a network.
///
/// # Errors
/// [`ModelError::Io`] with the path; the previous file, if any, is intact.
pub fn save(network: &Network, path: &Path, storage: StorageType) -> Result<(), ModelError> {
    let tensors = network
        .parameters()
        .all()
        .map(|(name, var)| (name.to_owned(), var.as_tensor().clone()));
    write(path, tensors.collect(), header(network.config())?, storage)
}

/// Reads a network.
///
/// # Errors
/// A file that cannot be read, is not a checkpoint, has another vocabulary, or whose tensors do not
/// match its configuration; the message names the file.
pub fn load(path: &Path, device: &Device) -> Result<Network, ModelError> {
    let archive = read(path)?;
    let config = archive.config()?;
    let tensors = archive
        .tensors
        .into_iter()
        .filter(|(name, _)| !PREFIXES.iter().any(|prefix| name.starts_with(prefix)))
        .collect();
    Network::build(config, Parameters::loaded(tensors, device)).map_err(|error| match error {
        ModelError::Io { .. } | ModelError::Checkpoint { .. } => error,
        other => ModelError::Checkpoint {
            what: other.to_string(),
            path: path.to_owned(),
        },
    })
}

/// Reads a network for further training with the configuration `wanted`; `None` if the file
/// contains another model.
///
/// A file without `unknown_marks` gets them: the weights of a mark start at zero, so that the
/// network computes the same as before.
///
/// # Errors
/// Those of [`load`].
pub fn load_to_grow(
    path: &Path,
    wanted: &ModelConfig,
    device: &Device,
) -> Result<Option<Network>, ModelError> {
    let network = load(path, device)?;
    if network.config() == wanted {
        return Ok(Some(network));
    }
    let grown = ModelConfig {
        unknown_marks: true,
        ..network.config().clone()
    };
    if grown != *wanted {
        return Ok(None);
    }
    let tensors = network.parameters().all().map(|(name, var)| {
        let tensor = match name {
            LOCAL_CONTEXT_IN => widened(var.as_tensor(), n_numbers(wanted))?,
            _ => var.as_tensor().clone(),
        };
        Ok((name.to_owned(), tensor))
    });
    let tensors: BTreeMap<String, Tensor> = tensors.collect::<Result<_, ModelError>>()?;
    Network::build(grown, Parameters::loaded(tensors, device)).map(Some)
}

/// The matrix `[rows, n]` with columns of zeros up to `columns`.
fn widened(matrix: &Tensor, columns: usize) -> Result<Tensor, ModelError> {
    let (rows, n) = matrix.dims2()?;
    let zeros = Tensor::zeros((rows, columns - n), matrix.dtype(), matrix.device())?;
    Ok(Tensor::cat(&[matrix, &zeros], 1)?)
}

impl Archive {
    /// Takes out the tensors whose names start with `prefix`, without it.
    pub fn take(&mut self, prefix: &str) -> BTreeMap<String, Tensor> {
        let all = std::mem::take(&mut self.tensors);
        let (taken, rest) = all
            .into_iter()
            .partition(|(name, _)| name.starts_with(prefix));
        self.tensors = rest;
        let taken: BTreeMap<String, Tensor> = taken;
        let bare = |(name, tensor): (String, Tensor)| (name[prefix.len()..].to_owned(), tensor);
        taken.into_iter().map(bare).collect()
    }

    /// The configuration in the header.
    pub fn config(&self) -> Result<ModelConfig, ModelError> {
        let text = self.entry("config")?;
        serde_json::from_str(text)
            .map_err(|error| self.error(format!("its configuration is not valid ({error})")))
    }

    /// A header entry.
    pub fn entry(&self, key: &str) -> Result<&str, ModelError> {
        let value = self.metadata.get(key);
        value
            .map(String::as_str)
            .ok_or_else(|| self.error(format!("its header has no \"{key}\"")))
    }

    /// An error that names the file.
    pub fn error(&self, what: String) -> ModelError {
        ModelError::Checkpoint {
            what,
            path: self.path.clone(),
        }
    }
}

/// Header entries every file of this crate has.
pub fn header(config: &ModelConfig) -> Result<BTreeMap<String, String>, ModelError> {
    let config = serde_json::to_string(config).map_err(ModelError::Json)?;
    Ok(BTreeMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        ("vocabulary".to_owned(), VOCABULARY_SIZE.to_string()),
        ("config".to_owned(), config),
    ]))
}

/// Writes named tensors and a header, atomically.
pub fn write(
    path: &Path,
    tensors: BTreeMap<String, Tensor>,
    metadata: BTreeMap<String, String>,
    storage: StorageType,
) -> Result<(), ModelError> {
    let (dtype, kind) = match storage {
        StorageType::Half => (DType::F16, Dtype::F16),
        StorageType::Full => (DType::F32, Dtype::F32),
    };
    let mut bytes: BTreeMap<String, (Vec<usize>, Vec<u8>)> = BTreeMap::new();
    for (name, tensor) in tensors {
        let flat = tensor
            .to_dtype(dtype)?
            .to_device(&Device::Cpu)?
            .flatten_all()?;
        let data = match storage {
            StorageType::Half => flat
                .to_vec1::<half::f16>()?
                .iter()
                .flat_map(|v| v.to_le_bytes())
                .collect(),
            StorageType::Full => flat
                .to_vec1::<f32>()?
                .iter()
                .flat_map(|v| v.to_le_bytes())
                .collect(),
        };
        bytes.insert(name, (tensor.dims().to_vec(), data));
    }
    let mut views = Vec::with_capacity(bytes.len());
    for (name, (shape, data)) in &bytes {
        let view =
            TensorView::new(kind, shape.clone(), data).map_err(|error| ModelError::Checkpoint {
                what: error.to_string(),
                path: path.to_owned(),
            })?;
        views.push((name, view));
    }
    let metadata: HashMap<String, String> = metadata.into_iter().collect();
    let encoded =
        safetensors::serialize(views, Some(metadata)).map_err(|error| ModelError::Checkpoint {
            what: error.to_string(),
            path: path.to_owned(),
        })?;
    let sorted = with_sorted_header(&encoded).map_err(|error| ModelError::Checkpoint {
        what: error.to_string(),
        path: path.to_owned(),
    })?;
    write_beside(path, &sorted)
}

/// A tensor in the header of a file.
#[derive(Serialize, Deserialize)]
struct Entry {
    dtype: String,
    shape: Vec<usize>,
    data_offsets: [usize; 2],
}

/// The header of a file: its own entries before the tensors.
#[derive(Serialize, Deserialize)]
struct Header {
    #[serde(rename = "__metadata__")]
    metadata: BTreeMap<String, String>,
    #[serde(flatten)]
    tensors: BTreeMap<String, Entry>,
}

/// The same file with its header in order: the library writes entries in the order of a hash map,
/// and equal weights should give equal bytes.
fn with_sorted_header(encoded: &[u8]) -> serde_json::Result<Vec<u8>> {
    let length = encoded.as_chunks::<8>().0.first().copied();
    let length = u64::from_le_bytes(length.unwrap_or_default()) as usize;
    let (header, data) = encoded[8..].split_at(length);
    let header: Header = serde_json::from_slice(header)?;
    let mut text = serde_json::to_string(&header)?;
    let padded = text.len().next_multiple_of(8);
    text.extend(std::iter::repeat_n(' ', padded - text.len()));
    let mut sorted = (padded as u64).to_le_bytes().to_vec();
    sorted.extend_from_slice(text.as_bytes());
    sorted.extend_from_slice(data);
    Ok(sorted)
}

/// Reads named tensors and the header, and checks format and vocabulary.
pub fn read(path: &Path) -> Result<Archive, ModelError> {
    let fail = |what: String| ModelError::Checkpoint {
        what,
        path: path.to_owned(),
    };
    let io = |cause| ModelError::Io {
        action: "reading weights",
        cause,
        path: path.to_owned(),
    };
    let bytes = fs::read(path).map_err(io)?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|error| {
        fail(format!(
            "expected a safetensors file, found something else ({error})"
        ))
    })?;
    let metadata: BTreeMap<String, String> = header
        .metadata()
        .iter()
        .flatten()
        .map(|(k, v)| (k.clone(), v.clone()))
        .collect();
    let file = SafeTensors::deserialize(&bytes)
        .map_err(|error| fail(format!("damaged weights ({error})")))?;
    let mut tensors = BTreeMap::new();
    for (name, view) in file.tensors() {
        let dtype = match view.dtype() {
            Dtype::F16 => DType::F16,
            Dtype::F32 => DType::F32,
            other => {
                return Err(fail(format!(
                    "tensor \"{name}\" has type {other:?}, expected F16 or F32"
                )));
            }
        };
        tensors.insert(
            name,
            Tensor::from_raw_buffer(view.data(), dtype, view.shape(), &Device::Cpu)?,
        );
    }
    let archive = Archive {
        tensors,
        metadata,
        path: path.to_owned(),
    };
    let format = archive
        .entry("format")
        .map_err(|_| fail("not a gump checkpoint: no format in its header".into()))?;
    if format != FORMAT {
        return Err(fail(format!(
            "checkpoint format is \"{format}\", expected \"{FORMAT}\""
        )));
    }
    let vocabulary = archive.entry("vocabulary")?;
    if vocabulary != VOCABULARY_SIZE.to_string() {
        return Err(fail(format!(
            "vocabulary has {vocabulary} tokens, expected {VOCABULARY_SIZE}"
        )));
    }
    Ok(archive)
}

/// Writes `bytes` under a temporary name and renames.
fn write_beside(path: &Path, bytes: &[u8]) -> Result<(), ModelError> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".partial");
    let beside = path.with_file_name(name);
    let attempt = || {
        let mut file = fs::File::create(&beside)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&beside, path)
    };
    attempt().map_err(|cause| {
        // Best effort: the error that matters is the first one.
        let _ = fs::remove_file(&beside);
        ModelError::Io {
            action: "writing weights",
            cause,
            path: path.to_owned(),
        }
    })
}
