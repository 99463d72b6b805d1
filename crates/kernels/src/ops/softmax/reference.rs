//! Row by row in f64.

use super::Targets;

/// `ln softmax(x)` of rows of `n`.
pub fn log_softmax(n: usize, x: &[f64]) -> Vec<f64> {
    let mut out = Vec::with_capacity(x.len());
    for row in x.chunks(n.max(1)) {
        let most = row.iter().fold(f64::NEG_INFINITY, |a, b| a.max(*b));
        let total = most + row.iter().map(|v| (v - most).exp()).sum::<f64>().ln();
        out.extend(row.iter().map(|v| v - total));
    }
    out
}

/// `softmax(x)` of rows of `n`.
pub fn softmax(n: usize, x: &[f64]) -> Vec<f64> {
    log_softmax(n, x).into_iter().map(f64::exp).collect()
}

/// Gradient of the input of [`softmax`], given its output `y`: `y (d − Σ d y)`.
pub fn softmax_backward(n: usize, y: &[f64], d: &[f64]) -> Vec<f64> {
    let mut out = Vec::with_capacity(y.len());
    for (y, d) in y.chunks(n.max(1)).zip(d.chunks(n.max(1))) {
        let dot: f64 = y.iter().zip(d).map(|(y, d)| y * d).sum();
        out.extend(y.iter().zip(d).map(|(y, d)| y * (d - dot)));
    }
    out
}

/// Gradient of the input of [`log_softmax`], given its output `l`: `d − eˡ Σ d`.
pub fn log_softmax_backward(n: usize, l: &[f64], d: &[f64]) -> Vec<f64> {
    let mut out = Vec::with_capacity(l.len());
    for (l, d) in l.chunks(n.max(1)).zip(d.chunks(n.max(1))) {
        let sum: f64 = d.iter().sum();
        out.extend(l.iter().zip(d).map(|(l, d)| d - l.exp() * sum));
    }
    out
}

/// Mean cross entropy over the rows that count; NaN where none does.
pub fn cross_entropy(n: usize, x: &[f64], targets: &Targets) -> f64 {
    let epsilon = targets.smoothing as f64;
    let mut sum = 0.0;
    for (l, class) in log_softmax(n, x).chunks(n.max(1)).zip(targets.classes) {
        if *class != targets.ignored {
            sum -= (1.0 - epsilon) * l[*class as usize] + epsilon / n as f64 * l.iter().sum::<f64>();
        }
    }
    sum / targets.counted() as f64
}

/// Gradient of [`cross_entropy`] with respect to the logits.
pub fn cross_entropy_backward(n: usize, x: &[f64], targets: &Targets) -> Vec<f64> {
    let (epsilon, counted) = (targets.smoothing as f64, targets.counted() as f64);
    let mut out = softmax(n, x);
    for (row, class) in out.chunks_mut(n.max(1)).zip(targets.classes) {
        for (k, v) in row.iter_mut().enumerate() {
            let wanted = epsilon / n as f64 + if *class == k as i64 { 1.0 - epsilon } else { 0.0 };
            *v = if *class == targets.ignored { 0.0 } else { (*v - wanted) / counted };
        }
    }
    out
}
