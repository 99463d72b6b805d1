//! The double sum, in f64.

use crate::ops::composite::Packed;

fn mid(p: &Packed, i: usize) -> f64 {
    p.t[i] as f64 + 0.5 * p.dt[i] as f64
}

/// Loss per ray.
pub fn forward(p: &Packed, w: &[f64]) -> Vec<f64> {
    (0..p.rays())
        .map(|r| {
            let pairs: f64 =
                p.range(r).flat_map(|i| p.range(r).map(move |j| (i, j))).map(|(i, j)| w[i] * w[j] * (mid(p, i) - mid(p, j)).abs()).sum();
            pairs + p.range(r).map(|i| w[i] * w[i] * p.dt[i] as f64 / 3.0).sum::<f64>()
        })
        .collect()
}

/// Gradient of the weights given that of each ray's loss.
pub fn backward(p: &Packed, w: &[f64], d: &[f64]) -> Vec<f64> {
    let mut g = vec![0.0; w.len()];
    for r in 0..p.rays() {
        for i in p.range(r) {
            let pairs: f64 = p.range(r).map(|j| w[j] * (mid(p, i) - mid(p, j)).abs()).sum();
            g[i] = d[r] * (2.0 * pairs + 2.0 / 3.0 * w[i] * p.dt[i] as f64);
        }
    }
    g
}
