//! Token sequences as tensors; the only place where sequences are padded.

use std::sync::Arc;

use candle_core::{Device, Tensor};
use gump_geometry::DVec2;
use gump_tokenizer::Slot;
use rayon::prelude::*;

use crate::config::ModelConfig;
use crate::embedding::{ROWS_PER_TOKEN, SineKey, SineTables, Tables};
use crate::local_context::{LaneMap, LocalContext, encode_local_context, n_numbers};
use crate::mct::{PLACES, TokenBatch};
use crate::placed_slot::PlacedSlot;

/// Converts tokens into the rows of a batch, for one network.
#[derive(Debug)]
pub struct Packer {
    tables: Tables,
    sines: SineTables,
    width: usize,
    local_map: bool,
    local_context: bool,
    n_numbers: usize,
    visual_side: usize,
    cell_m: f64,
}

impl Packer {
    /// For a network of this shape.
    pub fn new(config: &ModelConfig) -> Self {
        Self {
            tables: Tables::new(config),
            sines: SineTables::new(config),
            width: config.width,
            local_map: config.local_map,
            local_context: config.local_context,
            n_numbers: n_numbers(config),
            visual_side: config.visual_side(),
            cell_m: config.visual.metres_per_px * config.visual.encoder.stride() as f64,
        }
    }

    /// Packs sequences side by side, without their first `from` slots; shorter ones are padded at
    /// the end, where causality hides the padding. The same number of consecutive sequences shares
    /// each of the `lane_maps`.
    pub(crate) fn pack(
        &self,
        sequences: &[&[PlacedSlot]],
        from: usize,
        lane_maps: &[Arc<LaneMap>],
        device: &Device,
    ) -> candle_core::Result<TokenBatch> {
        let longest = sequences.iter().map(|sequence| sequence.len()).max();
        let t = longest.unwrap_or(0).saturating_sub(from);
        let b = sequences.len();
        let sharing = b / lane_maps.len().max(1);
        let look = |(row, slots): (usize, &&[PlacedSlot])| {
            if !self.local_context {
                return Vec::new();
            }
            let mut seen = encode_local_context(&lane_maps[row / sharing], slots, from);
            seen.iter_mut()
                .for_each(|(at, _)| *at = *at + row * t - from);
            seen
        };
        let seen: Vec<(usize, LocalContext)> = sequences
            .par_iter()
            .enumerate()
            .flat_map_iter(look)
            .collect();
        let mut rows: Vec<u32> = Vec::with_capacity(b * t * ROWS_PER_TOKEN);
        let mut sine_positions: Vec<u32> = Vec::new();
        let mut features: Vec<f32> = Vec::new();
        let mut local_map_rows: Vec<u32> = Vec::new();
        let mut local_map_sequences: Vec<u32> = Vec::new();
        let mut places: [Vec<u32>; PLACES.len()] = Default::default();
        for (row, sequence) in sequences.iter().enumerate() {
            let sequence = &sequence[from.min(sequence.len())..];
            for (column, placed) in sequence.iter().enumerate() {
                let flat = (row * t + column) as u32;
                rows.extend(self.rows(placed));
                if self.sine(placed, &mut features) {
                    sine_positions.push(flat);
                }
                if let Some(seen) = self.cells(placed) {
                    local_map_rows.push(flat);
                    local_map_sequences.push(row as u32);
                    for (cells, cell) in places.iter_mut().zip(seen) {
                        cells.push(cell);
                    }
                }
            }
            for position in sequence.len()..t {
                rows.extend(self.tables.rows(&padding(from + position)));
            }
        }
        let (n, k) = (sine_positions.len(), local_map_rows.len());
        Ok(TokenBatch {
            rows: Tensor::from_vec(rows, (b * t, ROWS_PER_TOKEN), device)?,
            sine_positions: Tensor::from_vec(sine_positions, n, device)?,
            sines: Tensor::from_vec(features, (n, self.width), device)?,
            local_map_rows: Tensor::from_vec(local_map_rows, k, device)?,
            places,
            local_map_sequences,
            context_rows: Tensor::from_iter(seen.iter().map(|(at, _)| *at as u32), device)?,
            local_context: Tensor::from_vec(
                seen.iter()
                    .flat_map(|(_, numbers)| &numbers[..self.n_numbers])
                    .copied()
                    .collect(),
                (seen.len(), self.n_numbers),
                device,
            )?,
            shape: (b, t),
        })
    }

    /// The table rows that a token sums, `u32::MAX` where there is none.
    pub fn rows(&self, placed: &PlacedSlot) -> [u32; ROWS_PER_TOKEN] {
        self.tables.rows(placed)
    }

    /// The key of a token's sine features.
    pub fn sine_key(&self, placed: &PlacedSlot) -> Option<SineKey> {
        self.sines.key(placed)
    }

    /// Appends the sine features of a token to `out` if it has any.
    pub fn sine(&self, placed: &PlacedSlot, out: &mut Vec<f32>) -> bool {
        self.sines.append(placed, out)
    }

    /// The visual tokens at the positions that a token's object looks at, if it does.
    pub fn cells(&self, placed: &PlacedSlot) -> Option<[u32; PLACES.len()]> {
        let last = placed.last.filter(|_| self.local_map)?;
        let (from, velocity) = match placed.exact {
            Some(exact) => (exact.pose(), exact.velocity()),
            None => (last.pose(), last.velocity()),
        };
        let at = |seconds| self.cell(from.position + velocity * seconds);
        matches!(placed.slot, Slot::Key(_)).then(|| PLACES.map(at))
    }

    /// The visual token that covers a point of the scene frame, or the nearest one.
    fn cell(&self, point: DVec2) -> u32 {
        let half = self.visual_side as f64 / 2.0;
        let index = |along: f64| {
            (half - along / self.cell_m)
                .floor()
                .clamp(0.0, self.visual_side as f64 - 1.0) as u32
        };
        index(point.x) * self.visual_side as u32 + index(point.y)
    }
}

fn padding(position: usize) -> PlacedSlot {
    PlacedSlot {
        slot: Slot::Pad,
        position,
        frame: 0,
        key: None,
        last: None,
        exact: None,
    }
}

#[cfg(test)]
mod tests {
    use gump_geometry::dvec2;

    use super::*;

    #[test]
    fn cells_are_numbered_as_visual_tokens_are() {
        let packer = Packer::new(&ModelConfig::tiny());
        assert_eq!((packer.visual_side, packer.cell_m), (26, 8.0));
        // Row 0 is ahead, column 0 is left; the centre is the corner of four cells.
        for (point, cell) in [
            (dvec2(103.0, 103.0), 0),
            (dvec2(103.0, -103.0), 25),
            (dvec2(1.0, 1.0), 12 * 26 + 12),
            (dvec2(-1.0, -1.0), 13 * 26 + 13),
            (dvec2(-500.0, 1.0), 25 * 26 + 12),
        ] {
            assert_eq!(packer.cell(point), cell, "{point}");
        }
    }
}
