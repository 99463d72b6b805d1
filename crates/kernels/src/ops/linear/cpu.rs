//! Blocks of rows through the small matrix product; weight gradients per block group, added in order.

use super::{Activation, BiasKind, Dense, LEAK};
use crate::gemm::{self, Gemm, Init, Precision, View, gemm};
use crate::math;
use rayon::prelude::*;

/// Rows per block.
const BLOCK: usize = 192;
/// Rows per block backward, where x, the gradient and what is computed of them stay in cache together.
const BLOCK_BACKWARD: usize = 96;
/// Groups of blocks with a weight gradient of their own: fixed, so that results do not depend on threads.
const GROUPS: usize = 16;
/// Rows that a group has at least, so that its weight gradient costs less than its products.
const GROUP_ROWS: usize = 512;

/// Applies an activation in place.
pub fn activate(a: Activation, values: &mut [f32]) {
    match a {
        Activation::None => {}
        Activation::Relu => values.iter_mut().for_each(|v| *v = v.max(0.0)),
        Activation::Sigmoid => math::sigmoid_in_place(values),
        Activation::Softplus => values.iter_mut().for_each(|v| *v = v.max(0.0) + (-v.abs()).exp().ln_1p()),
        Activation::TruncatedExp => math::exp_in_place(values),
        Activation::LeakyRelu => values.iter_mut().for_each(|v| *v = v.max(LEAK as f32 * *v)),
        Activation::Tanh => math::tanh_in_place(values),
        Activation::Silu => math::silu_in_place(values),
    }
}

/// Multiplies gradients `d` of an activation's outputs by its slopes: from the outputs `y`, or where those do not tell from the
/// inputs `x`.
pub fn scale_by_slope(a: Activation, x: &[f32], y: &[f32], d: &mut [f32]) {
    match a {
        Activation::None => {}
        Activation::Relu => d.iter_mut().zip(y).for_each(|(d, y)| *d = if *y > 0.0 { *d } else { 0.0 }),
        Activation::Silu => math::silu_backward(x, d),
        a => d.iter_mut().zip(y).for_each(|(d, y)| *d *= slope_from_output(a, *y)),
    }
}

/// Slope of a monotonic activation from its output.
///
/// # Panics
/// When the activation is not monotonic.
#[inline(always)]
pub fn slope_from_output(a: Activation, y: f32) -> f32 {
    match a {
        Activation::None => 1.0,
        Activation::Relu => (y > 0.0) as u8 as f32,
        Activation::Sigmoid => y * (1.0 - y),
        Activation::Softplus => 1.0 - (-y).exp(),
        Activation::TruncatedExp => y.min(3_269_017.4),
        Activation::LeakyRelu => {
            if y > 0.0 {
                1.0
            } else {
                LEAK as f32
            }
        }
        Activation::Tanh => 1.0 - y * y,
        Activation::Silu => panic!("the slope of SiLU is no function of its output"),
    }
}

/// `out = act(x W + b)`, all of it written.
///
/// # Shapes
/// x `[m, k]`, w `[k, n]`, bias empty, `[n]` or `[m, n]`, out `[m, n]`.
pub fn forward(m: usize, layer: &Dense, x: &[f32], w: &[f32], bias: &[f32], out: &mut [f32]) {
    let &Dense { k, n, bias: kind, activation: a } = layer;
    assert!(x.len() == m * k && w.len() == k * n && out.len() == m * n, "linear: shapes");
    if m * n == 0 {
        return;
    }
    out.par_chunks_mut(BLOCK * n).enumerate().for_each(|(block, out)| {
        let (first, rows) = (block * BLOCK, out.len() / n);
        let x = View::rows(&x[first * k..(first + rows) * k], k);
        let init = match kind {
            BiasKind::None => Init::Zero,
            BiasKind::Shared => Init::Bias(bias),
            BiasKind::PerRow => {
                out.copy_from_slice(&bias[first * n..(first + rows) * n]);
                Init::Accumulate
            }
        };
        gemm(Precision::F32, Gemm { m: rows, n, k, a: x, b: w, ldb: n, ldc: n, init, relu: a == Activation::Relu }, out);
        if a != Activation::Relu {
            activate(a, out);
        }
    });
}

/// Gradients of x, w and b, overwritten, given the layer's output.
///
/// # Shapes
/// As in [`forward`]; `gradients` are those of x, w and b.
pub fn backward(m: usize, layer: &Dense, x: &[f32], w: &[f32], out: &[f32], d: &[f32], gradients: [&mut [f32]; 3]) {
    let &Dense { k, n, bias: kind, activation: a } = layer;
    let [dx, dw, db] = gradients;
    dw.fill(0.0);
    db.fill(0.0);
    if m * n == 0 {
        return;
    }
    let mut wt = Vec::new();
    gemm::transpose(k, n, w, &mut wt);
    let rows_per_group = m.div_ceil(GROUPS).max(GROUP_ROWS).next_multiple_of(BLOCK_BACKWARD);
    let per_row = kind == BiasKind::PerRow;
    let mut empty = [0.0f32; 0];
    let db_rows = if per_row { &mut *db } else { &mut empty[..] };
    let mut db_chunks: Vec<&mut [f32]> = db_rows.chunks_mut(rows_per_group * n).collect();
    db_chunks.resize_with(m.div_ceil(rows_per_group), Default::default);
    let partial: Vec<(Vec<f32>, Vec<f32>)> = dx
        .par_chunks_mut((rows_per_group * k).max(1))
        .zip(db_chunks)
        .enumerate()
        .map(|(group, (dx, db_rows))| {
            let (mut dw, mut db) = (vec![0.0; k * n], vec![0.0; n]);
            let mut g = vec![0.0; BLOCK_BACKWARD * n];
            let first = group * rows_per_group;
            let last = (first + rows_per_group).min(m);
            for start in (first..last).step_by(BLOCK_BACKWARD) {
                let rows = BLOCK_BACKWARD.min(last - start);
                let span = start * n..(start + rows) * n;
                let slopes = g.iter_mut().zip(&d[span.clone()]).zip(&out[span]);
                match a {
                    Activation::Relu => {
                        slopes.for_each(|((g, d), y)| *g = f32::from_bits(d.to_bits() & ((*y > 0.0) as u32).wrapping_neg()))
                    }
                    _ => slopes.for_each(|((g, d), y)| *g = d * slope_from_output(a, *y)),
                }
                let g = &g[..rows * n];
                let local = start - first;
                gemm(
                    Precision::F32,
                    Gemm { m: rows, n: k, k: n, a: View::rows(g, n), b: &wt, ldb: k, ldc: k, init: Init::Zero, relu: false },
                    &mut dx[local * k..],
                );
                gemm(
                    Precision::F32,
                    Gemm {
                        m: k,
                        n,
                        k: rows,
                        a: View::transposed(&x[start * k..], k),
                        b: g,
                        ldb: n,
                        ldc: n,
                        init: Init::Accumulate,
                        relu: false,
                    },
                    &mut dw,
                );
                if per_row {
                    db_rows[local * n..(local + rows) * n].copy_from_slice(g);
                }
                if kind == BiasKind::Shared {
                    for row in g.chunks_exact(n) {
                        db.iter_mut().zip(row).for_each(|(b, g)| *b += g);
                    }
                }
            }
            (dw, db)
        })
        .collect();
    for (w, b) in &partial {
        dw.iter_mut().zip(w).for_each(|(a, b)| *a += b);
        if kind == BiasKind::Shared {
            db.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        }
    }
}
