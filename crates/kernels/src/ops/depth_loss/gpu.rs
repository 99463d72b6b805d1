//! One unit per ray.

use super::{EXACT, MOST};
use crate::gpu::{Buffer, Gpu, launch};
use crate::ops::composite::gpu::GpuPacked;
use cubecl::prelude::*;

/// Penalty on light that ends at distance `middle`.
#[cube]
pub fn away(middle: f32, surface: f32) -> f32 {
    clamp((middle / surface - 1.0).abs() - EXACT, 0.0, MOST)
}

/// Adds `depth` times the loss of each ray that counts and whose surface is known (`surface` not 0, `[R]`) to `values` `[R]`,
/// and `depth · scale` times its gradient to that of the weights `[S]`: `to` holds both.
pub fn add(
    gpu: &Gpu,
    p: &GpuPacked,
    weights: &Buffer,
    surface: &Buffer,
    left_out: &Buffer<u32>,
    (depth, scale): (f32, f32),
    to: (&Buffer, &Buffer),
) {
    let (r, s) = (p.rays(), p.t.len());
    let (values, d_weights) = to;
    launch!(
        gpu,
        add_depth_loss,
        r,
        [p.offsets => r + 1, p.t => s, p.dt => s, weights => s, surface => r, left_out => r, values => r, d_weights => s],
        r as u32,
        depth,
        scale,
    );
}

#[cube(launch_unchecked)]
fn add_depth_loss(
    offsets: &[u32],
    t: &[f32],
    dt: &[f32],
    weights: &[f32],
    surface: &[f32],
    left_out: &[u32],
    values: &mut [f32],
    d_weights: &mut [f32],
    rays: u32,
    depth: f32,
    scale: f32,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    if left_out[r] != 0 || surface[r] <= 0.0 {
        terminate!();
    }
    let mut sum = 0.0f32;
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        let away = depth * away(t[i] + 0.5 * dt[i], surface[r]);
        sum += away * weights[i];
        d_weights[i] += scale * away;
    }
    values[r] += sum;
}
