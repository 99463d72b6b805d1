//! Blocks of elements, one loop per function and instruction set.

use super::Activation;
use super::functions::{Function, with_function};
use crate::tasks::{self, Parts};
use crate::vector::vectorized;

/// Elements per task.
const BLOCK: usize = 1 << 14;

vectorized! {
    /// `out = f(x)` on this thread.
    pub(crate) fn forward_block<const F>(a: Activation, x: &[f32], out: &mut [f32]) {
        with_function!(a, f => out.iter_mut().zip(x).for_each(|(o, x)| *o = f.value::<F>(*x)))
    }
}

vectorized! {
    /// `values ← f(values)` on this thread.
    pub(crate) fn forward_in_place<const F>(a: Activation, values: &mut [f32]) {
        with_function!(a, f => values.iter_mut().for_each(|v| *v = f.value::<F>(*v)))
    }
}

vectorized! {
    /// `dx = d · f′(x)` on this thread.
    pub(crate) fn backward_block<const F>(a: Activation, x: &[f32], d: &[f32], dx: &mut [f32]) {
        with_function!(a, f => dx.iter_mut().zip(x).zip(d).for_each(|((o, x), d)| *o = d * f.slope::<F>(*x)))
    }
}

vectorized! {
    /// `values ← d · f′(values)` on this thread.
    pub(crate) fn backward_in_place<const F>(a: Activation, d: &[f32], values: &mut [f32]) {
        with_function!(a, f => values.iter_mut().zip(d).for_each(|(v, d)| *v = d * f.slope::<F>(*v)))
    }
}

vectorized! {
    fn sigmoid_backward<const F>(y: &[f32], d: &[f32], dx: &mut [f32]) {
        dx.iter_mut().zip(y).zip(d).for_each(|((o, y), d)| *o = d * y * (1.0 - y));
    }
}

vectorized! {
    fn tanh_backward<const F>(y: &[f32], d: &[f32], dx: &mut [f32]) {
        dx.iter_mut().zip(y).zip(d).for_each(|((o, y), d)| *o = d * (1.0 - y * y));
    }
}

/// `dx = d · f′(x)` on this thread, with `kept` the function's input where it [needs that](Activation::needs_input), else its output.
pub(crate) fn backward_of_kept(a: Activation, kept: &[f32], d: &[f32], dx: &mut [f32]) {
    match a {
        Activation::Sigmoid => sigmoid_backward(kept, d, dx),
        Activation::Tanh => tanh_backward(kept, d, dx),
        // Output and input have one sign where the output is kept.
        _ => backward_block(a, kept, d, dx),
    }
}

/// `out = f(x)`; slices of one length.
pub fn forward(a: Activation, x: &[f32], out: &mut [f32]) {
    assert_eq!(x.len(), out.len(), "activation: shapes");
    let (n, parts) = (x.len(), Parts::new(out));
    tasks::run(n.div_ceil(BLOCK), n, |i| {
        // SAFETY: each task has a chunk of its own.
        let out = unsafe { parts.chunk(i, BLOCK) };
        forward_block(a, &x[i * BLOCK..i * BLOCK + out.len()], out);
    });
}

/// `dx = d · f′(x)`; slices of one length.
pub fn backward(a: Activation, x: &[f32], d: &[f32], dx: &mut [f32]) {
    assert!(x.len() == dx.len() && d.len() == dx.len(), "activation: shapes");
    let (n, parts) = (x.len(), Parts::new(dx));
    tasks::run(n.div_ceil(BLOCK), n, |i| {
        // SAFETY: each task has a chunk of its own.
        let dx = unsafe { parts.chunk(i, BLOCK) };
        let span = i * BLOCK..i * BLOCK + dx.len();
        backward_block(a, &x[span.clone()], &d[span], dx);
    });
}
