//! Every kernel that the processor has, against f64.

use super::*;
use crate::gemm::{Mat, MatMut, Right, Store, Threads};
use crate::operands::Operands;
use crate::testing::values;

/// `dst = before + scale * lhs rhs` in f64, of rounded numbers.
fn exact(before: &[f32], scale: f32, lhs: Mat<'_>, rhs: Mat<'_>) -> Vec<f64> {
    let number = |mat: Mat<'_>, i: usize, j: usize| {
        let (data, _, [rows, cols]) = mat.parts();
        f64::from(rounded::round(data[i * rows + j * cols]))
    };
    let (_, [m, k], _) = lhs.parts();
    let (_, [_, n], _) = rhs.parts();
    let element = |at: usize| {
        let terms = (0..k).map(|p| number(lhs, at / n, p) * number(rhs, p, at % n));
        f64::from(before[at]) + f64::from(scale) * terms.sum::<f64>()
    };
    (0..m * n).map(element).collect()
}

/// All ways to multiply rounded numbers that this processor has.
type Way = fn(MatMut<'_>, Store, f32, Mat<'_>, Mat<'_>, Threads);

fn ways() -> Vec<(&'static str, Way)> {
    let mut ways: Vec<(&str, Way)> = vec![("rounded", rounded::product)];
    #[cfg(target_arch = "x86_64")]
    {
        if Avx512Bf16::detect().is_some() {
            ways.push(("avx512-bf16", |dst, store, scale, lhs, rhs, threads| {
                let unit = Avx512Bf16::detect().unwrap();
                bf16::product(unit, dst, store, scale, (lhs, rhs), threads);
            }));
            ways.push(("tiles as told", |dst, store, scale, lhs, rhs, threads| {
                let unit = tiles::Emulated(Avx512Bf16::detect().unwrap());
                bf16::product(unit, dst, store, scale, (lhs, rhs), threads);
            }));
        } else {
            eprintln!("skipped: this processor has no avx512-bf16");
        }
        if Amx::detect().is_some() {
            ways.push(("amx", |dst, store, scale, lhs, rhs, threads| {
                let unit = Amx::detect().unwrap();
                bf16::product(unit, dst, store, scale, (lhs, rhs), threads);
            }));
        } else {
            eprintln!("skipped: this processor has no amx");
        }
    }
    ways
}

#[cfg(target_arch = "x86_64")]
mod tiles {
    //! The tiles' packing on any processor: the tile instructions emulated after their description,
    //! with the same byte offsets as the assembly's.

    use super::super::avx512_bf16::Avx512Bf16;
    use super::super::bf16::{Lanes, Target, Unit};

    #[derive(Clone, Copy)]
    pub(super) struct Emulated(pub(super) Avx512Bf16);

    /// A tile of 16 rows of 16 pairs, its rows `stride` bytes apart from a byte on.
    fn load(memory: &[u32], byte: usize, stride: usize) -> [[u32; 16]; 16] {
        std::array::from_fn(|r| std::array::from_fn(|c| memory[byte / 4 + r * stride / 4 + c]))
    }

    fn halves(pair: u32) -> [f32; 2] {
        [pair << 16, pair & 0xffff_0000].map(f32::from_bits)
    }

    /// `TDPBF16PS`: rows of pairs of the left times columns of pairs of the right.
    fn multiply_add(sums: &mut [[f32; 16]; 16], left: &[[u32; 16]; 16], right: &[[u32; 16]; 16]) {
        for (sums, left) in sums.iter_mut().zip(left) {
            for (left, right) in left.iter().zip(right) {
                for (sum, right) in sums.iter_mut().zip(right) {
                    let ([a, b], [c, d]) = (halves(*left), halves(*right));
                    *sum = b.mul_add(d, a.mul_add(c, *sum));
                }
            }
        }
    }

    impl Unit for Emulated {
        const ROWS: usize = 32;

        fn pairs(depth: usize) -> usize {
            depth.div_ceil(2).next_multiple_of(16)
        }

        fn pack_left(self, from: Lanes<'_>, blocks: &mut [u32]) {
            self.0.pack_tiles(from, Self::pairs(from.depth), blocks);
        }

        fn pack_right(self, from: Lanes<'_>, panels: &mut [u32]) {
            self.0.pack_panels(from, Self::pairs(from.depth), panels);
        }

        fn multiply(self, block: &[u32], panel: &[u32], to: &mut Target<'_>) {
            let mut sums = [[[[0f32; 16]; 16]; 2]; 2];
            for step in 0..panel.len() / 512 {
                for (half, sums) in sums.iter_mut().enumerate() {
                    let left = load(block, step * 2048 + half * 1024, 64);
                    for (side, sums) in sums.iter_mut().enumerate() {
                        let right = load(panel, step * 2048 + side * 64, 128);
                        multiply_add(sums, &left, &right);
                    }
                }
            }
            for r in 0..to.rows {
                let row: [f32; 32] = std::array::from_fn(|c| sums[r / 16][c / 16][r % 16][c % 16]);
                to.take_in(r, &row);
            }
        }
    }
}

const SHAPES: [[usize; 3]; 10] = [
    [1, 1, 1],
    [3, 2, 5],
    [8, 32, 32],
    [9, 33, 31],
    [17, 7, 49],
    [130, 64, 96],
    [5, 513, 40],
    [300, 129, 17],
    [64, 1030, 70],
    [13, 31, 260],
];

#[test]
fn products_are_those_of_rounded_numbers() {
    for (name, way) in ways() {
        for [m, k, n] in SHAPES {
            let (a, b) = (values(m * k, 1), values(k * n, 2));
            let left = [Mat::new(&a, m, k), Mat::new(&a, k, m).t()];
            let right = [Mat::new(&b, k, n), Mat::new(&b, n, k).t()];
            for (lhs, rhs) in left.into_iter().flat_map(|l| right.map(|r| (l, r))) {
                for (store, scale) in [(Store::Replace, 1.0), (Store::Add, -0.7)] {
                    let before = values(m * n, 3);
                    let mut found = before.clone();
                    way(
                        MatMut::new(&mut found, m, n),
                        store,
                        scale,
                        lhs,
                        rhs,
                        Threads::One,
                    );
                    let before = match store {
                        Store::Replace => vec![0.0; m * n],
                        Store::Add => before,
                    };
                    let expected = exact(&before, scale, lhs, rhs);
                    for (at, (found, expected)) in found.iter().zip(&expected).enumerate() {
                        let off = (f64::from(*found) - expected).abs();
                        let most = 2e-6 * (k as f64).sqrt().max(1.0);
                        assert!(off < most, "{name} {m} {k} {n} [{at}]: {found} {expected}");
                    }
                    let mut shared = before_of(store, m * n);
                    way(
                        MatMut::new(&mut shared, m, n),
                        store,
                        scale,
                        lhs,
                        rhs,
                        Threads::Pool,
                    );
                    assert_eq!(found, shared, "{name} {m} {k} {n} on all threads");
                }
            }
        }
    }
}

fn before_of(store: Store, n: usize) -> Vec<f32> {
    match store {
        Store::Replace => vec![9.0; n],
        Store::Add => values(n, 3),
    }
}

#[test]
fn rows_between_the_rows_of_the_target_stay() {
    for (name, way) in ways() {
        let (m, k, n, stride) = (11, 9, 33, 40);
        let (a, b) = (values(m * k, 1), values(k * n, 2));
        let mut dst = vec![7.0; (m + 1) * stride];
        let target = MatMut::strided(&mut dst, m, n, stride);
        let (lhs, rhs) = (Mat::new(&a, m, k), Mat::new(&b, k, n));
        way(target, Store::Replace, 1.0, lhs, rhs, Threads::One);
        for (r, row) in dst.chunks_exact(stride).enumerate() {
            let first = if r < m { n } else { 0 };
            assert!(row[first..].iter().all(|x| *x == 7.0), "{name}, row {r}");
            assert!(row[..first].iter().all(|x| *x != 7.0), "{name}, row {r}");
        }
    }
}

#[test]
fn a_row_has_the_same_bits_alone() {
    for (name, way) in ways() {
        let (m, k, n) = (150, 70, 50);
        let (a, b) = (values(m * k, 1), values(k * n, 2));
        let rhs = Mat::new(&b, k, n);
        let product = |a: &[f32]| {
            let mut found = vec![0.0; a.len() / k * n];
            let dst = MatMut::new(&mut found, a.len() / k, n);
            let lhs = Mat::new(a, a.len() / k, k);
            way(dst, Store::Replace, 1.0, lhs, rhs, Threads::One);
            found
        };
        let all = product(&a);
        if name != "rounded" {
            for r in [0, 7, 8, 131, 149] {
                let alone = product(&a[r * k..][..k]);
                assert_eq!(alone, all[r * n..][..n], "{name}, row {r}");
            }
        }
    }
}

#[test]
fn packed_once_is_packed_each_time() {
    let (m, k, n) = (21, 600, 70);
    let (a, b) = (values(m * k, 1), values(k * n, 2));
    let rhs = Mat::new(&b, k, n);
    for operands in [Operands::F32, Operands::Bf16] {
        let packed = Right::new(rhs, operands);
        for (depth, columns) in [(k, n), (555, 70), (512, 33), (7, 5)] {
            let lhs = Mat::strided(&a, m, depth, k);
            let (mut found, mut expected) = (vec![0.0; m * columns], vec![0.0; m * columns]);
            let dst = MatMut::new(&mut found, m, columns);
            packed.product(dst, Store::Replace, 0.5, lhs, Threads::One);
            let part = Mat::strided(&b, depth, columns, n);
            let dst = MatMut::new(&mut expected, m, columns);
            let (store, threads) = (Store::Replace, Threads::One);
            crate::gemm::gemm(dst, store, 0.5, lhs, part, threads, operands);
            for (found, expected) in found.iter().zip(&expected) {
                assert!((found - expected).abs() < 1e-5, "{found} {expected}");
            }
        }
    }
}

#[test]
fn a_product_over_nothing_is_zero() {
    for (name, way) in ways() {
        let mut found = [3.0; 6];
        let dst = MatMut::new(&mut found, 2, 3);
        let (lhs, rhs) = (Mat::new(&[], 2, 0), Mat::new(&[], 0, 3));
        way(dst, Store::Replace, 1.0, lhs, rhs, Threads::One);
        assert_eq!(found, [0.0; 6], "{name}");
    }
}

#[test]
fn infinities_stay_and_the_smallest_vanish() {
    for (name, way) in ways() {
        let a = [
            f32::INFINITY,
            1.0,
            1e-40,
            1.0,
            -f32::INFINITY,
            0.0,
            2.0,
            0.5,
        ];
        let b = [1.0, 1.0];
        let mut found = [0.0; 4];
        let dst = MatMut::new(&mut found, 4, 1);
        let (lhs, rhs) = (Mat::new(&a, 4, 2), Mat::new(&b, 2, 1));
        way(dst, Store::Replace, 1.0, lhs, rhs, Threads::One);
        let expected = [f32::INFINITY, 1.0, f32::NEG_INFINITY, 2.5];
        assert_eq!(found, expected, "{name}");
    }
}

#[test]
fn the_best_kernel_is_one_the_processor_has() {
    let choice = Choice::current();
    assert!(choice.kernel.is_present());
    assert!(choice.wrong.is_empty(), "{choice:?}");
    for kernel in Kernel::ALL {
        assert_eq!(Kernel::named(kernel.name()).unwrap(), kernel);
        if kernel == choice.kernel {
            assert!(Choice::force(kernel).is_ok());
        } else {
            let why = Choice::force(kernel).unwrap_err().to_string();
            assert!(why.contains(kernel.name()), "{why}");
        }
    }
    let why = Kernel::named("neon").unwrap_err().to_string();
    assert!(why.contains("avx512-bf16, avx512"), "{why}");
}

/// Sums of products of this many numbers, whose rows and panel look random.
fn f32_case(depth: usize) -> (Vec<f32>, Vec<f32>) {
    (values(4 * depth, 5), values(depth * PANEL, 6))
}

fn f32_rows(rows: &[f32]) -> [&[f32]; 4] {
    std::array::from_fn(|r| &rows[r * (rows.len() / 4)..][..rows.len() / 4])
}

#[test]
fn tiles_have_the_same_bits_on_every_processor() {
    for depth in [1, 2, 37, 50] {
        let (rows, b) = f32_case(depth);
        let cut = depth / 3 * PANEL;
        let blocks = || [&b[..cut], &b[cut..]].into_iter();
        let rows = f32_rows(&rows);
        let plain = portable::tile(rows, blocks());
        assert_eq!(tile(rows, blocks()), plain);
        let slow = (0..depth).fold(0f32, |sum, i| rows[2][i].mul_add(b[i * PANEL + 9], sum));
        assert_eq!(plain[2][9], slow);
        let exact = (0..depth).map(|i| f64::from(rows[2][i]) * f64::from(b[i * PANEL + 9]));
        assert!((exact.sum::<f64>() - f64::from(slow)).abs() < 1e-5);
        #[cfg(target_arch = "x86_64")]
        {
            match Avx2::detect() {
                Some(vectors) => {
                    assert_eq!(vectors.tile(rows, blocks()), plain);
                    let three = [rows[0], rows[1], rows[2]];
                    let three = vectors.tile(three, blocks());
                    assert_eq!(three, plain[..3], "an odd number of rows");
                }
                None => eprintln!("skipped: this processor has no avx2"),
            }
            match Avx512::detect() {
                Some(vectors) => assert_eq!(vectors.tile(rows, blocks()), plain),
                None => eprintln!("skipped: this processor has no avx512"),
            }
        }
    }
}

#[test]
fn bytes_are_summed_exactly() {
    for depth in [4, 44, 64, 132, 256] {
        let panel: Vec<i8> = (0..depth * PANEL).map(|i| (i * 37 % 255) as i8).collect();
        let all: Vec<u8> = (0..32 * depth).map(|i| (i * 91 % 256) as u8).collect();
        let rows: [&[u8]; 32] = std::array::from_fn(|r| &all[r * depth..][..depth]);
        let plain = portable::byte_tile(rows, &panel);
        let at = |k: usize, j: usize| i32::from(panel[(k / 4 * PANEL + j) * 4 + k % 4]);
        let slow = (0..depth).map(|k| i32::from(rows[3][k]) * at(k, 7));
        assert_eq!(plain[3][7], slow.sum::<i32>());
        assert_eq!(byte_tile(rows, &panel), plain);
        #[cfg(target_arch = "x86_64")]
        {
            match Avx2::detect() {
                Some(vectors) => assert_eq!(vectors.byte_tile(rows, &panel), plain),
                None => eprintln!("skipped: this processor has no avx2"),
            }
            match Avx512::detect() {
                Some(vectors) => assert_eq!(vectors.byte_tile(rows, &panel), plain),
                None => eprintln!("skipped: this processor has no avx512"),
            }
            match Amx::detect() {
                Some(unit) => {
                    for n in [BYTE_ROWS, 2 * BYTE_ROWS] {
                        let mut sums = vec![[1; PANEL]; n];
                        ByteTiles::of(unit).multiply(&all[..n * depth], &panel, &mut sums);
                        assert_eq!(sums, plain[..n], "{n} rows");
                    }
                }
                None => eprintln!("skipped: this processor has no amx"),
            }
        }
    }
}

#[test]
fn extreme_bytes_do_not_saturate() {
    let panel = [[127i8, -128].repeat(2 * PANEL), vec![-128; 4 * PANEL]].concat();
    let all = [255u8; 8];
    let sums = byte_tile([&all], &panel);
    assert_eq!(sums, portable::byte_tile([&all], &panel));
    assert_eq!(sums[0][0], 2 * 255 * 127 - 6 * 255 * 128);
}

/// Attention in f64, of one row with one head.
#[cfg(target_arch = "x86_64")]
fn exact_attention(q: &[f32], keys: &[&[f32]], values: &[&[f32]]) -> Vec<f64> {
    let number = |x: f32| f64::from(rounded::round(x));
    let score = |key: &&[f32]| {
        q.iter()
            .zip(*key)
            .map(|(q, k)| number(*q) * number(*k))
            .sum()
    };
    let scores: Vec<f64> = keys.iter().map(score).collect();
    let weights: Vec<f64> = scores.iter().map(|score| score.exp()).collect();
    let all: f64 = weights.iter().sum();
    let channel = |c: usize| {
        let terms = weights.iter().zip(values).map(|(w, v)| w * number(v[c]));
        terms.sum::<f64>() / all
    };
    (0..q.len()).map(channel).collect()
}

/// Some channels of all rows.
#[cfg(target_arch = "x86_64")]
fn head_of(all: &[f32], c: usize, part: std::ops::Range<usize>) -> Vec<&[f32]> {
    all.chunks_exact(c).map(|row| &row[part.clone()]).collect()
}

#[test]
#[cfg(target_arch = "x86_64")]
fn attention_over_pages_is_that_of_rounded_numbers() {
    use crate::half_pages::PAGE;
    type Way = fn(HalfHeads, &[&HalfPage], &[f32], &[usize], &mut [f32], &mut Room);
    let mut ways: Vec<(&str, Way)> = Vec::new();
    match Avx512Bf16::detect() {
        Some(_) => {
            ways.push(("avx512-bf16", |heads, pages, q, visible, out, room| {
                let unit = Avx512Bf16::detect().unwrap();
                half_attention::attend(unit, heads, pages, q, visible, out, room);
            }));
            ways.push(("tiles as told", |heads, pages, q, visible, out, room| {
                let unit = tiles::Emulated(Avx512Bf16::detect().unwrap());
                half_attention::attend(unit, heads, pages, q, visible, out, room);
            }));
        }
        None => eprintln!("skipped: this processor has no avx512-bf16"),
    }
    match Amx::detect() {
        Some(_) => ways.push(("amx", |heads, pages, q, visible, out, room| {
            let unit = Amx::detect().unwrap();
            half_attention::attend(unit, heads, pages, q, visible, out, room);
        })),
        None => eprintln!("skipped: this processor has no amx"),
    }
    // An odd number of channels, more than a panel of them, the sizes of the networks, and more pages
    // than are multiplied at once.
    for (n, d, tokens) in [
        (1, 5, 75),
        (3, 40, 75),
        (4, 32, 75),
        (2, 64, 75),
        (1, 33, 600),
    ] {
        let (heads, c, rows) = (HalfHeads { n, d }, n * d, 41);
        let (keys, worth) = (values(tokens * c, 1), values(tokens * c, 2));
        let mut pages = vec![HalfPage::new(heads); tokens.div_ceil(PAGE)];
        // Written twice: what was there before does not count.
        for at in (0..tokens).chain(0..tokens) {
            let own = at * c..(at + 1) * c;
            pages[at / PAGE].write(heads, at % PAGE, &keys[own.clone()], &worth[own]);
        }
        let pages: Vec<&HalfPage> = pages.iter().collect();
        let q = values(rows * c, 3);
        let visible: Vec<usize> = (0..rows).map(|r| 1 + (r * 31) % tokens).collect();
        for (name, way) in &ways {
            let mut out = vec![9.0; rows * c];
            let mut room = Room::default();
            way(heads, &pages, &q, &visible, &mut out, &mut room);
            for (r, seen) in visible.iter().enumerate() {
                for h in 0..n {
                    let part = h * d..(h + 1) * d;
                    let rows = |all| head_of(all, c, part.clone());
                    let (keys, worth) = (rows(&keys), rows(&worth));
                    let expected = exact_attention(rows(&q)[r], &keys[..*seen], &worth[..*seen]);
                    for (found, expected) in rows(&out)[r].iter().zip(expected) {
                        // Weights are rounded, too: to 8 bits, of values up to 1.
                        let off = (f64::from(*found) - expected).abs();
                        assert!(off < 4e-3, "{name} {n} {d} row {r}: {found} {expected}");
                    }
                }
                // A row alone has the bits it has among others.
                let mut alone = vec![0.0; c];
                let of_row = r * c..(r + 1) * c;
                way(
                    heads,
                    &pages,
                    &q[of_row.clone()],
                    &[*seen],
                    &mut alone,
                    &mut room,
                );
                assert_eq!(alone, out[of_row], "{name} {n} {d} row {r}");
            }
        }
    }
}
