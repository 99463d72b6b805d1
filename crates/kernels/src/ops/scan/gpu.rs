//! Sums over all rays in one cube, sums within rays by one unit each.

use crate::gpu::{Buffer, CUBE, Gpu, launch};
use cubecl::prelude::*;

/// `offsets[r] = Σ_{q<r} counts[q]`, `[R + 1]`.
pub fn exclusive(gpu: &Gpu, counts: &Buffer<u32>) -> Buffer<u32> {
    let n = counts.len();
    let out = gpu.empty(n + 1);
    launch!(gpu, offsets, ([1; 3], CubeDim::new_1d(CUBE)), [counts => n, out => n + 1], n as u32, gpu.shared);
    out
}

/// `out[i] = Σ_{j≤i, same ray} x[j]`.
pub fn inclusive(gpu: &Gpu, offsets: &Buffer<u32>, x: &Buffer) -> Buffer {
    within(gpu, offsets, x, false)
}

/// `g[j] = Σ_{i≥j, same ray} d[i]`.
pub fn inclusive_backward(gpu: &Gpu, offsets: &Buffer<u32>, d: &Buffer) -> Buffer {
    within(gpu, offsets, d, true)
}

fn within(gpu: &Gpu, offsets: &Buffer<u32>, x: &Buffer, from_the_end: bool) -> Buffer {
    let (rays, n) = (offsets.len().saturating_sub(1), x.len());
    let out = gpu.empty(n);
    launch!(gpu, running, rays, [offsets => rays + 1, x => n, out => n], rays as u32, from_the_end);
    out
}

#[cube(launch_unchecked)]
fn offsets(counts: &[u32], out: &mut [u32], n: u32, #[comptime] shared: bool) {
    let unit = UNIT_POS as usize;
    let n = n as usize;
    let part = n.div_ceil(256usize);
    let first = min(unit * part, n);
    let end = min(first + part, n);
    let mut before = 0u32;
    if comptime!(shared) {
        let mut sums = Shared::<[u32]>::new_slice(256usize);
        let mut sum = 0u32;
        for i in first..end {
            sum += counts[i];
        }
        sums[unit] = sum;
        sync_cube();
        for i in 0..unit {
            before += sums[i];
        }
    } else {
        for i in 0..first {
            before += counts[i];
        }
    }
    for i in first..end {
        out[i] = before;
        before += counts[i];
    }
    if unit == 255usize {
        out[n] = before;
    }
}

#[cube(launch_unchecked)]
fn running(offsets: &[u32], x: &[f32], out: &mut [f32], rays: u32, #[comptime] from_the_end: bool) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let first = offsets[r] as usize;
    let count = offsets[r + 1] as usize - first;
    let mut sum = 0.0f32;
    for j in 0..count {
        let mut i = first + j;
        if comptime!(from_the_end) {
            i = first + count - 1 - j;
        }
        sum += x[i];
        out[i] = sum;
    }
}
