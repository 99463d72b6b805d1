//! One unit per sample, or per ray where coarse and new edges are merged. The random numbers are the CPU's.

use super::Jitter;
use crate::gpu::random::{Wide, halves, key, sum, uniform, widened};
use crate::gpu::{Buffer, Gpu, launch};
use crate::ops::composite::gpu::GpuPacked;
use crate::ops::sample_pdf::gpu::sample;
use cubecl::prelude::*;
use diorama_geom::rng::Rng;

/// Key and first counter, for a launch.
fn numbers(jitter: Jitter, per_ray: usize) -> [u32; 4] {
    let (rng, first) = jitter.unwrap_or((Rng::new(0, 0), 0));
    let ((key_high, key_low), (high, low)) = (key(&rng), halves(first.wrapping_mul(per_ray as u64)));
    [key_high, key_low, high, low]
}

/// `n` jittered samples per ray between near and far `[R, 2]`; intervals reach from midpoint to midpoint.
pub fn stratified(gpu: &Gpu, near_far: &Buffer, n: usize, jitter: Jitter) -> GpuPacked {
    let rays = near_far.len() / 2;
    let p = GpuPacked { offsets: gpu.empty(rays + 1), t: gpu.empty(rays * n), dt: gpu.empty(rays * n) };
    let [key_high, key_low, high, low] = numbers(jitter, n);
    launch!(
        gpu,
        spread,
        rays * n + 1,
        [near_far => rays * 2, p.offsets => rays + 1, p.t => rays * n, p.dt => rays * n],
        rays as u32,
        n as u32,
        key_high,
        key_low,
        high,
        low,
        jitter.is_some(),
    );
    p
}

/// Intervals whose edges are those of `n` coarse ones per ray and `m` more where `weights` `[R, n]` are high.
pub fn refine(gpu: &Gpu, coarse: &GpuPacked, weights: &Buffer, n: usize, m: usize, jitter: Jitter) -> GpuPacked {
    let rays = coarse.rays();
    let (n_edges, n_fine, n_all) = (rays * (n + 1), rays * m, rays * (n + m));
    let (edges, u) = (gpu.empty(n_edges), gpu.empty(n_fine));
    let p = GpuPacked { offsets: gpu.empty(rays + 1), t: gpu.empty(n_all), dt: gpu.empty(n_all) };
    let [key_high, key_low, high, low] = numbers(jitter, m);
    launch!(
        gpu,
        bounds,
        n_edges,
        [coarse.t => rays * n, coarse.dt => rays * n, edges => n_edges],
        n_edges as u32,
        n as u32,
    );
    launch!(gpu, spread_quantiles, n_fine, [u => n_fine], n_fine as u32, m as u32, key_high, key_low, high, low, jitter.is_some());
    let fine = sample(gpu, n, &edges, weights, m, &u);
    launch!(
        gpu,
        merge,
        rays + 1,
        [edges => n_edges, fine => n_fine, p.offsets => rays + 1, p.t => n_all, p.dt => n_all],
        rays as u32,
        n as u32,
        m as u32,
    );
    p
}

#[cube]
fn point(near: f32, step: f32, i: usize, at: usize, key: &Wide, base: &Wide, #[comptime] jittered: bool) -> f32 {
    let mut u = 0.5f32;
    if comptime!(jittered) {
        u = uniform(key, &sum(base, &widened(u32::cast_from(at))));
    }
    near + (f32::cast_from(i) + u) * step
}

#[cube(launch_unchecked)]
fn spread(
    near_far: &[f32],
    offsets: &mut [u32],
    t: &mut [f32],
    dt: &mut [f32],
    rays: u32,
    per_ray: u32,
    key_high: u32,
    key_low: u32,
    high: u32,
    low: u32,
    #[comptime] jittered: bool,
) {
    let unit = ABSOLUTE_POS;
    let n = per_ray as usize;
    let all = rays as usize * n;
    if unit > all {
        terminate!();
    }
    if unit == all {
        offsets[rays as usize] = u32::cast_from(all);
        terminate!();
    }
    let key = Wide { high: key_high, low: key_low };
    let base = Wide { high, low };
    let r = unit / n;
    let i = unit % n;
    let near = near_far[r * 2];
    let far = near_far[r * 2 + 1];
    let step = (far - near) / f32::cast_from(per_ray);
    let here = point(near, step, i, unit, &key, &base, jittered);
    let mut start = near;
    let mut end = far;
    if i > 0 {
        start = 0.5 * (point(near, step, i - 1, unit - 1, &key, &base, jittered) + here);
    } else {
        offsets[r] = u32::cast_from(unit);
    }
    if i + 1 < n {
        end = 0.5 * (here + point(near, step, i + 1, unit + 1, &key, &base, jittered));
    }
    t[unit] = start;
    dt[unit] = end - start;
}

#[cube(launch_unchecked)]
fn bounds(t: &[f32], dt: &[f32], edges: &mut [f32], len: u32, n: u32) {
    let unit = ABSOLUTE_POS;
    if unit >= len as usize {
        terminate!();
    }
    let n = n as usize;
    let r = unit / (n + 1);
    let i = unit % (n + 1);
    if i < n {
        edges[unit] = t[r * n + i];
    } else {
        edges[unit] = t[r * n + n - 1] + dt[r * n + n - 1];
    }
}

#[cube(launch_unchecked)]
fn spread_quantiles(u: &mut [f32], len: u32, m: u32, key_high: u32, key_low: u32, high: u32, low: u32, #[comptime] jittered: bool) {
    let unit = ABSOLUTE_POS;
    if unit >= len as usize {
        terminate!();
    }
    let mut jitter = 0.5f32;
    if comptime!(jittered) {
        jitter = uniform(&Wide { high: key_high, low: key_low }, &sum(&Wide { high, low }, &widened(u32::cast_from(unit))));
    }
    u[unit] = (f32::cast_from(unit % m as usize) + jitter) / f32::cast_from(m);
}

/// Both lists ascend.
#[cube(launch_unchecked)]
fn merge(edges: &[f32], fine: &[f32], offsets: &mut [u32], t: &mut [f32], dt: &mut [f32], rays: u32, n: u32, m: u32) {
    let r = ABSOLUTE_POS;
    if r > rays as usize {
        terminate!();
    }
    let n = n as usize;
    let m = m as usize;
    let first = r * (n + m);
    offsets[r] = u32::cast_from(first);
    if r == rays as usize {
        terminate!();
    }
    let mut a = r * (n + 1);
    let mut b = r * m;
    let last_a = a + n + 1;
    let last_b = b + m;
    let mut before = edges[a];
    a += 1;
    for j in 0..n + m {
        // The last edge may come before the last of the fine ones.
        let mut next = edges[min(a, last_a - 1)];
        let mut takes_fine = b < last_b;
        if takes_fine && a < last_a {
            takes_fine = fine[b] < next;
        }
        if takes_fine {
            next = fine[b];
            b += 1;
        } else {
            a += 1;
        }
        t[first + j] = before;
        dt[first + j] = max(next - before, 0.0);
        before = max(next, before);
    }
}
