//! One unit per ray, by running sums as on the CPU.

use crate::gpu::{Buffer, Gpu, launch};
use crate::ops::composite::gpu::GpuPacked;
use cubecl::prelude::*;

/// Loss per ray `[R]`.
pub fn forward(gpu: &Gpu, p: &GpuPacked, weights: &Buffer) -> Buffer {
    both(gpu, p, weights, &gpu.zeros(p.rays())).0
}

/// Gradient of the weights `[S]`, given that of each ray's loss.
pub fn backward(gpu: &Gpu, p: &GpuPacked, weights: &Buffer, d_loss: &Buffer) -> Buffer {
    both(gpu, p, weights, d_loss).1
}

/// Loss per ray `[R]` and gradient of the weights `[S]` at once.
pub fn both(gpu: &Gpu, p: &GpuPacked, weights: &Buffer, d_loss: &Buffer) -> (Buffer, Buffer) {
    let (r, s) = (p.rays(), p.t.len());
    let (loss, g) = (gpu.empty(r), gpu.empty(s));
    launch!(
        gpu,
        spread,
        r,
        [p.offsets => r + 1, p.t => s, p.dt => s, weights => s, d_loss => r, loss => r, g => s],
        r as u32,
    );
    (loss, g)
}

/// Samples in [`super::normalized_distance`].
pub fn normalized(gpu: &Gpu, p: &GpuPacked) -> GpuPacked {
    let (r, s) = (p.rays(), p.t.len());
    let (starts, lengths) = (gpu.empty(s), gpu.empty(s));
    launch!(gpu, normalize, r, [p.offsets => r + 1, p.t => s, p.dt => s, starts => s, lengths => s], r as u32);
    GpuPacked { offsets: p.offsets.clone(), t: starts, dt: lengths }
}

#[cube(launch_unchecked)]
fn normalize(offsets: &[u32], t: &[f32], dt: &[f32], s: &mut [f32], ds: &mut [f32], rays: u32) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        s[i] = 4.0 * t[i] / (1.0 + t[i]);
        ds[i] = 4.0 * dt[i] / ((1.0 + t[i]) * (1.0 + t[i] + dt[i]));
    }
}

#[cube(launch_unchecked)]
fn spread(offsets: &[u32], t: &[f32], dt: &[f32], w: &[f32], d_loss: &[f32], loss: &mut [f32], g: &mut [f32], rays: u32) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let first = offsets[r] as usize;
    let end = offsets[r + 1] as usize;
    let mut all_w = 0.0f32;
    let mut all_m = 0.0f32;
    for i in first..end {
        all_w += w[i];
        // Midpoints relative to the first keep the differences exact in f32.
        all_m += w[i] * ((t[i] - t[first]) + 0.5 * dt[i]);
    }
    let mut sum_w = 0.0f32;
    let mut sum_m = 0.0f32;
    let mut total = 0.0f32;
    for i in first..end {
        let mid = (t[i] - t[first]) + 0.5 * dt[i];
        sum_w += w[i];
        sum_m += w[i] * mid;
        let pairs = mid * (2.0 * sum_w - all_w) - (2.0 * sum_m - all_m);
        total += w[i] * (pairs + w[i] * dt[i] / 3.0);
        g[i] = d_loss[r] * (2.0 * pairs + w[i] * dt[i] * 2.0 / 3.0);
    }
    loss[r] = total;
}
