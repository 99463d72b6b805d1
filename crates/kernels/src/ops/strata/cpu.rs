//! One ray after the other.

use super::Jitter;
use crate::ops::march::Marched;
use crate::ops::sample_pdf;

/// `n` samples per ray between near and far `[R, 2]`.
pub fn stratified(near_far: &[f32], n: usize, jitter: Jitter, out: &mut Marched) {
    start(near_far.len() / 2, n, out);
    for r in 0..near_far.len() / 2 {
        let (near, far) = (near_far[r * 2], near_far[r * 2 + 1]);
        let step = (far - near) / n as f32;
        let point = |i: usize| {
            let u = jitter.map_or(0.5, |(rng, first)| rng.uniform((first + r as u64) * n as u64 + i as u64));
            near + (i as f32 + u) * step
        };
        let mut t = near;
        for i in 0..n {
            // The interval around point i ends half way to point i + 1.
            let end = if i + 1 < n { 0.5 * (point(i) + point(i + 1)) } else { far };
            out.t.push(t);
            out.dt.push(end - t);
            t = end;
        }
    }
}

/// Intervals whose edges are those of `n` coarse ones per ray and `m` more where `weights` `[R, n]` are high.
pub fn refine(coarse: &Marched, weights: &[f32], n: usize, m: usize, jitter: Jitter, out: &mut Marched) {
    let rays = coarse.offsets.len() - 1;
    let mut edges = Vec::with_capacity(rays * (n + 1));
    for r in 0..rays {
        edges.extend_from_slice(&coarse.t[r * n..(r + 1) * n]);
        edges.push(coarse.t[(r + 1) * n - 1] + coarse.dt[(r + 1) * n - 1]);
    }
    let u: Vec<f32> = (0..rays * m)
        .map(|i| {
            let jitter = jitter.map_or(0.5, |(rng, first)| rng.uniform(first * m as u64 + i as u64));
            ((i % m) as f32 + jitter) / m as f32
        })
        .collect();
    let mut fine = vec![0.0; rays * m];
    sample_pdf::cpu::sample(n, &edges, weights, m, &u, &mut fine);
    start(rays, n + m, out);
    let mut all = Vec::with_capacity(n + m + 1);
    for r in 0..rays {
        all.clear();
        all.extend_from_slice(&edges[r * (n + 1)..(r + 1) * (n + 1)]);
        all.extend_from_slice(&fine[r * m..(r + 1) * m]);
        all.sort_unstable_by(f32::total_cmp);
        for w in all.windows(2) {
            out.t.push(w[0]);
            out.dt.push(w[1] - w[0]);
        }
    }
}

fn start(rays: usize, per_ray: usize, out: &mut Marched) {
    out.t.clear();
    out.dt.clear();
    out.offsets.clear();
    out.offsets.extend((0..=rays).map(|r| (r * per_ray) as u32));
}
