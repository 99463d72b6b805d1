//! Linear time through prefix sums: for sorted midpoints
//! `Σ_j w_j |m_i − m_j| = m_i (2 W_i − W) − (2 M_i − M)` with running sums `W_i = Σ_{j≤i} w_j`, `M_i = Σ_{j≤i} w_j m_j`.

use super::normalized_distance;
use crate::ops::composite::Packed;
use rayon::prelude::*;

/// Samples per task.
const TASK: usize = 1 << 12;

/// Starts `[S]` and lengths `[S]` of samples in [`normalized_distance`].
pub fn normalize(p: &Packed, s: &mut Vec<f32>, ds: &mut Vec<f32>) {
    s.resize(p.samples(), 0.0);
    ds.resize(p.samples(), 0.0);
    let out = s.par_chunks_mut(TASK).zip(ds.par_chunks_mut(TASK));
    out.zip(p.t.par_chunks(TASK).zip(p.dt.par_chunks(TASK))).for_each(|((s, ds), (t, dt))| {
        for i in 0..s.len() {
            s[i] = normalized_distance(t[i]);
            // s(t + δ) − s(t) without a difference of close numbers.
            ds[i] = 4.0 * dt[i] / ((1.0 + t[i]) * (1.0 + t[i] + dt[i]));
        }
    });
}

/// Loss of ray `r`, whose samples have weights `w`; adds `scale · ∂loss/∂w` to `g` unless it is empty.
pub fn ray(p: &Packed, r: usize, w: &[f32], scale: f32, g: &mut [f32]) -> f32 {
    let span = p.range(r);
    let (t, dt) = (&p.t[span.clone()], &p.dt[span]);
    // Midpoints relative to the first keep the differences exact in f32.
    let origin = t.first().copied().unwrap_or(0.0);
    let mid = |i: usize| (t[i] - origin) + 0.5 * dt[i];
    let (mut total_w, mut total_m) = (0.0f32, 0.0f32);
    for i in 0..w.len() {
        total_w += w[i];
        total_m += w[i] * mid(i);
    }
    let (mut sum_w, mut sum_m, mut loss) = (0.0f32, 0.0f32, 0.0f32);
    for i in 0..w.len() {
        sum_w += w[i];
        sum_m += w[i] * mid(i);
        let pairs = mid(i) * (2.0 * sum_w - total_w) - (2.0 * sum_m - total_m);
        loss += w[i] * (pairs + w[i] * dt[i] / 3.0);
        if !g.is_empty() {
            g[i] += scale * (2.0 * pairs + 2.0 / 3.0 * w[i] * dt[i]);
        }
    }
    loss
}
