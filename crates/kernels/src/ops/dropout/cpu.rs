//! Blocks of elements; the random bits of an element are computed where they are needed.

use super::Dropout;
use crate::math::multiversion;
use crate::tasks::{self, Parts};

/// Elements per task.
const BLOCK: usize = 1 << 14;

multiversion! {
    fn block(dropout: &Dropout, first: u64, x: &[f32], out: &mut [f32]) {
        let scale = 1.0 / (1.0 - dropout.p);
        for (i, (o, x)) in out.iter_mut().zip(x).enumerate() {
            let kept = dropout.rng.uniform(first.wrapping_add(i as u64)) >= dropout.p;
            *o = if kept { x * scale } else { 0.0 };
        }
    }
}

/// Forward of `x`, or backward of the output's gradient; slices of one length.
///
/// # Panics
/// When `p` is not in 0..1.
pub fn apply(dropout: &Dropout, x: &[f32], out: &mut [f32]) {
    assert_eq!(x.len(), out.len(), "dropout: shapes");
    assert!((0.0..1.0).contains(&dropout.p), "dropout: p is {}", dropout.p);
    let (n, parts) = (x.len(), Parts::new(out));
    tasks::run(n.div_ceil(BLOCK), n, |i| {
        // SAFETY: each task has a chunk of its own.
        let out = unsafe { parts.chunk(i, BLOCK) };
        let first = i * BLOCK;
        block(dropout, dropout.first.wrapping_add(first as u64), &x[first..first + out.len()], out);
    });
}
