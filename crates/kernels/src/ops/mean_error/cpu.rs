//! Blocks of elements in parallel; sums per block in f64, added in order.

use super::Error;
use crate::math::multiversion;
use crate::tasks::{self, Parts};

/// Elements per task, whose sum is one term: fixed, so that results do not depend on threads.
const BLOCK: usize = 1 << 13;
/// Sums that run side by side within a block.
const LANES: usize = 16;

multiversion! {
    fn block_sum(kind: Error, x: &[f32], y: &[f32]) -> f64 {
        let mut lanes = [0.0f32; LANES];
        let term = |x: f32, y: f32| {
            let e = x - y;
            match kind {
                Error::Squared => e * e,
                Error::Absolute => e.abs(),
                Error::Huber(d) => {
                    let near = e.abs().min(d);
                    near * (e.abs() - 0.5 * near)
                }
            }
        };
        let (xs, ys) = (x.as_chunks::<LANES>(), y.as_chunks::<LANES>());
        for (x, y) in xs.0.iter().zip(ys.0) {
            for l in 0..LANES {
                lanes[l] += term(x[l], y[l]);
            }
        }
        let rest: f64 = xs.1.iter().zip(ys.1).map(|(x, y)| term(*x, *y) as f64).sum();
        lanes.iter().map(|v| *v as f64).sum::<f64>() + rest
    }
}

multiversion! {
    fn block_gradient(kind: Error, x: &[f32], y: &[f32], scale: f32, out: &mut [f32]) {
        for ((o, x), y) in out.iter_mut().zip(x).zip(y) {
            let e = x - y;
            *o = scale * match kind {
                Error::Squared => 2.0 * e,
                Error::Absolute => (e > 0.0) as u8 as f32 - (e < 0.0) as u8 as f32,
                Error::Huber(d) => e.clamp(-d, d),
            };
        }
    }
}

/// The mean error; 0 of nothing.
pub fn forward(kind: Error, x: &[f32], y: &[f32]) -> f32 {
    assert_eq!(x.len(), y.len(), "mean error: shapes");
    let mut sums = vec![0.0f64; x.len().div_ceil(BLOCK)];
    let parts = Parts::new(&mut sums);
    tasks::run(x.len().div_ceil(BLOCK), x.len(), |i| {
        let span = i * BLOCK..((i + 1) * BLOCK).min(x.len());
        // SAFETY: each task has an element of its own.
        let sum = unsafe { parts.chunk(i, 1) };
        sum[0] = block_sum(kind, &x[span.clone()], &y[span]);
    });
    (sums.iter().sum::<f64>() / x.len().max(1) as f64) as f32
}

/// The gradient of x, given that of the mean; y's is its negative.
pub fn backward(kind: Error, x: &[f32], y: &[f32], d: f32, dx: &mut [f32]) {
    assert!(x.len() == y.len() && x.len() == dx.len(), "mean error: shapes");
    let (n, parts) = (dx.len(), Parts::new(dx));
    let scale = d / n.max(1) as f32;
    tasks::run(n.div_ceil(BLOCK), n, |i| {
        // SAFETY: each task has a chunk of its own.
        let out = unsafe { parts.chunk(i, BLOCK) };
        let span = i * BLOCK..i * BLOCK + out.len();
        block_gradient(kind, &x[span.clone()], &y[span], scale, out);
    });
}
