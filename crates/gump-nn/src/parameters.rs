//! Named, seeded, trainable tensors: how a network is built, and how it is loaded.
//!
//! candle's `VarMap` draws from an unseeded generator and iterates over a hash map; this store does
//! neither, so one seed gives one network and every walk over the parameters has one order.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Shape, Tensor, Var};
use gump_seed::{Seed, standard_normal};
use rand::Rng as _;

use crate::NnError;

/// Initialisation of a parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Init {
    /// Every entry the same.
    Constant(f64),
    /// Normal with mean 0 and this standard deviation.
    Normal(f64),
    /// Uniform in ±√(6 / (fan_in + fan_out)), for a `[out, in]` matrix.
    Xavier,
    /// Uniform in ±√(1 / fan_in): what PyTorch gives linear and convolution layers.
    FanIn(usize),
}

/// The parameters of one network, by name.
#[derive(Debug)]
pub struct Parameters {
    variables: BTreeMap<String, Var>,
    trainable: BTreeMap<String, bool>,
    loaded: Option<BTreeMap<String, Tensor>>,
    device: Device,
    seed: Seed,
    /// Number type in which the network's matrices are multiplied.
    products: DType,
}

impl Parameters {
    /// Creates an empty store; parameters requested from it are drawn from `seed`.
    pub fn random(seed: Seed, device: &Device) -> Self {
        Self {
            variables: BTreeMap::new(),
            trainable: BTreeMap::new(),
            loaded: None,
            device: device.clone(),
            seed,
            products: DType::F32,
        }
    }

    /// Creates an empty store; parameters requested from it are taken from `tensors`.
    pub fn loaded(tensors: BTreeMap<String, Tensor>, device: &Device) -> Self {
        Self {
            loaded: Some(tensors),
            ..Self::random(Seed(0), device)
        }
    }

    /// The same store, for a network whose matrices are multiplied in this type.
    pub fn multiplied_in(self, products: DType) -> Self {
        Self { products, ..self }
    }

    /// Device of the parameters.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// The parameters that training changes, sorted by name.
    pub fn trainable(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.variables
            .iter()
            .filter(|(name, _)| self.trainable[name.as_str()])
            .map(|(name, var)| (name.as_str(), var))
    }

    /// The running statistics, which training does not differentiate, sorted by name.
    pub fn statistics(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.all().filter(|(name, _)| !self.trainable[*name])
    }

    /// Everything a checkpoint holds, running statistics included, sorted by name.
    pub fn all(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.variables
            .iter()
            .map(|(name, var)| (name.as_str(), var))
    }

    /// The parameter called `name`, if there is one.
    pub fn find(&self, name: &str) -> Option<&Var> {
        self.variables.get(name)
    }

    /// Number of trainable numbers.
    pub fn count(&self) -> usize {
        self.trainable().map(|(_, var)| var.elem_count()).sum()
    }

    /// Number of trainable numbers whose name starts with `prefix`.
    pub fn count_under(&self, prefix: &str) -> usize {
        self.trainable()
            .filter(|(name, _)| name.starts_with(prefix))
            .map(|(_, var)| var.elem_count())
            .sum()
    }

    /// Names in the file this store was loaded from that no part of the network requested.
    pub fn unused(&self) -> Vec<&str> {
        let loaded = self.loaded.iter().flat_map(BTreeMap::keys);
        loaded
            .map(String::as_str)
            .filter(|name| !self.variables.contains_key(*name))
            .collect()
    }

    /// The root of the name space.
    pub fn root(&mut self) -> Scope<'_> {
        Scope {
            store: self,
            prefix: String::new(),
        }
    }

    fn get(
        &mut self,
        name: String,
        shape: Shape,
        init: Init,
        trainable: bool,
    ) -> Result<Tensor, NnError> {
        let tensor = match &self.loaded {
            Some(tensors) => {
                let tensor = tensors
                    .get(&name)
                    .ok_or_else(|| NnError::MissingTensor { name: name.clone() })?;
                if tensor.shape() != &shape {
                    return Err(NnError::TensorShape {
                        name,
                        expected: shape.into_dims(),
                        found: tensor.dims().to_vec(),
                    });
                }
                tensor.to_dtype(DType::F32)?.to_device(&self.device)?
            }
            None => {
                // Seeded by name, so that adding a layer elsewhere changes no other layer's start.
                let seed = name
                    .bytes()
                    .fold(self.seed, |seed, byte| seed.fork(u64::from(byte)));
                initial(&shape, init, seed, &self.device)?
            }
        };
        let var = Var::from_tensor(&tensor)?;
        let tensor = var.as_tensor().clone();
        let before = self.variables.insert(name.clone(), var);
        assert!(before.is_none(), "parameter {name} is asked for once");
        self.trainable.insert(name, trainable);
        Ok(tensor)
    }
}

/// A prefix into the name space of a store, as the layers of a network nest.
pub struct Scope<'a> {
    store: &'a mut Parameters,
    prefix: String,
}

impl Scope<'_> {
    /// The scope of a part.
    pub fn part(&mut self, name: impl AsRef<str>) -> Scope<'_> {
        let prefix = self.name(name.as_ref());
        Scope {
            store: self.store,
            prefix,
        }
    }

    /// Number type in which matrices are multiplied.
    pub fn products(&self) -> DType {
        self.store.products
    }

    /// A trainable parameter.
    pub fn get(
        &mut self,
        name: &str,
        shape: impl Into<Shape>,
        init: Init,
    ) -> Result<Tensor, NnError> {
        let name = self.name(name);
        self.store.get(name, shape.into(), init, true)
    }

    /// A number that is stored but not trained: running statistics. Returns the variable, so that
    /// its owner can update it.
    pub fn buffer(
        &mut self,
        name: &str,
        shape: impl Into<Shape>,
        init: Init,
    ) -> Result<Var, NnError> {
        let name = self.name(name);
        self.store.get(name.clone(), shape.into(), init, false)?;
        Ok(self.store.variables[&name].clone())
    }

    fn name(&self, name: &str) -> String {
        if self.prefix.is_empty() {
            name.to_owned()
        } else {
            format!("{}.{name}", self.prefix)
        }
    }
}

fn initial(shape: &Shape, init: Init, seed: Seed, device: &Device) -> Result<Tensor, NnError> {
    let mut rng = seed.rng();
    let n = shape.elem_count();
    let values: Vec<f32> = match init {
        Init::Constant(value) => vec![value as f32; n],
        Init::Normal(deviation) => (0..n)
            .map(|_| (standard_normal(&mut rng) * deviation) as f32)
            .collect(),
        Init::Xavier => {
            let dims = shape.dims();
            let bound = (6.0 / (dims[0] + dims[1]) as f64).sqrt();
            (0..n)
                .map(|_| rng.random_range(-bound..bound) as f32)
                .collect()
        }
        Init::FanIn(fan_in) => {
            let bound = (1.0 / fan_in as f64).sqrt();
            (0..n)
                .map(|_| rng.random_range(-bound..bound) as f32)
                .collect()
        }
    };
    Ok(Tensor::from_vec(values, shape, device)?)
}
