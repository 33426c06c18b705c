//! AdamW with its moments in reach, so that a checkpoint can hold them (Loshchilov & Hutter 2019).

use std::collections::BTreeMap;

use candle_core::{CpuStorage, InplaceOp2, InplaceOp3, Layout, Result, Tensor, Var};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::parameters::Parameters;
use crate::{NnError, ops};

/// Gradients by the names of their parameters; one that nothing reached is not there.
pub type Gradients = BTreeMap<String, Tensor>;

/// Step size and its schedule.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimizerConfig {
    /// Peak learning rate (paper: 2e-4).
    pub learning_rate: f64,
    /// Steps of linear warm-up (paper: none stated; ours, not tuned).
    pub warmup: usize,
    /// Learning rate at the end of the cosine, as a fraction of the peak (ours, not tuned).
    pub final_fraction: f64,
    /// Points of the run, as fractions of it, at which the rate is multiplied by `drop`; with any,
    /// the rate is constant between them and there is no cosine.
    pub milestones: Vec<f64>,
    /// Factor of the rate at each milestone (paper: 0.1).
    pub drop: f64,
    /// Decoupled weight decay of matrices (paper: 1e-3); norms, biases, tables and gates have none.
    pub weight_decay: f64,
    /// Largest gradient norm; larger ones are scaled down (released code: 5).
    pub clip: f64,
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        Self {
            learning_rate: 2e-4,
            warmup: 200,
            final_fraction: 0.05,
            milestones: Vec::new(),
            drop: 0.1,
            weight_decay: 1e-3,
            clip: 5.0,
        }
    }
}

impl OptimizerConfig {
    /// The learning rate of a step (0-based) of `total`.
    pub fn rate(&self, step: usize, total: usize) -> f64 {
        if step < self.warmup {
            return self.learning_rate * (step + 1) as f64 / self.warmup as f64;
        }
        if !self.milestones.is_empty() {
            let is_passed = |at: &&f64| step as f64 >= **at * total as f64;
            let passed = self.milestones.iter().filter(is_passed).count();
            return self.learning_rate * self.drop.powi(passed as i32);
        }
        let span = total.saturating_sub(self.warmup).max(1);
        let t = ((step - self.warmup) as f64 / span as f64).min(1.0);
        let cosine = 0.5 * (1.0 + (std::f64::consts::PI * t).cos());
        self.learning_rate * (self.final_fraction + (1.0 - self.final_fraction) * cosine)
    }

    /// Checks the numbers that mean nothing outside of a range.
    ///
    /// # Errors
    /// [`NnError::Config`] naming the first.
    pub fn validate(&self) -> std::result::Result<(), NnError> {
        let is_inside = |share: &f64| *share > 0.0 && *share < 1.0;
        let ascend = self.milestones.is_sorted_by(|a, b| a < b);
        if !ascend || !self.milestones.iter().all(is_inside) {
            return Err(NnError::Config {
                key: "milestones",
                reason: format!(
                    "milestones are {:?}, expected ascending fractions of the run between 0 and 1",
                    self.milestones
                ),
            });
        }
        if !(self.drop > 0.0 && self.drop <= 1.0) {
            let drop = self.drop;
            return Err(NnError::Config {
                key: "drop",
                reason: format!("drop {drop} is not in 0..1"),
            });
        }
        Ok(())
    }
}

/// Source of all three: PyTorch's defaults; the paper states none.
const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPS: f64 = 1e-8;

/// First and second moments of every trainable parameter.
#[derive(Debug)]
pub struct AdamW {
    moments: BTreeMap<String, (Var, Var)>,
    steps: usize,
}

impl AdamW {
    /// Moments of zero.
    ///
    /// # Errors
    /// The tensor library failed.
    pub fn new(parameters: &Parameters) -> Result<Self> {
        let zeros = |(name, var): (&str, &Var)| {
            let zeros = || Var::from_tensor(&var.zeros_like()?);
            Ok((name.to_owned(), (zeros()?, zeros()?)))
        };
        Ok(Self {
            moments: parameters.trainable().map(zeros).collect::<Result<_>>()?,
            steps: 0,
        })
    }

    /// The moments as named tensors, for a checkpoint.
    pub fn state(&self) -> impl Iterator<Item = (String, &Tensor)> {
        self.moments.iter().flat_map(|(name, (m, v))| {
            [
                (format!("optimizer.m.{name}"), m.as_tensor()),
                (format!("optimizer.v.{name}"), v.as_tensor()),
            ]
        })
    }

    /// The optimiser that a checkpoint of `steps` steps holds.
    pub fn restore(
        parameters: &Parameters,
        steps: usize,
        mut take: impl FnMut(&str) -> std::result::Result<Tensor, NnError>,
    ) -> std::result::Result<Self, NnError> {
        let mut moments = BTreeMap::new();
        for (name, var) in parameters.trainable() {
            let mut moment = |kind: &str| {
                let name = format!("{kind}.{name}");
                let tensor = take(&name)?;
                if tensor.shape() != var.shape() {
                    let (expected, found) = (var.dims().to_vec(), tensor.dims().to_vec());
                    return Err(NnError::TensorShape {
                        name,
                        expected,
                        found,
                    });
                }
                Ok(Var::from_tensor(&tensor.to_device(var.device())?)?)
            };
            moments.insert(name.to_owned(), (moment("m")?, moment("v")?));
        }
        Ok(Self { moments, steps })
    }

    /// One step; returns the norm of the gradient before clipping. A gradient that is not finite changes
    /// nothing, and neither is its norm.
    pub fn step(
        &mut self,
        parameters: &Parameters,
        gradients: &Gradients,
        config: &OptimizerConfig,
        rate: f64,
    ) -> Result<f64> {
        // Each tensor on its own thread; the sum over tensors keeps their order.
        let all: Vec<&Tensor> = gradients.values().collect();
        let squares = all.into_par_iter().map(ops::sum_of_squares);
        let squares: Vec<f64> = squares.collect::<Result<_>>()?;
        let norm = squares.iter().sum::<f64>().sqrt();
        if !norm.is_finite() {
            return Ok(norm);
        }
        let scale = if norm > config.clip {
            config.clip / norm
        } else {
            1.0
        };
        self.steps += 1;
        let correction1 = 1.0 - BETA1.powi(self.steps as i32);
        let correction2 = 1.0 - BETA2.powi(self.steps as i32);
        let trainable: Vec<_> = parameters.trainable().collect();
        let moves = trainable.into_par_iter().map(|(name, var): (_, &Var)| {
            let Some(gradient) = gradients.get(name) else {
                return Ok(());
            };
            let gradient = gradient.contiguous()?;
            let (m, v) = &self.moments[name];
            let moment = |beta, squared| Moment {
                beta,
                scale,
                squared,
            };
            moment(BETA1, false).take_in(m, &gradient)?;
            moment(BETA2, true).take_in(v, &gradient)?;
            let decay = if decays(name, var) {
                config.weight_decay
            } else {
                0.0
            };
            let update = Update {
                rate,
                decay: rate * decay,
                correction1,
                correction2,
            };
            update.apply(var, m, v)
        });
        moves.collect::<Result<()>>()?;
        Ok(norm)
    }
}

/// Moves averages towards the parameters: `share` of the old stays. Running statistics, which are
/// averages already, are taken as they are.
pub fn move_average(average: &Parameters, now: &Parameters, share: f64) -> Result<()> {
    let moving = Moment {
        beta: share,
        scale: 1.0,
        squared: false,
    };
    for ((_, old), (_, new)) in average.trainable().zip(now.trainable()) {
        moving.take_in(old, new.as_tensor())?;
    }
    for ((_, old), (_, new)) in average.statistics().zip(now.statistics()) {
        old.set(new.as_tensor())?;
    }
    Ok(())
}

/// Matrices and kernels decay; vectors, gates and embedding tables do not.
fn decays(name: &str, tensor: &Tensor) -> bool {
    tensor.rank() >= 2 && !name.ends_with("tables") && !name.ends_with("slots")
}

/// An exponential moving average of the gradient or of its square, or of a parameter.
struct Moment {
    beta: f64,
    scale: f64,
    squared: bool,
}

impl Moment {
    /// Moves the average, in one pass over memory where that is a CPU's.
    fn take_in(&self, average: &Var, new: &Tensor) -> Result<()> {
        if average.device().is_cpu() {
            return average.as_tensor().inplace_op2(new, self);
        }
        self.take_in_by_tensors(average, new)
    }

    fn take_in_by_tensors(&self, average: &Var, new: &Tensor) -> Result<()> {
        let new = (new.detach() * self.scale)?;
        let new = if self.squared { new.sqr()? } else { new };
        let kept = (average.as_tensor().detach() * self.beta)?;
        average.set(&(kept + (new * (1.0 - self.beta))?)?)
    }
}

impl InplaceOp2 for Moment {
    fn name(&self) -> &'static str {
        "adamw-moment"
    }

    fn cpu_fwd(
        &self,
        moment: &mut CpuStorage,
        ml: &Layout,
        gradient: &CpuStorage,
        gl: &Layout,
    ) -> Result<()> {
        let n = ml.shape().elem_count();
        let moment = &mut floats(moment)?[ml.start_offset()..][..n];
        let gradient = &gradient.as_slice::<f32>()?[gl.start_offset()..][..n];
        let (beta, scale) = (self.beta as f32, self.scale as f32);
        for (m, &g) in moment.iter_mut().zip(gradient) {
            let g = g * scale;
            let g = if self.squared { g * g } else { g };
            *m = beta * *m + (1.0 - beta) * g;
        }
        Ok(())
    }
}

/// The parameter's step from its moments.
struct Update {
    rate: f64,
    decay: f64,
    correction1: f64,
    correction2: f64,
}

impl Update {
    /// Moves the parameter, in one pass over memory where that is a CPU's.
    fn apply(&self, parameter: &Var, m: &Var, v: &Var) -> Result<()> {
        let (m, v) = (m.as_tensor(), v.as_tensor());
        if parameter.device().is_cpu() {
            return parameter.as_tensor().inplace_op3(m, v, self);
        }
        self.apply_by_tensors(parameter, m, v)
    }

    fn apply_by_tensors(&self, parameter: &Var, m: &Tensor, v: &Tensor) -> Result<()> {
        let deviation = ((v.detach() / self.correction2)?.sqrt()? + EPS)?;
        let change = ((m.detach() * (self.rate / self.correction1))? / deviation)?;
        let kept = (parameter.as_tensor().detach() * (1.0 - self.decay))?;
        parameter.set(&(kept - change)?)
    }
}

impl InplaceOp3 for Update {
    fn name(&self) -> &'static str {
        "adamw-update"
    }

    fn cpu_fwd(
        &self,
        parameter: &mut CpuStorage,
        pl: &Layout,
        m: &CpuStorage,
        ml: &Layout,
        v: &CpuStorage,
        vl: &Layout,
    ) -> Result<()> {
        let n = pl.shape().elem_count();
        let parameter = &mut floats(parameter)?[pl.start_offset()..][..n];
        let m = &m.as_slice::<f32>()?[ml.start_offset()..][..n];
        let v = &v.as_slice::<f32>()?[vl.start_offset()..][..n];
        let rate = (self.rate / self.correction1) as f32;
        let correction2 = (1.0 / self.correction2) as f32;
        let keep = (1.0 - self.decay) as f32;
        for ((p, &m), &v) in parameter.iter_mut().zip(m).zip(v) {
            *p = keep * *p - rate * m / ((v * correction2).sqrt() + EPS as f32);
        }
        Ok(())
    }
}

fn floats(storage: &mut CpuStorage) -> Result<&mut [f32]> {
    match storage {
        CpuStorage::F32(values) => Ok(values),
        _ => candle_core::bail!("the optimiser works in f32"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    /// The fused pass on a CPU agrees with the tensor operations used on other devices.
    #[test]
    fn one_pass_is_what_tensors_say() {
        let var = |salt: f32| {
            let numbers: Vec<f32> = (0..50).map(|i| (i as f32 * salt).sin()).collect();
            Var::from_vec(numbers, 50, &Device::Cpu).unwrap()
        };
        let assert_alike = |a: &Var, b: &Var| {
            let [a, b] = [a, b].map(|v| v.to_vec1::<f32>().unwrap());
            for (a, b) in a.iter().zip(&b) {
                assert!((a - b).abs() < 1e-6, "{a} against {b}");
            }
        };
        let gradient = var(0.7);
        for squared in [false, true] {
            let moment = Moment {
                beta: 0.9,
                scale: 0.5,
                squared,
            };
            let (fused, plain) = (var(0.3), var(0.3));
            moment.take_in(&fused, &gradient).unwrap();
            moment.take_in_by_tensors(&plain, &gradient).unwrap();
            assert_alike(&fused, &plain);
        }
        let update = Update {
            rate: 0.01,
            decay: 1e-3,
            correction1: 0.1,
            correction2: 0.02,
        };
        let second = Var::from_tensor(&var(0.4).sqr().unwrap()).unwrap();
        let (fused, plain, first) = (var(0.3), var(0.3), var(0.9));
        update.apply(&fused, &first, &second).unwrap();
        update.apply_by_tensors(&plain, &first, &second).unwrap();
        assert_alike(&fused, &plain);
    }

    #[test]
    fn the_schedule_warms_up_and_falls() {
        let config = OptimizerConfig {
            learning_rate: 1.0,
            warmup: 10,
            final_fraction: 0.1,
            ..Default::default()
        };
        assert!((config.rate(0, 100) - 0.1).abs() < 1e-12);
        assert!((config.rate(10, 100) - 1.0).abs() < 1e-12);
        assert!((config.rate(100, 100) - 0.1).abs() < 1e-12);
        assert!((config.rate(55, 100) - 0.55).abs() < 1e-12);
    }
}
