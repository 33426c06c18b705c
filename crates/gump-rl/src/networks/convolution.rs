//! A convolution over square maps as one matrix product, forward and backward.
//!
//! Maps are stored as `[channel, row of the batch, y, x]`. The maps of many rows are therefore one
//! matrix, and deep layers, whose maps are a few pixels wide, multiply as fast as shallow ones.

use super::product::{Mat, add_product};

/// Squares of weights that slide over maps; what lies beyond the border is 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Convolution {
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    /// Side of the weights' square, odd; padded by half of it.
    pub(super) kernel: usize,
    pub(super) stride: usize,
    /// Side of the maps that come in, pixels.
    pub(super) side: usize,
}

/// The pixels of a line or column that a tap of the kernel reads: those inside the map.
struct Taps {
    /// The first output pixel whose tap is inside.
    begin: usize,
    /// The first after it whose tap is not.
    end: usize,
    /// The input pixel that the tap of `begin` reads.
    first: usize,
}

impl Convolution {
    /// Side of the maps that come out, pixels.
    pub(super) fn side_out(&self) -> usize {
        (self.side - 1) / self.stride + 1
    }

    /// Weights, `[output, input, y, x]`; biases are left to the normalization.
    pub(super) fn n_weights(&self) -> usize {
        self.outputs * self.taps()
    }

    /// Weights of an output.
    pub(super) fn taps(&self) -> usize {
        self.inputs * self.kernel * self.kernel
    }

    /// Shape: `input` `[inputs, rows, side, side]`, `output` `[outputs, rows, side_out, side_out]`.
    /// `columns` is working memory.
    pub(super) fn forward(
        &self,
        weights: &[f32],
        input: &[f32],
        rows: usize,
        columns: &mut Vec<f32>,
        output: &mut Vec<f32>,
    ) {
        let pixels = rows * self.side_out().pow(2);
        self.gather(input, rows, columns);
        output.clear();
        output.resize(self.outputs * pixels, 0.0);
        add_product(
            output,
            Mat::new(weights, self.outputs, self.taps()),
            Mat::new(columns, self.taps(), pixels),
        );
    }

    /// Adds the gradient of the weights to `weight_gradient` and that of the input, if requested,
    /// to `input_gradient`, given that of the output. Shape: as [`Convolution::forward`].
    pub(super) fn backward(
        &self,
        (weights, weight_gradient): (&[f32], &mut [f32]),
        (input, input_gradient): (&[f32], Option<&mut [f32]>),
        output_gradient: &[f32],
        rows: usize,
        columns: &mut Vec<f32>,
    ) {
        let pixels = rows * self.side_out().pow(2);
        let above = Mat::new(output_gradient, self.outputs, pixels);
        self.gather(input, rows, columns);
        let seen = Mat::new(columns, self.taps(), pixels);
        add_product(weight_gradient, above, seen.t());
        if let Some(input_gradient) = input_gradient {
            columns.fill(0.0);
            let weights = Mat::new(weights, self.outputs, self.taps());
            add_product(columns, weights.t(), above);
            self.scatter(columns, rows, input_gradient);
        }
    }

    /// Collects the pixels that each tap reads, tap after tap. Shape:
    /// `[inputs, kernel, kernel, rows, y, x]`.
    fn gather(&self, input: &[f32], rows: usize, columns: &mut Vec<f32>) {
        columns.clear();
        columns.resize(self.taps() * rows * self.side_out().pow(2), 0.0);
        self.each_line(rows, |to, from, taps| {
            let read = &input[from + taps.first..];
            let written = &mut columns[to + taps.begin..to + taps.end];
            if self.stride == 1 {
                written.copy_from_slice(&read[..written.len()]);
            } else {
                for (x, pixels) in written.iter_mut().zip(read.chunks(self.stride)) {
                    *x = pixels[0];
                }
            }
        });
    }

    /// Adds up what every tap read. Shape: as [`Convolution::gather`].
    fn scatter(&self, columns: &[f32], rows: usize, input: &mut [f32]) {
        self.each_line(rows, |from, to, taps| {
            let read = &columns[from + taps.begin..from + taps.end];
            let written = input[to + taps.first..].chunks_mut(self.stride);
            for (pixels, y) in written.zip(read) {
                pixels[0] += y;
            }
        });
    }

    /// Visits every line of every tap: where it starts in the columns, where the line of the input
    /// that it reads starts, and which pixels of it are inside.
    fn each_line(&self, rows: usize, mut visit: impl FnMut(usize, usize, &Taps)) {
        let (side, out) = (self.side, self.side_out());
        let mut column = 0;
        for channel in 0..self.inputs {
            for tap in 0..self.kernel * self.kernel {
                let down = self.inside(tap / self.kernel);
                let across = self.inside(tap % self.kernel);
                for row in 0..rows {
                    let map = (channel * rows + row) * side * side;
                    for y in down.begin..down.end {
                        let line = down.first + (y - down.begin) * self.stride;
                        visit(column + y * out, map + line * side, &across);
                    }
                    column += out * out;
                }
            }
        }
    }

    /// The output pixels along one axis whose tap at `offset` lies inside the map.
    fn inside(&self, offset: usize) -> Taps {
        let padding = self.kernel / 2;
        let begin = padding.saturating_sub(offset).div_ceil(self.stride);
        // The last pixel reads at most the last of the map.
        let end = match (self.side + padding).checked_sub(offset + 1) {
            Some(room) => (room / self.stride + 1).min(self.side_out()),
            None => 0,
        };
        if begin >= end {
            return Taps {
                begin: 0,
                end: 0,
                first: 0,
            };
        }
        Taps {
            begin,
            end,
            first: begin * self.stride + offset - padding,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::Seed;
    use rand::Rng as _;

    fn random(n: usize, seed: u64) -> Vec<f32> {
        let mut rng = Seed(seed).rng();
        (0..n).map(|_| rng.random_range(-1.0..1.0)).collect()
    }

    /// The definition, pixel by pixel.
    fn by_definition(c: &Convolution, weights: &[f32], input: &[f32], rows: usize) -> Vec<f32> {
        let (side, out, padding) = (c.side, c.side_out(), c.kernel / 2);
        let mut output = vec![0.0; c.outputs * rows * out * out];
        for (i, sum) in output.iter_mut().enumerate() {
            let (x, y) = (i % out, i / out % out);
            let (row, o) = (i / out / out % rows, i / out / out / rows);
            for tap in 0..c.taps() {
                let (dx, dy) = (tap % c.kernel, tap / c.kernel % c.kernel);
                let channel = tap / c.kernel / c.kernel;
                let (px, py) = (x * c.stride + dx, y * c.stride + dy);
                let inside = |p: usize| (padding..side + padding).contains(&p);
                if inside(px) && inside(py) {
                    let map = (channel * rows + row) * side * side;
                    let pixel = input[map + (py - padding) * side + px - padding];
                    *sum += weights[o * c.taps() + tap] * pixel;
                }
            }
        }
        output
    }

    #[test]
    fn products_of_columns_are_convolutions() {
        for (kernel, stride, side) in [
            (1, 1, 5),
            (1, 2, 5),
            (3, 1, 6),
            (3, 2, 7),
            (3, 2, 2),
            (7, 2, 9),
            (7, 2, 2),
            (3, 1, 1),
        ] {
            let c = Convolution {
                inputs: 3,
                outputs: 4,
                kernel,
                stride,
                side,
            };
            let (weights, rows) = (random(c.n_weights(), 1), 2);
            let input = random(3 * rows * side * side, 2);
            let (mut columns, mut output) = (Vec::new(), Vec::new());
            c.forward(&weights, &input, rows, &mut columns, &mut output);
            let expected = by_definition(&c, &weights, &input, rows);
            assert_eq!(output.len(), expected.len());
            for (found, expected) in output.iter().zip(&expected) {
                assert!((found - expected).abs() < 1e-5, "{c:?}");
            }

            // A convolution is linear in weights and in input, so its gradients obey
            // <above, conv(w, x)> = <w, gradient of w> = <x, gradient of x>, here with other
            // weights and another input than those that the gradient was taken at.
            let above = random(output.len(), 3);
            let (mut of_weights, mut of_input) = (vec![0.0; weights.len()], vec![0.0; input.len()]);
            c.backward(
                (&weights, &mut of_weights),
                (&input, Some(&mut of_input)),
                &above,
                rows,
                &mut columns,
            );
            let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
            let (moved_weights, moved) = (random(weights.len(), 4), random(input.len(), 5));
            let by_weights = by_definition(&c, &moved_weights, &input, rows);
            let by_input = by_definition(&c, &weights, &moved, rows);
            for (expected, found) in [
                (dot(&above, &by_weights), dot(&moved_weights, &of_weights)),
                (dot(&above, &by_input), dot(&moved, &of_input)),
            ] {
                assert!((expected - found).abs() < 1e-3, "{c:?}: {expected} {found}");
            }
        }
    }
}
