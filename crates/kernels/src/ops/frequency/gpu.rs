//! One unit per number of the input.

use super::Frequency;
use crate::gpu::{Buffer, Gpu, launch};
use cubecl::prelude::*;

/// Weights of the bands, after the window.
fn band_weights(gpu: &Gpu, f: &Frequency) -> Buffer {
    gpu.upload(&(0..f.bands).map(|k| f.band_weight(k) as f32).collect::<Vec<_>>())
}

fn scale(f: &Frequency) -> f32 {
    if f.pi { std::f32::consts::PI } else { 1.0 }
}

/// `[N, dims]` to `[N, output_dims]`.
pub fn forward(gpu: &Gpu, f: &Frequency, x: &Buffer) -> Buffer {
    let (n, n_out) = (x.len(), x.len() / f.dims * f.output_dims());
    let (bands, out) = (band_weights(gpu, f), gpu.empty(n_out));
    launch!(
        gpu,
        waves,
        n,
        [x => n, bands => f.bands, out => n_out],
        n as u32,
        scale(f),
        f.dims,
        f.bands,
        f.include_input,
    );
    out
}

/// Gradient of the input.
pub fn backward(gpu: &Gpu, f: &Frequency, x: &Buffer, d_out: &Buffer) -> Buffer {
    let (n, n_out) = (x.len(), x.len() / f.dims * f.output_dims());
    let (bands, out) = (band_weights(gpu, f), gpu.empty(n));
    launch!(
        gpu,
        slopes,
        n,
        [x => n, bands => f.bands, d_out => n_out, out => n],
        n as u32,
        scale(f),
        f.dims,
        f.bands,
        f.include_input,
    );
    out
}

#[cube(launch_unchecked)]
fn waves(
    x: &[f32],
    bands: &[f32],
    out: &mut [f32],
    len: u32,
    scale: f32,
    #[comptime] dims: usize,
    #[comptime] n_bands: usize,
    #[comptime] include_input: bool,
) {
    let at = ABSOLUTE_POS;
    if at >= len as usize {
        terminate!();
    }
    let width = comptime!(dims * (2 * n_bands + include_input as usize));
    let head = comptime!(dims * include_input as usize);
    let base = at / dims * width + at % dims;
    if comptime!(include_input) {
        out[base] = x[at];
    }
    let mut angle = scale * x[at];
    for k in 0..n_bands {
        out[base + head + 2 * k * dims] = bands[k] * angle.sin();
        out[base + head + (2 * k + 1) * dims] = bands[k] * angle.cos();
        angle *= 2.0;
    }
}

#[cube(launch_unchecked)]
fn slopes(
    x: &[f32],
    bands: &[f32],
    d_out: &[f32],
    out: &mut [f32],
    len: u32,
    scale: f32,
    #[comptime] dims: usize,
    #[comptime] n_bands: usize,
    #[comptime] include_input: bool,
) {
    let at = ABSOLUTE_POS;
    if at >= len as usize {
        terminate!();
    }
    let width = comptime!(dims * (2 * n_bands + include_input as usize));
    let head = comptime!(dims * include_input as usize);
    let base = at / dims * width + at % dims;
    let mut g = 0.0f32;
    if comptime!(include_input) {
        g = d_out[base];
    }
    let mut s = scale;
    for k in 0..n_bands {
        let angle = s * x[at];
        let d_sin = d_out[base + head + 2 * k * dims];
        let d_cos = d_out[base + head + (2 * k + 1) * dims];
        g += bands[k] * s * (d_sin * angle.cos() - d_cos * angle.sin());
        s *= 2.0;
    }
    out[at] = g;
}
