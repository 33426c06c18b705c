//! Named tensors and a JSON header in one file: the format of archives.

use std::collections::{BTreeMap, HashMap};

use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::replay_buffer::Store;
use crate::RlError;
use crate::networks::Adam;

/// The header entry that everything but tensors is in.
const HEADER: &str = "gump";

pub(crate) fn wrong(what: impl Into<String>) -> RlError {
    RlError::Archive { what: what.into() }
}

/// Tensors and header entries to be written.
#[derive(Default)]
pub(crate) struct Writer {
    pub(crate) tensors: BTreeMap<String, (Dtype, Vec<u8>)>,
    /// One JSON object, so that the bytes do not depend on the order of a hash map.
    header: serde_json::Map<String, serde_json::Value>,
    /// The first tensor with a number that is NaN or infinite.
    not_finite: Option<String>,
}

impl Writer {
    /// Name of the first tensor with a number that is NaN or infinite.
    pub(crate) fn not_finite(&self) -> Option<&str> {
        self.not_finite.as_deref()
    }

    pub(crate) fn floats(&mut self, name: &str, values: &[f32]) {
        if self.not_finite.is_none() && !values.iter().all(|value| value.is_finite()) {
            self.not_finite = Some(name.to_owned());
        }
        let bytes = values.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.tensors.insert(name.to_owned(), (Dtype::F32, bytes));
    }

    pub(crate) fn adam(&mut self, name: &str, adam: &Adam) {
        self.floats(&format!("{name}.adam.mean"), &adam.mean);
        self.floats(&format!("{name}.adam.square"), &adam.square);
    }

    pub(crate) fn store(&mut self, name: &str, store: &Store) {
        match store {
            Store::Numbers(numbers) => self.floats(name, numbers),
            Store::Bits(bytes) => {
                let bytes = (Dtype::U8, bytes.clone());
                self.tensors.insert(name.to_owned(), bytes);
            }
        }
    }

    pub(crate) fn header(&mut self, name: &str, value: &impl Serialize) -> Result<(), RlError> {
        let value = serde_json::to_value(value).map_err(|error| wrong(error.to_string()))?;
        self.header.insert(name.to_owned(), value);
        Ok(())
    }

    pub(crate) fn finish(self) -> Result<Vec<u8>, RlError> {
        let mut views = Vec::with_capacity(self.tensors.len());
        for (name, (kind, bytes)) in &self.tensors {
            let width = if *kind == Dtype::F32 { 4 } else { 1 };
            let view = TensorView::new(*kind, vec![bytes.len() / width], bytes);
            views.push((name, view.map_err(|error| wrong(error.to_string()))?));
        }
        let header = serde_json::Value::Object(self.header).to_string();
        let header = HashMap::from([(HEADER.to_owned(), header)]);
        safetensors::serialize(views, Some(header)).map_err(|error| wrong(error.to_string()))
    }
}

/// A file being read.
pub(crate) struct Reader<'a> {
    tensors: SafeTensors<'a>,
    header: serde_json::Map<String, serde_json::Value>,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Result<Self, RlError> {
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| {
            wrong(format!(
                "expected a safetensors file, found something else ({error})"
            ))
        })?;
        let (_, metadata) =
            SafeTensors::read_metadata(bytes).map_err(|error| wrong(error.to_string()))?;
        let header = metadata.metadata().as_ref().and_then(|m| m.get(HEADER));
        let header = header.ok_or_else(|| wrong(format!("its header has no \"{HEADER}\"")))?;
        let header = serde_json::from_str(header)
            .map_err(|error| wrong(format!("its header is not valid ({error})")))?;
        Ok(Self { tensors, header })
    }

    pub(crate) fn header<T: DeserializeOwned>(&mut self, name: &str) -> Result<T, RlError> {
        let value = self.header.remove(name);
        let value = value.ok_or_else(|| wrong(format!("it holds no {name}")))?;
        serde_json::from_value(value)
            .map_err(|error| wrong(format!("its {name} is not valid ({error})")))
    }

    pub(crate) fn bytes(&self, name: &str, kind: Dtype) -> Result<&'a [u8], RlError> {
        let tensor = self.tensors.tensor(name);
        let tensor = tensor.map_err(|_| wrong(format!("it has no tensor \"{name}\"")))?;
        if tensor.dtype() == kind {
            Ok(tensor.data())
        } else {
            let found = tensor.dtype();
            let what = format!("tensor \"{name}\" has type {found:?}, expected {kind:?}");
            Err(wrong(what))
        }
    }

    pub(crate) fn floats(&self, name: &str) -> Result<Vec<f32>, RlError> {
        let bytes = self.bytes(name, Dtype::F32)?.chunks_exact(4);
        Ok(bytes
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
            .collect())
    }

    /// As many numbers as there is room for.
    pub(crate) fn fill(&self, name: &str, room: &mut [f32]) -> Result<(), RlError> {
        let values = self.floats(name)?;
        check_len(name, room.len(), values.len())?;
        room.copy_from_slice(&values);
        Ok(())
    }

    pub(crate) fn adam(&self, name: &str, adam: &mut Adam, steps: u64) -> Result<(), RlError> {
        adam.steps = steps;
        self.fill(&format!("{name}.adam.mean"), &mut adam.mean)?;
        self.fill(&format!("{name}.adam.square"), &mut adam.square)
    }
}

pub(crate) fn check_len(name: &str, expected: usize, found: usize) -> Result<(), RlError> {
    if expected == found {
        Ok(())
    } else {
        Err(wrong(format!(
            "tensor \"{name}\" has {found} numbers, expected {expected}"
        )))
    }
}
