//! Weight gradients: sums over pixels of products of output-gradient and input channels, vectorized along input channels.
//!
//! `out[g, m, n, tap] = Σ_pixels d[g, m, pixel] x[g, n, step · pixel + tap]`: `d` is read in place, `x`
//! from a copy with channels innermost, in which neighboring taps of a row are neighboring vectors.

use super::bands::{Bands, Scratch, aligned, with_scratch};
use super::depthwise;
use super::shapes::{WeightSums, offset};
use crate::simd;
use crate::tile::{Ahead, Kernel, MOST_VECTORS, Shared, Start, Tile, kernel};
use rayon::prelude::*;
use std::cell::Cell;
use std::ops::Range;

/// Pixels per pass.
const PIXELS: usize = 768;
/// Fewest rows of a task, because each task copies its input again.
const FEWEST_ROWS: usize = 32;
/// Wanted number of tasks: layers with few channels are also split by pixels to reach it.
const TASKS: usize = 16;

/// Layout of the copy of a block of channels: `[image, row, column, width]`.
#[derive(Clone, Copy)]
struct Layout {
    /// Channels of a block.
    channels: usize,
    /// Floats per pixel.
    width: usize,
    /// Taps whose floats are contiguous.
    run: usize,
    /// Vectors of a run.
    vectors: usize,
    columns: usize,
}

impl WeightSums {
    /// Computes the weight gradient; overwrites `out`, `[groups · rows, columns, taps]`.
    pub fn run(&self, d: &[f32], x: &[f32], out: &mut [f32]) {
        let taps = self.kernel[0] * self.kernel[1];
        assert_eq!(out.len(), self.groups * self.rows * self.columns * taps, "convolution: gradient of weights");
        assert_eq!(d.len(), self.batch * self.groups * self.rows * self.grid[0] * self.grid[1], "convolution: gradient of outputs");
        assert_eq!(x.len(), self.batch * self.groups * self.columns * self.input[0] * self.input[1], "convolution: input");
        if out.is_empty() {
            return;
        }
        if self.rows <= 2 && self.columns == 1 {
            return depthwise::weight_gradient(self, d, x, out);
        }
        let level = simd::level();
        let kernel = kernel(level);
        let layout = self.layout(kernel);
        let blocks = self.columns.div_ceil(layout.channels);
        let wanted = (3 * rayon::current_num_threads()).div_ceil(self.groups * blocks);
        let part = self.rows.div_ceil(wanted).max(FEWEST_ROWS).next_multiple_of(kernel.rows);
        let parts = self.rows.div_ceil(part);
        let bands = Bands::plan(self.batch, self.grid[0], self.grid[1], PIXELS);
        let shares = self.shares();
        let size = out.len();
        let mut partial = PARTIAL.take();
        partial.resize((shares - 1) * size, 0.0);
        let (first, others) = (Shared(out.as_mut_ptr()), Shared(partial.as_mut_ptr()));
        let tasks = self.groups * blocks * parts;
        (0..shares * tasks).into_par_iter().for_each(|i| {
            let (share, i) = (i / tasks, i % tasks);
            let (block, p) = (i / parts % blocks, i % parts);
            let channel = block * layout.channels;
            let task = Task {
                s: self,
                kernel,
                layout,
                group: i / parts / blocks,
                rows: p * part..((p + 1) * part).min(self.rows),
                channels: channel..(channel + layout.channels).min(self.columns),
                share: share * bands.len() / shares..(share + 1) * bands.len() / shares,
                bands,
            };
            // SAFETY: every share except the first has its own part of the partial sums.
            let out = if share == 0 { first } else { Shared(unsafe { others.at((share - 1) * size) }) };
            simd::with_level(level, || with_scratch(|scratch| task.compute(d, x, out, scratch)));
        });
        for share in partial.chunks_exact(size) {
            out.iter_mut().zip(share).for_each(|(o, v)| *o += v);
        }
        PARTIAL.set(partial);
    }

    /// Number of parts of the pixels that are summed separately; it fixes the order of summation, so it must not depend on the thread count.
    pub(super) fn shares(&self) -> usize {
        let blocks = self.columns.div_ceil(self.layout(kernel(simd::level())).channels);
        let bands = Bands::plan(self.batch, self.grid[0], self.grid[1], PIXELS);
        TASKS.div_ceil(self.groups * blocks * self.rows.div_ceil(FEWEST_ROWS)).min(bands.len()).max(1)
    }

    fn layout(&self, kernel: &Kernel) -> Layout {
        let joined = self.dilation[1] == 1 && self.kernel[1] > 1;
        let lanes = kernel.lanes;
        let width = if joined && self.columns < lanes {
            self.columns
        } else if self.kernel[1] > 1 && joined {
            lanes
        } else {
            lanes * self.columns.div_ceil(lanes).min(kernel.vectors)
        };
        let run = if joined { self.kernel[1] } else { 1 };
        let columns = (self.grid[1] - 1) * self.step[1] + (self.kernel[1] - 1) * self.dilation[1] + 1;
        Layout { channels: width.min(self.columns), width, run, vectors: (run * width).div_ceil(lanes), columns }
    }
}

thread_local! {
    static PARTIAL: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
}

/// One task: some rows times a block of channels, over a share of the bands.
struct Task<'a> {
    s: &'a WeightSums,
    kernel: &'static Kernel,
    layout: Layout,
    group: usize,
    rows: Range<usize>,
    channels: Range<usize>,
    bands: Bands,
    /// Bands whose pixels are summed.
    share: Range<usize>,
}

impl Task<'_> {
    fn compute(&self, d: &[f32], x: &[f32], out: Shared, scratch: &mut Scratch) {
        let (s, l) = (self.s, self.layout);
        let runs = s.kernel[0] * s.kernel[1] / l.run;
        let length = l.vectors * self.kernel.lanes;
        let bands = self.bands;
        let Scratch { planes, sums, offsets, .. } = scratch;
        let height = (bands.rows - 1) * s.step[0] + (s.kernel[0] - 1) * s.dilation[0] + 1;
        let image = height * l.columns * l.width;
        // The last vector of a run may reach beyond it.
        let planes = aligned(planes, bands.images * image + length);
        let sums = aligned(sums, self.rows.len() * runs * length);
        sums.fill(0.0);
        let mut shape = (0, 0);
        for band in self.share.clone() {
            let (images, rows) = bands.band(band);
            if shape != (images.len(), rows.len()) {
                shape = (images.len(), rows.len());
                self.list_pixels(shape, image, offsets);
            }
            for (i, n) in images.clone().enumerate() {
                self.fill(x, n, rows.start, rows.len(), &mut planes[i * image..(i + 1) * image]);
            }
            let pixels = s.grid[0] * s.grid[1];
            let first = (images.start * s.groups + self.group) * s.rows * pixels + rows.start * s.grid[1];
            for (i, row) in self.rows.clone().enumerate().step_by(self.kernel.rows) {
                let height = self.kernel.rows.min(self.rows.end - row);
                for run in 0..runs {
                    let (ky, kx) = (run * l.run / s.kernel[1], run * l.run % s.kernel[1]);
                    let at = (ky * s.dilation[0] * l.columns + kx * s.dilation[1]) * l.width;
                    let each = l.vectors.div_ceil(l.vectors.div_ceil(self.kernel.vectors.min(MOST_VECTORS)));
                    for v in (0..l.vectors).step_by(each) {
                        let to = (i * runs + run) * length + v * self.kernel.lanes;
                        let tile = Tile {
                            a: d[first + row * pixels..].as_ptr(),
                            row: pixels,
                            b: planes[at + v * self.kernel.lanes..].as_ptr(),
                            offsets,
                            c: sums[to..].as_mut_ptr(),
                            c_row: runs * length,
                            c_vector: self.kernel.lanes,
                            start: Start::Accumulate,
                            ahead: Ahead::none(planes.as_ptr()),
                            pairs: None,
                        };
                        // SAFETY: `height` rows of d exist from there, `list_pixels` lists only pixels of d and of the copy, sums have all rows.
                        unsafe { self.kernel.run(height, each.min(l.vectors - v), &tile) };
                    }
                }
            }
        }
        self.write(sums, runs, length, out);
    }

    /// Lists the offsets of each pixel of a band in `d` and in the copy of `x`.
    fn list_pixels(&self, (images, rows): (usize, usize), image: usize, offsets: &mut Vec<(u32, u32)>) {
        let s = self.s;
        offsets.clear();
        for n in 0..images {
            for y in 0..rows {
                for x in 0..s.grid[1] {
                    let d = (n * s.groups * s.rows * s.grid[0] + y) * s.grid[1] + x;
                    let copy = n * image + (y * s.step[0] * self.layout.columns + x * s.step[1]) * self.layout.width;
                    offsets.push((offset(d), offset(copy)));
                }
            }
        }
    }

    /// Copies the block's channels of an image, channels innermost, for `rows` grid rows starting at `first`.
    fn fill(&self, x: &[f32], image: usize, first: usize, rows: usize, out: &mut [f32]) {
        let (s, l) = (self.s, self.layout);
        let [height, width] = s.input;
        let begin = s.padding[1].min(l.columns);
        let end = (width + s.padding[1]).min(l.columns).max(begin);
        let channel = (image * s.groups + self.group) * s.columns + self.channels.start;
        let needed = (rows - 1) * s.step[0] + (s.kernel[0] - 1) * s.dilation[0] + 1;
        for (t, row) in out.chunks_exact_mut(l.columns * l.width).enumerate().take(needed) {
            let y = (first * s.step[0] + t).wrapping_sub(s.padding[0]);
            if y >= height {
                row.fill(0.0);
                continue;
            }
            row[..begin * l.width].fill(0.0);
            row[end * l.width..].fill(0.0);
            let from = &x[(channel * height + y) * width..];
            interleave(from, height * width, self.channels.len(), l.width, &mut row[begin * l.width..end * l.width]);
        }
    }

    fn write(&self, sums: &[f32], runs: usize, length: usize, out: Shared) {
        let (s, l) = (self.s, self.layout);
        let taps = s.kernel[0] * s.kernel[1];
        for (i, row) in self.rows.clone().enumerate() {
            for (c, channel) in self.channels.clone().enumerate() {
                for tap in 0..taps {
                    let (run, k) = (tap / l.run, tap % l.run);
                    debug_assert!(run < runs);
                    let value = sums[(i * runs + run) * length + k * l.width + c];
                    // SAFETY: rows and channels are this task's own; `run` checked the length.
                    unsafe { *out.at(((self.group * s.rows + row) * s.columns + channel) * taps + tap) = value };
                }
            }
        }
    }
}

/// `out[i, c] = from[c · stride + i]` for `c < channels`; the other floats of `out`, whose rows have `width`, are unchanged.
pub fn interleave(from: &[f32], stride: usize, channels: usize, width: usize, out: &mut [f32]) {
    let pixels = out.len() / width;
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if simd::level() == simd::Level::Avx512 && width.is_multiple_of(16) {
        let whole = channels / 16 * 16;
        assert!(pixels == 0 || whole == 0 || from.len() >= (whole - 1) * stride + pixels);
        for c in (0..whole).step_by(16) {
            // SAFETY: the level guarantees AVX-512; the assertion checks the source's length.
            unsafe { interleave16(from[c * stride..].as_ptr(), stride, pixels, out[c..].as_mut_ptr(), width) };
        }
        done = whole;
    }
    for c in done..channels {
        let from = &from[c * stride..c * stride + pixels];
        for (o, v) in out[c..].iter_mut().step_by(width).zip(from) {
            *o = *v;
        }
    }
}

/// Interleaves sixteen channels, sixteen pixels at a time.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn interleave16(from: *const f32, stride: usize, pixels: usize, out: *mut f32, width: usize) {
    use std::arch::x86_64::*;
    // SAFETY: loads and stores are limited to the pixels, whose sixteen channels the caller guarantees.
    unsafe {
        for i in (0..pixels).step_by(16) {
            let count = (pixels - i).min(16);
            let mask = (((1u32 << count) - 1) & 0xffff) as u16;
            let v: [__m512i; 16] = std::array::from_fn(|c| _mm512_maskz_loadu_epi32(mask, from.add(c * stride + i).cast()));
            let t = crate::gemm::amx::transpose16(v);
            for (p, t) in t.iter().enumerate().take(count) {
                _mm512_storeu_si512(out.add((i + p) * width).cast(), *t);
            }
        }
    }
}
