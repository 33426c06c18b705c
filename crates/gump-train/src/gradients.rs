//! Losses and gradients of the parts of a batch, summed over parts and processes.

use std::collections::BTreeMap;

use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor};
use gump_nn::ops::Deferred;
use gump_nn::parameters::Parameters;
use rayon::prelude::*;

use super::process_group::ProcessGroup;
use crate::TrainError;
use crate::loss::LossParts;

/// Gradients by the names of their parameters; parameters without a gradient are absent.
pub(crate) type Gradients = BTreeMap<String, Tensor>;

/// The loss of a batch, its gradients, and the amount of data.
#[derive(Default)]
pub(super) struct BatchGradients {
    pub(super) gradients: Gradients,
    pub(super) loss: LossParts,
    pub(super) tokens: usize,
}

/// The result for a part of the batch.
pub(super) struct Part {
    pub(super) gradients: GradStore,
    /// Gradients of matrices that are not yet multiplied out.
    pub(super) deferred: Deferred,
    pub(super) loss: LossParts,
    pub(super) tokens: usize,
}

impl BatchGradients {
    /// Adds the results of parts of the batch, in their order.
    pub(super) fn add(&mut self, parameters: &Parameters, parts: &[Part]) -> Result<()> {
        let trainable: Vec<_> = parameters.trainable().collect();
        let sums = trainable.into_par_iter().map(|(name, var)| {
            let mut sum = self.gradients.get(name).cloned();
            for part in parts {
                if let Some(gradient) = part.gradients.get(var) {
                    sum = Some(match sum {
                        Some(sum) => (sum + gradient)?,
                        None => gradient.clone(),
                    });
                }
            }
            let deferred = parts.iter().map(|part| &part.deferred);
            let sum = Deferred::take_in(deferred, var, sum)?;
            Ok(sum.map(|sum| (name.to_owned(), sum)))
        });
        let sums: Vec<_> = sums.collect::<Result<_>>()?;
        self.gradients = sums.into_iter().flatten().collect();
        for part in parts {
            self.loss.add(&part.loss);
            self.tokens += part.tokens;
        }
        Ok(())
    }

    /// Sums the results of all processes, and averages their running statistics.
    pub(super) fn share(
        &mut self,
        parameters: &Parameters,
        group: &dyn ProcessGroup,
    ) -> std::result::Result<(), TrainError> {
        if group.size() == 1 {
            return Ok(());
        }
        let mut numbers = self.loss.numbers();
        numbers.push(self.tokens as f32);
        let n_scalars = numbers.len();
        for (name, var) in parameters.trainable() {
            // Each gradient after whether there is one.
            match self.gradients.get(name) {
                Some(gradient) => {
                    numbers.push(1.0);
                    numbers.extend(gradient.flatten_all()?.to_vec1::<f32>()?);
                }
                None => numbers.resize(numbers.len() + 1 + var.elem_count(), 0.0),
            }
        }
        for (_, var) in parameters.statistics() {
            numbers.extend(var.flatten_all()?.to_vec1::<f32>()?);
        }
        group.sum(&mut numbers)?;
        let (scalars, mut rest) = numbers.split_at(n_scalars);
        self.tokens = scalars[n_scalars - 1].round() as usize;
        self.loss = LossParts::of_numbers(&scalars[..n_scalars - 1]);
        let mut take = |n: usize| {
            let (taken, left) = rest.split_at(n);
            rest = left;
            taken
        };
        for (name, var) in parameters.trainable() {
            let is_there = take(1)[0] > 0.0;
            let gradient = take(var.elem_count());
            if is_there {
                let gradient = Tensor::from_slice(gradient, var.shape(), var.device())?;
                self.gradients.insert(name.to_owned(), gradient);
            }
        }
        for (_, var) in parameters.statistics() {
            let sum = Tensor::from_slice(take(var.elem_count()), var.shape(), var.device())?;
            var.set(&(sum / group.size() as f64)?)?;
        }
        Ok(())
    }
}
