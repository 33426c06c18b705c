//! Embedding of slots for the engine: table rows, sines, and the map under an object.
//!
//! Sines pass through their layers once per distinct state, not once per token: a state occurs in a
//! value and again in the next frame's key, and in every future that has not yet diverged.

use std::collections::HashMap;

use candle_core::Tensor;
use gump_kernels::gelu::gelu_row;
use gump_kernels::panels::{Panels, Scratch};
use gump_kernels::wide;
use gump_model::ModelError;
use gump_model::batch::Packer;
use gump_model::embedding::SineKey;
use gump_model::local_context::{LaneMap, LocalContext, encode_local_context, n_numbers};
use gump_model::mct::PLACES;
use gump_model::placed_slot::PlacedSlot;
use rayon::prelude::*;

use super::weights::{Norm, WeightReader, numbers};
use super::{Pool, chunk_rows};

/// Turns slots into vectors.
#[derive(Debug)]
pub(super) struct Embedder {
    width: usize,
    packer: Packer,
    table: Vec<f32>,
    sine_in: Panels,
    sine_norm: Norm,
    sine_out: Panels,
    /// One map per position that an object looks at, if the network has this option.
    local: Vec<Panels>,
    /// Two layers over the local context of an object, if the network has this option.
    local_context: Option<[Panels; 2]>,
    /// Number of its inputs.
    n_numbers: usize,
}

/// Projected visual tokens of a scene for each position that objects look at, `[M, C]` per
/// position.
#[derive(Debug, Default)]
pub(super) struct Ground(Vec<Vec<f32>>);

impl Embedder {
    pub(super) fn new(weights: &WeightReader<'_>) -> Result<Self, ModelError> {
        let config = weights.network.config();
        let c = config.width;
        let n_places = if config.local_map { PLACES.len() } else { 0 };
        Ok(Self {
            width: c,
            packer: Packer::new(config),
            table: weights.get("mct.tables")?,
            sine_in: weights.linear("mct.sine_in", c)?,
            sine_norm: weights.norm("mct.sine_norm")?,
            sine_out: weights.linear("mct.sine_out", 2 * c)?,
            local: (0..n_places)
                .map(|i| weights.linear(&format!("mct.local.{i}"), c))
                .collect::<Result<_, _>>()?,
            local_context: match config.local_context {
                true => Some([
                    weights.linear("mct.surroundings.in", n_numbers(config))?,
                    weights.linear("mct.surroundings.out", 2 * c)?,
                ]),
                false => None,
            },
            n_numbers: n_numbers(config),
        })
    }

    /// Projects the visual tokens `[1, M, C]` of a scene.
    pub(super) fn ground(&self, visual: &Tensor) -> Result<Ground, ModelError> {
        let visual = numbers(visual)?;
        let see = |map: &Panels| {
            let mut seen = vec![0.0; visual.len()];
            let step = 64 * self.width;
            let pairs = visual.par_chunks(step).zip(seen.par_chunks_mut(step));
            pairs.for_each(|(x, y)| map.apply(x, y, &mut Scratch::default()));
            seen
        };
        Ok(Ground(self.local.iter().map(see).collect()))
    }

    /// The vectors of tokens into `x`, `[rows, C]`; `ground(row)` is the scene of a token's object.
    /// Returns the number of multiplications.
    pub(super) fn embed<'a>(
        &self,
        slots: &[&PlacedSlot],
        ground: impl Fn(usize) -> &'a Ground + Sync,
        rooms: &Pool,
        x: &mut Vec<f32>,
    ) -> u64 {
        let c = self.width;
        let (sine_of, features) = self.distinct_sines(slots);
        let n_sines = features.len() / c;
        let mut sines = vec![0.0; features.len()];
        let step = chunk_rows(n_sines) * c;
        features
            .par_chunks(step)
            .zip(sines.par_chunks_mut(step))
            .for_each(|(features, sines)| self.embed_sines(features, sines, rooms));
        x.clear();
        x.resize(slots.len() * c, 0.0);
        let step = chunk_rows(slots.len());
        x.par_chunks_mut(step * c)
            .enumerate()
            .for_each(|(chunk, x)| {
                for (i, x) in x.chunks_exact_mut(c).enumerate() {
                    let row = chunk * step + i;
                    self.sum_rows(slots[row], x);
                    if let Some(sine) = sine_of[row] {
                        add(x, &sines[sine as usize * c..][..c]);
                    }
                    if let Some(cells) = self.packer.cells(slots[row]) {
                        for (seen, cell) in ground(row).0.iter().zip(cells) {
                            add(x, &seen[cell as usize * c..][..c]);
                        }
                    }
                }
            });
        self.sine_in.products(n_sines) + self.sine_out.products(n_sines)
    }

    /// The local contexts of the objects at the keys from slot `from` on, if the network uses them.
    pub(super) fn local_context(
        &self,
        lane_map: &LaneMap,
        slots: &[PlacedSlot],
        from: usize,
    ) -> Vec<(usize, LocalContext)> {
        match self.local_context {
            Some(_) => encode_local_context(lane_map, slots, from),
            None => Vec::new(),
        }
    }

    /// Adds the encoded local contexts to rows of `x`. Returns the number of multiplications.
    pub(super) fn add_local_context(
        &self,
        seen: &[(usize, LocalContext)],
        rooms: &Pool,
        x: &mut [f32],
    ) -> u64 {
        let Some([first, second]) = &self.local_context else {
            return 0;
        };
        let c = self.width;
        let step = chunk_rows(seen.len());
        let mut vectors = vec![0.0; seen.len() * c];
        let pairs = seen.par_chunks(step).zip(vectors.par_chunks_mut(step * c));
        pairs.for_each(|(seen, vectors)| {
            rooms.with(|room| {
                let [numbers, hidden, ..] = &mut room.buffers;
                numbers.clear();
                seen.iter()
                    .for_each(|(_, seen)| numbers.extend_from_slice(&seen[..self.n_numbers]));
                hidden.resize(2 * c * seen.len(), 0.0);
                first.apply(numbers, hidden, &mut room.products);
                gelu_row(hidden);
                second.apply(hidden, vectors, &mut room.products);
            });
        });
        for ((row, _), vector) in seen.iter().zip(vectors.chunks_exact(c)) {
            add(&mut x[row * c..][..c], vector);
        }
        first.products(seen.len()) + second.products(seen.len())
    }

    /// Per token the number of its sine, and the features of each.
    fn distinct_sines(&self, slots: &[&PlacedSlot]) -> (Vec<Option<u32>>, Vec<f32>) {
        let mut known: HashMap<SineKey, u32> = HashMap::new();
        let mut features = Vec::new();
        let sine_of = slots.iter().map(|placed| {
            let next = known.len() as u32;
            let number = *known.entry(self.packer.sine_key(placed)?).or_insert(next);
            if number == next {
                self.packer.sine(placed, &mut features);
            }
            Some(number)
        });
        let sine_of = sine_of.collect();
        (sine_of, features)
    }

    fn embed_sines(&self, features: &[f32], sines: &mut [f32], rooms: &Pool) {
        rooms.with(|room| {
            let rows = features.len() / self.width;
            let [hidden, normal, ..] = &mut room.buffers;
            hidden.resize(2 * self.width * rows, 0.0);
            normal.resize(2 * self.width * rows, 0.0);
            self.sine_in.apply(features, hidden, &mut room.products);
            self.sine_norm.apply(hidden, normal);
            normal.iter_mut().for_each(|x| *x = x.max(0.0));
            self.sine_out.apply(normal, sines, &mut room.products);
        });
    }

    fn sum_rows(&self, placed: &PlacedSlot, x: &mut [f32]) {
        let rows = self.packer.rows(placed);
        for row in rows.into_iter().filter(|row| *row != u32::MAX) {
            add(x, &self.table[row as usize * self.width..][..self.width]);
        }
    }
}

fn add(x: &mut [f32], row: &[f32]) {
    wide(
        #[inline(always)]
        || x.iter_mut().zip(row).for_each(|(x, r)| *x += r),
    );
}
