//! Observations of many rows in one allocation.

use std::sync::OnceLock;

use rayon::prelude::*;

use super::{ObservationSpec, expand};

/// Observations of all rows, `[row, number]`: numbers of vectors, bits of rasters.
#[derive(Clone, Debug)]
pub(crate) struct Observed {
    /// Empty for rasters.
    numbers: Vec<f32>,
    /// Empty for vectors.
    packed: Vec<u8>,
    /// The bits as numbers, expanded on first use: 32 times as much memory.
    expanded: OnceLock<Vec<f32>>,
    n_rows: usize,
}

/// The observation of one row.
#[derive(Debug)]
pub(crate) struct ObservedRow<'a> {
    pub(crate) numbers: &'a mut [f32],
    pub(crate) packed: &'a mut [u8],
}

impl Observed {
    pub(crate) fn new(spec: &ObservationSpec, n_rows: usize) -> Self {
        let packed_len = spec.packed_len();
        let len = if packed_len == 0 { spec.len() } else { 0 };
        Self {
            numbers: vec![0.0; n_rows * len],
            packed: vec![0; n_rows * packed_len],
            expanded: OnceLock::new(),
            n_rows,
        }
    }

    /// Shape: `[n_rows, len]`.
    pub(crate) fn numbers(&self) -> &[f32] {
        if self.packed.is_empty() {
            return &self.numbers;
        }
        self.expanded.get_or_init(|| {
            let mut numbers = vec![0.0; self.packed.len() * 8];
            let rows = numbers.par_chunks_mut(self.packed.len() / self.n_rows * 8);
            rows.zip(self.packed.par_chunks(self.packed.len() / self.n_rows))
                .for_each(|(numbers, packed)| expand(packed, numbers));
            numbers
        })
    }

    /// Shape: `[n_rows, packed_len]`.
    pub(crate) fn packed(&self) -> &[u8] {
        &self.packed
    }

    /// All rows at once, to be filled by many threads.
    pub(crate) fn rows_mut(&mut self) -> Vec<ObservedRow<'_>> {
        self.expanded.take();
        let (mut numbers, mut packed) = (self.numbers.as_mut_slice(), self.packed.as_mut_slice());
        let (len, packed_len) = (numbers.len() / self.n_rows, packed.len() / self.n_rows);
        let row = |_| ObservedRow {
            numbers: first(&mut numbers, len),
            packed: first(&mut packed, packed_len),
        };
        (0..self.n_rows).map(row).collect()
    }

    /// Takes one row of another buffer of the same shape.
    pub(crate) fn copy_row(&mut self, row: usize, from: &Self) {
        self.expanded.take();
        let part = |len: usize| row * len / self.n_rows..(row + 1) * len / self.n_rows;
        let (numbers, packed) = (part(self.numbers.len()), part(self.packed.len()));
        self.numbers[numbers.clone()].copy_from_slice(&from.numbers[numbers]);
        self.packed[packed.clone()].copy_from_slice(&from.packed[packed]);
    }
}

/// Takes the first `len` values off.
fn first<'a, T>(values: &mut &'a mut [T], len: usize) -> &'a mut [T] {
    let (first, rest) = std::mem::take(values).split_at_mut(len);
    *values = rest;
    first
}

impl ObservedRow<'_> {
    pub(crate) fn copy_from(self, other: &Self) {
        self.numbers.copy_from_slice(other.numbers);
        self.packed.copy_from_slice(other.packed);
    }
}
