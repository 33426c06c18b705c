//! Rows of a table: some that lie together, or sums of some for each of many tokens.
//!
//! The tensor library's gradient of a slice is as large as the whole tensor, and so is that of a
//! gather; within [`Deferred::during`] only the rows that were touched are kept.

use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Result, Shape, Tensor, bail};

use super::deferred::{Deferred, Part};
use super::{Host, elements, fusible, gradient, output};
use gump_kernels::rows::add_to;
use gump_kernels::wide;

/// Rows `first..first + n` of a table.
///
/// Shape: `table` `[R, C]`; the result `[n, C]`.
///
/// Error: when the table has no such rows.
pub fn table_rows(table: &Tensor, first: usize, n: usize) -> Result<Tensor> {
    let (n_rows, _) = table.dims2()?;
    if first + n > n_rows {
        let shape = table.shape();
        bail!("table_rows: table {shape:?}, rows {first} to {}", first + n);
    }
    if !fusible(&[table]) {
        return table.narrow(0, first, n);
    }
    let deferred = Deferred::current();
    table.contiguous()?.apply_op1(Rows { first, n, deferred })
}

struct Rows {
    first: usize,
    n: usize,
    deferred: Option<Deferred>,
}

impl CustomOp1 for Rows {
    fn name(&self) -> &'static str {
        "table-rows"
    }

    fn cpu_fwd(&self, table: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (_, width) = layout.shape().dims2()?;
        let rows = &elements(table, layout)?[self.first * width..][..self.n * width];
        Ok(output(rows.to_vec(), (self.n, width)))
    }

    fn bwd(&self, table: &Tensor, _rows: &Tensor, slopes: &Tensor) -> Result<Option<Tensor>> {
        let slopes = slopes.contiguous()?;
        if let Some(deferred) = self.deferred.as_ref().filter(|_| table.is_variable()) {
            let (first, slopes) = (self.first, slopes.detach());
            deferred.note(table, Part::Rows { first, slopes });
            return Ok(None);
        }
        let slopes = Host::new(&slopes)?;
        let slopes = slopes.slice::<f32>()?;
        let mut all = vec![0.0; table.elem_count()];
        all[self.first * table.dim(1)?..][..slopes.len()].copy_from_slice(slopes);
        gradient(all, table).map(Some)
    }
}

/// Sums of rows, one per token.
///
/// Shape: `table` `[R, C]`; `rows` `[N, K]` u32, `u32::MAX` for none; the result `[N, C]`.
///
/// Error: when the shapes do not fit, or (on a CPU) the table has no such row.
pub fn embedding_sum(table: &Tensor, rows: &Tensor) -> Result<Tensor> {
    let (n_rows, width) = table.dims2()?;
    let (n, k) = rows.dims2()?;
    if fusible(&[table]) {
        let deferred = Deferred::current();
        return table
            .contiguous()?
            .apply_op2(&rows.contiguous()?, EmbeddingSum { deferred });
    }
    // "None" points at a row of zeros behind the table.
    let zeros = Tensor::zeros((1, width), table.dtype(), table.device())?;
    let padded = Tensor::cat(&[table, &zeros], 0)?;
    let last = Tensor::full(n_rows as u32, (n, k), rows.device())?;
    let rows = rows.minimum(&last)?.flatten_all()?;
    padded
        .index_select(&rows, 0)?
        .reshape((n, k, width))?
        .sum(1)
}

struct EmbeddingSum {
    deferred: Option<Deferred>,
}

impl CustomOp2 for EmbeddingSum {
    fn name(&self) -> &'static str {
        "embedding-sum"
    }

    fn cpu_fwd(
        &self,
        table: &CpuStorage,
        table_layout: &Layout,
        rows: &CpuStorage,
        rows_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (n_rows, width) = table_layout.shape().dims2()?;
        let (n, k) = rows_layout.shape().dims2()?;
        let table = elements(table, table_layout)?;
        let rows = &rows.as_slice::<u32>()?[rows_layout.start_offset()..][..n * k];
        let is_there = |row: &&u32| **row != u32::MAX;
        if let Some(row) = rows
            .iter()
            .filter(is_there)
            .find(|r| **r as usize >= n_rows)
        {
            bail!("embedding_sum: row {row} of a table of {n_rows}");
        }
        let mut out = vec![0f32; n * width];
        wide(
            #[inline(always)]
            || {
                for (sum, rows) in out.chunks_exact_mut(width).zip(rows.chunks_exact(k)) {
                    for &row in rows.iter().filter(is_there) {
                        add_to(sum, &table[row as usize * width..][..width]);
                    }
                }
            },
        );
        Ok(output(out, (n, width)))
    }

    fn bwd(
        &self,
        table: &Tensor,
        rows: &Tensor,
        _sums: &Tensor,
        slopes: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let slopes = slopes.contiguous()?;
        if let Some(deferred) = self.deferred.as_ref().filter(|_| table.is_variable()) {
            let (rows, slopes) = (rows.clone(), slopes.detach());
            deferred.note(table, Part::Scattered { rows, slopes });
            return Ok((None, None));
        }
        let (n_each, width) = (rows.dim(1)?, table.dim(1)?);
        let (rows, slopes) = (Host::new(rows)?, Host::new(&slopes)?);
        let (rows, slopes) = (rows.slice::<u32>()?, slopes.slice::<f32>()?);
        let mut all = vec![0.0; table.elem_count()];
        scatter(&mut all, rows.chunks_exact(n_each), slopes, width);
        Ok((Some(gradient(all, table)?), None))
    }
}

/// Adds every row of `slopes` to the rows of the table it came from.
pub(super) fn scatter<'a>(
    table: &mut [f32],
    rows: impl Iterator<Item = &'a [u32]>,
    slopes: &[f32],
    width: usize,
) {
    wide(
        #[inline(always)]
        || {
            for (slope, rows) in slopes.chunks_exact(width).zip(rows) {
                for &row in rows.iter().filter(|row| **row != u32::MAX) {
                    add_to(&mut table[row as usize * width..][..width], slope);
                }
            }
        },
    );
}

#[cfg(test)]
mod tests {
    use super::super::testing::{assert_close, check, var};
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn rows_that_lie_together() {
        let table = var(&[9, 5], 1);
        for (first, n) in [(0, 9), (3, 1), (8, 1), (2, 4)] {
            check(
                &[&table],
                || table_rows(&table, first, n),
                || table.narrow(0, first, n),
            );
        }
        assert!(table_rows(&table, 8, 2).is_err());
    }

    #[test]
    fn sums_of_rows() {
        let table = var(&[6, 4], 1);
        let rows = [[0, 3, u32::MAX], [5, 5, 1], [u32::MAX; 3]].concat();
        let indices = Tensor::from_vec(rows.clone(), (3, 3), &Device::Cpu).unwrap();
        let picks: Vec<f32> = (0..3 * 6)
            .map(|i| {
                rows[i / 6 * 3..][..3]
                    .iter()
                    .filter(|r| **r == i as u32 % 6)
                    .count() as f32
            })
            .collect();
        let picks = Tensor::from_vec(picks, (3, 6), &Device::Cpu).unwrap();
        check(
            &[&table],
            || embedding_sum(&table, &indices),
            || picks.matmul(&table),
        );
        let beyond = Tensor::from_vec(vec![6u32], (1, 1), &Device::Cpu).unwrap();
        assert!(embedding_sum(&table, &beyond).is_err());
    }

    #[test]
    fn gradients_put_off_are_the_gradients() {
        let table = var(&[6, 4], 1);
        let indices = Tensor::from_vec(vec![0u32, 3, u32::MAX, 3], (2, 2), &Device::Cpu).unwrap();
        let loss = || {
            let sums = embedding_sum(&table, &indices).unwrap();
            let rows = table_rows(&table, 2, 2).unwrap();
            let product = (sums * (rows * 3.0).unwrap()).unwrap();
            product.sqr().unwrap().sum_all().unwrap()
        };
        let expected = loss().backward().unwrap();
        let deferred = Deferred::default();
        let grads = deferred.during(loss).backward().unwrap();
        let of = |table: &Var| grads.get(table).cloned();
        assert!(of(&table).is_none());
        let found = Deferred::take_in([&deferred].into_iter(), &table, None).unwrap();
        assert_close(
            "table",
            &found.unwrap(),
            expected.get(&table).unwrap(),
            1e-5,
        );
    }
}
