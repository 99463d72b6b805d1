//! Matrix products on AMX tiles: bf16 operands, f32 sums (Intel SDM, volume 1, chapter 18).
//!
//! A tile is 16 lines of 64 bytes. `C[16, 16] += A[16, 32] · B[32, 16]` is one instruction; A's lines are
//! rows, B's lines hold pairs of rows interleaved. Operands are rounded to bf16 (nearest even) while they
//! are packed into tiles; sums run over `k` in a fixed order.

use super::{Gemm, Init, View};
use std::arch::asm;
use std::arch::x86_64::*;
use std::cell::RefCell;
use std::sync::OnceLock;

/// Elements of `k` per tile.
pub const K: usize = 32;
/// Rows and columns of a block of 2 × 2 tiles.
pub const BLOCK: usize = 32;

/// One line of a tile: 32 bf16 numbers.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Line([u16; K]);

impl Line {
    pub const ZERO: Line = Line([0; K]);
}

#[derive(Default)]
struct Scratch {
    a: Vec<Line>,
    b: Vec<Line>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// Whether this CPU multiplies bf16 tiles and the system lets this process do so.
pub fn is_available() -> bool {
    static KNOWN: OnceLock<bool> = OnceLock::new();
    *KNOWN.get_or_init(|| {
        let vectors = is_x86_feature_detected!("avx512bf16") && is_x86_feature_detected!("avx512bw");
        let leaf = __cpuid_count(7, 0).edx;
        let tiles = leaf >> 22 & 1 == 1 && leaf >> 24 & 1 == 1;
        vectors && tiles && request_permission()
    })
}

/// Linux gives a process the tile registers when it asks (`arch_prctl(ARCH_REQ_XCOMP_PERM, XTILEDATA)`).
#[cfg(target_os = "linux")]
fn request_permission() -> bool {
    let answer: i64;
    // SAFETY: a system call without memory operands; it clobbers rcx and r11.
    unsafe {
        asm!("syscall", inlateout("rax") 158i64 => answer, in("rdi") 0x1023, in("rsi") 18,
             out("rcx") _, out("r11") _, options(nostack));
    }
    answer == 0
}

#[cfg(not(target_os = "linux"))]
fn request_permission() -> bool {
    false
}

/// Palette 1 with all eight tiles at 16 lines of 64 bytes.
#[repr(C, align(64))]
struct TileConfig([u8; 64]);

static CONFIG: TileConfig = {
    let mut c = [0u8; 64];
    c[0] = 1;
    let mut t = 0;
    while t < 8 {
        c[16 + 2 * t] = 64;
        c[48 + t] = 16;
        t += 1;
    }
    TileConfig(c)
};

/// Runs a product whose shapes were checked.
///
/// # Safety
/// [`is_available`] holds; slices fit the shapes as `gemm` asserts.
pub unsafe fn run(g: &Gemm, c: &mut [f32]) {
    SCRATCH.with_borrow_mut(|s| {
        // SAFETY: as the caller vouches.
        unsafe {
            pack_a(g, &mut s.a);
            run_packed(g, &s.a, &mut s.b, c.as_mut_ptr());
        }
    });
}

/// A as tiles, of whole blocks of rows.
///
/// # Safety
/// [`is_available`] holds; A fits the shapes.
pub unsafe fn pack_a(g: &Gemm, out: &mut Vec<Line>) {
    let kt = g.k.div_ceil(K);
    grow(out, g.m.div_ceil(BLOCK) * 2 * kt);
    // SAFETY: there is room for these tiles; the CPU has the instructions.
    unsafe { if g.a.col == 1 { pack_rows(g, out, kt) } else { pack_columns(g, out, kt) } }
}

/// Runs a product whose A is packed already; `b` is memory to pack B into.
///
/// # Safety
/// [`is_available`] holds; `a` is what [`pack_a`] made of as many rows and terms; B and C fit the shapes.
pub unsafe fn run_packed(g: &Gemm, a: &[Line], b: &mut Vec<Line>, c: *mut f32) {
    let kt = g.k.div_ceil(K);
    grow(b, g.n.div_ceil(BLOCK) * 2 * kt);
    // SAFETY: there is room for these tiles; the CPU has the instructions.
    unsafe {
        pack_pairs(g, b, kt);
        with_tiles(|| multiply(g, a, b, kt, c));
    }
}

fn grow(lines: &mut Vec<Line>, tiles: usize) {
    if lines.len() < tiles * 16 {
        lines.resize(tiles * 16, Line::ZERO);
    }
}

/// Runs `work` with the tile registers configured.
///
/// # Safety
/// [`is_available`] holds.
pub unsafe fn with_tiles(work: impl FnOnce()) {
    // SAFETY: the CPU has the instructions and the process the permission.
    unsafe { asm!("ldtilecfg [{}]", in(reg) &CONFIG, options(nostack, readonly)) };
    work();
    // SAFETY: as above.
    unsafe { asm!("tilerelease", options(nostack, nomem)) };
}

/// Weights `[k, n]` as tiles.
///
/// # Safety
/// [`is_available`] holds; `weights` holds `k · n` numbers and `out` the tiles of `n` columns.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub unsafe fn pack_weights(k: usize, n: usize, weights: &[f32], out: &mut [Line]) {
    let (a, init) = (View::rows(&[], 0), Init::Zero);
    let g = Gemm { m: 0, n, k, a, b: weights, ldb: n, ldc: n, init, relu: false };
    // SAFETY: see the caller.
    unsafe { pack_pairs(&g, out, k.div_ceil(K)) };
}

/// Rows `[m, k]` as tiles, `kt` of them per row.
///
/// # Safety
/// [`is_available`] holds; `rows` holds `m · k` numbers and `out` the tiles of `m` rows.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub unsafe fn pack_lines(rows: &[f32], k: usize, m: usize, kt: usize, out: &mut [Line]) {
    let (a, init) = (View::rows(rows, k), Init::Zero);
    let g = Gemm { m, n: 0, k, a, b: &[], ldb: 0, ldc: 0, init, relu: false };
    // SAFETY: see the caller.
    unsafe { pack_rows(&g, out, kt) };
}

/// The first `n` of 16 lanes.
#[inline(always)]
fn lanes(n: usize) -> u16 {
    if n >= 16 { u16::MAX } else { (1u16 << n) - 1 }
}

/// A row-major: a line holds 32 elements of a row.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn pack_rows(g: &Gemm, out: &mut [Line], kt: usize) {
    // SAFETY: loads are masked to the row's k elements; lines lie inside the scratch.
    unsafe {
        for i in 0..g.m {
            let row = g.a.data.as_ptr().add(i * g.a.row);
            for q in 0..kt {
                let left = g.k - q * K;
                let p = row.wrapping_add(q * K);
                let (lo, hi) = if left >= K {
                    (_mm512_loadu_ps(p), _mm512_loadu_ps(p.add(16)))
                } else {
                    (_mm512_maskz_loadu_ps(lanes(left), p), _mm512_maskz_loadu_ps(lanes(left.saturating_sub(16)), p.wrapping_add(16)))
                };
                store(out, ((i / 16) * kt + q) * 16 + i % 16, _mm512_cvtne2ps_pbh(hi, lo));
            }
        }
    }
}

/// A given by its transpose: pairs along `k` are joined, then 16 × 16 pairs are transposed.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn pack_columns(g: &Gemm, out: &mut [Line], kt: usize) {
    // SAFETY: loads are masked to the m columns and skipped beyond row k; lines lie inside the scratch.
    unsafe {
        for tile in 0..g.m.div_ceil(16) {
            let mask = lanes(g.m - tile * 16);
            for q in 0..kt {
                let mut v = [_mm512_setzero_si512(); 16];
                for (pair, v) in v.iter_mut().enumerate() {
                    let p = q * K + 2 * pair;
                    if p < g.k {
                        let src = g.a.data.as_ptr().add(p * g.a.col + tile * 16);
                        *v = joined(src, g.a.col, p + 1 < g.k, mask);
                    }
                }
                let v = transpose16(v);
                for (i, v) in v.iter().enumerate() {
                    let at = (tile * kt + q) * 16 + i;
                    _mm512_store_si512(out.as_mut_ptr().add(at).cast(), *v);
                }
            }
        }
    }
}

/// B: a line holds 16 columns of two rows, interleaved.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn pack_pairs(g: &Gemm, out: &mut [Line], kt: usize) {
    // SAFETY: loads are masked to the n columns and skipped beyond row k; lines lie inside the scratch.
    unsafe {
        for tile in 0..g.n.div_ceil(16) {
            let mask = lanes(g.n - tile * 16);
            for pair in 0..kt * 16 {
                let p = 2 * pair;
                let v = if p < g.k {
                    joined(g.b.as_ptr().add(p * g.ldb + tile * 16), g.ldb, p + 1 < g.k, mask)
                } else {
                    _mm512_setzero_si512()
                };
                _mm512_store_si512(out.as_mut_ptr().add(tile * kt * 16 + pair).cast(), v);
            }
        }
    }
}

/// Sixteen floats at `src` and sixteen `stride` further on, as interleaved bf16.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn joined(src: *const f32, stride: usize, second: bool, mask: u16) -> __m512i {
    // SAFETY: the caller vouches for the masked lanes.
    unsafe {
        let lo = _mm512_maskz_loadu_ps(mask, src);
        let hi = _mm512_maskz_loadu_ps(if second { mask } else { 0 }, src.wrapping_add(stride));
        let both: __m512i = std::mem::transmute(_mm512_cvtne2ps_pbh(hi, lo));
        // Words 0, 16, 1, 17, …
        let low = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        let order = _mm512_or_si512(low, _mm512_slli_epi32::<16>(_mm512_add_epi32(low, _mm512_set1_epi32(16))));
        _mm512_permutexvar_epi16(order, both)
    }
}

#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn store(out: &mut [Line], at: usize, v: __m512bh) {
    // SAFETY: the caller vouches for the line.
    unsafe { _mm512_store_si512(out.as_mut_ptr().add(at).cast(), std::mem::transmute::<__m512bh, __m512i>(v)) }
}

/// Transpose of 16 × 16 words of 32 bits.
#[inline]
#[target_feature(enable = "avx512f")]
pub fn transpose16(r: [__m512i; 16]) -> [__m512i; 16] {
    let mut t = r;
    for i in (0..16).step_by(2) {
        t[i] = _mm512_unpacklo_epi32(r[i], r[i + 1]);
        t[i + 1] = _mm512_unpackhi_epi32(r[i], r[i + 1]);
    }
    let mut u = t;
    for i in (0..16).step_by(4) {
        u[i] = _mm512_unpacklo_epi64(t[i], t[i + 2]);
        u[i + 1] = _mm512_unpackhi_epi64(t[i], t[i + 2]);
        u[i + 2] = _mm512_unpacklo_epi64(t[i + 1], t[i + 3]);
        u[i + 3] = _mm512_unpackhi_epi64(t[i + 1], t[i + 3]);
    }
    // u[4 g + c] holds, in 128-bit part p, column 4 p + c of rows 4 g .. 4 g + 4.
    let mut out = u;
    for c in 0..4 {
        let a = _mm512_shuffle_i32x4::<0x88>(u[c], u[4 + c]);
        let b = _mm512_shuffle_i32x4::<0xdd>(u[c], u[4 + c]);
        let d = _mm512_shuffle_i32x4::<0x88>(u[8 + c], u[12 + c]);
        let e = _mm512_shuffle_i32x4::<0xdd>(u[8 + c], u[12 + c]);
        out[c] = _mm512_shuffle_i32x4::<0x88>(a, d);
        out[8 + c] = _mm512_shuffle_i32x4::<0xdd>(a, d);
        out[4 + c] = _mm512_shuffle_i32x4::<0x88>(b, e);
        out[12 + c] = _mm512_shuffle_i32x4::<0xdd>(b, e);
    }
    out
}

/// `sum[32, 32] = A · B` for 2 × 2 tiles, `kt` tiles deep.
///
/// # Safety
/// Within [`with_tiles`]; `a0` and `b0` hold `2 · kt` tiles each.
#[inline(always)]
pub unsafe fn sum_tiles(a0: *const Line, b0: *const Line, kt: usize, sum: *mut f32) {
    // SAFETY: the caller vouches for 2 · kt tiles of each operand and the room for the sum.
    unsafe {
        asm!("tilezero tmm0", "tilezero tmm1", "tilezero tmm2", "tilezero tmm3", options(nostack, nomem));
        for q in 0..kt {
            asm!(
                "tileloadd tmm4, [{a0} + {line}]",
                "tileloadd tmm6, [{b0} + {line}]",
                "tileloadd tmm7, [{b1} + {line}]",
                "tileloadd tmm5, [{a1} + {line}]",
                "tdpbf16ps tmm0, tmm4, tmm6",
                "tdpbf16ps tmm1, tmm4, tmm7",
                "tdpbf16ps tmm2, tmm5, tmm6",
                "tdpbf16ps tmm3, tmm5, tmm7",
                a0 = in(reg) a0.add(q * 16),
                a1 = in(reg) a0.add((kt + q) * 16),
                b0 = in(reg) b0.add(q * 16),
                b1 = in(reg) b0.add((kt + q) * 16),
                line = in(reg) 64usize,
                options(nostack, readonly),
            );
        }
        asm!(
            "tilestored [{c} + {row}], tmm0",
            "tilestored [{c} + {row} + 64], tmm1",
            "tilestored [{d} + {row}], tmm2",
            "tilestored [{d} + {row} + 64], tmm3",
            c = in(reg) sum,
            d = in(reg) sum.add(16 * BLOCK),
            row = in(reg) BLOCK * 4,
            options(nostack),
        );
    }
}

/// All blocks of 2 × 2 tiles, each summed in tiles and then finished in vectors.
#[target_feature(enable = "avx512f")]
unsafe fn multiply(g: &Gemm, a: &[Line], b: &[Line], kt: usize, c: *mut f32) {
    let mut sums = [[0.0f32; BLOCK * BLOCK]; 2];
    let mut turn = 0;
    // SAFETY: tiles lie inside the scratch; the finish is masked to the m rows and n columns.
    unsafe {
        for j in (0..g.n).step_by(BLOCK) {
            let b0 = b.as_ptr().add(j / 16 * kt * 16);
            for i in (0..g.m).step_by(BLOCK) {
                let a0 = a.as_ptr().add(i / 16 * kt * 16);
                let sum = sums[turn].as_mut_ptr();
                turn ^= 1;
                sum_tiles(a0, b0, kt, sum);
                finish(g, sum, i, j, c);
            }
        }
    }
}

/// `c = act(init + sum)` for a block.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn finish(g: &Gemm, sum: *const f32, i: usize, j: usize, c: *mut f32) {
    let zero = _mm512_setzero_ps();
    // SAFETY: rows below m, columns masked below n.
    unsafe {
        for half in 0..2 {
            let col = j + 16 * half;
            if col >= g.n {
                return;
            }
            let mask = lanes(g.n - col);
            let bias = match g.init {
                Init::Bias(b) => _mm512_maskz_loadu_ps(mask, b.as_ptr().add(col)),
                _ => zero,
            };
            for r in 0..BLOCK.min(g.m - i) {
                let out = c.add((i + r) * g.ldc + col);
                let start = if matches!(g.init, Init::Accumulate) { _mm512_maskz_loadu_ps(mask, out) } else { bias };
                let v = _mm512_add_ps(_mm512_loadu_ps(sum.add(r * BLOCK + 16 * half)), start);
                let v = if g.relu { _mm512_max_ps(v, zero) } else { v };
                _mm512_mask_storeu_ps(out, mask, v);
            }
        }
    }
}
