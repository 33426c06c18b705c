//! What training minimises: cross-entropy of states and successors, trajectories, reconstruction.
//!
//! Every mean is over valid targets only; an ignored target has no value and no gradient.
//!
//! Source: GUMP's loss with separate means for values and keys, winner-takes-all trajectories.

use std::sync::Arc;

use candle_core::{D, Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::ModelError;
use crate::decoder::STEPS;
use crate::mct::Dropout;
use crate::network::Network;
use crate::ops::{self, OrdinalSmoothing};
use crate::sample::{ControlTarget, Sample, StateTarget, TrajectoryTarget};
use crate::trajectory::{FUTURE, MODES, PAST, POSE, Trajectories};

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
    /// Weight of recalling the past in the trajectory heads, relative to the future.
    pub past: f64,
    /// Weight of reconstructing the raster (paper: 1).
    pub reconstruction: f64,
    /// Weight of objects that the window has not shown before, relative to the others (paper: 1);
    /// where they are is nearly all chance.
    pub unknown: f64,
    /// Width of the label smoothing over neighbouring bins, as a standard deviation in bins; 0 is
    /// none (paper).
    pub smoothing_bins: f64,
    /// Most agents per batch that a trajectory head is asked about (released code: 512).
    pub max_trajectories: usize,
}

impl Default for LossConfig {
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
            max_trajectories: 512,
        }
    }
}

/// The parts of a loss as numbers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LossParts {
    /// What was minimised.
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

impl LossParts {
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

/// One forward pass over samples: the loss to differentiate and its parts.
///
/// With `dropout` the pass is a training pass; without, an evaluation.
pub(crate) fn loss(
    network: &Network,
    samples: &[Sample],
    config: &LossConfig,
    training: bool,
    dropout: Option<&Dropout>,
) -> Result<(Tensor, LossParts), ModelError> {
    let device = network.device();
    let width = network.config().width;
    let rasters: Vec<_> = samples.iter().map(|sample| sample.raster.clone()).collect();
    let raster = network.raster_tensor(&rasters)?;
    let features = network.visual.features(&raster, training)?;
    let surveys = samples.iter().map(|sample| Arc::clone(&sample.survey));
    let memory = network
        .mct
        .remember(&network.place(&features)?, surveys.collect())?;
    let sequences: Vec<_> = samples
        .iter()
        .map(|sample| sample.slots.as_slice())
        .collect();
    let batch = network.pack(&sequences, 0, &memory)?;
    let (b, t) = batch.shape;
    let passed = network.mct.forward(&batch, &memory, None, dropout)?;
    let flat = passed.hidden.reshape((b * t, width))?;

    let mut parts = LossParts::default();
    let mut total = Tensor::zeros((), candle_core::DType::F32, device)?;
    if let Some(state) = state_loss(network, samples, t, &flat, config, &mut parts)? {
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
    let said = [&mut parts.control, &mut parts.lights, &mut parts.classes];
    for ((loss, weight), said) in spoken.into_iter().zip(weights).zip(said) {
        if let Some(loss) = loss {
            *said = scalar(&loss)?;
            total = (total + (loss * weight)?)?;
        }
    }
    let targets = trajectory_targets(samples, t, config.max_trajectories);
    if !targets.is_empty() {
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
            let part = (trajectory_loss(&predicted, &targets, config.past, device)? * *weight)?;
            parts.trajectory += scalar(&part)?;
            total = (total + part)?;
        }
    }
    if let Some(decoder) = network
        .visual
        .reconstruction()
        .filter(|_| config.reconstruction > 0.0)
    {
        let part = decoder.loss(&features, &raster)?;
        parts.reconstruction = scalar(&part)?;
        total = (total + (part * config.reconstruction)?)?;
    }
    parts.total = scalar(&total)?;
    Ok((total, parts))
}

fn scalar(tensor: &Tensor) -> candle_core::Result<f64> {
    Ok(f64::from(tensor.to_scalar::<f32>()?))
}

/// Mean cross-entropy of all state targets; fills the per-step parts.
fn state_loss(
    network: &Network,
    samples: &[Sample],
    t: usize,
    flat: &Tensor,
    config: &LossConfig,
    parts: &mut LossParts,
) -> Result<Option<Tensor>, ModelError> {
    let device = network.device();
    let targets: Vec<_> = samples.iter().flat_map(|sample| &sample.states).collect();
    let k = targets.len();
    if k == 0 {
        return Ok(None);
    }
    let rows = samples.iter().enumerate().flat_map(|(row, sample)| {
        sample
            .states
            .iter()
            .map(move |target| (row * t + target.key) as u32)
    });
    let hidden = flat.index_select(&Tensor::from_vec(rows.collect::<Vec<u32>>(), k, device)?, 0)?; // [K, C]
    let tokens: Vec<u32> = (0..STEPS.len())
        .flat_map(|step| targets.iter().map(move |target| target.token(step)))
        .collect();
    let tokens = Tensor::from_vec(tokens, (STEPS.len(), k), device)?;
    let outputs = network.decoder.teacher_forced(
        &network.decoder.input_table(&network.mct.token_table()?)?,
        &hidden,
        &tokens,
    )?;

    let weight = |target: &StateTarget, step: usize| match target.bins[step] {
        None => 0.0,
        Some(_) if target.is_known => 1.0,
        Some(_) => config.unknown,
    };
    let weights: Vec<f64> = (0..STEPS.len())
        .map(|step| targets.iter().map(|target| weight(target, step)).sum())
        .collect();
    let n: f64 = weights.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    let mut total = None;
    for (step, field) in STEPS.into_iter().enumerate() {
        let bins: Vec<u32> = targets
            .iter()
            .map(|t| t.bins[step].map_or(0, u32::from))
            .collect();
        let valid: Vec<f32> = targets
            .iter()
            .map(|target| weight(target, step) as f32)
            .collect();
        let logits = network.decoder.logits(&outputs.get(step)?, field)?; // [K, bins]
        let smoothing = (config.smoothing_bins > 0.0).then(|| OrdinalSmoothing {
            sigma_bins: config.smoothing_bins as f32,
            circular: field.is_circular(),
        });
        let mean = ops::masked_cross_entropy(
            &logits,
            &Tensor::from_vec(bins, k, device)?,
            &Tensor::from_vec(valid, k, device)?,
            smoothing,
        )?;
        parts.fields.push(scalar(&mean)?);
        let share = weights[step] / n;
        parts.state += share * parts.fields[step];
        let part = (mean * share)?;
        total = Some(match total {
            None => part,
            Some(total) => (part + total)?,
        });
    }
    Ok(total)
}

/// Mean cross-entropy of what is said of the successors of some slots.
fn successor_loss(
    samples: &[Sample],
    targets: impl Fn(&Sample) -> &Vec<ControlTarget>,
    t: usize,
    flat: &Tensor,
    logits: impl Fn(&Tensor) -> candle_core::Result<Tensor>,
) -> Result<Option<Tensor>, ModelError> {
    let device = flat.device();
    let (rows, successors): (Vec<u32>, Vec<u32>) = samples
        .iter()
        .enumerate()
        .flat_map(|(row, sample)| {
            let of_sample = targets(sample).iter();
            of_sample.map(move |target| ((row * t + target.slot) as u32, target.successor))
        })
        .unzip();
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

/// Up to `limit` targets spread evenly over the batch, with the flat index of their key.
fn trajectory_targets(samples: &[Sample], t: usize, limit: usize) -> Vec<(u32, &TrajectoryTarget)> {
    let all: Vec<_> = samples
        .iter()
        .enumerate()
        .flat_map(|(row, sample)| {
            sample
                .trajectories
                .iter()
                .map(move |target| ((row * t + target.key) as u32, target))
        })
        .collect();
    let stride = all.len().div_ceil(limit.max(1)).max(1);
    all.into_iter().step_by(stride).collect()
}

/// Features at key and value side by side, [A, 2C].
fn at_agents(
    level: &Tensor,
    targets: &[(u32, &TrajectoryTarget)],
    device: &Device,
) -> candle_core::Result<Tensor> {
    let pick = |offset: u32| {
        let rows: Vec<u32> = targets.iter().map(|(key, _)| key + offset).collect();
        level.index_select(&Tensor::new(rows, device)?, 0)
    };
    Tensor::cat(&[pick(0)?, pick(1)?], 1)
}

/// Best-of-modes regression plus classification of the best mode, plus recalling the past.
pub(crate) fn trajectory_loss(
    predicted: &Trajectories,
    targets: &[(u32, &TrajectoryTarget)],
    past_weight: f64,
    device: &Device,
) -> candle_core::Result<Tensor> {
    let a = targets.len();
    let (future, future_share) =
        pose_tensors::<FUTURE>(targets.iter().map(|t| &t.1.future), device)?;
    let (past, past_share) = pose_tensors::<PAST>(targets.iter().map(|t| &t.1.past), device)?;

    let off = predicted
        .future
        .broadcast_sub(&future.reshape((a, 1, FUTURE, POSE))?)?;
    let distance = (off.narrow(3, 0, 2)?.sqr()?.sum(3)? + 1e-5)?.sqrt()?; // [A, MODES, FUTURE]
    let turn = off.narrow(3, 2, 2)?.abs()?.sum(3)?;
    let share = future_share.reshape((a, 1, FUTURE))?;
    let error = (distance + (turn * 2.0)?)?.broadcast_mul(&share)?.sum(2)?; // [A, MODES]

    // The winner is picked outside the graph: no gradient flows through the choice.
    let errors = error.to_vec2::<f32>()?;
    let winners = errors.iter().flat_map(|row| {
        let best = (0..MODES)
            .min_by(|&i, &j| row[i].total_cmp(&row[j]))
            .expect("there are modes");
        (0..MODES).map(move |mode| f32::from(u8::from(mode == best)))
    });
    let winners = Tensor::from_vec(winners.collect::<Vec<f32>>(), (a, MODES), device)?;
    let log_share = candle_nn::ops::log_softmax(&predicted.modes, D::Minus1)?;
    let regression = (&error * &winners)?.sum_all()?;
    let classification = (log_share * &winners)?.sum_all()?.neg()?;

    let off = (&predicted.past - past)?.abs()?;
    let recall = (off.narrow(2, 0, 2)?.sum(2)? + (off.narrow(2, 2, 2)?.sum(2)? * 2.0)?)?;
    let recall = (recall * past_share)?.sum_all()?;
    ((regression + classification)? + (recall * past_weight)?)? / a as f64
}

/// Poses [A, N, POSE] with zeros where missing, and per step 1 / (valid steps) or 0, [A, N].
fn pose_tensors<'a, const N: usize>(
    rows: impl Iterator<Item = &'a [Option<[f32; POSE]>; N]>,
    device: &Device,
) -> candle_core::Result<(Tensor, Tensor)> {
    let (mut poses, mut shares) = (Vec::new(), Vec::new());
    for row in rows {
        let valid = row.iter().flatten().count().max(1) as f32;
        for pose in row {
            poses.extend(pose.unwrap_or([0.0; POSE]));
            shares.push(if pose.is_some() { 1.0 / valid } else { 0.0 });
        }
    }
    let a = shares.len() / N;
    Ok((
        Tensor::from_vec(poses, (a, N, POSE), device)?,
        Tensor::from_vec(shares, (a, N), device)?,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn target(future: [Option<[f32; POSE]>; FUTURE]) -> TrajectoryTarget {
        TrajectoryTarget {
            key: 0,
            past: [None; PAST],
            future,
        }
    }

    /// The loss of one agent whose modes all predict standing still, and its gradient on the
    /// future.
    fn check(target: &TrajectoryTarget) -> (f32, Vec<f32>) {
        let device = Device::Cpu;
        let future =
            candle_core::Var::zeros((1, MODES, FUTURE, POSE), candle_core::DType::F32, &device)
                .unwrap();
        let predicted = Trajectories {
            past: Tensor::zeros((1, PAST, POSE), candle_core::DType::F32, &device).unwrap(),
            future: future.as_tensor().clone(),
            modes: Tensor::zeros((1, MODES), candle_core::DType::F32, &device).unwrap(),
        };
        let loss = trajectory_loss(&predicted, &[(0, target)], 1.0, &device).unwrap();
        let gradient = loss
            .backward()
            .unwrap()
            .get(&future)
            .unwrap()
            .flatten_all()
            .unwrap();
        (loss.to_scalar().unwrap(), gradient.to_vec1().unwrap())
    }

    #[test]
    fn equal_modes_cost_ln_6_and_masked_steps_nothing() {
        let (loss, gradient) = check(&target([None; FUTURE]));
        assert!((loss - 6f32.ln()).abs() < 1e-5, "{loss}");
        assert!(gradient.iter().all(|&g| g == 0.0));
    }

    #[test]
    fn only_the_winning_mode_and_valid_steps_learn() {
        let mut future = [None; FUTURE];
        future[3] = Some([3.0, 4.0, 0.6, 0.8]);
        let (loss, gradient) = check(&target(future));
        // One valid step, 5 m and 0.6 + 0.8 in sine and cosine off: its share is one.
        assert!(
            (loss - (6f32.ln() + 5.0 + 2.0 * 1.4)).abs() < 1e-4,
            "{loss}"
        );
        let moved: Vec<usize> = (0..gradient.len())
            .filter(|&i| gradient[i] != 0.0)
            .collect();
        assert_eq!(moved, [12, 13, 14, 15]);
    }

    #[test]
    fn the_first_part_that_is_not_a_number_is_named() {
        let mut parts = LossParts {
            fields: vec![0.5; STEPS.len()],
            ..LossParts::default()
        };
        assert_eq!(parts.first_not_finite(), None);
        parts.total = f64::NAN;
        parts.fields[4] = f64::INFINITY;
        assert_eq!(parts.first_not_finite().unwrap(), "step 4 X");
    }
}
