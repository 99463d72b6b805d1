//! Matrix products on the CPU: blocks of rows of A times panels of columns of B, copied to stay in the L1 cache.

use super::Matmul;
use crate::gemm::{Gemm, Init, Precision, View, has_bf16};
use crate::ops::conv2d::bands::{Scratch, aligned, with_scratch};
use crate::ops::conv2d::weights::interleave;
use crate::simd;
use crate::tile::{Ahead, Kernel, MOST_VECTORS, Shared, Start, Tile, kernel};
use crate::vector::{by_lanes, vectorized};
use rayon::prelude::*;
use std::cell::Cell;
use std::ops::Range;

/// Most rows of a task, so that its part of A stays in the L2 cache.
const ROWS: usize = 384;
/// Fewest rows of a task, because they share the cost of copying a panel.
const FEWEST_ROWS: usize = 96;
/// Fewest rows over which B is read from the caches; with fewer, the speed of memory matters.
const MANY_ROWS: usize = 128;
/// Panels of B that are then copied side by side, because memory is faster at reading longer rows.
const PANELS: usize = 2;
/// Terms of a sum per pass in bf16.
const ROUNDED_TERMS: usize = 256;
/// Most groups that a long sum over few outputs is split into, and fewest terms per group.
const GROUPS: usize = 16;
const GROUP_TERMS: usize = 2048;
/// Most outputs of a product whose sums are split: each group has its own copy.
const GROUP_OUTPUTS: usize = 1 << 19;

/// Function that turns finished sums into outputs in place, given (row, first column, sums).
pub type Finish<'a> = &'a (dyn Fn(usize, usize, &mut [f32]) + Sync);

/// A batch of products in progress, shared by all threads.
struct Job<'a> {
    s: Matmul,
    kernel: &'static Kernel,
    a: &'a [f32],
    b: &'a [f32],
    finish: Option<Finish<'a>>,
}

/// Part of the outputs that one task computes, and its destination.
struct Part {
    batch: usize,
    rows: Range<usize>,
    columns: Range<usize>,
    terms: Range<usize>,
    c: Shared,
    accumulate: bool,
}

/// `c = a b`, or `c += a b` with [`Matmul::accumulate`]. Results do not depend on the number of threads.
///
/// # Shapes
/// As in [`Matmul`].
pub fn matmul(s: &Matmul, a: &[f32], b: &[f32], c: &mut [f32]) {
    matmul_with(s, a, b, c, None);
}

/// As [`matmul`], then applies `finish`, such as a bias or an activation, while the outputs are in cache.
pub fn matmul_with(s: &Matmul, a: &[f32], b: &[f32], c: &mut [f32], finish: Option<Finish>) {
    let Some(job) = Job::new(s, a, b, c, finish) else { return };
    let groups = groups(s);
    if groups > 1 {
        return job.in_groups(groups, c);
    }
    let level = simd::level();
    let (rows, columns) = divide(s, job.kernel);
    let (down, across) = (s.m.div_ceil(rows), s.n.div_ceil(columns));
    let c = Shared(c.as_mut_ptr());
    (0..s.batch * down * across).into_par_iter().for_each(|i| {
        let (row, column) = (i / across % down * rows, i % across * columns);
        let part = Part {
            batch: i / across / down,
            rows: row..(row + rows).min(s.m),
            columns: column..(column + columns).min(s.n),
            terms: 0..s.k,
            c,
            accumulate: s.accumulate,
        };
        simd::with_level(level, || with_scratch(|scratch| job.compute(&part, scratch)));
    });
}

/// As [`matmul`], on the current thread only, for tasks of a larger parallel problem.
pub(crate) fn matmul_here(s: &Matmul, a: &[f32], b: &[f32], c: &mut [f32]) {
    let Some(job) = Job::new(s, a, b, c, None) else { return };
    let c = Shared(c.as_mut_ptr());
    with_scratch(|scratch| {
        for (batch, row) in (0..s.batch).flat_map(|b| (0..s.m).step_by(ROWS).map(move |r| (b, r))) {
            let rows = row..(row + ROWS).min(s.m);
            job.compute(&Part { batch, rows, columns: 0..s.n, terms: 0..s.k, c, accumulate: s.accumulate }, scratch);
        }
    });
}

/// Rows and columns per task.
fn divide(s: &Matmul, kernel: &Kernel) -> (usize, usize) {
    let wanted = (4 * rayon::current_num_threads()).div_ceil(s.batch);
    let rows = s.m.div_ceil(wanted).clamp(FEWEST_ROWS, ROWS).next_multiple_of(kernel.rows);
    let across = wanted.div_ceil(s.m.div_ceil(rows)).min(s.n.div_ceil(kernel.width()));
    (rows, s.n.div_ceil(across).next_multiple_of(kernel.width()))
}

/// Number of groups that sums are split into: more than one only with few outputs and many terms.
fn groups(s: &Matmul) -> usize {
    if s.batch == 1 && s.m * s.n <= GROUP_OUTPUTS { (s.k / GROUP_TERMS).clamp(1, GROUPS) } else { 1 }
}

thread_local! {
    static PARTIAL: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
}

vectorized! {
    fn add<const F>(sums: &mut [f32], values: &[f32]) {
        sums.iter_mut().zip(values).for_each(|(s, v)| *s += v);
    }
}

impl<'a> Job<'a> {
    /// Returns none if there is nothing to multiply; then the outputs of empty sums are already written.
    fn new(s: &Matmul, a: &'a [f32], b: &'a [f32], c: &mut [f32], finish: Option<Finish<'a>>) -> Option<Job<'a>> {
        assert_eq!(a.len(), s.batch * s.m * s.k, "matmul: a");
        assert_eq!(b.len(), s.batch * s.k * s.n, "matmul: b");
        assert_eq!(c.len(), s.batch * s.m * s.n, "matmul: c");
        if c.is_empty() {
            return None;
        }
        if s.k == 0 {
            if !s.accumulate {
                c.fill(0.0);
            }
            if let Some(finish) = finish {
                c.chunks_exact_mut(s.n).enumerate().for_each(|(i, row)| finish(i % s.m, 0, row));
            }
            return None;
        }
        Some(Job { s: *s, kernel: kernel(simd::level()), a, b, finish })
    }

    /// Computes groups of the terms in parallel and adds their sums in order.
    fn in_groups(&self, groups: usize, c: &mut [f32]) {
        let (s, level) = (&self.s, simd::level());
        let per = s.k.div_ceil(groups);
        let mut partial = PARTIAL.take();
        partial.resize((groups - 1) * c.len(), 0.0);
        let (first, others, size) = (Shared(c.as_mut_ptr()), Shared(partial.as_mut_ptr()), c.len());
        let sums = Job { finish: None, ..*self };
        let down = s.m.div_ceil(ROWS);
        (0..groups * down).into_par_iter().for_each(|i| {
            let (group, row) = (i / down, i % down * ROWS);
            // SAFETY: every group except the first has its own part of the partial sums.
            let c = if group == 0 { first } else { Shared(unsafe { others.at((group - 1) * size) }) };
            let part = Part {
                batch: 0,
                rows: row..(row + ROWS).min(s.m),
                columns: 0..s.n,
                terms: (group * per).min(s.k)..((group + 1) * per).min(s.k),
                c,
                accumulate: group == 0 && s.accumulate,
            };
            simd::with_level(level, || with_scratch(|scratch| sums.compute(&part, scratch)));
        });
        c.par_chunks_mut(s.n).enumerate().for_each(|(row, c)| {
            simd::with_level(level, || {
                partial.chunks_exact(size).for_each(|p| add(c, &p[row * s.n..][..s.n]));
                if let Some(finish) = self.finish {
                    finish(row, 0, c);
                }
            });
        });
        PARTIAL.set(partial);
    }

    fn compute(&self, part: &Part, scratch: &mut Scratch) {
        if self.s.precision == Precision::Bf16 && has_bf16() {
            return self.compute_rounded(part, scratch);
        }
        let (s, width, height) = (&self.s, self.kernel.width(), self.kernel.rows);
        let a = &self.a[part.batch * s.m * s.k..][..s.m * s.k];
        let b = &self.b[part.batch * s.k * s.n..][..s.k * s.n];
        let few = s.m < MANY_ROWS;
        let most = (self.kernel.terms() / if few { PANELS } else { 1 }).min(part.terms.len());
        let Scratch { planes, panel, sums, offsets, .. } = scratch;
        let across = width * if few && !s.b_transposed { PANELS } else { 1 };
        let panels = aligned(panel, most * across + width);
        let edge = aligned(sums, height * width);
        let rows = aligned(planes, if s.a_transposed { part.rows.len().next_multiple_of(height) * most } else { 0 });
        let (row, term) = if s.a_transposed { (1, height as u32) } else { (s.k, 1) };
        offsets.clear();
        offsets.extend((0..most as u32).map(|p| (p * term, p * width as u32)));
        for p in part.terms.clone().step_by(most.max(1)) {
            let terms = p..(p + most).min(part.terms.end);
            if s.a_transposed {
                self.pack_rows(a, part.rows.clone(), terms.clone(), rows);
            }
            let add = p > part.terms.start || part.accumulate;
            let finish = self.finish.filter(|_| terms.end == part.terms.end);
            for first in part.columns.clone().step_by(across) {
                let columns = first..(first + across).min(part.columns.end);
                self.pack(b, terms.clone(), columns.clone(), panels);
                let mut ahead = self.after(part, &terms, &columns);
                for (j, panel) in columns.clone().step_by(width).zip(panels.chunks(terms.len() * width)) {
                    let count = width.min(columns.end - j);
                    for i in part.rows.clone().step_by(height) {
                        let tall = height.min(part.rows.end - i);
                        let a = if s.a_transposed { &rows[(i - part.rows.start) * terms.len()..] } else { &a[i * s.k + terms.start..] };
                        let to = (part.batch * s.m + i) * s.n + j;
                        let tile = Tile {
                            a: a.as_ptr(),
                            row,
                            b: panel.as_ptr(),
                            offsets: &offsets[..terms.len()],
                            c: edge.as_mut_ptr(),
                            c_row: width,
                            c_vector: self.kernel.lanes,
                            start: Start::Zero,
                            ahead: ahead.take(panel.as_ptr()),
                            pairs: None,
                        };
                        let vectors = count.div_ceil(self.kernel.lanes);
                        // SAFETY: the blocks of A and the panel hold all terms; C's columns are this task's own.
                        unsafe {
                            if count.is_multiple_of(self.kernel.lanes) {
                                let start = if add { Start::Accumulate } else { Start::Zero };
                                self.kernel.run(tall, vectors, &Tile { c: part.c.at(to), c_row: s.n, start, ..tile });
                            } else {
                                self.kernel.run(tall, vectors, &tile);
                                store(&edge[..tall * width], width, count, part.c.at(to), s.n, add);
                            }
                            if let Some(finish) = finish {
                                for r in 0..tall {
                                    finish(i + r, j, std::slice::from_raw_parts_mut(part.c.at(to + r * s.n), count));
                                }
                            }
                        }
                    }
                }
            }
        }
    }

    /// Part of B that will be copied after some columns and terms, for prefetching.
    fn after(&self, part: &Part, terms: &Range<usize>, columns: &Range<usize>) -> Coming {
        let (s, width) = (&self.s, self.kernel.width());
        let more = columns.end < part.columns.end;
        let (term, column) = if more { (terms.start, columns.end) } else { (terms.end, part.columns.start) };
        let end = (term + terms.len()).min(part.terms.end);
        let across = columns.len().min(part.columns.end - column);
        let pieces = across.div_ceil(width);
        Coming {
            from: self.b[part.batch * s.k * s.n..].as_ptr().wrapping_add(term * s.n + column),
            left: if s.b_transposed { 0 } else { end.saturating_sub(term) * pieces },
            pieces,
            piece: 0,
            width,
            stride: s.n,
            rows: Ahead::pieces(terms.len()) / pieces.max(1),
            rest: Ahead::pieces(terms.len()) % pieces.max(1),
        }
    }

    /// As [`Self::compute`], with factors rounded to bf16.
    fn compute_rounded(&self, part: &Part, scratch: &mut Scratch) {
        let (s, width) = (&self.s, self.kernel.width());
        let a = &self.a[part.batch * s.m * s.k..][..s.m * s.k];
        let b = &self.b[part.batch * s.k * s.n..][..s.k * s.n];
        let Scratch { panel, rounded, .. } = scratch;
        for p in part.terms.clone().step_by(ROUNDED_TERMS) {
            let terms = p..(p + ROUNDED_TERMS).min(part.terms.end);
            let (first, m, k) = (part.rows.start, part.rows.len(), terms.len());
            let a = if s.a_transposed {
                View { data: &a[terms.start * s.m + first..], row: 1, col: s.m }
            } else {
                View { data: &a[first * s.k + terms.start..], row: s.k, col: 1 }
            };
            let init = if p > part.terms.start || part.accumulate { Init::Accumulate } else { Init::Zero };
            let g = Gemm { m, n: 0, k, a, b: &[], ldb: width, ldc: s.n, init, relu: false };
            rounded.pack(&g);
            let panel = aligned(panel, k * width);
            for j in part.columns.clone().step_by(width) {
                let n = width.min(part.columns.end - j);
                let g = if s.b_transposed {
                    self.pack(b, terms.clone(), j..j + n, panel);
                    Gemm { n, b: panel, ..g }
                } else {
                    Gemm { n, b: &b[terms.start * s.n + j..], ldb: s.n, ..g }
                };
                let to = (part.batch * s.m + first) * s.n + j;
                // SAFETY: A is packed; C's columns are this task's own.
                unsafe {
                    rounded.multiply(&g, part.c.at(to));
                    if let Some(finish) = self.finish.filter(|_| terms.end == part.terms.end) {
                        for r in 0..m {
                            finish(first + r, j, std::slice::from_raw_parts_mut(part.c.at(to + r * s.n), n));
                        }
                    }
                }
            }
        }
    }

    /// Copies some terms of some rows of a transposed A into blocks of a tile's rows, `[terms, rows]` each.
    fn pack_rows(&self, a: &[f32], rows: Range<usize>, terms: Range<usize>, out: &mut [f32]) {
        let (s, height) = (&self.s, self.kernel.rows);
        for (i, block) in rows.clone().step_by(height).zip(out.chunks_exact_mut(height * terms.len())) {
            let tall = height.min(rows.end - i);
            for (p, to) in terms.clone().zip(block.chunks_exact_mut(height)) {
                to[..tall].copy_from_slice(&a[p * s.m + i..][..tall]);
            }
        }
    }

    /// Copies some columns and terms of B into panels of `[terms, width]`.
    fn pack(&self, b: &[f32], terms: Range<usize>, columns: Range<usize>, panel: &mut [f32]) {
        let (s, width) = (&self.s, self.kernel.width());
        if s.b_transposed {
            let from = &b[columns.start * s.k + terms.start..];
            return interleave(from, s.k, columns.len(), width, &mut panel[..terms.len() * width]);
        }
        let from = &b[terms.start * s.n + columns.start..];
        let pieces = if self.kernel.vectors == MOST_VECTORS { columns.len() / width } else { 0 };
        // SAFETY: B has the rows and columns, and the panels their room.
        unsafe { copy_panels(from.as_ptr(), s.n, pieces, terms.len(), panel.as_mut_ptr()) };
        for j in (pieces * width..columns.len()).step_by(width) {
            let count = width.min(columns.len() - j);
            for (p, to) in panel[j * terms.len()..].chunks_exact_mut(width).take(terms.len()).enumerate() {
                to[..count].copy_from_slice(&from[p * s.n + j..][..count]);
            }
        }
    }
}

/// Prefetch distance of a copy, in rows.
const AHEAD: usize = 12;

by_lanes! {
    /// Copies `pieces` full panels of `[terms, 3 vectors]` from rows that are `stride` floats apart.
    unsafe fn copy_panels<L>(from: *const f32, stride: usize, pieces: usize, terms: usize, out: *mut f32) {
        let width = MOST_VECTORS * L::N;
        for p in 0..terms {
            let from = from.add(p * stride);
            simd::fetch_now(from.wrapping_add(AHEAD * stride), pieces * width);
            for j in 0..pieces {
                let (from, to) = (from.add(j * width), out.add((j * terms + p) * width));
                for q in 0..MOST_VECTORS {
                    L::store(to.add(q * L::N), L::load(from.add(q * L::N)));
                }
            }
        }
    }
}

/// What is left of a part of B to prefetch, in pieces of a tile's width.
struct Coming {
    from: *const f32,
    /// Pieces of a row, and where in it the next one lies.
    pieces: usize,
    piece: usize,
    width: usize,
    /// Floats between rows.
    stride: usize,
    /// Rows and pieces that a tile takes.
    rows: usize,
    rest: usize,
    /// Pieces that are left.
    left: usize,
}

impl Coming {
    /// What the next tile prefetches: its share, or what is in cache anyway if none is left.
    fn take(&mut self, cached: *const f32) -> Ahead {
        if self.left == 0 {
            return Ahead::none(cached);
        }
        let ahead = Ahead {
            from: self.from.wrapping_add(self.piece * self.width),
            left: self.pieces - self.piece,
            pieces: self.pieces,
            step: self.width,
            turn: self.stride - (self.pieces - 1) * self.width,
        };
        self.left = self.left.saturating_sub(self.rows * self.pieces + self.rest);
        self.piece += self.rest;
        let more = self.piece >= self.pieces;
        self.piece -= if more { self.pieces } else { 0 };
        self.from = self.from.wrapping_add((self.rows + more as usize) * self.stride);
        ahead
    }
}

/// Writes the first `count` columns of a tile to C, or adds them.
///
/// # Safety
/// The rows of C, `stride` floats apart, have at least `count` columns.
unsafe fn store(tile: &[f32], width: usize, count: usize, to: *mut f32, stride: usize, add: bool) {
    for (r, row) in tile.chunks_exact(width).enumerate() {
        // SAFETY: the caller guarantees the rows of C.
        let out = unsafe { std::slice::from_raw_parts_mut(to.add(r * stride), count) };
        for (o, v) in out.iter_mut().zip(row) {
            *o = if add { *o + v } else { *v };
        }
    }
}
