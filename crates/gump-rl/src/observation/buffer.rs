//! Observations of many rows in one allocation.

use super::ObservationSpec;

/// Observations of all rows, `[row, number]`, and packed where they are rasters.
#[derive(Clone, Debug)]
pub(crate) struct Observed {
    pub(crate) numbers: Vec<f32>,
    pub(crate) packed: Vec<u8>,
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
        Self {
            numbers: vec![0.0; n_rows * spec.len()],
            packed: vec![0; n_rows * spec.packed_len()],
            n_rows,
        }
    }

    /// All rows at once, to be filled by many threads.
    pub(crate) fn rows_mut(&mut self) -> Vec<ObservedRow<'_>> {
        let (len, packed_len) = (
            self.numbers.len() / self.n_rows,
            self.packed.len() / self.n_rows,
        );
        let mut packed = self.packed.as_mut_slice();
        self.numbers
            .chunks_exact_mut(len)
            .map(|numbers| {
                let (own, rest) = std::mem::take(&mut packed).split_at_mut(packed_len);
                packed = rest;
                ObservedRow {
                    numbers,
                    packed: own,
                }
            })
            .collect()
    }

    /// Takes one row of another buffer of the same shape.
    pub(crate) fn copy_row(&mut self, row: usize, from: &Self) {
        let part = |len: usize| row * len / self.n_rows..(row + 1) * len / self.n_rows;
        let (numbers, packed) = (part(self.numbers.len()), part(self.packed.len()));
        self.numbers[numbers.clone()].copy_from_slice(&from.numbers[numbers]);
        self.packed[packed.clone()].copy_from_slice(&from.packed[packed]);
    }
}

impl ObservedRow<'_> {
    pub(crate) fn copy_from(self, other: &Self) {
        self.numbers.copy_from_slice(other.numbers);
        self.packed.copy_from_slice(other.packed);
    }
}
