//! One ray after the other in f64.

use super::Jitter;
use crate::ops::sample_pdf;

/// Edges of intervals `[R, n + 1]` for rays between near and far `[R, 2]`.
pub fn stratified(near_far: &[f32], n: usize, jitter: Jitter) -> Vec<f64> {
    let mut edges = Vec::new();
    for (r, span) in near_far.chunks_exact(2).enumerate() {
        let (near, far) = (span[0] as f64, span[1] as f64);
        let place = |i: usize| {
            let u = jitter.map_or(0.5, |(rng, first)| rng.uniform((first + r as u64) * n as u64 + i as u64) as f64);
            near + (i as f64 + u) * (far - near) / n as f64
        };
        edges.push(near);
        edges.extend((1..n).map(|i| 0.5 * (place(i - 1) + place(i))));
        edges.push(far);
    }
    edges
}

/// Edges `[R, n + m + 1]`: those given `[R, n + 1]`, and `m` more where `weights` `[R, n]` are high.
pub fn refine(edges: &[f64], weights: &[f64], n: usize, m: usize, jitter: Jitter) -> Vec<f64> {
    let rays = edges.len() / (n + 1);
    let quantile = |i: usize| {
        let u = jitter.map_or(0.5, |(rng, first)| rng.uniform(first * m as u64 + i as u64) as f64);
        ((i % m) as f64 + u) / m as f64
    };
    let u: Vec<f64> = (0..rays * m).map(quantile).collect();
    let fine = sample_pdf::reference::sample(n, edges, weights, m, &u);
    let mut out = Vec::new();
    for r in 0..rays {
        let mut all = [&edges[r * (n + 1)..(r + 1) * (n + 1)], &fine[r * m..(r + 1) * m]].concat();
        all.sort_by(f64::total_cmp);
        out.extend(all);
    }
    out
}
