//! Blocks of rows times panels of columns, which are copied to stay in the first-level cache.

use super::Matmul;
use crate::ops::conv2d::bands::{Scratch, aligned, with_scratch};
use crate::ops::conv2d::weights::interleave;
use crate::simd;
use crate::tile::{Kernel, Pack, Segment, Shared, Start, Tile, kernel};
use rayon::prelude::*;
use std::ops::Range;

/// Terms of a sum per pass.
const TERMS: usize = 288;
/// Most rows of a task, whose part of A stays in the second-level cache.
const ROWS: usize = 384;
/// Fewest rows of a task, which share the copy of a panel.
const FEWEST_ROWS: usize = 96;

/// One product of a batch, as all threads see it.
struct Job<'a> {
    s: Matmul,
    kernel: &'static Kernel,
    a: &'a [f32],
    b: &'a [f32],
    c: Shared,
}

/// `c = a b`, or `c += a b` where the description says so.
///
/// # Shapes
/// As [`Matmul`] says. Sums run over `k` in blocks of fixed size, so results do not depend on the number of threads.
pub fn matmul(s: &Matmul, a: &[f32], b: &[f32], c: &mut [f32]) {
    assert_eq!(a.len(), s.batch * s.m * s.k, "matmul: a");
    assert_eq!(b.len(), s.batch * s.k * s.n, "matmul: b");
    assert_eq!(c.len(), s.batch * s.m * s.n, "matmul: c");
    if c.is_empty() {
        return;
    }
    if s.k == 0 {
        if !s.accumulate {
            c.fill(0.0);
        }
        return;
    }
    let level = simd::level();
    let kernel = kernel(level);
    let (rows, columns) = divide(s, kernel);
    let (down, across) = (s.m.div_ceil(rows), s.n.div_ceil(columns));
    let job = Job { s: *s, kernel, a, b, c: Shared(c.as_mut_ptr()) };
    (0..s.batch * down * across).into_par_iter().for_each(|i| {
        let (row, column) = (i / across % down * rows, i % across * columns);
        let part = (row..(row + rows).min(s.m), column..(column + columns).min(s.n));
        simd::with_level(level, || with_scratch(|scratch| job.compute(i / across / down, part, scratch)));
    });
}

/// Rows and columns per task.
fn divide(s: &Matmul, kernel: &Kernel) -> (usize, usize) {
    let wanted = (4 * rayon::current_num_threads()).div_ceil(s.batch);
    let rows = s.m.div_ceil(wanted).clamp(FEWEST_ROWS, ROWS).next_multiple_of(kernel.rows);
    let across = wanted.div_ceil(s.m.div_ceil(rows)).min(s.n.div_ceil(kernel.width()));
    (rows, s.n.div_ceil(across).next_multiple_of(kernel.width()))
}

impl Job<'_> {
    fn compute(&self, batch: usize, (rows, columns): (Range<usize>, Range<usize>), scratch: &mut Scratch) {
        let (s, width) = (&self.s, self.kernel.width());
        let a = &self.a[batch * s.m * s.k..][..s.m * s.k];
        let b = &self.b[batch * s.k * s.n..][..s.k * s.n];
        let (row, term) = if s.a_transposed { (1, s.m) } else { (s.k, 1) };
        let Scratch { panel, sums, offsets, .. } = scratch;
        let panel = aligned(panel, (TERMS + 1) * width);
        let edge = aligned(sums, self.kernel.rows * width);
        assert!(u32::try_from(TERMS * term).is_ok(), "matmul: {} rows of a transposed matrix", s.m);
        offsets.clear();
        offsets.extend((0..TERMS.min(s.k)).map(|p| ((p * term) as u32, (p * width) as u32)));
        for p in (0..s.k).step_by(TERMS) {
            let terms = TERMS.min(s.k - p);
            for j in columns.clone().step_by(width) {
                let count = width.min(columns.end - j);
                self.pack(b, p..p + terms, j..j + count, panel);
                for i in rows.clone().step_by(self.kernel.rows) {
                    let height = self.kernel.rows.min(rows.end - i);
                    let to = (batch * s.m + i) * s.n + j;
                    let tile = Tile {
                        a: a[i * row + p * term..].as_ptr(),
                        row,
                        b: panel.as_ptr(),
                        offsets: &offsets[..terms],
                        c: edge.as_mut_ptr(),
                        c_row: width,
                        c_vector: self.kernel.lanes,
                        start: Start::Zero,
                    };
                    let add = p > 0 || s.accumulate;
                    let vectors = count.div_ceil(self.kernel.lanes);
                    // SAFETY: rows and terms of A exist from there; the panel has all terms; C's columns are this task's own.
                    unsafe {
                        if count.is_multiple_of(self.kernel.lanes) {
                            let start = if add { Start::Accumulate } else { Start::Zero };
                            self.kernel.run(height, vectors, &Tile { c: self.c.at(to), c_row: s.n, start, ..tile });
                        } else {
                            self.kernel.run(height, vectors, &tile);
                            self.store(&edge[..height * width], count, to, add);
                        }
                    }
                }
            }
        }
    }

    /// Copies some columns of some terms of B, row after row of the panel.
    fn pack(&self, b: &[f32], terms: Range<usize>, columns: Range<usize>, panel: &mut [f32]) {
        let (s, width) = (&self.s, self.kernel.width());
        if s.b_transposed {
            let from = &b[columns.start * s.k + terms.start..];
            return interleave(from, s.k, columns.len(), width, &mut panel[..terms.len() * width]);
        }
        let segment = [Segment { from: columns.start, at: 0, len: columns.len(), to: 0 }];
        for (p, to) in terms.zip(panel.chunks_exact_mut(width)) {
            let pack =
                Pack { from: b[p * s.n..].as_ptr(), offsets: &[(0, 0)], segments: &segment, panel: to.as_mut_ptr(), width, exact: true };
            // SAFETY: the columns of row p exist, and no more is read.
            unsafe { self.kernel.pack(&pack) };
        }
    }

    /// Writes the first `count` columns of a tile.
    unsafe fn store(&self, tile: &[f32], count: usize, to: usize, add: bool) {
        for (r, row) in tile.chunks_exact(self.kernel.width()).enumerate() {
            // SAFETY: the caller vouches for the rows of C.
            let out = unsafe { std::slice::from_raw_parts_mut(self.c.at(to + r * self.s.n), count) };
            for (o, v) in out.iter_mut().zip(row) {
                *o = if add { *o + v } else { *v };
            }
        }
    }
}
