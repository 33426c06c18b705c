//! The training loss: cross-entropy of states and successors, trajectories, reconstruction.
//!
//! Every mean is over valid targets only; ignored targets have no effect on value and gradient. A
//! batch may come in parts: each mean is over the targets of the whole batch, so the parts' losses
//! and gradients add up to those of the batch.
//!
//! Source: GUMP's loss with separate means for values and keys, winner-takes-all trajectories.

mod counts;
mod export;
mod trajectory;

use std::sync::Arc;

use candle_core::Tensor;
use serde::{Deserialize, Serialize};

pub(crate) use self::counts::Counts;
pub(crate) use self::export::export;
use gump_kernels::smoothing::OrdinalSmoothing;
use gump_model::ModelError;
use gump_model::Network;
use gump_model::decoder::{STEPS, StateDecoder};
use gump_nn::layers::Dropout;
use gump_nn::ops;
use gump_nn::ops::Targets;
use gump_raster::Raster;

use self::counts::weight;
use self::trajectory::{at_agents, trajectory_loss, trajectory_targets};
use crate::sample::{ControlTarget, Sample, StateTarget};

/// Decoder steps of sizes.
const SIZES: usize = 2;

/// Weights of the parts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Weight of the successor of control and value tokens (released code v1.1: 0.1).
    pub control: f64,
    /// Weight of the states of traffic lights.
    pub lights: f64,
    /// Weight of the classes of agents not seen before.
    pub classes: f64,
    /// Weights of the trajectory heads, shallow to deep (paper: 0.25, 0.25, 0.5, 0.5); a network
    /// with fewer heads uses the last ones.
    pub trajectory: [f64; 4],
    /// Weight of the past in the trajectory heads, relative to the future.
    pub past: f64,
    /// Weight of reconstructing the raster (paper: 1).
    pub reconstruction: f64,
    /// Weight of objects that the window has not shown before, relative to the others (paper: 1);
    /// their position is mostly random.
    pub unknown: f64,
    /// Width of the label smoothing over neighbouring bins, as a standard deviation in bins; 0 is
    /// none (paper).
    pub smoothing_bins: f64,
    /// Whether targets that must be exact are excluded from the smoothing: sizes, and objects that
    /// stand (below 0.3 m/s). A smoothed target gives a parked car a probability of starting at
    /// every step.
    pub exact_standing: bool,
    /// Maximum number of agents per sample for a trajectory head (released code: 512 per batch).
    pub max_trajectories: usize,
}

impl Default for LossConfig {
    /// Where the fields state no source, chosen by hand: lights and classes weigh what the released
    /// code gives control tokens.
    fn default() -> Self {
        Self {
            control: 0.1,
            lights: 0.1,
            classes: 0.1,
            trajectory: [0.25, 0.25, 0.5, 0.5],
            past: 0.25,
            reconstruction: 1.0,
            unknown: 1.0,
            smoothing_bins: 0.0,
            exact_standing: false,
            max_trajectories: 128,
        }
    }
}

/// The parts of a loss as numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LossParts {
    /// The total, which is minimised.
    pub total: f64,
    /// Mean cross-entropy over all state targets, nats.
    pub state: f64,
    /// Cross-entropy per decoder step (width, length, v_x, v_y, four times x, y, θ), nats.
    pub fields: Vec<f64>,
    /// Cross-entropy of successors, nats.
    pub control: f64,
    /// Cross-entropy of the states of lights, nats; 0 where there are none.
    #[serde(default)]
    pub lights: f64,
    /// Cross-entropy of the classes of agents not seen before, nats.
    #[serde(default)]
    pub classes: f64,
    /// Trajectory heads, weighted.
    pub trajectory: f64,
    /// Mean absolute error of the reconstructed raster.
    pub reconstruction: f64,
}

impl Default for LossParts {
    fn default() -> Self {
        Self {
            total: 0.0,
            state: 0.0,
            fields: vec![0.0; STEPS.len()],
            control: 0.0,
            lights: 0.0,
            classes: 0.0,
            trajectory: 0.0,
            reconstruction: 0.0,
        }
    }
}

impl LossParts {
    /// Adds another part of the same batch.
    pub(crate) fn add(&mut self, part: &Self) {
        self.total += part.total;
        self.state += part.state;
        self.control += part.control;
        self.lights += part.lights;
        self.classes += part.classes;
        self.trajectory += part.trajectory;
        self.reconstruction += part.reconstruction;
        let fields = self.fields.iter_mut().zip(&part.fields);
        fields.for_each(|(sum, part)| *sum += part);
    }

    /// All values in a row, for another process.
    pub(crate) fn numbers(&self) -> Vec<f32> {
        let parts = [
            self.total,
            self.state,
            self.control,
            self.lights,
            self.classes,
            self.trajectory,
            self.reconstruction,
        ];
        let all = parts.iter().chain(&self.fields);
        all.map(|&number| number as f32).collect()
    }

    /// From the values of [`Self::numbers`].
    pub(crate) fn of_numbers(numbers: &[f32]) -> Self {
        let number = |i: usize| f64::from(numbers[i]);
        Self {
            total: number(0),
            state: number(1),
            control: number(2),
            lights: number(3),
            classes: number(4),
            trajectory: number(5),
            reconstruction: number(6),
            fields: (7..numbers.len()).map(number).collect(),
        }
    }

    /// The first part that is not a finite number.
    pub fn first_not_finite(&self) -> Option<String> {
        let named = [
            ("control", self.control),
            ("lights", self.lights),
            ("classes", self.classes),
            ("trajectory", self.trajectory),
            ("reconstruction", self.reconstruction),
            ("total", self.total),
        ];
        let fields = self
            .fields
            .iter()
            .enumerate()
            .map(|(i, &v)| (format!("step {i} {:?}", STEPS[i]), v));
        let all = fields.chain(named.map(|(name, value)| (name.to_owned(), value)));
        all.into_iter()
            .find(|(_, value)| !value.is_finite())
            .map(|(name, _)| name)
    }
}

/// One forward pass over samples of a batch that has `whole` targets: their part of its loss, for
/// differentiation, and as numbers.
///
/// `training` decides whether batch norms use the batch; `dropout` is applied where it is given.
pub(crate) fn loss(
    network: &Network,
    samples: &[Sample],
    config: &LossConfig,
    whole: &Counts,
    training: bool,
    dropout: Option<&Dropout>,
) -> Result<(Tensor, LossParts), ModelError> {
    let device = network.device();
    let width = network.config().width;
    let rasters: Vec<&Raster> = samples.iter().map(|sample| &sample.raster).collect();
    let raster = network.raster_tensor(&rasters)?;
    let features = network.visual.features(&raster, training)?;
    let lane_maps = samples.iter().map(|sample| Arc::clone(&sample.lane_map));
    let memory = network
        .mct
        .remember(&network.place(&features)?, lane_maps.collect())?;
    let sequences: Vec<_> = samples
        .iter()
        .map(|sample| sample.slots.as_slice())
        .collect();
    let batch = network.pack(&sequences, 0, &memory)?;
    let (b, t) = batch.shape;
    let passed = network.mct.forward(&batch, &memory, None, dropout)?;
    let flat = passed.hidden.reshape((b * t, width))?;

    let own = Counts::of(samples, config);
    let mut parts = LossParts::default();
    let mut total = Tensor::zeros((), candle_core::DType::F32, device)?;
    if let Some(state) = state_loss(network, samples, t, &flat, config, whole, &mut parts)? {
        total = (total + state)?;
    }
    let decoder = &network.decoder;
    let spoken = [
        successor_loss(
            samples,
            |s| &s.control,
            t,
            &flat,
            |hidden| decoder.control_logits(hidden),
        )?,
        successor_loss(
            samples,
            |s| &s.lights,
            t,
            &flat,
            |hidden| decoder.light_logits(hidden),
        )?,
        successor_loss(
            samples,
            |s| &s.classes,
            t,
            &flat,
            |hidden| network.mct.class_logits(hidden),
        )?,
    ];
    let weights = [config.control, config.lights, config.classes];
    let shares = [
        own.control / whole.control,
        own.lights / whole.lights,
        own.classes / whole.classes,
    ];
    let fields = [&mut parts.control, &mut parts.lights, &mut parts.classes];
    for (((loss, weight), share), field) in spoken.into_iter().zip(weights).zip(shares).zip(fields)
    {
        if let Some(loss) = loss {
            *field = share * scalar(&loss)?;
            total = (total + (loss * (share * weight))?)?;
        }
    }
    let targets = trajectory_targets(samples, t, config.max_trajectories);
    if !targets.is_empty() {
        let share = own.trajectories / whole.trajectories;
        let weights =
            &config.trajectory[config.trajectory.len().saturating_sub(passed.levels.len())..];
        for ((level, head), weight) in passed
            .levels
            .iter()
            .zip(&network.trajectory_heads)
            .zip(weights)
        {
            let level = level.reshape((b * t, width))?;
            let predicted = head.forward(&at_agents(&level, &targets, device)?)?;
            let part = trajectory_loss(&predicted, &targets, config.past, device)?;
            let part = (part * (share * weight))?;
            parts.trajectory += scalar(&part)?;
            total = (total + part)?;
        }
    }
    if let Some(decoder) = network
        .visual
        .reconstruction()
        .filter(|_| config.reconstruction > 0.0)
    {
        let share = own.scenes / whole.scenes;
        let part = decoder.loss(&features, &raster)?;
        parts.reconstruction = share * scalar(&part)?;
        total = (total + (part * (share * config.reconstruction))?)?;
    }
    parts.total = scalar(&total)?;
    Ok((total, parts))
}

fn scalar(tensor: &Tensor) -> candle_core::Result<f64> {
    Ok(f64::from(tensor.to_scalar::<f32>()?))
}

/// The samples' part of the mean cross-entropy of all state targets; fills the per-step parts.
fn state_loss(
    network: &Network,
    samples: &[Sample],
    t: usize,
    flat: &Tensor,
    config: &LossConfig,
    whole: &Counts,
    parts: &mut LossParts,
) -> Result<Option<Tensor>, ModelError> {
    let device = network.device();
    let targets: Vec<_> = samples.iter().flat_map(|sample| &sample.states).collect();
    let k = targets.len();
    if k == 0 {
        return Ok(None);
    }
    let hidden = flat.index_select(&Tensor::new(state_rows(samples, t), device)?, 0)?; // [K, C]
    let tokens = Tensor::from_vec(state_tokens(&targets), (STEPS.len(), k), device)?;
    let outputs = network.decoder.teacher_forced(
        &network.decoder.input_table(&network.mct.token_table()?)?,
        &hidden,
        &tokens,
    )?;

    let by_field = STEPS.into_iter().enumerate().map(|(step, field)| {
        let bins = targets.iter().map(|t| t.bins[step].map_or(0, u32::from));
        let weights = targets.iter().map(|t| weight(t, step, config) as f32);
        let field_targets = Targets {
            bins: bins.collect(),
            weights: weights.collect(),
            smoothing: (config.smoothing_bins > 0.0).then(|| OrdinalSmoothing {
                sigma_bins: config.smoothing_bins as f32,
                circular: field.is_circular(),
            }),
            exact: match config.exact_standing {
                true => targets.iter().map(|t| step < SIZES || t.stands).collect(),
                false => Vec::new(),
            },
        };
        (StateDecoder::rows_of(field), field_targets)
    });
    let matrix = network.decoder.all_output_rows()?;
    let means = ops::linear_cross_entropy(&outputs, &matrix, by_field.collect())?; // [STEPS]
    let all = whole.states();
    let mut shares = Vec::with_capacity(STEPS.len());
    for (step, mean) in means.to_vec1::<f32>()?.into_iter().enumerate() {
        let own: f64 = targets.iter().map(|t| weight(t, step, config)).sum();
        let sum = own * f64::from(mean);
        parts.fields[step] = sum / whole.steps[step].max(f64::MIN_POSITIVE);
        parts.state += sum / all;
        shares.push((own / all) as f32);
    }
    let shares = Tensor::new(shares, device)?;
    Ok(Some((means * shares)?.sum_all()?))
}

/// The flat index of every state target's key, in sequences of `t` tokens.
fn state_rows(samples: &[Sample], t: usize) -> Vec<u32> {
    let rows = samples.iter().enumerate().flat_map(|(row, sample)| {
        let keys = sample.states.iter().map(|target| target.key);
        keys.map(move |key| (row * t + key) as u32)
    });
    rows.collect()
}

/// The tokens of state targets, step by step.
fn state_tokens(targets: &[&StateTarget]) -> Vec<u32> {
    (0..STEPS.len())
        .flat_map(|step| targets.iter().map(move |target| target.token(step)))
        .collect()
}

/// The flat index of every slot with such a target, in sequences of `t` tokens, and the target.
fn successor_rows(
    samples: &[Sample],
    targets: impl Fn(&Sample) -> &Vec<ControlTarget>,
    t: usize,
) -> (Vec<u32>, Vec<u32>) {
    let of_sample = |(row, sample): (usize, _)| {
        let at = move |target: &ControlTarget| ((row * t + target.slot) as u32, target.successor);
        targets(sample).iter().map(at).collect::<Vec<_>>()
    };
    samples.iter().enumerate().flat_map(of_sample).unzip()
}

/// Mean cross-entropy of the successors of some slots.
fn successor_loss(
    samples: &[Sample],
    targets: impl Fn(&Sample) -> &Vec<ControlTarget>,
    t: usize,
    flat: &Tensor,
    logits: impl Fn(&Tensor) -> candle_core::Result<Tensor>,
) -> Result<Option<Tensor>, ModelError> {
    let device = flat.device();
    let (rows, successors) = successor_rows(samples, targets, t);
    let n = rows.len();
    if n == 0 {
        return Ok(None);
    }
    let hidden = flat.index_select(&Tensor::from_vec(rows, n, device)?, 0)?;
    let weights = Tensor::ones(n, candle_core::DType::F32, device)?;
    let targets = Tensor::from_vec(successors, n, device)?;
    Ok(Some(ops::masked_cross_entropy(
        &logits(&hidden)?,
        &targets,
        &weights,
        None,
    )?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_part_that_is_not_a_number_is_named() {
        let mut parts = LossParts::default();
        assert_eq!(parts.first_not_finite(), None);
        parts.total = f64::NAN;
        parts.fields[4] = f64::INFINITY;
        assert_eq!(parts.first_not_finite().unwrap(), "step 4 X");
    }

    #[test]
    fn numbers_in_a_row_are_the_parts_again() {
        let row: Vec<f32> = (0..7 + STEPS.len()).map(|i| i as f32).collect();
        let parts = LossParts::of_numbers(&row);
        assert_eq!(parts.numbers(), row);
        let mut twice = parts.clone();
        twice.add(&parts);
        let doubled: Vec<f32> = row.iter().map(|number| 2.0 * number).collect();
        assert_eq!(twice.numbers(), doubled);
    }
}
