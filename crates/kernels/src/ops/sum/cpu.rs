//! Blocks of elements in parallel, compiled for each instruction set.

use crate::math::multiversion;
use crate::tasks::{self, Parts};

/// Elements per task.
const BLOCK: usize = 1 << 13;

multiversion! {
    fn add_block(a: &[f32], b: &[f32], out: &mut [f32]) {
        out.iter_mut().zip(a).zip(b).for_each(|((o, a), b)| *o = a + b);
    }
}

multiversion! {
    fn add_relu_block(a: &[f32], b: &[f32], out: &mut [f32]) {
        out.iter_mut().zip(a).zip(b).for_each(|((o, a), b)| *o = (a + b).max(0.0));
    }
}

multiversion! {
    fn mask_block(y: &[f32], d: &[f32], out: &mut [f32]) {
        out.iter_mut().zip(y).zip(d).for_each(|((o, y), d)| *o = if *y > 0.0 { *d } else { 0.0 });
    }
}

/// Runs a block function over two inputs.
fn blocks(a: &[f32], b: &[f32], out: &mut [f32], block: fn(&[f32], &[f32], &mut [f32])) {
    assert!(a.len() == out.len() && b.len() == out.len(), "sum: shapes");
    let (n, parts) = (out.len(), Parts::new(out));
    tasks::run(n.div_ceil(BLOCK), n, |i| {
        // SAFETY: each task has a chunk of its own.
        let out = unsafe { parts.chunk(i, BLOCK) };
        let span = i * BLOCK..i * BLOCK + out.len();
        block(&a[span.clone()], &b[span], out);
    });
}

/// `out = a + b`, at least 0 where `relu` says so; slices of one length.
pub fn forward(a: &[f32], b: &[f32], relu: bool, out: &mut [f32]) {
    blocks(a, b, out, if relu { add_relu_block } else { add_block });
}

/// The gradient of both terms of a sum with ReLU, given its output `y`.
pub fn backward_relu(y: &[f32], d: &[f32], out: &mut [f32]) {
    blocks(y, d, out, mask_block);
}
