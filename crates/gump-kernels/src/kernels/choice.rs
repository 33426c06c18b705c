//! The choice of a kernel: the best one that the processor has and that multiplies a small matrix
//! correctly, or the one requested.

use std::fmt;
use std::sync::OnceLock;

use serde::Serialize;

#[cfg(target_arch = "x86_64")]
use super::amx::Amx;
#[cfg(target_arch = "x86_64")]
use super::avx2::Avx2;
#[cfg(target_arch = "x86_64")]
use super::avx512::Avx512;
#[cfg(target_arch = "x86_64")]
use super::avx512_bf16::Avx512Bf16;
#[cfg(target_arch = "x86_64")]
use super::bf16;
#[cfg(target_arch = "x86_64")]
use super::{portable, rounded};
use crate::KernelError;
#[cfg(target_arch = "x86_64")]
use crate::gemm::{Mat, MatMut, Store, Threads};
#[cfg(target_arch = "x86_64")]
use crate::panels::PANEL;

/// A set of instructions that matrices are multiplied with. A later one includes the earlier.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Kernel {
    /// No more than every processor has.
    Portable,
    /// Vectors of 256 bits with fused multiply-adds.
    Avx2,
    /// Vectors of 512 bits; sums of products of bytes where the processor has them.
    Avx512,
    /// The same, and products of pairs of bfloat16.
    Avx512Bf16,
    /// The same, and products of tiles of bfloat16 and of bytes.
    Amx,
}

impl Kernel {
    /// All of them, the best first.
    pub const ALL: [Self; 5] = [
        Self::Amx,
        Self::Avx512Bf16,
        Self::Avx512,
        Self::Avx2,
        Self::Portable,
    ];

    /// Its name, for example `avx512-bf16`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
            Self::Avx512Bf16 => "avx512-bf16",
            Self::Amx => "amx",
        }
    }

    /// Whether it multiplies bfloat16 by instructions of the processor. Others round, then multiply
    /// in f32, which takes longer than f32 alone.
    pub fn multiplies_bfloat16(self) -> bool {
        matches!(self, Self::Amx | Self::Avx512Bf16)
    }

    /// The kernel of this name.
    ///
    /// # Errors
    /// [`KernelError`] that lists the names.
    pub fn named(name: &str) -> Result<Self, KernelError> {
        let found = Self::ALL.into_iter().find(|kernel| kernel.name() == name);
        found.ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            KernelError(format!(
                "no kernel is called {name}, expected one of {known}"
            ))
        })
    }

    /// Whether this processor has the instructions, and its system lets them be used.
    pub fn is_present(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        match self {
            Self::Portable => true,
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            Self::Avx512 => {
                Self::Avx2.is_present()
                    && is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512vl")
            }
            Self::Avx512Bf16 => Self::Avx512.is_present() && Avx512Bf16::detect().is_some(),
            Self::Amx => Self::Avx512Bf16.is_present() && Amx::detect().is_some(),
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            self == Self::Portable
        }
    }

    /// Whether it multiplies a small matrix of odd sizes correctly, up to rounding.
    fn is_right(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        {
            let wide = || {
                Avx512::detect()
                    .is_some_and(|v| are_tiles_right(|r, b| v.tile(r, b), |r, p| v.byte_tile(r, p)))
            };
            match self {
                Self::Portable => true,
                Self::Avx2 => Avx2::detect().is_some_and(|v| {
                    are_tiles_right(|r, b| v.tile(r, b), |r, p| v.byte_tile(r, p))
                }),
                Self::Avx512 => wide(),
                Self::Avx512Bf16 => wide() && Avx512Bf16::detect().is_some_and(is_unit_right),
                Self::Amx => {
                    wide()
                        && Amx::detect()
                            .is_some_and(|unit| is_unit_right(unit) && are_bytes_right(unit))
                }
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        true
    }
}

impl fmt::Display for Kernel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The kernel that a process multiplies with, and how it was chosen.
#[derive(Clone, Debug, Serialize)]
pub struct Choice {
    /// The kernel in use.
    pub kernel: Kernel,
    /// Whether it was set by [`Choice::force`] instead of detected.
    pub forced: bool,
    /// Kernels that the processor has and that failed their test.
    pub wrong: Vec<Kernel>,
}

/// Set once: results would change midway if the kernel of a process did.
static CHOSEN: OnceLock<Choice> = OnceLock::new();

impl Choice {
    /// Returns the choice of this process; the first call makes it.
    pub fn current() -> &'static Self {
        CHOSEN.get_or_init(Self::best)
    }

    /// Makes this process multiply with a certain kernel. Must be called before the first product.
    ///
    /// # Errors
    /// [`KernelError`] if the processor does not have it, if it fails its test, or if
    /// another one is already in use.
    pub fn force(kernel: Kernel) -> Result<&'static Self, KernelError> {
        let best = Self::best();
        usable(kernel, best.kernel, Kernel::is_present, Kernel::is_right)?;
        let forced = Self {
            kernel,
            forced: true,
            wrong: best.wrong,
        };
        let choice = CHOSEN.get_or_init(|| forced);
        if choice.kernel != kernel {
            let other = choice.kernel;
            return Err(KernelError(format!(
                "kernel {kernel} comes too late, {other} is at work"
            )));
        }
        Ok(choice)
    }

    fn best() -> Self {
        Self::first_of(Kernel::is_present, Kernel::is_right)
    }

    /// The best kernel that is present and right. The portable one is always both.
    fn first_of(is_present: impl Fn(Kernel) -> bool, is_right: impl Fn(Kernel) -> bool) -> Self {
        let (mut kernel, mut wrong) = (Kernel::Portable, Vec::new());
        for candidate in Kernel::ALL {
            if is_present(candidate) {
                if is_right(candidate) {
                    kernel = candidate;
                    break;
                }
                wrong.push(candidate);
            }
        }
        Self {
            kernel,
            forced: false,
            wrong,
        }
    }
}

/// Refuses a kernel that the processor lacks, or that multiplies wrongly on it: on a real one with a
/// fault, or on an emulated one.
fn usable(
    kernel: Kernel,
    best: Kernel,
    is_present: impl Fn(Kernel) -> bool,
    is_right: impl Fn(Kernel) -> bool,
) -> Result<(), KernelError> {
    if !is_present(kernel) {
        return Err(KernelError(format!(
            "this processor has no kernel {kernel}, its best is {best}"
        )));
    }
    if !is_right(kernel) {
        return Err(KernelError(format!(
            "kernel {kernel} multiplies wrongly on this processor"
        )));
    }
    Ok(())
}

/// Whether a unit's product of odd sizes is that of rounded numbers, in f64, but for the rounding
/// of sums in f32.
#[cfg(target_arch = "x86_64")]
pub(super) fn is_unit_right<U: bf16::Unit>(unit: U) -> bool {
    // No multiples of any block, panel or vector, but more than the largest of them.
    let (m, k, n) = (35, 37, 45);
    let number = |i: usize| i as f32 / 507.0 - 1.0;
    let (a, b) = (numbers(m * k, number), numbers(k * n, number));
    let mut found = vec![0.0; m * n];
    let (lhs, rhs) = (Mat::new(&a, m, k), Mat::new(&b, k, n));
    let dst = MatMut::new(&mut found, m, n);
    bf16::product(unit, dst, Store::Replace, 1.0, (lhs, rhs), Threads::One);
    (0..m * n).all(|at| {
        let (i, j) = (at / n, at % n);
        let term = |p: usize| {
            f64::from(rounded::round(a[i * k + p])) * f64::from(rounded::round(b[p * n + j]))
        };
        let sum: f64 = (0..k).map(term).sum();
        (f64::from(found[at]) - sum).abs() < 1e-5 * k as f64
    })
}

/// Numbers to multiply: of every size, the same everywhere.
#[cfg(target_arch = "x86_64")]
fn numbers<T>(n: usize, number: impl Fn(usize) -> T) -> Vec<T> {
    (0..n).map(|i| number(i * 7919 % 1013)).collect()
}

/// Whether sums of products, of numbers and of bytes, are those of the portable kernel to the bit.
#[cfg(target_arch = "x86_64")]
fn are_tiles_right(
    tile: impl Fn([&[f32]; 3], std::iter::Once<&[f32]>) -> [[f32; PANEL]; 3],
    byte_tile: impl Fn([&[u8]; 3], &[i8]) -> [[i32; PANEL]; 3],
) -> bool {
    // A multiple of the four bytes of a group, but of no vector.
    const DEPTH: usize = 20;
    let a = numbers(3 * DEPTH, |i| i as f32 / 507.0 - 1.0);
    let b = numbers(DEPTH * PANEL, |i| i as f32 / 507.0 - 1.0);
    let rows = std::array::from_fn(|r| &a[r * DEPTH..][..DEPTH]);
    let blocks = || std::iter::once(&b[..]);
    let bytes = numbers(3 * DEPTH, |i| i as u8);
    let panel = numbers(DEPTH * PANEL, |i| i as i8);
    let byte_rows = std::array::from_fn(|r| &bytes[r * DEPTH..][..DEPTH]);
    tile(rows, blocks()) == portable::tile(rows, blocks())
        && byte_tile(byte_rows, &panel) == portable::byte_tile(byte_rows, &panel)
}

/// Whether tiles of bytes sum exactly.
#[cfg(target_arch = "x86_64")]
fn are_bytes_right(unit: Amx) -> bool {
    // Two steps of a tile, 64 bytes each.
    const DEPTH: usize = 128;
    let bytes = numbers(32 * DEPTH, |i| i as u8);
    let panel = numbers(DEPTH * PANEL, |i| i as i8);
    let rows: [&[u8]; 32] = std::array::from_fn(|r| &bytes[r * DEPTH..][..DEPTH]);
    let exact = portable::byte_tile(rows, &panel);
    let tiles = super::amx::Tiles::cut(unit);
    [16, 32].into_iter().all(|n| {
        let mut sums = [[0; PANEL]; 32];
        let done = tiles.multiply_bytes(&bytes[..n * DEPTH], &panel, &mut sums[..n]);
        done == DEPTH && sums[..n] == exact[..n]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kernel_that_multiplies_wrongly_is_not_used_and_named() {
        let is_present = |kernel| kernel != Kernel::Amx;
        let is_right = |kernel| !matches!(kernel, Kernel::Avx512Bf16 | Kernel::Avx2);
        let choice = Choice::first_of(is_present, is_right);
        assert_eq!(choice.kernel, Kernel::Avx512);
        assert_eq!(choice.wrong, [Kernel::Avx512Bf16]);
        let refused = |kernel| {
            let why = usable(kernel, choice.kernel, is_present, is_right).unwrap_err();
            why.to_string()
        };
        assert_eq!(
            refused(Kernel::Avx2),
            "kernel avx2 multiplies wrongly on this processor"
        );
        assert_eq!(
            refused(Kernel::Amx),
            "this processor has no kernel amx, its best is avx512"
        );
        assert!(usable(Kernel::Portable, choice.kernel, is_present, is_right).is_ok());
    }
}
