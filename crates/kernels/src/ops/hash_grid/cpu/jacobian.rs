//! Derivatives of the features with respect to the points, and the table's gradient from theirs.

use super::super::HashGrid;
use super::{cell, trilinear_slopes};
use rayon::prelude::*;

/// `∂features/∂point`, `[L, S, F, 3]`, overwritten.
pub fn jacobian(grid: &HashGrid, points: &[f32], table: &[f32], out: &mut [f32]) {
    let (s, width) = (points.len() / 3, grid.config.features);
    assert_eq!(out.len(), s * grid.output_dims() * 3, "hash grid: jacobian");
    if s == 0 {
        return;
    }
    out.par_chunks_mut(s * width * 3).zip(&grid.levels).for_each(|(out, level)| {
        for (p, o) in points.chunks_exact(3).zip(out.chunks_exact_mut(width * 3)) {
            let (idx, f, clamped) = cell(level, p);
            for k in 0..width {
                let v = idx.map(|r| table[(level.offset + r) * width + k]);
                let slopes = trilinear_slopes(v, f);
                for a in 0..3 {
                    o[k * 3 + a] = if clamped[a] { 0.0 } else { slopes[a] * level.cells as f32 };
                }
            }
        }
    });
}

/// Adds to the table's gradient, given the Jacobian's gradient `[L, S, F, 3]`.
pub fn jacobian_backward(grid: &HashGrid, points: &[f32], d_jacobian: &[f32], d_table: &mut [f32]) {
    let (s, width) = (points.len() / 3, grid.config.features);
    assert_eq!(d_jacobian.len(), s * grid.output_dims() * 3, "hash grid: d_jacobian");
    let mut rest = d_table;
    let mut tasks = Vec::with_capacity(grid.levels.len());
    for (l, level) in grid.levels.iter().enumerate() {
        let (own, tail) = rest.split_at_mut(level.rows * width);
        rest = tail;
        tasks.push((level, &d_jacobian[l * s * width * 3..(l + 1) * s * width * 3], own));
    }
    tasks.into_par_iter().with_max_len(1).for_each(|(level, d, own)| {
        for (p, d) in points.chunks_exact(3).zip(d.chunks_exact(width * 3)) {
            let (idx, f, clamped) = cell(level, p);
            let n = level.cells as f32;
            for c in 0..8usize {
                let bit = |k: usize| (c >> k) & 1 == 1;
                let w = |k: usize| if bit(k) { f[k] } else { 1.0 - f[k] };
                let s = |k: usize| {
                    if clamped[k] {
                        0.0
                    } else if bit(k) {
                        n
                    } else {
                        -n
                    }
                };
                let dw = [s(0) * w(1) * w(2), w(0) * s(1) * w(2), w(0) * w(1) * s(2)];
                for k in 0..width {
                    own[idx[c] * width + k] += dw[0] * d[k * 3] + dw[1] * d[k * 3 + 1] + dw[2] * d[k * 3 + 2];
                }
            }
        }
    });
}
