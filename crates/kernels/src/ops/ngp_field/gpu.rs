//! The standard field as a composition of its parts on the device.

use super::{FieldNet, Head};
use crate::gpu::{Buffer, CUBE, Gpu, units};
use crate::ops::composite::gpu::{self as composite, GpuComposited, GpuPacked};
use crate::ops::fused_mlp::gpu::{self as mlp, columns};
use crate::ops::linear::BiasKind;
use crate::ops::linear::gpu as linear;
use cubecl::prelude::*;

/// What a backward pass needs of the forward one.
pub struct GpuStep {
    pub out: GpuComposited,
    inputs: Vec<Buffer>,
    values: Vec<Buffer>,
    sigma: Buffer,
    rgb: Buffer,
}

/// Gradients of a step.
pub struct GpuStepGradients {
    pub params: Buffer,
    /// Level-major, `[L, S, F]`.
    pub features: Buffer,
    /// Per code, `[R, K]`.
    pub codes: Vec<Buffer>,
    pub background: Buffer,
}

/// Evaluates and composites packed samples.
///
/// # Shapes
/// features: `[L, S, F]` with `F` numbers per level; codes: `[R, K_i]`; background: `[R, 3]`.
#[allow(clippy::too_many_arguments)]
pub fn forward(
    gpu: &Gpu,
    net: &FieldNet,
    params: &Buffer,
    p: &GpuPacked,
    features: &Buffer,
    per_level: usize,
    codes: &[&Buffer],
    background: &Buffer,
) -> GpuStep {
    let s = p.t.len();
    let rows = gpu.empty(features.len());
    turn(gpu, features, &rows, s, per_level, net.mlp.input_widths[0], true);
    let mut inputs = vec![rows];
    for (code, width) in codes.iter().zip(&net.mlp.input_widths[1..]) {
        let per_sample = gpu.empty(s * width);
        along(gpu, p, code, &per_sample, *width, true);
        inputs.push(per_sample);
    }
    let values = mlp::forward(gpu, &net.mlp, params, &inputs.iter().collect::<Vec<_>>(), s);
    let sigma = head(gpu, net, net.sigma, &values, s, 1);
    let rgb = head(gpu, net, net.rgb, &values, s, 3);
    let out = composite::forward(gpu, p, &sigma, &rgb, 3, background);
    GpuStep { out, inputs, values, sigma, rgb }
}

/// Gradients, given those of what compositing gave.
pub fn backward(
    gpu: &Gpu,
    net: &FieldNet,
    params: &Buffer,
    p: &GpuPacked,
    per_level: usize,
    background: &Buffer,
    step: &GpuStep,
    d: &GpuComposited,
) -> GpuStepGradients {
    let s = p.t.len();
    let g = composite::backward(gpu, p, &step.rgb, 3, background, &step.out, d);
    let mut seeds: Vec<Option<Buffer>> = net.mlp.layers.iter().map(|_| None).collect();
    for (h, channels, out, d) in [(net.sigma, 1, &step.sigma, &g.sigma), (net.rgb, 3, &step.rgb, &g.features)] {
        let slope = linear::before_activation(gpu, h.activation, out, d);
        let width = net.mlp.layers[h.layer].width;
        let seed = seeds[h.layer].get_or_insert_with(|| gpu.zeros(s * width));
        columns(gpu, s, channels, (&slope, channels, 0), (seed, width, h.channel), true);
    }
    let inputs: Vec<&Buffer> = step.inputs.iter().collect();
    let (d_params, d_inputs) = mlp::backward(gpu, &net.mlp, params, &inputs, &step.values, s, seeds);
    let features = gpu.empty(d_inputs[0].len());
    turn(gpu, &d_inputs[0], &features, s, per_level, net.mlp.input_widths[0], false);
    let codes = d_inputs[1..].iter().zip(&net.mlp.input_widths[1..]).map(|(d, width)| {
        let sum = gpu.empty(p.rays() * width);
        along(gpu, p, &sum, d, *width, false);
        sum
    });
    GpuStepGradients { codes: codes.collect(), params: d_params, features, background: g.background }
}

/// Activated channels of a layer, `[S, channels]`.
fn head(gpu: &Gpu, net: &FieldNet, h: Head, values: &[Buffer], s: usize, channels: usize) -> Buffer {
    let out = gpu.empty(s * channels);
    columns(gpu, s, channels, (&values[h.layer], net.mlp.layers[h.layer].width, h.channel), (&out, channels, 0), false);
    let shift = gpu.upload(&vec![h.shift; channels]);
    linear::finish(gpu, &out, channels, Some((&shift).into()), BiasKind::Shared, h.activation);
    out
}

/// Level-major to row-major features, or back.
fn turn(gpu: &Gpu, from: &Buffer, to: &Buffer, samples: usize, per_level: usize, dims: usize, to_rows: bool) {
    if from.is_empty() {
        return;
    }
    // SAFETY: units past the length stop.
    unsafe {
        transpose::launch_unchecked(
            &gpu.client,
            units(from.len()),
            CubeDim::new_1d(CUBE),
            from.arg(),
            to.arg(),
            from.len() as u32,
            samples as u32,
            per_level as u32,
            dims as u32,
            to_rows,
        );
    }
}

/// Copies each ray's code `[R, K]` to its samples `[S, K]`, or sums them back.
fn along(gpu: &Gpu, p: &GpuPacked, code: &Buffer, samples: &Buffer, width: usize, spread: bool) {
    let n = p.rays() * width;
    if n == 0 {
        return;
    }
    // SAFETY: units past `n` stop; offsets bound the samples.
    unsafe {
        share::launch_unchecked(
            &gpu.client,
            units(n),
            CubeDim::new_1d(CUBE),
            p.offsets.arg(),
            code.arg(),
            samples.arg(),
            n as u32,
            width as u32,
            spread,
        );
    }
}

#[cube(launch_unchecked)]
fn transpose(from: &[f32], to: &mut [f32], n: u32, samples: u32, per_level: u32, dims: u32, #[comptime] to_rows: bool) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let f = per_level as usize;
    let row = unit / dims as usize;
    let col = unit % dims as usize;
    let level_major = (col / f * samples as usize + row) * f + col % f;
    if comptime!(to_rows) {
        to[unit] = from[level_major];
    } else {
        to[level_major] = from[unit];
    }
}

#[cube(launch_unchecked)]
fn share(offsets: &[u32], code: &mut [f32], samples: &mut [f32], n: u32, width: u32, #[comptime] spread: bool) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let k = width as usize;
    let r = unit / k;
    let col = unit % k;
    let mut sum = 0.0f32;
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        if comptime!(spread) {
            samples[i * k + col] = code[unit];
        } else {
            sum += samples[i * k + col];
        }
    }
    if comptime!(!spread) {
        code[unit] = sum;
    }
}
