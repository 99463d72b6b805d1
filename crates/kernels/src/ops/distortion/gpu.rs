//! One unit per ray, by running sums as on the CPU.

use crate::gpu::{Buffer, CUBE, Gpu, units};
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
    let (loss, g) = (gpu.empty(p.rays()), gpu.empty(weights.len()));
    run(gpu, p, weights, d_loss, &loss, &g);
    (loss, g)
}

/// Samples in [`super::normalized_distance`].
pub fn normalized(gpu: &Gpu, p: &GpuPacked) -> GpuPacked {
    let (s, ds) = (gpu.empty(p.t.len()), gpu.empty(p.t.len()));
    let r = p.rays();
    if r > 0 {
        // SAFETY: units past the rays stop; offsets bound the samples.
        unsafe {
            normalize::launch_unchecked(
                &gpu.client,
                units(r),
                CubeDim::new_1d(CUBE),
                p.offsets.arg(),
                p.t.arg(),
                p.dt.arg(),
                s.arg(),
                ds.arg(),
                r as u32,
            );
        }
    }
    GpuPacked { offsets: p.offsets.clone(), t: s, dt: ds }
}

fn run(gpu: &Gpu, p: &GpuPacked, weights: &Buffer, d_loss: &Buffer, loss: &Buffer, g: &Buffer) {
    let r = p.rays();
    if r > 0 {
        // SAFETY: units past the rays stop; offsets bound the samples.
        unsafe {
            spread::launch_unchecked(
                &gpu.client,
                units(r),
                CubeDim::new_1d(CUBE),
                p.offsets.arg(),
                p.t.arg(),
                p.dt.arg(),
                weights.arg(),
                d_loss.arg(),
                loss.arg(),
                g.arg(),
                r as u32,
            );
        }
    }
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
