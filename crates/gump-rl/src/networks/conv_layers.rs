//! Layers of convolutional networks, forward and backward.

use super::convolution::Convolution;
use super::group_norm::GroupNorm;

/// A convolution and the normalization of its output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Unit {
    pub(super) convolution: Convolution,
    /// Offset of its parameters: weights, scales, shifts.
    begin: usize,
}

/// One layer; ReLU comes last in those with weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Layer {
    Plain(Unit),
    /// The largest of 3 x 3 pixels, at every second one.
    Pool {
        channels: usize,
        side: usize,
    },
    /// Two convolutions, to which the input is added, by way of a third where shapes differ.
    Residual {
        first: Unit,
        second: Unit,
        shortcut: Option<Unit>,
    },
}

/// Activations of a layer for some rows, kept for the backward pass.
#[derive(Clone, Debug, Default)]
pub(super) struct LayerPass {
    /// Its output. Shape: `[channels, rows, side, side]`.
    pub(super) output: Vec<f32>,
    /// By unit: first, second, shortcut.
    units: [UnitPass; 3],
    /// Between first and second unit. Shape: as the output.
    middle: Vec<f32>,
    /// Index of the largest pixel of the input, for pooling. Shape: as the output.
    largest: Vec<u32>,
}

#[derive(Clone, Debug, Default)]
struct UnitPass {
    normalized: Vec<f32>,
    inverse_deviations: Vec<f32>,
}

impl Unit {
    pub(super) fn new(convolution: Convolution, begin: usize) -> Self {
        Self { convolution, begin }
    }

    pub(super) fn n_weights(&self) -> usize {
        self.convolution.n_weights()
    }

    /// Range of its parameters among all of them.
    pub(super) fn range(&self) -> std::ops::Range<usize> {
        let n = self.n_weights() + GroupNorm::n_parameters(self.convolution.outputs);
        self.begin..self.begin + n
    }

    fn norm(&self, rows: usize) -> GroupNorm {
        GroupNorm {
            channels: self.convolution.outputs,
            rows,
            area: self.convolution.side_out().pow(2),
        }
    }

    fn forward(
        &self,
        parameters: &[f32],
        input: &[f32],
        rows: usize,
        columns: &mut Vec<f32>,
        (pass, output): (&mut UnitPass, &mut Vec<f32>),
    ) {
        let (weights, rest) = parameters[self.range()].split_at(self.n_weights());
        self.convolution
            .forward(weights, input, rows, columns, &mut pass.normalized);
        self.norm(rows).forward(
            rest,
            &mut pass.normalized,
            &mut pass.inverse_deviations,
            output,
        );
    }

    /// Turns the gradient of the output, `delta`, into those of the parameters and the input, and
    /// adds them up.
    fn backward(
        &self,
        (parameters, gradient): (&[f32], &mut [f32]),
        (input, input_gradient): (&[f32], Option<&mut [f32]>),
        pass: &UnitPass,
        delta: &mut [f32],
        rows: usize,
        columns: &mut Vec<f32>,
    ) {
        let (weights, rest) = parameters[self.range()].split_at(self.n_weights());
        let gradient = gradient[self.range()].split_at_mut(self.n_weights());
        self.norm(rows).backward(
            (rest, gradient.1),
            &pass.normalized,
            &pass.inverse_deviations,
            delta,
        );
        self.convolution.backward(
            (weights, gradient.0),
            (input, input_gradient),
            delta,
            rows,
            columns,
        );
    }

    /// Numbers of its input for so many rows.
    fn input_len(&self, rows: usize) -> usize {
        self.convolution.inputs * rows * self.convolution.side.pow(2)
    }
}

impl Layer {
    /// The units in it.
    pub(super) fn units(&self) -> impl Iterator<Item = Unit> {
        let units = match *self {
            Self::Plain(unit) => [Some(unit), None, None],
            Self::Pool { .. } => [None; 3],
            Self::Residual {
                first,
                second,
                shortcut,
            } => [Some(first), Some(second), shortcut],
        };
        units.into_iter().flatten()
    }

    pub(super) fn channels_out(&self) -> usize {
        match self {
            Self::Plain(unit) | Self::Residual { second: unit, .. } => unit.convolution.outputs,
            Self::Pool { channels, .. } => *channels,
        }
    }

    pub(super) fn side_out(&self) -> usize {
        match self {
            Self::Plain(unit) | Self::Residual { second: unit, .. } => unit.convolution.side_out(),
            Self::Pool { side, .. } => (side - 1) / 2 + 1,
        }
    }

    /// Shape: `input` `[channels, rows, side, side]`.
    pub(super) fn forward(
        &self,
        parameters: &[f32],
        input: &[f32],
        rows: usize,
        columns: &mut Vec<f32>,
        pass: &mut LayerPass,
    ) {
        let LayerPass {
            output,
            units: [of_first, of_second, of_shortcut],
            middle,
            largest,
        } = pass;
        match self {
            Self::Plain(unit) => {
                unit.forward(parameters, input, rows, columns, (of_first, output));
                relu(output);
            }
            Self::Pool { side, .. } => pool(input, *side, output, largest),
            Self::Residual {
                first,
                second,
                shortcut,
            } => {
                let around = shortcut.map(|unit| {
                    let mut maps = Vec::new();
                    unit.forward(parameters, input, rows, columns, (of_shortcut, &mut maps));
                    maps
                });
                first.forward(parameters, input, rows, columns, (of_first, middle));
                relu(middle);
                second.forward(parameters, middle, rows, columns, (of_second, output));
                add(output, around.as_deref().unwrap_or(input));
                relu(output);
            }
        }
    }

    /// The gradient of the input, given that of the output, `delta`; that of the parameters is
    /// added to what there is.
    pub(super) fn backward(
        &self,
        (parameters, gradient): (&[f32], &mut [f32]),
        input: &[f32],
        pass: &LayerPass,
        mut delta: Vec<f32>,
        rows: usize,
        columns: &mut Vec<f32>,
    ) -> Vec<f32> {
        let [of_first, of_second, of_shortcut] = &pass.units;
        let mut before = vec![0.0; input.len()];
        match self {
            Self::Plain(unit) => {
                relu_back(&pass.output, &mut delta);
                // Pixels do not learn.
                let is_first = unit.range().start == 0;
                let input = (input, (!is_first).then_some(before.as_mut_slice()));
                unit.backward(
                    (parameters, gradient),
                    input,
                    of_first,
                    &mut delta,
                    rows,
                    columns,
                );
            }
            Self::Pool { .. } => {
                for (&at, d) in pass.largest.iter().zip(&delta) {
                    before[at as usize] += d;
                }
            }
            Self::Residual {
                first,
                second,
                shortcut,
            } => {
                relu_back(&pass.output, &mut delta);
                match shortcut {
                    Some(unit) => unit.backward(
                        (parameters, &mut *gradient),
                        (input, Some(&mut before)),
                        of_shortcut,
                        &mut delta.clone(),
                        rows,
                        columns,
                    ),
                    None => add(&mut before, &delta),
                }
                let mut middle = vec![0.0; second.input_len(rows)];
                second.backward(
                    (parameters, &mut *gradient),
                    (&pass.middle, Some(&mut middle)),
                    of_second,
                    &mut delta,
                    rows,
                    columns,
                );
                relu_back(&pass.middle, &mut middle);
                first.backward(
                    (parameters, gradient),
                    (input, Some(&mut before)),
                    of_first,
                    &mut middle,
                    rows,
                    columns,
                );
            }
        }
        before
    }
}

fn relu(values: &mut [f32]) {
    for x in values {
        *x = x.max(0.0);
    }
}

/// Keeps the gradient where ReLU let something through.
fn relu_back(output: &[f32], delta: &mut [f32]) {
    for (d, &x) in delta.iter_mut().zip(output) {
        *d = if x > 0.0 { *d } else { 0.0 };
    }
}

fn add(sum: &mut [f32], values: &[f32]) {
    for (x, y) in sum.iter_mut().zip(values) {
        *x += y;
    }
}

/// The largest of 3 x 3 pixels around every second one, and which it is.
fn pool(input: &[f32], side: usize, output: &mut Vec<f32>, largest: &mut Vec<u32>) {
    output.clear();
    largest.clear();
    for (map, pixels) in input.chunks_exact(side * side).enumerate() {
        for y in (0..side).step_by(2) {
            for x in (0..side).step_by(2) {
                let mut best = y * side + x;
                for ny in y.saturating_sub(1)..(y + 2).min(side) {
                    for nx in x.saturating_sub(1)..(x + 2).min(side) {
                        if pixels[ny * side + nx] > pixels[best] {
                            best = ny * side + nx;
                        }
                    }
                }
                output.push(pixels[best]);
                let at = map * side * side + best;
                largest.push(u32::try_from(at).expect("a piece has few pixels"));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_neighbour_is_found() {
        #[rustfmt::skip]
        let input = [
            1.0, 2.0, 0.0,
            0.0, 5.0, 0.0,
            7.0, 0.0, 3.0,
        ];
        let (mut output, mut largest) = (Vec::new(), Vec::new());
        pool(&input, 3, &mut output, &mut largest);
        assert_eq!(output, [5.0, 5.0, 7.0, 5.0]);
        assert_eq!(largest, [4, 4, 6, 4]);
    }
}
