//! The loss of the trajectory heads: best-of-modes regression, classification of the best mode, and
//! the past.

use candle_core::{D, Device, Tensor};
use gump_model::trajectory_head::{FUTURE, MODES, PAST, POSE, Trajectories};

use crate::sample::{Sample, TrajectoryTarget};

/// Up to `limit` targets of each sample, spread evenly over it, with the flat index of their key.
pub(super) fn trajectory_targets(
    samples: &[Sample],
    t: usize,
    limit: usize,
) -> Vec<(u32, &TrajectoryTarget)> {
    let rows = samples.iter().enumerate();
    rows.flat_map(|(row, sample)| {
        limited_targets(sample, limit).map(move |target| ((row * t + target.key) as u32, target))
    })
    .collect()
}

/// At most `limit` targets of the heads in a sample, spread evenly over it.
pub(super) fn limited_targets(
    sample: &Sample,
    limit: usize,
) -> impl Iterator<Item = &TrajectoryTarget> {
    let stride = sample.trajectories.len().div_ceil(limit.max(1)).max(1);
    sample.trajectories.iter().step_by(stride)
}

/// Features at key and value side by side, [A, 2C].
pub(super) fn at_agents(
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

/// Best-of-modes regression, classification of the best mode, and regression of the past.
pub(super) fn trajectory_loss(
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
pub(super) fn pose_tensors<'a, const N: usize>(
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
}
