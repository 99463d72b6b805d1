//! One unit per value, first along rows, then along columns.

use super::{Resample, Weights};
use crate::gpu::{Buffer, Gpu, launch};
use cubecl::prelude::*;

/// Resampled planes.
///
/// # Shapes
/// x `[P, H, W]`; result `[P, H', W']`.
pub fn forward(gpu: &Gpu, r: &Resample, planes: usize, x: &Buffer) -> Buffer {
    apply(gpu, &r.vertical, &r.horizontal, planes, x)
}

/// Gradient of the input.
///
/// # Shapes
/// d `[P, H', W']`; result `[P, H, W]`.
pub fn backward(gpu: &Gpu, r: &Resample, planes: usize, d: &Buffer) -> Buffer {
    apply(gpu, &r.vertical_transposed, &r.horizontal_transposed, planes, d)
}

/// `V x Hᵀ` for each plane.
fn apply(gpu: &Gpu, v: &Weights, h: &Weights, planes: usize, x: &Buffer) -> Buffer {
    let rows = along_axis(gpu, h, planes * v.inputs(), 1, x);
    along_axis(gpu, v, planes, h.outputs(), &rows)
}

/// The matrix of a table times the middle axis of `[outer, inputs, inner]`.
fn along_axis(gpu: &Gpu, table: &Weights, outer: usize, inner: usize, x: &Buffer) -> Buffer {
    let (inputs, outputs) = (table.inputs(), table.outputs());
    let n = outer * outputs * inner;
    let out = gpu.empty(n);
    let (first, weights) = (gpu.upload(&table.first), gpu.upload(&table.weights));
    launch!(
        gpu,
        sum_taps,
        n,
        [first => outputs, weights => table.taps * outputs, x => outer * inputs * inner, out => n],
        n as u32,
        inputs as u32,
        outputs as u32,
        inner as u32,
        table.taps as u32,
    );
    out
}

#[cube(launch_unchecked)]
fn sum_taps(first: &[u32], weights: &[f32], x: &[f32], out: &mut [f32], n: u32, inputs: u32, outputs: u32, inner: u32, taps: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let inner = inner as usize;
    let o = i / inner % outputs as usize;
    let from = (i / inner / outputs as usize * inputs as usize + first[o] as usize) * inner + i % inner;
    let mut sum = 0.0f32;
    for t in 0..taps as usize {
        sum += weights[t * outputs as usize + o] * x[from + t * inner];
    }
    out[i] = sum;
}
