//! Plain loops in f64.

use super::FLOOR;

/// Distances `[R, M]` for edges `[R, N + 1]`, weights `[R, N]` and numbers `u` `[R, M]` in [0, 1).
pub fn sample(n: usize, edges: &[f64], weights: &[f64], m: usize, u: &[f64]) -> Vec<f64> {
    let mut out = Vec::new();
    for r in 0..u.len() / m.max(1) {
        let w: Vec<f64> = weights[r * n..(r + 1) * n].iter().map(|w| w + FLOOR as f64).collect();
        let total: f64 = w.iter().sum();
        for x in &u[r * m..(r + 1) * m] {
            let mut rest = x * total;
            let mut i = 0;
            while i + 1 < n && rest > w[i] {
                rest -= w[i];
                i += 1;
            }
            let (a, b) = (edges[r * (n + 1) + i], edges[r * (n + 1) + i + 1]);
            out.push(a + (b - a) * (rest / w[i]).min(1.0));
        }
    }
    out
}
