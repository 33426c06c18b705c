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
use std::mem::MaybeUninit;
use std::sync::OnceLock;

use super::avx512_bf16::{Avx512Bf16, store_rows};
use super::bf16::{Lanes, Target, Unit};
use crate::gemm::Store;
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

    /// Products of 16 or 32 rows of unsigned bytes with a panel of signed ones, summed exactly into
    /// `sums`; as deep as whole tiles reach, which is returned.
    ///
    /// `rows` are `depth` bytes each, one after another; `panel` is `[depth / 4, PANEL, 4]`.
    ///
    /// Panics when they are not, or `sums` are of another number of rows.
    pub(super) fn multiply_bytes(
        &self,
        rows: &[u8],
        panel: &[i8],
        sums: &mut [[i32; PANEL]],
    ) -> usize {
        let depth = panel.len() / PANEL;
        assert!(rows.len() == sums.len() * depth, "rows of {depth} bytes");
        let steps = depth / TILE_BYTES;
        if steps == 0 {
            sums.as_flattened_mut().fill(0);
            return 0;
        }
        let (rows, panel, depth) = (rows.as_ptr(), panel.as_ptr(), depth);
        let to = sums.as_mut_ptr();
        // SAFETY: the value proves that the thread has cut the tiles; rows and panel were found to
        // be as long as their shapes, and `steps` is at least 1.
        unsafe {
            match sums.len() {
                TILE => byte_sums(rows, panel, (depth, steps), to),
                BLOCK => byte_sums_of_two(rows, panel, (depth, steps), to),
                n => panic!("{n} rows are neither {TILE} nor {BLOCK}"),
            }
        }
        steps * TILE_BYTES
    }
}

/// The sums of 16 rows of bytes, `depth` apart, with a panel. A step is 64 bytes of a row.
///
/// # Safety
/// The processor has the instructions and the tiles are cut; there are 16 rows of `steps` steps, at
/// least 1, and 16 rows of 128 bytes of the panel for each; `sums` has 16 rows of 128 bytes.
unsafe fn byte_sums(
    rows: *const u8,
    panel: *const i8,
    (depth, steps): (usize, usize),
    sums: *mut [i32; PANEL],
) {
    // SAFETY: as the function's.
    unsafe {
        asm!(
            "tilezero tmm0",
            "tilezero tmm1",
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
            "tilestored [{sums} + {of_panel}*1], tmm0",
            "tilestored [{sums} + {of_panel}*1 + 64], tmm1",
            rows = inout(reg) rows => _,
            panel = inout(reg) panel => _,
            steps = inout(reg) steps => _,
            sums = in(reg) sums,
            depth = in(reg) depth,
            of_panel = in(reg) PANEL_BYTES,
            out("tmm0") _, out("tmm1") _, out("tmm4") _, out("tmm6") _, out("tmm7") _,
            options(nostack)
        );
    }
}

/// As [`byte_sums`] of 32 rows: a tile of the panel is loaded once for two products.
///
/// # Safety
/// As there, with 32 rows.
unsafe fn byte_sums_of_two(
    rows: *const u8,
    panel: *const i8,
    (depth, steps): (usize, usize),
    sums: *mut [i32; PANEL],
) {
    // SAFETY: as the function's.
    unsafe {
        asm!(
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            "2:",
            "tileloadd tmm4, [{rows} + {depth}*1]",
            "tileloadd tmm6, [{panel} + {of_panel}*1]",
            "tileloadd tmm7, [{panel} + {of_panel}*1 + 64]",
            "tileloadd tmm5, [{below} + {depth}*1]",
            "tdpbusd tmm0, tmm4, tmm6",
            "tdpbusd tmm1, tmm4, tmm7",
            "tdpbusd tmm2, tmm5, tmm6",
            "tdpbusd tmm3, tmm5, tmm7",
            "add {rows}, 64",
            "add {below}, 64",
            "add {panel}, 2048",
            "dec {steps}",
            "jnz 2b",
            "tilestored [{sums} + {of_panel}*1], tmm0",
            "tilestored [{sums} + {of_panel}*1 + 64], tmm1",
            "tilestored [{sums} + {of_panel}*1 + 2048], tmm2",
            "tilestored [{sums} + {of_panel}*1 + 2112], tmm3",
            rows = inout(reg) rows => _,
            below = inout(reg) rows.add(TILE * depth) => _,
            panel = inout(reg) panel => _,
            steps = inout(reg) steps => _,
            sums = in(reg) sums,
            depth = in(reg) depth,
            of_panel = in(reg) PANEL_BYTES,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            options(nostack)
        );
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

impl Amx {
    /// Takes the sums of a block and at most [`AT_ONCE`] panels of one depth, one below another, into
    /// `to`.
    fn take_sums(self, block: &[u32], panels: &[&[u32]], to: &mut Target<'_>) {
        let steps = panels.first().map_or(0, |panel| panel.len()) / (TILE * PANEL);
        let of_panel = steps * TILE * PANEL;
        assert!(steps > 0, "at least one step");
        assert!(
            panels.iter().all(|panel| panel.len() == of_panel),
            "whole steps"
        );
        assert_eq!(
            block.len(),
            panels.len() * steps * TILE * BLOCK,
            "as deep as the panels"
        );
        let mut starts = [std::ptr::null(); AT_ONCE];
        for (start, panel) in starts[..panels.len()].iter_mut().zip(panels) {
            *start = panel.as_ptr();
        }
        let panels = (starts.as_ptr(), panels.len(), steps);
        let is_whole = to.rows == BLOCK && to.columns == PANEL;
        if is_whole && to.scale == 1.0 && to.store == Store::Replace {
            assert!(
                to.data.len() >= (BLOCK - 1) * to.stride + PANEL,
                "a whole block"
            );
            // SAFETY: the value proves the instructions, `during` has cut the tiles, and all slices
            // were found to be as long as their shapes.
            unsafe {
                bf16_sums(
                    block.as_ptr(),
                    panels,
                    (to.data.as_mut_ptr(), 4 * to.stride),
                );
            };
            return;
        }
        let mut sums = MaybeUninit::<[[f32; PANEL]; BLOCK]>::uninit();
        // SAFETY: as above; all sums are written.
        let sums = unsafe {
            bf16_sums(
                block.as_ptr(),
                panels,
                (sums.as_mut_ptr().cast(), PANEL_BYTES),
            );
            sums.assume_init()
        };
        // SAFETY: the value proves that there are vectors.
        unsafe { store_rows(to, &sums) };
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
        self.take_sums(block, &[panel], to);
    }

    fn multiply_stack<'a>(
        self,
        block: &[u32],
        mut panels: impl Iterator<Item = &'a [u32]>,
        to: &mut Target<'_>,
    ) {
        let mut rest = block;
        let mut some = [&[][..]; AT_ONCE];
        while !rest.is_empty() {
            let mut n = 0;
            for (some, panel) in some.iter_mut().zip(panels.by_ref()) {
                (*some, n) = (panel, n + 1);
            }
            assert!(n > 0, "panels as deep as the block");
            let (own, after) = rest.split_at(n * some[0].len() / PANEL * BLOCK);
            self.take_sums(own, &some[..n], to);
            (rest, to.store) = (after, Store::Add);
        }
    }

    fn pack_exponentials(
        self,
        scores: &mut [f32],
        visible: &[usize],
        block: &mut [u32],
        sums: &mut [f32],
    ) {
        let steps = block.len() / (TILE * BLOCK);
        let scores = scores.chunks_exact(2 * TILE * steps).zip(visible);
        for (r, ((scores, visible), sum)) in scores.zip(sums).enumerate() {
            let first = r / TILE * TILE * TILE + r % TILE * TILE;
            *sum = self.0.pack_exponentials(&scores[..*visible], first, block);
        }
    }
}

/// Panels that are multiplied by one call of [`bf16_sums`].
const AT_ONCE: usize = 16;

/// The 32 by 32 sums of a block and of panels below each other, in f32, in one chain. A step is 16
/// pairs.
///
/// # Safety
/// The processor has the instructions and the tiles are cut. `block` has `n * steps` steps of 32 rows
/// of 16 pairs, each of the `n` panels `steps` of 16 rows of 32 pairs, both at least 1; `to` has room
/// for 32 rows of 32 numbers, `stride` bytes apart.
unsafe fn bf16_sums(
    block: *const u32,
    (panels, n, steps): (*const *const u32, usize, usize),
    (to, stride): (*mut f32, usize),
) {
    // SAFETY: as the function's.
    unsafe {
        asm!(
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            "3:",
            "mov {panel}, [{panels}]",
            "mov {left}, {steps}",
            "4:",
            "tileloadd tmm4, [{block} + {of_tile}*1]",
            "tileloadd tmm6, [{panel} + {of_panel}*1]",
            "tileloadd tmm7, [{panel} + {of_panel}*1 + 64]",
            "tileloadd tmm5, [{block} + {of_tile}*1 + 1024]",
            "tdpbf16ps tmm0, tmm4, tmm6",
            "tdpbf16ps tmm1, tmm4, tmm7",
            "tdpbf16ps tmm2, tmm5, tmm6",
            "tdpbf16ps tmm3, tmm5, tmm7",
            "add {block}, 2048",
            "add {panel}, 2048",
            "dec {left}",
            "jnz 4b",
            "add {panels}, 8",
            "dec {n}",
            "jnz 3b",
            "tilestored [{to} + {stride}*1], tmm0",
            "tilestored [{to} + {stride}*1 + 64], tmm1",
            "tilestored [{below} + {stride}*1], tmm2",
            "tilestored [{below} + {stride}*1 + 64], tmm3",
            block = inout(reg) block => _,
            panels = inout(reg) panels => _,
            n = inout(reg) n => _,
            panel = out(reg) _,
            left = out(reg) _,
            steps = in(reg) steps,
            to = in(reg) to,
            below = in(reg) to.byte_add(TILE * stride),
            stride = in(reg) stride,
            of_tile = in(reg) TILE_BYTES,
            of_panel = in(reg) PANEL_BYTES,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            options(nostack)
        );
    }
}
