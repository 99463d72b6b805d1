//! Inverts the cumulative distribution per ray by a linear search that continues from the bin before as long as `u` increases.

use super::FLOOR;
use rayon::prelude::*;

/// Fills `out` `[R, M]`.
///
/// # Shapes
/// edges `[R, n + 1]`, weights `[R, n]`, u `[R, m]`.
pub fn sample(n: usize, edges: &[f32], weights: &[f32], m: usize, u: &[f32], out: &mut [f32]) {
    assert!(n > 0 && out.len() == u.len() && weights.len() * m == u.len() * n, "sample pdf: shapes");
    if m == 0 {
        return;
    }
    let rays = out.par_chunks_mut(m).zip(u.par_chunks(m)).zip(weights.par_chunks(n).zip(edges.par_chunks(n + 1)));
    rays.with_min_len(32).for_each(|((out, u), (w, edges))| {
        let total: f64 = w.iter().map(|w| (w + FLOOR) as f64).sum();
        let (mut i, mut before, mut last) = (0, 0.0f64, f32::NEG_INFINITY);
        for (o, &x) in out.iter_mut().zip(u) {
            if x < last {
                (i, before) = (0, 0.0);
            }
            last = x;
            let target = x as f64 * total;
            while i + 1 < n && target - before > (w[i] + FLOOR) as f64 {
                before += (w[i] + FLOOR) as f64;
                i += 1;
            }
            let f = ((target - before) / (w[i] + FLOOR) as f64).clamp(0.0, 1.0) as f32;
            *o = edges[i] + (edges[i + 1] - edges[i]) * f;
        }
    });
}
