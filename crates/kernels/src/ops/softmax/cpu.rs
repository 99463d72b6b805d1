//! Rows on their own: largest value, exponentials with their sum, division.

use super::Targets;
use crate::math::{exp, multiversion};
use crate::sums;
use crate::tasks::{self, Parts};

/// Elements per task, about.
const BLOCK: usize = 1 << 14;

fn rows_per_task(n: usize) -> usize {
    (BLOCK / n.max(1)).max(1)
}

/// `values ← e^(values − shift)`; returns their sum. To be called from a function compiled for the instruction set.
#[inline(always)]
pub(crate) fn exponentials(shift: f32, values: &mut [f32]) -> f32 {
    let mut lanes = [0.0f32; sums::LANES];
    let mut blocks = values.chunks_exact_mut(sums::LANES);
    for block in &mut blocks {
        for (lane, v) in lanes.iter_mut().zip(block) {
            *v = exp(*v - shift);
            *lane += *v;
        }
    }
    let mut tail = 0.0;
    for v in blocks.into_remainder() {
        *v = exp(*v - shift);
        tail += *v;
    }
    sums::fold(lanes) + tail
}

multiversion! {
    fn softmax_rows(n: usize, x: &[f32], out: &mut [f32]) {
        for (row, x) in out.chunks_exact_mut(n).zip(x.chunks_exact(n)) {
            row.copy_from_slice(x);
            let scale = 1.0 / exponentials(sums::most(x), row);
            row.iter_mut().for_each(|v| *v *= scale);
        }
    }
}

multiversion! {
    fn log_softmax_rows(n: usize, x: &[f32], out: &mut [f32]) {
        for (row, x) in out.chunks_exact_mut(n).zip(x.chunks_exact(n)) {
            let most = sums::most(x);
            row.copy_from_slice(x);
            let total = most + exponentials(most, row).ln();
            row.iter_mut().zip(x).for_each(|(v, x)| *v = x - total);
        }
    }
}

multiversion! {
    fn softmax_rows_backward(n: usize, y: &[f32], d: &[f32], dx: &mut [f32]) {
        for ((row, y), d) in dx.chunks_exact_mut(n).zip(y.chunks_exact(n)).zip(d.chunks_exact(n)) {
            let dot = sums::dot(y, d);
            row.iter_mut().zip(y).zip(d).for_each(|((o, y), d)| *o = y * (d - dot));
        }
    }
}

multiversion! {
    fn log_softmax_rows_backward(n: usize, l: &[f32], d: &[f32], dx: &mut [f32]) {
        for ((row, l), d) in dx.chunks_exact_mut(n).zip(l.chunks_exact(n)).zip(d.chunks_exact(n)) {
            let sum = sums::sum(d);
            row.iter_mut().zip(l).zip(d).for_each(|((o, l), d)| *o = d - exp(*l) * sum);
        }
    }
}

multiversion! {
    /// `(e^l − target) · scale`, with the targets' smoothed shares.
    fn cross_entropy_rows_backward(n: usize, l: &[f32], classes: &[i64], t: &Targets, scale: f32, dx: &mut [f32]) {
        for ((row, l), class) in dx.chunks_exact_mut(n).zip(l.chunks_exact(n)).zip(classes) {
            if *class == t.ignored {
                row.fill(0.0);
                continue;
            }
            let spread = t.smoothing / n as f32;
            row.iter_mut().zip(l).for_each(|(o, l)| *o = scale * (exp(*l) - spread));
            row[*class as usize] -= scale * (1.0 - t.smoothing);
        }
    }
}

/// Runs `rows` on blocks of whole rows: (first element, block of `out`).
fn by_rows(n: usize, out: &mut [f32], rows: impl Fn(usize, &mut [f32]) + Sync) {
    if n == 0 {
        return;
    }
    assert!(out.len().is_multiple_of(n), "softmax: {} elements are no rows of {n}", out.len());
    let (total, size, parts) = (out.len(), rows_per_task(n) * n, Parts::new(out));
    tasks::run(total.div_ceil(size), total, |i| {
        // SAFETY: each task has a chunk of its own.
        rows(i * size, unsafe { parts.chunk(i, size) });
    });
}

/// `out = softmax(x)` of rows.
///
/// # Shapes
/// x, out `[M, n]`.
pub fn softmax(n: usize, x: &[f32], out: &mut [f32]) {
    assert_eq!(x.len(), out.len(), "softmax: shapes");
    by_rows(n, out, |first, out| softmax_rows(n, &x[first..first + out.len()], out));
}

/// `out = ln softmax(x)` of rows.
///
/// # Shapes
/// x, out `[M, n]`.
pub fn log_softmax(n: usize, x: &[f32], out: &mut [f32]) {
    assert_eq!(x.len(), out.len(), "softmax: shapes");
    by_rows(n, out, |first, out| log_softmax_rows(n, &x[first..first + out.len()], out));
}

/// Gradient of the input of [`softmax`], given its output `y`.
///
/// # Shapes
/// y, d, dx `[M, n]`.
pub fn softmax_backward(n: usize, y: &[f32], d: &[f32], dx: &mut [f32]) {
    assert!(y.len() == dx.len() && d.len() == dx.len(), "softmax: shapes");
    by_rows(n, dx, |first, dx| softmax_rows_backward(n, &y[first..first + dx.len()], &d[first..first + dx.len()], dx));
}

/// Gradient of the input of [`log_softmax`], given its output `l`.
///
/// # Shapes
/// l, d, dx `[M, n]`.
pub fn log_softmax_backward(n: usize, l: &[f32], d: &[f32], dx: &mut [f32]) {
    assert!(l.len() == dx.len() && d.len() == dx.len(), "softmax: shapes");
    by_rows(n, dx, |first, dx| log_softmax_rows_backward(n, &l[first..first + dx.len()], &d[first..first + dx.len()], dx));
}

/// Mean cross entropy over the rows that count, NaN where none does; writes `ln softmax(x)`, which backward needs.
///
/// # Shapes
/// x, log_probabilities `[M, n]`, classes `[M]`.
///
/// # Panics
/// When a class that is not ignored is not in `0..n`.
pub fn cross_entropy(n: usize, x: &[f32], targets: &Targets, log_probabilities: &mut [f32]) -> f32 {
    assert_eq!(x.len(), targets.classes.len() * n, "cross entropy: shapes");
    log_softmax(n, x, log_probabilities);
    let (epsilon, mut sum) = (targets.smoothing as f64, 0.0f64);
    for (l, class) in log_probabilities.chunks_exact(n.max(1)).zip(targets.classes) {
        if *class == targets.ignored {
            continue;
        }
        assert!((0..n as i64).contains(class), "cross entropy: class {class} of {n}");
        sum -= (1.0 - epsilon) * l[*class as usize] as f64;
        if epsilon > 0.0 {
            sum -= epsilon / n as f64 * l.iter().map(|v| *v as f64).sum::<f64>();
        }
    }
    (sum / targets.counted() as f64) as f32
}

/// Gradient of the logits from that of the loss, given what [`cross_entropy`] wrote.
///
/// # Shapes
/// log_probabilities, dx `[M, n]`.
pub fn cross_entropy_backward(n: usize, log_probabilities: &[f32], targets: &Targets, d: f32, dx: &mut [f32]) {
    assert!(log_probabilities.len() == dx.len() && dx.len() == targets.classes.len() * n, "cross entropy: shapes");
    let scale = d / targets.counted() as f32;
    by_rows(n, dx, |first, dx| {
        let classes = &targets.classes[first / n..(first + dx.len()) / n];
        cross_entropy_rows_backward(n, &log_probabilities[first..first + dx.len()], classes, targets, scale, dx);
    });
}
