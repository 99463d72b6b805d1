//! Register tiles: `C += Σ_k A[·, k] B[k, ·]`, with both operands read in place through a table of offsets.
//!
//! Convolutions and large matrix products compute their outputs in such tiles. The loops over tiles are ordinary code: only
//! the tile, and the copies that feed it, are compiled per instruction set and reached through [`Kernel`].

pub mod rows;

use crate::simd::{self, Lane, Level, Plain};
use rows::{Dots, Line, Rows};

/// Initial values of a tile's sums.
#[derive(Clone, Copy)]
pub enum Start {
    Zero,
    /// The present content of `c`.
    Accumulate,
    /// One value per row.
    Bias(*const f32),
}

/// Operands of one tile: `c[r, j] = start + Σ_k a[r · row + offsets[k].0] · b[offsets[k].1 + j]`.
pub struct Tile<'a> {
    pub a: *const f32,
    /// Floats between rows of A.
    pub row: usize,
    pub b: *const f32,
    /// Offsets of A and B per term of the sum.
    pub offsets: &'a [(u32, u32)],
    pub c: *mut f32,
    pub c_row: usize,
    pub c_vector: usize,
    pub start: Start,
    /// Memory to prefetch meanwhile.
    pub ahead: Ahead,
    /// If set, rows come in pairs whose floats are written in turns: those of vector `q` of rows `2 r` and `2 r + 1` to
    /// `c[r · c_row + pairs[q]..]`. Such sums do not start from those in `c`.
    pub pairs: Option<&'a [usize; MOST_VECTORS]>,
}

/// Pieces of memory to prefetch, each as wide as a tile: one piece per eight terms of a sum, which matches the speed of memory.
#[derive(Clone, Copy)]
pub struct Ahead {
    pub from: *const f32,
    /// Pieces up to the end of the row of the first.
    pub left: usize,
    /// Pieces of a row.
    pub pieces: usize,
    /// Floats from one piece of a row to the next.
    pub step: usize,
    /// Floats from the last piece of a row to the first of the next.
    pub turn: usize,
}

impl Ahead {
    /// No prefetch: names only memory that is already in cache.
    pub fn none(cached: *const f32) -> Ahead {
        Ahead::rows(cached, 0)
    }

    /// One piece per row, `step` floats apart.
    pub fn rows(from: *const f32, step: usize) -> Ahead {
        Ahead { from, left: 1, pieces: 1, step, turn: step }
    }

    /// Pieces that a tile prefetches if its sums have `terms` terms.
    pub fn pieces(terms: usize) -> usize {
        terms.div_ceil(TERMS_PER_FETCH)
    }
}

/// Terms of a sum per prefetched piece.
const TERMS_PER_FETCH: usize = 8;

/// A run of pixels that is contiguous in the input, in a tile and in the output.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Segment {
    pub from: usize,
    /// Offset in the tile.
    pub at: usize,
    pub len: usize,
    /// Offset in the output, for the first channel.
    pub to: usize,
}

/// Copies of pixels into a panel `[offsets.len(), width]`.
pub struct Pack<'a> {
    pub from: *const f32,
    pub offsets: &'a [(u32, u32)],
    pub segments: &'a [Segment],
    pub panel: *mut f32,
    pub width: usize,
    /// Whether reads must not exceed a segment; else whole vectors are read, even beyond its end.
    pub exact: bool,
}

type TileFn = unsafe fn(&Tile);

/// Most rows, and most vectors per row, of a tile at any level.
pub const MOST_ROWS: usize = 8;
pub const MOST_VECTORS: usize = 3;

/// Floats of a panel.
const PANEL: usize = 9 << 10;
/// Most terms of a pass.
const MOST_TERMS: usize = 288;

/// The tiles of one instruction set.
pub struct Kernel {
    /// Floats per vector.
    pub lanes: usize,
    /// Rows of the largest tile.
    pub rows: usize,
    /// Vectors per row of the largest tile.
    pub vectors: usize,
    tiles: [[TileFn; MOST_VECTORS]; MOST_ROWS],
    pack: unsafe fn(&Pack),
    rows_of: unsafe fn(&Rows),
    line: unsafe fn(&Line),
    dots: unsafe fn(&Dots),
}

impl Kernel {
    /// Floats per row of the largest tile.
    pub fn width(&self) -> usize {
        self.lanes * self.vectors
    }

    /// Terms of a sum per pass, so that their panel stays in the L1 cache beside the streamed operands.
    pub fn terms(&self) -> usize {
        (PANEL / self.width()).min(MOST_TERMS)
    }

    /// Computes a tile of `rows` by `vectors`.
    ///
    /// # Safety
    /// All memory that the operands address must exist; `rows` and `vectors` are at least 1 and at most the kernel's.
    pub unsafe fn run(&self, rows: usize, vectors: usize, tile: &Tile) {
        // SAFETY: guaranteed by the caller.
        unsafe { self.tiles[rows - 1][vectors - 1](tile) }
    }

    /// Copies pixels into a panel, row by row.
    ///
    /// # Safety
    /// All memory that the segments address must exist, plus a vector unless `exact`; the panel has room for an extra vector.
    pub unsafe fn pack(&self, pack: &Pack) {
        // SAFETY: guaranteed by the caller.
        unsafe { (self.pack)(pack) }
    }

    /// Computes rows of a depthwise convolution.
    ///
    /// # Safety
    /// Inputs and outputs exist up to the next multiple of four vectors in each row.
    pub unsafe fn depthwise(&self, rows: &Rows) {
        // SAFETY: guaranteed by the caller.
        unsafe { (self.rows_of)(rows) }
    }

    /// Computes a line of a depthwise convolution.
    ///
    /// # Safety
    /// The inputs of all columns exist at every tap, with `step` 2 one float beyond the last; the outputs of all columns exist.
    pub unsafe fn line(&self, line: &Line) {
        assert!(line.columns >= self.lanes && matches!(line.step, 1 | 2), "a line of {} columns", line.columns);
        // SAFETY: guaranteed by the caller.
        unsafe { (self.line)(line) }
    }

    /// Adds the products of rows to the sums of each tap.
    ///
    /// # Safety
    /// All that the operands address must exist.
    pub unsafe fn dots(&self, dots: &Dots) {
        assert!(dots.offsets.len() <= rows::MOST_DOTS && dots.columns.is_multiple_of(self.lanes), "dots: {} taps", dots.offsets.len());
        // SAFETY: guaranteed by the caller.
        unsafe { (self.dots)(dots) }
    }
}

/// Repeats a statement for `i` from 0 to below `n`, at most 8, with `i` a constant: sums in an array that only constants index stay in
/// registers, whereas an array in a loop may be written to the stack at every term.
macro_rules! unrolled {
    ($i:ident < $n:expr, $body:expr) => {
        unrolled!($i < $n, $body, [0 1 2 3 4 5 6 7])
    };
    ($i:ident < $n:expr, $body:expr, [$($value:literal)*]) => {{
        $(if $value < $n {
            let $i: usize = $value;
            $body
        })*
    }};
}

#[inline(always)]
unsafe fn tile<L: Lane, const MR: usize, const NR: usize>(t: &Tile) {
    // SAFETY: `Kernel::run` states what must exist.
    unsafe {
        let mut acc = [[L::splat(0.0); NR]; MR];
        match t.start {
            Start::Zero => {}
            Start::Accumulate => {
                for r in 0..MR {
                    simd::fetch_now(t.c.add(r * t.c_row), NR * t.c_vector);
                }
            }
            Start::Bias(bias) => unrolled!(r < MR, *acc.get_unchecked_mut(r) = [L::splat(*bias.add(r)); NR]),
        }
        let (mut ahead, mut left, factors) = (t.ahead.from, t.ahead.left, (t.a, t.row, t.b));
        for block in t.offsets.chunks(TERMS_PER_FETCH) {
            simd::fetch_later(ahead, NR * L::N);
            left -= 1;
            let step = if left == 0 { t.ahead.turn } else { t.ahead.step };
            left = if left == 0 { t.ahead.pieces } else { left };
            ahead = ahead.wrapping_add(step);
            // Unrolled, because scalar instructions compete for ports with the multiply-adds.
            let mut fours = block.chunks_exact(4);
            for four in &mut fours {
                add::<L, MR, NR>(factors, four[0], &mut acc);
                add::<L, MR, NR>(factors, four[1], &mut acc);
                add::<L, MR, NR>(factors, four[2], &mut acc);
                add::<L, MR, NR>(factors, four[3], &mut acc);
            }
            for &one in fours.remainder() {
                add::<L, MR, NR>(factors, one, &mut acc);
            }
        }
        if let Some(pairs) = t.pairs {
            unrolled!(
                r < MR / 2,
                unrolled!(q < NR, {
                    let [even, odd] = [2 * r, 2 * r + 1].map(|r| *acc.get_unchecked(r).get_unchecked(q));
                    L::store_pairs(t.c.add(r * t.c_row + pairs.get_unchecked(q)), even, odd);
                })
            );
            return;
        }
        let (one, accumulate) = (L::splat(1.0), matches!(t.start, Start::Accumulate));
        unrolled!(
            r < MR,
            unrolled!(q < NR, {
                let (c, v) = (t.c.add(r * t.c_row + q * t.c_vector), *acc.get_unchecked(r).get_unchecked(q));
                L::store(c, if accumulate { L::fma(v, one, L::load(c)) } else { v });
            })
        );
    }
}

/// Adds one term of the sum.
#[inline(always)]
unsafe fn add<L: Lane, const MR: usize, const NR: usize>(
    (a, row, b): (*const f32, usize, *const f32),
    at: (u32, u32),
    acc: &mut [[L::V; NR]; MR],
) {
    // SAFETY: `Kernel::run` states what must exist.
    unsafe {
        let (ap, bp) = (a.add(at.0 as usize), b.add(at.1 as usize));
        let mut bv = [L::splat(0.0); NR];
        unrolled!(q < NR, *bv.get_unchecked_mut(q) = L::load(bp.add(q * L::N)));
        unrolled!(r < MR, {
            let av = L::splat(*ap.add(r * row));
            unrolled!(q < NR, {
                let sum = acc.get_unchecked_mut(r).get_unchecked_mut(q);
                // The factors of several terms at once would not fit into registers beside the sums.
                *sum = L::settle(L::fma(av, *bv.get_unchecked(q), *sum));
            })
        });
    }
}

#[inline(always)]
unsafe fn pack<L: Lane>(p: &Pack) {
    // SAFETY: `Kernel::pack` states what must exist.
    unsafe {
        let mut panel = p.panel;
        for &(_, offset) in p.offsets {
            let from = p.from.add(offset as usize);
            for s in p.segments {
                let (from, to) = (from.add(s.from), panel.add(s.at));
                let mut i = 0;
                while i + L::N <= s.len {
                    L::store(to.add(i), L::load(from.add(i)));
                    i += L::N;
                }
                if p.exact {
                    while i < s.len {
                        *to.add(i) = *from.add(i);
                        i += 1;
                    }
                } else if i < s.len {
                    // The next segment or row overwrites the surplus.
                    L::store(to.add(i), L::load(from.add(i)));
                }
            }
            panel = panel.add(p.width);
        }
    }
}

macro_rules! kernel {
    ($name:ident, $lane:ty, $rows:literal, $vectors:literal, [$($m:literal)*], $(#[$target:meta])*) => {
        mod $name {
            use super::*;

            $(#[$target])*
            unsafe fn of<const MR: usize, const NR: usize>(t: &Tile) {
                // SAFETY: compiled for the set; the rest as `Kernel::run` states.
                unsafe { tile::<$lane, MR, NR>(t) }
            }

            $(#[$target])*
            unsafe fn copy(p: &Pack) {
                // SAFETY: compiled for the set; the rest as `Kernel::pack` states.
                unsafe { pack::<$lane>(p) }
            }

            $(#[$target])*
            unsafe fn depthwise(r: &Rows) {
                // SAFETY: compiled for the set; the rest as `Kernel::depthwise` states.
                unsafe { rows::rows_of::<$lane>(r) }
            }

            $(#[$target])*
            unsafe fn part(l: &Line) {
                // SAFETY: compiled for the set; the rest as `Kernel::line` states.
                unsafe { if l.step == 1 { rows::line::<$lane, 1>(l) } else { rows::line::<$lane, 2>(l) } }
            }

            $(#[$target])*
            unsafe fn products(d: &Dots) {
                // SAFETY: compiled for the set; the rest as `Kernel::dots` states.
                unsafe { rows::dots::<$lane>(d) }
            }

            pub static KERNEL: Kernel = Kernel {
                lanes: <$lane as Lane>::N,
                rows: $rows,
                vectors: $vectors,
                tiles: [$([of::<$m, 1>, of::<$m, 2>, of::<$m, 3>]),*],
                pack: copy,
                rows_of: depthwise,
                line: part,
                dots: products,
            };
        }
    };
}

#[cfg(target_arch = "x86_64")]
kernel!(avx512, simd::Avx512, 8, 3, [1 2 3 4 5 6 7 8], #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")]);
#[cfg(target_arch = "x86_64")]
kernel!(avx2, simd::Avx2, 4, 3, [1 2 3 4 4 4 4 4], #[target_feature(enable = "avx2,fma")]);
#[cfg(target_arch = "aarch64")]
kernel!(neon, simd::Neon, 8, 3, [1 2 3 4 5 6 7 8],);
kernel!(portable, Plain, 4, 1, [1 2 3 4 4 4 4 4],);

/// The kernel of an instruction set level.
pub fn kernel(level: Level) -> &'static Kernel {
    match level {
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => &avx512::KERNEL,
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => &avx2::KERNEL,
        #[cfg(target_arch = "aarch64")]
        Level::Neon => &neon::KERNEL,
        _ => &portable::KERNEL,
    }
}

/// A pointer that threads share; each thread writes only its own part.
#[derive(Clone, Copy)]
pub struct Shared(pub *mut f32);

// SAFETY: users keep the parts of different threads disjoint.
unsafe impl Send for Shared {}
// SAFETY: as above.
unsafe impl Sync for Shared {}

impl Shared {
    /// The pointer advanced by `offset` floats.
    ///
    /// # Safety
    /// The result lies inside the slice that the pointer was made from.
    pub unsafe fn at(&self, offset: usize) -> *mut f32 {
        // SAFETY: guaranteed by the caller.
        unsafe { self.0.add(offset) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_testkit::{assert_close, random};

    #[test]
    fn every_tile_of_every_level_matches_plain_loops() {
        for level in Level::available() {
            let kernel = kernel(level);
            for rows in 1..=kernel.rows {
                for vectors in 1..=kernel.vectors {
                    matches_plain_loops(kernel, rows, vectors);
                }
            }
        }
    }

    fn matches_plain_loops(kernel: &Kernel, rows: usize, vectors: usize) {
        let (terms, n) = (21, vectors * kernel.lanes);
        let (a, b, bias) = (random(rows * terms, 1), random(terms * n, 2), random(rows, 3));
        let offsets: Vec<(u32, u32)> = (0..terms).rev().map(|k| (k as u32, (k * n) as u32)).collect();
        for start in [Start::Zero, Start::Accumulate, Start::Bias(bias.as_ptr())] {
            let mut c = vec![3.0; rows * n];
            let want: Vec<f64> = (0..rows * n)
                .map(|e| {
                    let (r, j) = (e / n, e % n);
                    let before = match start {
                        Start::Zero => 0.0,
                        Start::Accumulate => 3.0,
                        Start::Bias(_) => bias[r] as f64,
                    };
                    before + (0..terms).map(|k| a[r * terms + k] as f64 * b[k * n + j] as f64).sum::<f64>()
                })
                .collect();
            let (lanes, c_row) = (kernel.lanes, n);
            let t = Tile {
                a: a.as_ptr(),
                row: terms,
                b: b.as_ptr(),
                offsets: &offsets,
                c: c.as_mut_ptr(),
                c_row,
                c_vector: lanes,
                start,
                ahead: Ahead::none(b.as_ptr()),
                pairs: None,
            };
            // SAFETY: all operands have the tile's size.
            unsafe { kernel.run(rows, vectors, &t) };
            assert_close("tile", &c, &want, 1e-5);
        }
    }

    #[test]
    fn panels_hold_segments_one_after_the_other() {
        for level in Level::available() {
            for exact in [false, true] {
                let kernel = kernel(level);
                let from: Vec<f32> = (0..200).map(|i| i as f32).collect();
                let segments = [Segment { from: 3, at: 0, len: 5, to: 0 }, Segment { from: 40, at: 5, len: 20, to: 0 }];
                let mut panel = vec![-1.0; 2 * 25 + kernel.lanes];
                let pack = Pack {
                    from: from.as_ptr(),
                    offsets: &[(0, 0), (9, 100)],
                    segments: &segments,
                    panel: panel.as_mut_ptr(),
                    width: 25,
                    exact,
                };
                // SAFETY: the source and the panel extend by more than a vector after each segment.
                unsafe { kernel.pack(&pack) };
                for k in 0..2 {
                    for i in 0..25 {
                        let want = k * 100 + if i < 5 { 3 + i } else { 35 + i };
                        assert_eq!(panel[k * 25 + i], want as f32, "{k} {i}");
                    }
                }
            }
        }
    }
}
