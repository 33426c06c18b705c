//! Tiles: Intel since Sapphire Rapids. Eight registers of 16 rows of 64 bytes, two of which are
//! multiplied by one instruction, of bfloat16 (`TDPBF16PS`) or of bytes (`TDPBUSD`).
//!
//! A block is 32 rows of the left matrix, `[steps, 2, 16, 16]` pairs, a step being 16 pairs of the
//! inner index; with a panel of 32 columns that makes four sums, two tiles of the left and two of
//! the right matrix: all eight registers. The system lends the registers to a process that
//! requests them ([`Amx::detect`]), and a thread configures them before it uses them ([`Tiles`]).
//!
//! Source: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 1, chapter 18, and
//! volume 2; the Linux kernel's documentation of dynamically enabled features.
#![allow(
    unsafe_code,
    unused_unsafe,
    reason = "the instructions exist as assembly only on stable Rust; what they need is checked once, in `detect`, and the slices they read and write before each call. Asking for the processor's features is unsafe in Rust 1.91 and safe later"
)]

use std::arch::asm;
use std::arch::x86_64::{__cpuid, __cpuid_count, _xgetbv};
use std::marker::PhantomData;
use std::sync::OnceLock;

use super::avx512_bf16::{Avx512Bf16, store_rows};
use super::bf16::{Lanes, Target, Unit};
use crate::panels::PANEL;

/// Rows of a tile, the most that the hardware has.
const TILE: usize = 16;

/// Bytes of a row of a tile, likewise.
const TILE_BYTES: usize = 64;

/// Rows of a block: two tiles.
const BLOCK: usize = 2 * TILE;

/// Bytes of a row of a panel: a pair per column.
const PANEL_BYTES: usize = 4 * PANEL;

/// Proof that the processor has tiles of bfloat16 and of bytes, and that the system lends them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Amx(Avx512Bf16);

impl Amx {
    /// Asks the system once per process.
    pub(super) fn detect() -> Option<Self> {
        static LENT: OnceLock<bool> = OnceLock::new();
        let vectors = Avx512Bf16::detect()?;
        let is_there = *LENT.get_or_init(|| has_tiles() && saves_tiles() && are_tiles_lent());
        is_there.then_some(Self(vectors))
    }
}

/// The processor's features: leaf 7, EDX bit 22 AMX-BF16, 24 AMX-TILE, 25 AMX-INT8.
fn has_tiles() -> bool {
    const ALL: u32 = 1 << 22 | 1 << 24 | 1 << 25;
    // SAFETY: every processor of 64 bits has the instruction; leaves are asked for in their range.
    unsafe { __cpuid(0).eax >= 7 && __cpuid_count(7, 0).edx & ALL == ALL }
}

/// Whether the system saves the tiles' configuration and data with a thread: XCR0 bits 17 and 18.
fn saves_tiles() -> bool {
    #[target_feature(enable = "xsave")]
    fn enabled() -> u64 {
        // SAFETY: register 0 exists wherever the instruction is enabled.
        unsafe { _xgetbv(0) }
    }
    const BOTH: u64 = 0b11 << 17;
    // SAFETY: leaf 1, ECX bit 27 says that the system has enabled the instruction.
    unsafe { __cpuid(1).ecx & 1 << 27 != 0 && enabled() & BOTH == BOTH }
}

/// Asks Linux for the permission to use the tiles' data, for all threads of the process.
#[cfg(target_os = "linux")]
fn are_tiles_lent() -> bool {
    // From the kernel's `unistd_64.h`, `prctl.h` and `fpu/types.h` for x86.
    const ARCH_PRCTL: i64 = 158;
    const ARCH_REQ_XCOMP_PERM: u64 = 0x1023;
    const XFEATURE_XTILEDATA: u64 = 18;
    let mut answer = ARCH_PRCTL;
    // SAFETY: the call reads and writes no memory of the process; the kernel keeps all registers
    // but the three named ones.
    unsafe {
        asm!(
            "syscall",
            inout("rax") answer,
            in("rdi") ARCH_REQ_XCOMP_PERM,
            in("rsi") XFEATURE_XTILEDATA,
            out("rcx") _,
            out("r11") _,
            options(nostack)
        );
    }
    answer == 0
}

/// No other system is known to lend them.
#[cfg(not(target_os = "linux"))]
fn are_tiles_lent() -> bool {
    false
}

/// Tile configuration of a thread: all eight as 16 rows of 64 bytes; released when dropped, by the same
/// thread.
pub(super) struct Tiles(PhantomData<*const ()>);

impl Tiles {
    pub(super) fn cut(_: Amx) -> Self {
        #[repr(C, align(64))]
        struct Config {
            palette: u8,
            start_row: u8,
            reserved: [u8; 14],
            /// Bytes of a row, per tile.
            row_bytes: [u16; 16],
            rows: [u8; 16],
        }
        let mut config = Config {
            palette: 1,
            start_row: 0,
            reserved: [0; 14],
            row_bytes: [0; 16],
            rows: [0; 16],
        };
        config.row_bytes[..8].fill(TILE_BYTES as u16);
        config.rows[..8].fill(TILE as u8);
        // SAFETY: the instruction exists, and reads the 64 bytes of the configuration.
        unsafe {
            asm!(
                "ldtilecfg [{config}]",
                config = in(reg) &raw const config,
                out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                options(nostack, readonly)
            );
        }
        Self(PhantomData)
    }

    /// Products of 16 rows of unsigned bytes with a panel of signed ones, summed exactly; as deep as
    /// whole tiles reach, which is returned too: what is left is another kernel's.
    ///
    /// `rows` are `depth` bytes each, one after another; `panel` is `[depth / 4, PANEL, 4]`.
    ///
    /// Panics when they are not.
    pub(super) fn multiply_bytes(
        &self,
        rows: &[u8],
        panel: &[i8],
    ) -> ([[i32; PANEL]; TILE], usize) {
        let depth = panel.len() / PANEL;
        assert!(rows.len() == TILE * depth, "16 rows of {depth} bytes");
        let steps = depth / TILE_BYTES;
        let mut sums = [[0i32; PANEL]; TILE];
        // SAFETY: the value proves that the thread has cut the tiles; a step reads 64 bytes of each of
        // the 16 rows, `depth` apart, and 16 rows of 128 bytes of the panel, `steps` times, which both
        // were found to have; what is written is `sums`, 16 rows of 128 bytes.
        unsafe {
            asm!(
                "tilezero tmm0",
                "tilezero tmm1",
                "test {steps}, {steps}",
                "jz 3f",
                "2:",
                "tileloadd tmm4, [{rows} + {depth}*1]",
                "tileloadd tmm6, [{panel} + {of_panel}*1]",
                "tileloadd tmm7, [{panel} + {of_panel}*1 + 64]",
                "tdpbusd tmm0, tmm4, tmm6",
                "tdpbusd tmm1, tmm4, tmm7",
                "add {rows}, 64",
                "add {panel}, 2048",
                "dec {steps}",
                "jnz 2b",
                "3:",
                "tilestored [{sums} + {of_panel}*1], tmm0",
                "tilestored [{sums} + {of_panel}*1 + 64], tmm1",
                rows = inout(reg) rows.as_ptr() => _,
                panel = inout(reg) panel.as_ptr() => _,
                steps = inout(reg) steps => _,
                sums = in(reg) sums.as_mut_ptr(),
                depth = in(reg) depth,
                of_panel = in(reg) PANEL_BYTES,
                out("tmm0") _, out("tmm1") _, out("tmm4") _, out("tmm6") _, out("tmm7") _,
                options(nostack)
            );
        }
        (sums, steps * TILE_BYTES)
    }
}

impl Drop for Tiles {
    fn drop(&mut self) {
        // SAFETY: the thread that configured them has the instruction; their contents are unused.
        unsafe {
            asm!(
                "tilerelease",
                out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                options(nostack, nomem)
            );
        }
    }
}

impl Unit for Amx {
    const ROWS: usize = BLOCK;

    fn pairs(depth: usize) -> usize {
        depth.div_ceil(2).next_multiple_of(TILE)
    }

    fn pack_left(self, from: Lanes<'_>, blocks: &mut [u32]) {
        self.0.pack_tiles(from, Self::pairs(from.depth), blocks);
    }

    fn pack_right(self, from: Lanes<'_>, panels: &mut [u32]) {
        self.0.pack_panels(from, Self::pairs(from.depth), panels);
    }

    fn during<R>(self, work: impl FnOnce() -> R) -> R {
        let _tiles = Tiles::cut(self);
        work()
    }

    fn multiply(self, block: &[u32], panel: &[u32], to: &mut Target<'_>) {
        let steps = panel.len() / (TILE * PANEL);
        assert_eq!(panel.len(), steps * TILE * PANEL, "whole steps");
        assert_eq!(block.len(), steps * TILE * BLOCK, "as deep as the panel");
        let mut sums = [[0f32; PANEL]; BLOCK];
        // SAFETY: the value proves the instructions, `during` has cut the tiles, and both slices
        // were found to be `steps` long.
        unsafe { bf16_sums(block.as_ptr(), panel.as_ptr(), steps, &mut sums) };
        // SAFETY: the value proves that there are vectors.
        unsafe { store_rows(to, &sums) };
    }
}

/// The 32 by 32 sums of a block and a panel.
///
/// # Safety
/// The processor has the instructions, the tiles are cut, and `block` and `panel` have as many
/// steps: 32 rows of 16 pairs, and 16 rows of 32 pairs.
unsafe fn bf16_sums(
    block: *const u32,
    panel: *const u32,
    steps: usize,
    sums: &mut [[f32; PANEL]; BLOCK],
) {
    // SAFETY: as the function's; what is written is `sums`, 32 rows of 128 bytes.
    unsafe {
        asm!(
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            "test {steps}, {steps}",
            "jz 3f",
            "2:",
            "tileloadd tmm4, [{block} + {of_tile}*1]",
            "tileloadd tmm5, [{block} + {of_tile}*1 + 1024]",
            "tileloadd tmm6, [{panel} + {of_panel}*1]",
            "tileloadd tmm7, [{panel} + {of_panel}*1 + 64]",
            "tdpbf16ps tmm0, tmm4, tmm6",
            "tdpbf16ps tmm1, tmm4, tmm7",
            "tdpbf16ps tmm2, tmm5, tmm6",
            "tdpbf16ps tmm3, tmm5, tmm7",
            "add {block}, 2048",
            "add {panel}, 2048",
            "dec {steps}",
            "jnz 2b",
            "3:",
            "tilestored [{sums} + {of_panel}*1], tmm0",
            "tilestored [{sums} + {of_panel}*1 + 64], tmm1",
            "tilestored [{sums} + {of_panel}*1 + 2048], tmm2",
            "tilestored [{sums} + {of_panel}*1 + 2112], tmm3",
            block = inout(reg) block => _,
            panel = inout(reg) panel => _,
            steps = inout(reg) steps => _,
            sums = in(reg) sums.as_mut_ptr(),
            of_tile = in(reg) TILE_BYTES,
            of_panel = in(reg) PANEL_BYTES,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            options(nostack)
        );
    }
}
