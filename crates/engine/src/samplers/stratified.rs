//! Samples without an occupancy grid: one per equal interval (Mildenhall et al. 2020, equation 2), and their union with samples drawn
//! from the weights of a coarse pass.

use super::RayBatch;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::march::Marched;
use diorama_kernels::ops::sample_pdf;

/// `n` jittered samples per ray between near and far; intervals reach from midpoint to midpoint.
///
/// With `rng` absent, samples lie in the middle of their intervals.
pub fn stratified(batch: &RayBatch, n: usize, rng: Option<(Rng, u64)>, out: &mut Marched) {
    start(batch.len(), n, out);
    for r in 0..batch.len() {
        let (near, far) = (batch.near_far[r * 2], batch.near_far[r * 2 + 1]);
        let step = (far - near) / n as f32;
        let point = |i: usize| {
            let u = rng.map_or(0.5, |(rng, first)| rng.uniform((first + r as u64) * n as u64 + i as u64));
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

/// Intervals whose edges are the coarse ones' and `m` more where `weights` are high.
pub fn refine(coarse: &Marched, weights: &[f32], n: usize, m: usize, rng: Option<(Rng, u64)>, out: &mut Marched) {
    let rays = coarse.offsets.len() - 1;
    let mut edges = Vec::with_capacity(rays * (n + 1));
    for r in 0..rays {
        edges.extend_from_slice(&coarse.t[r * n..(r + 1) * n]);
        edges.push(coarse.t[(r + 1) * n - 1] + coarse.dt[(r + 1) * n - 1]);
    }
    let u: Vec<f32> = (0..rays * m)
        .map(|i| {
            let jitter = rng.map_or(0.5, |(rng, first)| rng.uniform(first * m as u64 + i as u64));
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

#[cfg(test)]
mod tests {
    use super::*;

    fn batch() -> RayBatch {
        let mut b = RayBatch::default();
        b.resize(3);
        b.near_far = vec![1.0, 2.0, 0.5, 4.0, 0.0, 0.0];
        b
    }

    #[test]
    fn intervals_cover_near_to_far_without_gaps() {
        let mut coarse = Marched::default();
        stratified(&batch(), 8, Some((Rng::new(1, 1), 0)), &mut coarse);
        let mut fine = Marched::default();
        let mut w = vec![0.0; 24];
        w[11] = 1.0;
        refine(&coarse, &w, 8, 16, Some((Rng::new(1, 2), 0)), &mut fine);
        for (m, n) in [(&coarse, 8), (&fine, 24)] {
            for r in 0..2 {
                let span = r * n..(r + 1) * n;
                let total: f32 = m.dt[span.clone()].iter().sum();
                let (near, far) = (batch().near_far[r * 2], batch().near_far[r * 2 + 1]);
                assert!((m.t[r * n] - near).abs() < 1e-6 && (total - (far - near)).abs() < 1e-4);
                assert!(m.dt[span].iter().all(|d| *d >= 0.0));
            }
        }
        // Most new samples of ray 1 fall into its fourth interval.
        let (a, b) = (coarse.t[11], coarse.t[11] + coarse.dt[11]);
        assert!(fine.t[24..48].iter().filter(|t| (a..=b).contains(*t)).count() >= 14);
    }
}
