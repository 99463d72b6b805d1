//! Depthwise layers (one input channel per group): whole rows at a time, vectorized along pixels.

use super::activate;
use super::bands::{Scratch, aligned, with_scratch};
use super::planes::{Planes, Source};
use super::shapes::{Correlation, Tap, Tensors, WeightSums, offset};
use crate::simd;
use crate::tile::rows::{Dots, Line, MOST_DOTS, Rows};
use crate::tile::{Kernel, Shared, kernel};
use rayon::prelude::*;
use std::ops::Range;

/// Prefetch distance in floats.
const AHEAD: isize = 1024;
/// Floats of a band's copy.
const BAND: usize = 6 << 10;

/// Computes a correlation with one input channel per group.
pub fn run(c: &Correlation, t: Tensors) {
    match Inner::of(c).filter(|i| i.columns.len() > kernel(simd::level()).lanes) {
        Some(inner) => inner.run(c, t),
        None => run_copied(c, t),
    }
}

/// As [`run`], from padded copies of the input in which taps are shifts.
fn run_copied(c: &Correlation, t: Tensors) {
    let level = simd::level();
    let kernel = kernel(level);
    let mut planes = Planes::default();
    planes.update(c.input, c.step, c.phases.iter().flat_map(|p| &p.taps).map(|t| t.at));
    let most = |i: usize| c.phases.iter().map(|p| p.size[i]).max().unwrap_or(0);
    // Bands whose copy stays in the L1 cache.
    let band = (BAND / planes.floats_per_row(most(1)).max(1)).clamp(1, most(0).max(1));
    planes.fit(1, band, most(1));
    let offsets: Vec<Vec<(u32, u32)>> =
        c.phases.iter().map(|p| p.taps.iter().map(|t| (offset(t.weight), offset(planes.offset(t.at)))).collect()).collect();
    let (x, bias, pixels) = (t.x, t.bias, c.output[0] * c.output[1]);
    let row_len = most(1).next_multiple_of(64) + 64;
    let compute = |image: usize, group: usize, out: &mut [f32], mut before: Option<&mut [f32]>| {
        with_scratch(|scratch| {
            let copy = aligned(&mut scratch.planes, planes.channel + row_len + 64);
            let row = aligned(&mut scratch.sums, row_len);
            let taps = &mut scratch.taps;
            let source = Source { data: x, image_stride: c.groups * c.input[0] * c.input[1], first_channel: group };
            for (first, feature) in (0..most(0)).step_by(band).flat_map(|first| (0..c.features).map(move |f| (first, f))) {
                if feature == 0 {
                    planes.fill(source, 0..1, image..image + 1, first, copy);
                }
                let channel = group * c.features + feature;
                let weights = &t.weights[group * c.weight_group + feature * c.weight_feature..];
                for (phase, offsets) in c.phases.iter().zip(&offsets) {
                    taps.clear();
                    taps.extend(offsets.iter().map(|o| weights[o.0 as usize]));
                    let columns = phase.size[1];
                    // Rows of whole tiles are written directly.
                    let in_place = before.is_none() && c.spread == [1; 2] && columns.is_multiple_of(4 * kernel.lanes);
                    let rows = first..(first + band).min(phase.size[0]);
                    let place = |y: usize| feature * pixels + (phase.start[0] + y * c.spread[0]) * c.output[1] + phase.start[1];
                    let of = |y: usize, rows: usize, to: *mut f32| Rows {
                        weights: taps,
                        offsets,
                        b: copy[(y - first) * planes.pitch..].as_ptr(),
                        b_pitch: planes.pitch,
                        rows,
                        columns,
                        start: bias.get(channel).copied().unwrap_or(0.0),
                        c: to,
                        c_pitch: c.spread[0] * c.output[1],
                    };
                    if in_place {
                        let out = &mut out[place(rows.start)..];
                        // SAFETY: the copy extends by a row; the rows are whole tiles of the output.
                        unsafe { kernel.depthwise(&of(rows.start, rows.len(), out.as_mut_ptr())) };
                        activate(t.activation, &mut out[..rows.len() * columns]);
                        continue;
                    }
                    for y in rows {
                        // SAFETY: the copy and `row` extend by a row.
                        unsafe { kernel.depthwise(&of(y, 1, row.as_mut_ptr())) };
                        if let Some(before) = &mut before {
                            spread(&row[..columns], c.spread[1], &mut before[place(y)..]);
                        }
                        activate(t.activation, &mut row[..columns]);
                        spread(&row[..columns], c.spread[1], &mut out[place(y)..]);
                    }
                }
            }
        });
    };
    let size = c.features * pixels;
    let place = |i: usize| (i / c.groups, i % c.groups);
    match t.before {
        Some(before) => t.out.par_chunks_mut(size).zip(before.par_chunks_mut(size)).enumerate().for_each(|(i, (out, before))| {
            simd::with_level(level, || compute(place(i).0, place(i).1, out, Some(before)));
        }),
        None => t.out.par_chunks_mut(size).enumerate().for_each(|(i, out)| {
            simd::with_level(level, || compute(place(i).0, place(i).1, out, None));
        }),
    }
}

/// Columns whose taps all lie inside an input row, so that the input is read in place.
struct Inner {
    columns: Range<usize>,
    low: [isize; 2],
    /// Rows from the first to the last tap.
    rows: usize,
    /// The other columns, each with its taps inside a row.
    borders: Vec<(usize, Vec<Tap>)>,
}

/// Input of one output channel.
struct Plane<'a> {
    /// The input channel, and what follows it in memory.
    x: &'a [f32],
    weights: &'a [f32],
    start: f32,
}

impl Inner {
    /// None if there are several phases, or the horizontal step exceeds 2.
    fn of(c: &Correlation) -> Option<Inner> {
        let [phase] = &c.phases[..] else { return None };
        if c.spread != [1; 2] || phase.size != c.output || phase.taps.is_empty() || c.step[1] > 2 {
            return None;
        }
        let of = |i: usize| phase.taps.iter().map(move |t| t.at[i]);
        let low = [of(0).min()?, of(1).min()?];
        let (step, last) = (c.step[1] as isize, of(1).max()?);
        let width = c.input[1] as isize;
        let first = ((-low[1]).max(0) + step - 1) / step;
        let end = ((width - last).max(0) + step - 1) / step;
        let columns = first as usize..(end as usize).min(c.output[1]);
        let inside = |x: usize| {
            let taps = phase.taps.iter().filter(move |t| (0..width).contains(&(x as isize * step + t.at[1])));
            (x, taps.copied().collect())
        };
        // Includes the last inner column: with step 2, vectors read one float past it.
        let borders = (0..columns.start).chain(columns.end.saturating_sub(1)..c.output[1]).map(inside).collect();
        Some(Inner { columns, low, rows: (of(0).max()? - low[0] + 1) as usize, borders })
    }

    /// Computes all outputs.
    fn run(&self, c: &Correlation, t: Tensors) {
        let level = simd::level();
        let kernel = kernel(level);
        let (size, pixels) = (c.input[0] * c.input[1], c.output[0] * c.output[1]);
        let (x, bias) = (t.x, t.bias);
        let compute = |i: usize, out: &mut [f32]| {
            let channel = i % (c.groups * c.features);
            let (group, feature) = (channel / c.features, channel % c.features);
            let x = &x[i / c.features * size..];
            let weights = &t.weights[group * c.weight_group + feature * c.weight_feature..];
            let plane = Plane { x, weights, start: bias.get(channel).copied().unwrap_or(0.0) };
            with_scratch(|scratch| self.compute(c, kernel, plane, out, scratch));
        };
        match t.before {
            Some(before) => t.out.par_chunks_mut(pixels).zip(before.par_chunks_mut(pixels)).enumerate().for_each(|(i, (out, before))| {
                simd::with_level(level, || {
                    compute(i, before);
                    out.copy_from_slice(before);
                    activate(t.activation, out);
                });
            }),
            None => t.out.par_chunks_mut(pixels).enumerate().for_each(|(i, out)| {
                simd::with_level(level, || {
                    compute(i, out);
                    activate(t.activation, out);
                });
            }),
        }
    }

    /// Computes all outputs of one channel: inner columns in vectors, border columns one by one.
    fn compute(&self, c: &Correlation, kernel: &Kernel, p: Plane, out: &mut [f32], scratch: &mut Scratch) {
        let ([height, width], taps) = (c.input.map(|n| n as isize), &c.phases[0].taps);
        let Scratch { taps: weights, columns: offsets, .. } = scratch;
        let goes_on = p.x.len() > c.input[0] * c.input[1];
        let mut inside = false;
        for (y, out) in out.chunks_exact_mut(c.output[1]).enumerate() {
            let top = (y * c.step[0]) as isize + self.low[0];
            let was_inside = std::mem::replace(&mut inside, top >= 0 && top + self.rows as isize <= height);
            if !(inside && was_inside) {
                let rows = taps.iter().filter(|t| (0..height).contains(&(top + t.at[0] - self.low[0])));
                weights.clear();
                weights.extend(rows.clone().map(|t| p.weights[t.weight]));
                offsets.clear();
                offsets.extend(rows.map(|t| offset(((t.at[0] - self.low[0]) * width + t.at[1] - self.low[1]) as usize)));
            }
            let first = top * width + (self.columns.start * c.step[1]) as isize + self.low[1];
            let rest = (c.step[1] == 2 && !goes_on && top + self.rows as isize >= height) as usize;
            let columns = self.columns.start..self.columns.end - rest;
            let line = Line {
                weights,
                offsets,
                from: p.x.as_ptr().wrapping_offset(first),
                step: c.step[1],
                columns: columns.len(),
                start: p.start,
                c: out[columns.clone()].as_mut_ptr(),
            };
            simd::fetch_now(p.x.as_ptr().wrapping_offset(first + AHEAD), c.step[0] * c.input[1]);
            // SAFETY: only taps in rows inside the input are listed, and only columns whose taps are all inside.
            unsafe { kernel.line(&line) };
            for (x, taps) in self.borders.iter().filter(|(x, _)| !columns.contains(x)) {
                let at = [(y * c.step[0]) as isize, (x * c.step[1]) as isize];
                let mut sum = p.start;
                for t in taps.iter().filter(|t| inside || (0..height).contains(&(at[0] + t.at[0]))) {
                    sum += p.weights[t.weight] * p.x[((at[0] + t.at[0]) * width + at[1] + t.at[1]) as usize];
                }
                out[*x] = sum;
            }
        }
    }
}

/// `out[step · i] = row[i]`
fn spread(row: &[f32], step: usize, out: &mut [f32]) {
    if step == 1 {
        out[..row.len()].copy_from_slice(row);
    } else {
        out.iter_mut().step_by(step).zip(row).for_each(|(o, v)| *o = *v);
    }
}

/// Weight gradients of layers with one input channel and few output channels per group.
pub fn weight_gradient(s: &WeightSums, d: &[f32], x: &[f32], out: &mut [f32]) {
    let level = simd::level();
    let kernel = kernel(level);
    let taps: Vec<[isize; 2]> = (0..s.kernel[0] * s.kernel[1])
        .map(|t| {
            let k = [t / s.kernel[1], t % s.kernel[1]];
            std::array::from_fn(|i| (k[i] * s.dilation[i]) as isize - s.padding[i] as isize)
        })
        .collect();
    let mut planes = Planes::default();
    planes.update(s.input, s.step, taps.iter().copied());
    planes.fit(1, s.grid[0], s.grid[1]);
    let offsets: Vec<(u32, u32)> = taps.iter().map(|t| (0, offset(planes.offset(*t)))).collect();
    let columns = s.grid[1].next_multiple_of(kernel.lanes);
    let pixels = s.grid[0] * s.grid[1];
    let compute = |group: usize, out: &mut [f32]| {
        with_scratch(|scratch| {
            let copy = aligned(&mut scratch.planes, planes.channel + 2 * kernel.lanes);
            let rows = aligned(&mut scratch.panel, s.grid[0] * columns);
            let sums = aligned(&mut scratch.sums, s.rows * taps.len() * kernel.lanes);
            sums.fill(0.0);
            for image in 0..s.batch {
                let source = Source { data: x, image_stride: s.groups * s.input[0] * s.input[1], first_channel: group };
                planes.fill(source, 0..1, image..image + 1, 0, copy);
                // Columns beyond the last are multiplied by 0, so they must be finite.
                copy[planes.image..].fill(0.0);
                for feature in 0..s.rows {
                    let from = &d[((image * s.groups + group) * s.rows + feature) * pixels..][..pixels];
                    for (to, from) in rows.chunks_exact_mut(columns).zip(from.chunks_exact(s.grid[1])) {
                        to[..from.len()].copy_from_slice(from);
                        to[from.len()..].fill(0.0);
                    }
                    for first in (0..taps.len()).step_by(MOST_DOTS) {
                        let dots = Dots {
                            d: rows.as_ptr(),
                            d_pitch: columns,
                            b: copy.as_ptr(),
                            b_pitch: planes.pitch,
                            rows: s.grid[0],
                            columns,
                            offsets: &offsets[first..(first + MOST_DOTS).min(taps.len())],
                            sums: sums[(feature * taps.len() + first) * kernel.lanes..].as_mut_ptr(),
                        };
                        // SAFETY: rows are whole vectors; the copy extends by a vector beyond its last row.
                        unsafe { kernel.dots(&dots) };
                    }
                }
            }
            for (o, lanes) in out.iter_mut().zip(sums.chunks_exact(kernel.lanes)) {
                *o = lanes.iter().sum();
            }
        });
    };
    let out = Shared(out.as_mut_ptr());
    let size = s.rows * taps.len();
    (0..s.groups).into_par_iter().for_each(|group| {
        // SAFETY: every group has its own part.
        let out = unsafe { std::slice::from_raw_parts_mut(out.at(group * size), size) };
        simd::with_level(level, || compute(group, out));
    });
}
