//! One unit per number of the input.

use crate::gpu::{Buffer, Gpu, launch};
use cubecl::prelude::*;

/// `[N, dims]` to `[N, dims · bands]`.
pub fn forward(gpu: &Gpu, bands: usize, x: &Buffer) -> Buffer {
    let n = x.len();
    let out = gpu.empty(n * bands);
    launch!(gpu, wave, n, [x => n, out => n * bands], n as u32, bands as u32);
    out
}

/// Gradient of x.
pub fn backward(gpu: &Gpu, bands: usize, x: &Buffer, d_out: &Buffer) -> Buffer {
    let n = x.len();
    let out = gpu.empty(n);
    launch!(gpu, slope, n, [x => n, d_out => n * bands, out => n], n as u32, bands as u32);
    out
}

/// `(v + k/2) mod 2` in [0, 2).
#[cube]
fn phase(v: f32, k: u32) -> f32 {
    let p = v * 0.5 + f32::cast_from(k) * 0.25;
    (p - p.floor()) * 2.0
}

#[cube(launch_unchecked)]
fn wave(x: &[f32], out: &mut [f32], len: u32, bands: u32) {
    let i = ABSOLUTE_POS;
    if i >= len as usize {
        terminate!();
    }
    let mut v = x[i];
    for k in 0..bands as usize {
        out[i * bands as usize + k] = 2.0 * (phase(v, k as u32) - 1.0).abs() - 1.0;
        v *= 2.0;
    }
}

#[cube(launch_unchecked)]
fn slope(x: &[f32], d_out: &[f32], out: &mut [f32], len: u32, bands: u32) {
    let i = ABSOLUTE_POS;
    if i >= len as usize {
        terminate!();
    }
    let mut s = 1.0f32;
    let mut g = 0.0f32;
    for k in 0..bands as usize {
        let mut d = 2.0 * s * d_out[i * bands as usize + k];
        if phase(s * x[i], k as u32) < 1.0 {
            d = -d;
        }
        g += d;
        s *= 2.0;
    }
    out[i] = g;
}
