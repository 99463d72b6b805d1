//! One unit per ray for weights and densities, one per ray and channel for colors.

use crate::gpu::{Buffer, Gpu, Rows, launch};
use cubecl::prelude::*;

/// Packed samples on the device: offsets `[R + 1]`, starts and lengths `[S]`.
#[derive(Clone)]
pub struct GpuPacked {
    pub offsets: Buffer<u32>,
    pub t: Buffer,
    pub dt: Buffer,
}

impl GpuPacked {
    pub fn upload(gpu: &Gpu, p: &super::Packed) -> Self {
        GpuPacked { offsets: gpu.upload(p.offsets), t: gpu.upload(p.t), dt: gpu.upload(p.dt) }
    }

    pub fn rays(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Rows of the samples, whose number is the last offset.
    pub fn rows(&self) -> Rows {
        Rows::counted(self.t.len(), &self.offsets, self.rays())
    }
}

/// As [`super::Composited`], on the device.
pub struct GpuComposited {
    pub color: Buffer,
    pub depth: Buffer,
    pub opacity: Buffer,
    pub weights: Buffer,
}

/// Gradients of densities, features and background.
pub struct GpuGradients {
    pub sigma: Buffer,
    pub features: Buffer,
    pub background: Buffer,
}

/// Forward for `c` channels.
pub fn forward(gpu: &Gpu, p: &GpuPacked, sigma: &Buffer, features: &Buffer, c: usize, background: &Buffer) -> GpuComposited {
    let (r, s) = (p.rays(), p.t.len());
    let out = GpuComposited { color: gpu.empty(r * c), depth: gpu.empty(r), opacity: gpu.empty(r), weights: gpu.empty(s) };
    launch!(
        gpu,
        weigh_samples,
        r,
        [p.offsets => r + 1, p.t => s, p.dt => s, sigma => s, out.weights => s, out.depth => r, out.opacity => r],
        r as u32,
    );
    launch!(
        gpu,
        blend,
        r * c,
        [p.offsets => r + 1, out.weights => s, out.opacity => r, features => s * c, background => r * c, out.color => r * c],
        (r * c) as u32,
        c as u32,
    );
    out
}

/// Backward from the gradients of all four results.
pub fn backward(
    gpu: &Gpu,
    p: &GpuPacked,
    features: &Buffer,
    c: usize,
    background: &Buffer,
    out: &GpuComposited,
    d: &GpuComposited,
) -> GpuGradients {
    let (r, s) = (p.rays(), p.t.len());
    let g = GpuGradients { sigma: gpu.empty(s), features: gpu.empty(s * c), background: gpu.empty(r * c) };
    launch!(
        gpu,
        features_backward,
        r * c,
        [p.offsets => r + 1, out.weights => s, out.opacity => r, d.color => r * c, g.features => s * c, g.background => r * c],
        (r * c) as u32,
        c as u32,
    );
    launch!(
        gpu,
        densities_backward,
        r,
        [
            p.offsets => r + 1,
            p.t => s,
            p.dt => s,
            features => s * c,
            background => r * c,
            out.weights => s,
            out.opacity => r,
            d.color => r * c,
            d.depth => r,
            d.opacity => r,
            d.weights => s,
            g.sigma => s,
        ],
        r as u32,
        c as u32,
    );
    g
}

#[cube(launch_unchecked)]
fn weigh_samples(
    offsets: &[u32],
    t: &[f32],
    dt: &[f32],
    sigma: &[f32],
    weights: &mut [f32],
    depth: &mut [f32],
    opacity: &mut [f32],
    rays: u32,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let mut light = 1.0f32;
    let mut far = 0.0f32;
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        let through = (-sigma[i] * dt[i]).exp();
        let w = light * (1.0 - through);
        weights[i] = w;
        far += w * (t[i] + 0.5 * dt[i]);
        light *= through;
    }
    depth[r] = far;
    opacity[r] = 1.0 - light;
}

#[cube(launch_unchecked)]
fn blend(
    offsets: &[u32],
    weights: &[f32],
    opacity: &[f32],
    features: &[f32],
    background: &[f32],
    color: &mut [f32],
    n: u32,
    channels: u32,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let c = channels as usize;
    let r = unit / c;
    let k = unit % c;
    let mut sum = (1.0 - opacity[r]) * background[unit];
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        sum += weights[i] * features[i * c + k];
    }
    color[unit] = sum;
}

#[cube(launch_unchecked)]
fn features_backward(
    offsets: &[u32],
    weights: &[f32],
    opacity: &[f32],
    d_color: &[f32],
    d_features: &mut [f32],
    d_background: &mut [f32],
    n: u32,
    channels: u32,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let c = channels as usize;
    let r = unit / c;
    let k = unit % c;
    let d = d_color[unit];
    d_background[unit] = (1.0 - opacity[r]) * d;
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        d_features[i * c + k] = weights[i] * d;
    }
}

#[cube(launch_unchecked)]
fn densities_backward(
    offsets: &[u32],
    t: &[f32],
    dt: &[f32],
    features: &[f32],
    background: &[f32],
    weights: &[f32],
    opacity: &[f32],
    d_color: &[f32],
    d_depth: &[f32],
    d_opacity: &[f32],
    d_weights: &[f32],
    d_sigma: &mut [f32],
    rays: u32,
    channels: u32,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let c = channels as usize;
    let first = offsets[r] as usize;
    let count = offsets[r + 1] as usize - first;
    let mut out = -d_opacity[r];
    for k in 0..c {
        out += d_color[r * c + k] * background[r * c + k];
    }
    // From the last sample on, where sums are small.
    let mut after = 1.0 - opacity[r];
    let mut behind = after * out;
    for j in 0..count {
        let i = first + count - 1 - j;
        let mut g = d_depth[r] * (t[i] + 0.5 * dt[i]) + d_weights[i];
        for k in 0..c {
            g += d_color[r * c + k] * features[i * c + k];
        }
        d_sigma[i] = dt[i] * (after * g - behind);
        behind += weights[i] * g;
        after += weights[i];
    }
}
