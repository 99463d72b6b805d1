//! Two passes per band of output rows, in the cheaper order. Columns are summed from whole rows, rows by gathering.

use super::{Resample, Weights};
use crate::math::multiversion;
use crate::tasks::{self, Parts};

/// Output elements per task, about.
const BAND: usize = 1 << 15;
/// Columns that are summed in registers.
const COLUMNS: usize = 32;
/// What a gathered element costs beside one of a whole row.
const GATHER: usize = 3;

/// One sum of the vertical pass: `out = Σ_t weights[t] · rows[t]`, rows `width` apart.
#[inline(always)]
fn sum_rows<const TAPS: usize>(weights: [f32; TAPS], rows: &[f32], width: usize, out: &mut [f32]) {
    let rows: [&[f32]; TAPS] = std::array::from_fn(|t| &rows[t * width..][..out.len()]);
    for (i, o) in out.iter_mut().enumerate() {
        let mut sum = weights[0] * rows[0][i];
        for t in 1..TAPS {
            sum += weights[t] * rows[t][i];
        }
        *o = sum;
    }
}

multiversion! {
    /// Rows `range` of the vertical pass; `x` begins with row `start` of the input.
    fn vertical(table: &Weights, range: std::ops::Range<usize>, start: usize, width: usize, x: &[f32], out: &mut [f32]) {
        let n = table.outputs();
        let w = |t: usize, o: usize| table.weights[t * n + o];
        for (out, o) in out.chunks_exact_mut(width).zip(range) {
            let rows = &x[(table.first[o] as usize - start) * width..];
            match table.taps {
                0 => out.fill(0.0),
                1 => sum_rows([w(0, o)], rows, width, out),
                2 => sum_rows([w(0, o), w(1, o)], rows, width, out),
                3 => sum_rows([w(0, o), w(1, o), w(2, o)], rows, width, out),
                4 => sum_rows([w(0, o), w(1, o), w(2, o), w(3, o)], rows, width, out),
                taps => {
                    for (block, out) in out.chunks_mut(COLUMNS).enumerate() {
                        let mut sums = [0.0f32; COLUMNS];
                        for t in 0..taps {
                            let (w, row) = (w(t, o), &rows[t * width + block * COLUMNS..][..out.len()]);
                            sums.iter_mut().zip(row).for_each(|(s, v)| *s += w * v);
                        }
                        out.copy_from_slice(&sums[..out.len()]);
                    }
                }
            }
        }
    }
}

/// One row of the horizontal pass with few taps.
#[inline(always)]
fn gather<const TAPS: usize>(table: &Weights, x: &[f32], out: &mut [f32]) {
    let n = out.len();
    let weights: [&[f32]; TAPS] = std::array::from_fn(|t| &table.weights[t * n..][..n]);
    let first = &table.first[..n];
    for o in 0..n {
        let mut sum = 0.0;
        for t in 0..TAPS {
            // SAFETY: `first[o] + taps` is at most the row's length, by the table's construction.
            sum += weights[t][o] * unsafe { *x.get_unchecked(first[o] as usize + t) };
        }
        out[o] = sum;
    }
}

multiversion! {
    /// The horizontal pass of whole rows.
    fn horizontal(table: &Weights, x: &[f32], out: &mut [f32]) {
        let (inputs, n) = (table.inputs(), table.outputs());
        if table.taps == 0 {
            return out.fill(0.0);
        }
        for (x, out) in x.chunks_exact(inputs).zip(out.chunks_exact_mut(n)) {
            match table.taps {
                1 => gather::<1>(table, x, out),
                2 => gather::<2>(table, x, out),
                3 => gather::<3>(table, x, out),
                4 => gather::<4>(table, x, out),
                taps => {
                    out.fill(0.0);
                    for t in 0..taps {
                        let weights = &table.weights[t * n..][..n];
                        for ((o, w), first) in out.iter_mut().zip(weights).zip(&table.first) {
                            // SAFETY: `first + taps` is at most the row's length, by the table's construction.
                            *o += w * unsafe { *x.get_unchecked(*first as usize + t) };
                        }
                    }
                }
            }
        }
    }
}

/// `out = V x Hᵀ` for each of `planes`.
fn apply(v: &Weights, h: &Weights, planes: usize, x: &[f32], out: &mut [f32]) {
    let (height, width, oh, ow) = (v.inputs(), h.inputs(), v.outputs(), h.outputs());
    assert!(x.len() == planes * height * width, "resample: {} elements, not {planes} x {height} x {width}", x.len());
    assert!(out.len() == planes * oh * ow, "resample: {} elements, not {planes} x {oh} x {ow}", out.len());
    if out.is_empty() {
        return;
    }
    if x.is_empty() {
        return out.fill(0.0);
    }
    let horizontal_first = (height * h.taps * GATHER + oh * v.taps) * ow < (width * v.taps + ow * h.taps * GATHER) * oh;
    let rows = (BAND / ow).max(1);
    let bands = oh.div_ceil(rows);
    let (elements, parts) = (x.len() + out.len(), Parts::new(out));
    tasks::run(planes * bands, elements, |task| {
        let (plane, band) = (task / bands, task % bands);
        let range = band * rows..((band + 1) * rows).min(oh);
        // SAFETY: each task has rows of its own.
        let out = unsafe { parts.range((plane * oh + range.start) * ow..(plane * oh + range.end) * ow) };
        let x = &x[plane * height * width..][..height * width];
        // First inputs may fall at the end of a table, where short rows begin earlier.
        let needed = range.clone().map(|o| v.first[o] as usize);
        let (from, to) = (needed.clone().min().unwrap_or(0), needed.max().unwrap_or(0) + v.taps);
        if horizontal_first {
            tasks::with_buffer((to - from) * ow, |between| {
                horizontal(h, &x[from * width..to * width], between);
                vertical(v, range, from, ow, between, out);
            });
        } else {
            tasks::with_buffer(range.len() * width, |between| {
                vertical(v, range, from, width, &x[from * width..to * width], between);
                horizontal(h, between, out);
            });
        }
    });
}

/// Resampled planes.
///
/// # Shapes
/// x `[P, H, W]`, out `[P, H', W']`; images and channels count as planes alike.
pub fn forward(r: &Resample, planes: usize, x: &[f32], out: &mut [f32]) {
    apply(&r.vertical, &r.horizontal, planes, x, out);
}

/// Gradient of the input, overwritten.
///
/// # Shapes
/// d `[P, H', W']`, dx `[P, H, W]`.
pub fn backward(r: &Resample, planes: usize, d: &[f32], dx: &mut [f32]) {
    apply(&r.vertical_transposed, &r.horizontal_transposed, planes, d, dx);
}
