//! Rows on their own: largest value, exponentials with their sum, division.

use super::Targets;
use crate::sums;
use crate::tasks::{self, Parts};
use crate::vector::{exp, fma, vectorized};

/// Elements per task, about.
const BLOCK: usize = 1 << 14;

fn rows_per_task(n: usize) -> usize {
    (BLOCK / n.max(1)).max(1)
}

/// `values ← e^(values − shift)`; returns their sum. To be called from a function compiled for the instruction set.
#[inline(always)]
pub(crate) fn exponentials<const F: bool>(shift: f32, values: &mut [f32]) -> f32 {
    let mut lanes = [0.0f32; sums::LANES];
    let mut blocks = values.chunks_exact_mut(sums::LANES);
    for block in &mut blocks {
        for (lane, v) in lanes.iter_mut().zip(block) {
            *v = exp::<F>(*v - shift);
            *lane += *v;
        }
    }
    let mut tail = 0.0;
    for v in blocks.into_remainder() {
        *v = exp::<F>(*v - shift);
        tail += *v;
    }
    sums::fold(lanes) + tail
}

vectorized! {
    fn softmax_rows<const F>(n: usize, x: &[f32], out: &mut [f32]) {
        for (row, x) in out.chunks_exact_mut(n).zip(x.chunks_exact(n)) {
            row.copy_from_slice(x);
            let scale = 1.0 / exponentials::<F>(sums::most(x), row);
            row.iter_mut().for_each(|v| *v *= scale);
        }
    }
}

vectorized! {
    fn log_softmax_rows<const F>(n: usize, x: &[f32], out: &mut [f32]) {
        for (row, x) in out.chunks_exact_mut(n).zip(x.chunks_exact(n)) {
            let most = sums::most(x);
            row.copy_from_slice(x);
            let total = most + exponentials::<F>(most, row).ln();
            row.iter_mut().zip(x).for_each(|(v, x)| *v = x - total);
        }
    }
}

vectorized! {
    fn softmax_rows_backward<const F>(n: usize, y: &[f32], d: &[f32], dx: &mut [f32]) {
        for ((row, y), d) in dx.chunks_exact_mut(n).zip(y.chunks_exact(n)).zip(d.chunks_exact(n)) {
            let dot = sums::dot::<F>(y, d);
            row.iter_mut().zip(y).zip(d).for_each(|((o, y), d)| *o = y * (d - dot));
        }
    }
}

vectorized! {
    fn log_softmax_rows_backward<const F>(n: usize, l: &[f32], d: &[f32], dx: &mut [f32]) {
        for ((row, l), d) in dx.chunks_exact_mut(n).zip(l.chunks_exact(n)).zip(d.chunks_exact(n)) {
            let sum = sums::sum(d);
            row.iter_mut().zip(l).zip(d).for_each(|((o, l), d)| *o = d - exp::<F>(*l) * sum);
        }
    }
}

vectorized! {
    /// `(e^l − target) · scale`, with the targets' smoothed shares.
    fn cross_entropy_rows_backward<const F>(n: usize, l: &[f32], classes: &[i64], t: &Targets, scale: f32, dx: &mut [f32]) {
        for ((row, l), class) in dx.chunks_exact_mut(n).zip(l.chunks_exact(n)).zip(classes) {
            if *class == t.ignored {
                row.fill(0.0);
                continue;
            }
            let spread = t.smoothing / n as f32;
            row.iter_mut().zip(l).for_each(|(o, l)| *o = scale * (exp::<F>(*l) - spread));
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

vectorized! {
    /// Loss of each row that counts, 0 of the others.
    fn cross_entropy_rows<const F>(n: usize, l: &[f32], classes: &[i64], t: &Targets, losses: &mut [f32]) {
        for ((loss, l), class) in losses.iter_mut().zip(l.chunks_exact(n)).zip(classes) {
            *loss = 0.0;
            if *class != t.ignored {
                let spread = if t.smoothing > 0.0 { t.smoothing / n as f32 * sums::sum(l) } else { 0.0 };
                *loss = -fma::<F>(1.0 - t.smoothing, l[*class as usize], spread);
            }
        }
    }
}

/// Mean cross entropy over the rows that count, NaN where none does; writes `ln softmax(x)`, which backward needs, and each
/// row's loss.
///
/// # Shapes
/// x, log_probabilities `[M, n]`, classes, losses `[M]`.
///
/// # Panics
/// When a class that is not ignored is not in `0..n`.
pub fn cross_entropy(n: usize, x: &[f32], targets: &Targets, log_probabilities: &mut [f32], losses: &mut [f32]) -> f32 {
    let classes = targets.classes;
    assert!(x.len() == classes.len() * n && log_probabilities.len() == x.len() && losses.len() == classes.len(), "cross entropy: shapes");
    if let Some(class) = classes.iter().find(|c| **c != targets.ignored && !(0..n as i64).contains(c)) {
        panic!("cross entropy: class {class} of {n}");
    }
    let per_task = rows_per_task(n);
    let (l, parts) = (Parts::new(log_probabilities), Parts::new(losses));
    tasks::run(if n == 0 { 0 } else { classes.len().div_ceil(per_task) }, x.len(), |task| {
        let rows = task * per_task..((task + 1) * per_task).min(classes.len());
        let span = rows.start * n..rows.end * n;
        // SAFETY: each task has rows of its own.
        let (l, losses) = unsafe { (l.range(span.clone()), parts.range(rows.clone())) };
        log_softmax_rows(n, &x[span], l);
        cross_entropy_rows(n, l, &classes[rows], targets, losses);
    });
    (losses.iter().map(|l| *l as f64).sum::<f64>() / targets.counted() as f64) as f32
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
