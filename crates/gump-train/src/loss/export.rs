//! The tensors of a batch by name: what a loss reads, for the same loss in another language.

use std::collections::BTreeMap;

use candle_core::Tensor;
use gump_model::decoder::STEPS;
use gump_model::{ModelError, Network};
use gump_raster::Raster;
use serde_json::{Value, json};

use super::counts::weight;
use super::trajectory::{pose_tensors, trajectory_targets};
use super::{LossConfig, state_rows, state_tokens, successor_rows};
use crate::sample::{ControlTarget, Sample};

/// The targets of one kind of successor in a sample.
type Spoken = fn(&Sample) -> &Vec<ControlTarget>;

/// Everything that the loss of these samples depends on, by name, and the numbers that its shape
/// depends on.
///
/// Label smoothing and exact targets are not part of it.
pub(crate) fn export(
    network: &Network,
    samples: &[Sample],
    config: &LossConfig,
) -> Result<(BTreeMap<String, Tensor>, Value), ModelError> {
    let device = network.device();
    let rasters: Vec<&Raster> = samples.iter().map(|sample| &sample.raster).collect();
    let raster = network.raster_tensor(&rasters)?;
    let lane_maps = samples.iter().map(|sample| sample.lane_map.clone());
    let memory = network.look(&rasters, lane_maps.collect())?;
    let sequences: Vec<_> = samples
        .iter()
        .map(|sample| sample.slots.as_slice())
        .collect();
    let batch = network.pack(&sequences, 0, &memory)?;
    let (b, t) = batch.shape;

    let (mut all, mut shape) = network.export()?;
    let mut put = |name: String, tensor: Tensor| all.insert(name, tensor);
    put("input.raster".into(), raster);
    for (name, tensor) in batch.named(memory.visual.dim(1)?)? {
        put(format!("input.{name}"), tensor);
    }

    let states: Vec<_> = samples.iter().flat_map(|sample| &sample.states).collect();
    let size = (STEPS.len(), states.len());
    let steps = || (0..STEPS.len()).flat_map(|step| states.iter().map(move |state| (step, *state)));
    let bins = steps().map(|(step, state)| state.bins[step].map_or(0, u32::from));
    let weights = steps().map(|(step, state)| weight(state, step, config) as f32);
    let of_states = [
        (
            "rows",
            Tensor::from_vec(state_rows(samples, t), states.len(), device)?,
        ),
        (
            "tokens",
            Tensor::from_vec(state_tokens(&states), size, device)?,
        ),
        ("bins", Tensor::from_vec(bins.collect(), size, device)?),
        (
            "weights",
            Tensor::from_vec(weights.collect(), size, device)?,
        ),
    ];
    for (name, tensor) in of_states {
        put(format!("state.{name}"), tensor);
    }
    let spoken: [(&str, Spoken); 3] = [
        ("control", |sample| &sample.control),
        ("lights", |sample| &sample.lights),
        ("classes", |sample| &sample.classes),
    ];
    for (name, targets) in spoken {
        let (rows, successors) = successor_rows(samples, targets, t);
        let n = rows.len();
        put(format!("{name}.rows"), Tensor::from_vec(rows, n, device)?);
        put(
            format!("{name}.targets"),
            Tensor::from_vec(successors, n, device)?,
        );
    }
    let agents = trajectory_targets(samples, t, config.max_trajectories);
    if !agents.is_empty() {
        let rows: Vec<u32> = agents.iter().map(|(key, _)| *key).collect();
        let (future, future_shares) =
            pose_tensors(agents.iter().map(|agent| &agent.1.future), device)?;
        let (past, past_shares) = pose_tensors(agents.iter().map(|agent| &agent.1.past), device)?;
        put(
            "trajectory.rows".into(),
            Tensor::from_vec(rows, agents.len(), device)?,
        );
        put("trajectory.future".into(), future);
        put("trajectory.future_shares".into(), future_shares);
        put("trajectory.past".into(), past);
        put("trajectory.past_shares".into(), past_shares);
    }
    shape["sequences"] = json!(b);
    shape["tokens"] = json!(t);
    shape["loss"] = json!(config);
    Ok((all, shape))
}
