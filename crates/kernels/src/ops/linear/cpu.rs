//! Matrix products with bias and activation while their outputs are in cache. Backward, many rows are cut into groups that keep
//! the gradient before the activation in cache and have a weight gradient of their own; few rows are cut by columns.

use super::{Activation, BiasKind, Gradients, LEAK, Linear};
use crate::math;
use crate::ops::matmul::Matmul;
use crate::ops::matmul::cpu::{matmul, matmul_here, matmul_with};
use crate::simd;
use crate::tasks::Parts;
use crate::vector::vectorized;
use rayon::prelude::*;
use std::cell::{Cell, RefCell};

/// Rows per block of a group.
const BLOCK: usize = 384;
/// Groups of rows with gradients of weights of their own: fixed, so that results do not depend on threads.
const GROUPS: usize = 16;
/// Fewest rows that are cut into groups, and most weights.
const MANY_ROWS: usize = 4096;
const FEW_WEIGHTS: usize = 1 << 18;

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

vectorized! {
    fn add<const F>(sums: &mut [f32], values: &[f32]) {
        sums.iter_mut().zip(values).for_each(|(s, v)| *s += v);
    }
}

vectorized! {
    fn add_and_clip<const F>(sums: &mut [f32], values: &[f32]) {
        sums.iter_mut().zip(values).for_each(|(s, v)| *s = (*s + v).max(0.0));
    }
}

vectorized! {
    /// `out = d` where `y` is positive, else 0.
    fn clip_gradient<const F>(y: &[f32], d: &[f32], out: &mut [f32]) {
        for ((o, y), d) in out.iter_mut().zip(y).zip(d) {
            *o = if *y > 0.0 { *d } else { 0.0 };
        }
    }
}

/// Second derivative of a monotonic activation from its output.
///
/// # Panics
/// When the activation is not monotonic.
#[inline(always)]
pub fn second_slope_from_output(a: Activation, y: f32) -> f32 {
    let s = slope_from_output(a, y);
    match a {
        Activation::None | Activation::Relu | Activation::LeakyRelu => 0.0,
        Activation::Sigmoid => s * (1.0 - 2.0 * y),
        Activation::Softplus => s * (1.0 - s),
        Activation::TruncatedExp => {
            if s < y {
                0.0
            } else {
                s
            }
        }
        Activation::Tanh => -2.0 * y * s,
        Activation::Silu => panic!("the slope of SiLU is no function of its output"),
    }
}

thread_local! {
    /// The gradient before the activation, of all rows or of a block.
    static SLOPES: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
    /// Gradients of groups: weights, then bias.
    static PARTIAL: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

impl Linear {
    fn check(&self, x: &[f32], w: &[f32], out: usize) {
        let (m, k, n) = (self.rows, self.inputs, self.outputs);
        assert!(x.len() == m * k && w.len() == k * n && out == m * n, "linear: shapes");
    }

    /// `d` times the slopes of outputs.
    fn before_activation(&self, out: &[f32], d: &[f32], g: &mut [f32]) {
        match self.activation {
            Activation::Relu => clip_gradient(out, d, g),
            a => g.iter_mut().zip(d).zip(out).for_each(|((g, d), y)| *g = d * slope_from_output(a, *y)),
        }
    }
}

/// `out = act(x W + b)`, all of it written.
///
/// # Shapes
/// x `[m, k]`, w `[k, n]`, bias empty, `[n]` or `[m, n]`, out `[m, n]`.
pub fn forward(l: &Linear, x: &[f32], w: &[f32], bias: &[f32], out: &mut [f32]) {
    l.check(x, w, out.len());
    let n = l.outputs;
    assert_eq!(bias.len(), l.bias.len(l.rows, n), "linear: bias");
    let finish = |row: usize, column: usize, values: &mut [f32]| {
        let first = if l.bias == BiasKind::PerRow { row * n + column } else { column };
        let bias = if l.bias == BiasKind::None { &[][..] } else { &bias[first..first + values.len()] };
        match l.activation {
            Activation::Relu if !bias.is_empty() => return add_and_clip(values, bias),
            _ => add(values, bias),
        }
        activate(l.activation, values);
    };
    let plain = l.bias == BiasKind::None && l.activation == Activation::None;
    matmul_with(
        &Matmul { precision: l.precision, ..Matmul::new(l.rows, n, l.inputs) },
        x,
        w,
        out,
        if plain { None } else { Some(&finish) },
    );
}

/// Gradients of what is wanted, given the layer's output.
///
/// # Shapes
/// as in [`forward`]; d as `out`.
pub fn backward(l: &Linear, x: &[f32], w: &[f32], out: &[f32], d: &[f32], gradients: Gradients) {
    l.check(x, w, d.len());
    assert_eq!(out.len(), d.len(), "linear: output");
    if l.rows >= MANY_ROWS && l.inputs * l.outputs <= FEW_WEIGHTS && l.bias != BiasKind::PerRow {
        return by_rows(l, x, w, out, d, gradients);
    }
    if l.activation == Activation::None {
        return by_columns(l, x, w, d, gradients);
    }
    let mut g = SLOPES.take();
    g.resize(d.len(), 0.0);
    let (level, chunk) = (simd::level(), BLOCK * l.outputs.max(1));
    g.par_chunks_mut(chunk).zip(out.par_chunks(chunk)).zip(d.par_chunks(chunk)).for_each(|((g, out), d)| {
        simd::with_level(level, || l.before_activation(out, d, g));
    });
    by_columns(l, x, w, &g, gradients);
    SLOPES.set(g);
}

/// Whole products, given the gradient before the activation.
fn by_columns(l: &Linear, x: &[f32], w: &[f32], g: &[f32], gradients: Gradients) {
    let s = Matmul { precision: l.precision, ..Matmul::new(l.rows, l.outputs, l.inputs) };
    if let Some(dx) = gradients.x {
        matmul(&s.gradient_a(), g, w, dx);
    }
    if let Some(dw) = gradients.w {
        matmul(&s.gradient_b(), x, g, dw);
    }
    match (gradients.bias, l.bias) {
        (Some(db), BiasKind::Shared) => {
            db.fill(0.0);
            g.chunks_exact(l.outputs.max(1)).for_each(|row| add(db, row));
        }
        (Some(db), BiasKind::PerRow) => db.copy_from_slice(g),
        _ => {}
    }
}

/// Groups of rows, whose gradients of weights and bias are added in order.
fn by_rows(l: &Linear, x: &[f32], w: &[f32], out: &[f32], d: &[f32], gradients: Gradients) {
    let (m, k, n) = (l.rows, l.inputs, l.outputs);
    let (per_group, size, level) = (m.div_ceil(GROUPS), k * n + n, simd::level());
    let groups = m.div_ceil(per_group);
    let wanted = [gradients.w.is_some(), gradients.bias.is_some() && l.bias == BiasKind::Shared];
    let dx = gradients.x.map(|dx| {
        assert_eq!(dx.len(), m * k, "linear: gradient of the input");
        Parts::new(dx)
    });
    PARTIAL.with_borrow_mut(|partial| {
        partial.resize(groups * size, 0.0);
        partial.par_chunks_mut(size).enumerate().for_each(|(group, partial)| {
            let (dw, db) = partial.split_at_mut(k * n);
            db.fill(0.0);
            let end = ((group + 1) * per_group).min(m);
            let mut g = SLOPES.take();
            for first in (group * per_group..end).step_by(BLOCK) {
                let rows = first..(first + BLOCK).min(end);
                let span = rows.start * n..rows.end * n;
                simd::with_level(level, || {
                    let g = if l.activation == Activation::None {
                        &d[span]
                    } else {
                        g.resize(rows.len() * n, 0.0);
                        l.before_activation(&out[span.clone()], &d[span], &mut g);
                        &g[..]
                    };
                    let s = Matmul { precision: l.precision, ..Matmul::new(rows.len(), n, k) };
                    let inputs = rows.start * k..rows.end * k;
                    if let Some(dx) = &dx {
                        // SAFETY: each task has rows of its own.
                        matmul_here(&s.gradient_a(), g, w, unsafe { dx.range(inputs.clone()) });
                    }
                    if wanted[0] {
                        let accumulate = first > group * per_group;
                        matmul_here(&Matmul { accumulate, ..s.gradient_b() }, &x[inputs], g, dw);
                    }
                    if wanted[1] {
                        g.chunks_exact(n.max(1)).for_each(|row| add(db, row));
                    }
                });
            }
            SLOPES.set(g);
        });
        let collect = |to: &mut [f32], at: usize| {
            to.fill(0.0);
            partial.chunks_exact(size).for_each(|p| add(to, &p[at..at + to.len()]));
        };
        if let Some(dw) = gradients.w {
            collect(dw, 0);
        }
        if let Some(db) = gradients.bias.filter(|_| wanted[1]) {
            collect(db, k * n);
        }
    });
}
