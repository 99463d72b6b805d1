//! Sums over all rays, and sums within rays by one unit each.
//!
//! Exclusive sums take three launches where cubes share memory: sums of parts of `PART` counts, exclusive sums of those by the same
//! means, and the sums within parts. Elsewhere one cube does it all.

use crate::gpu::{Buffer, CUBE, Gpu, launch};
use cubecl::prelude::*;

/// Counts that a unit adds up, and that a cube does.
const PER_UNIT: usize = 4;
const PART: usize = CUBE as usize * PER_UNIT;

/// `offsets[r] = Σ_{q<r} counts[q]`, `[R + 1]`.
pub fn exclusive(gpu: &Gpu, counts: &Buffer<u32>) -> Buffer<u32> {
    let n = counts.len();
    let (out, cube) = (gpu.empty(n + 1), CubeDim::new_1d(CUBE));
    if !gpu.shared {
        launch!(gpu, offsets, ([1; 3], cube), [counts => n, out => n + 1], n as u32);
        return out;
    }
    let parts = (n + 1).div_ceil(PART);
    let before = if parts > 1 {
        let sums = gpu.empty(parts);
        launch!(gpu, sum_parts, ([parts, 1, 1], cube), [counts => n, sums => parts], n as u32);
        exclusive(gpu, &sums)
    } else {
        gpu.empty(0)
    };
    let begins = if parts > 1 { parts } else { 0 };
    launch!(
        gpu,
        offsets_in_parts,
        ([parts, 1, 1], cube),
        [counts => n, before => begins, out => n + 1],
        n as u32,
        parts > 1,
    );
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
fn offsets(counts: &[u32], out: &mut [u32], n: u32) {
    let unit = UNIT_POS as usize;
    let n = n as usize;
    let part = n.div_ceil(256usize);
    let first = min(unit * part, n);
    let end = min(first + part, n);
    let mut before = 0u32;
    for i in 0..first {
        before += counts[i];
    }
    for i in first..end {
        out[i] = before;
        before += counts[i];
    }
    if unit == 255usize {
        out[n] = before;
    }
}

/// Sum of a unit's counts, which begin at `first`.
#[cube]
fn sum_of_unit(counts: &[u32], first: usize, n: usize) -> u32 {
    let mut sum = 0u32;
    #[unroll]
    for k in 0..PER_UNIT {
        if first + k < n {
            sum += counts[first + k];
        }
    }
    sum
}

/// Replaces the cube's numbers by their inclusive sums (Hillis and Steele 1986). Units see the sums of others after it.
#[cube]
fn accumulate(sums: &mut Shared<[u32]>, unit: usize) {
    sync_cube();
    #[unroll]
    for k in 0..8u32 {
        let reach = comptime!(1usize << k);
        let mut own = sums[unit];
        if unit >= reach {
            own += sums[unit - reach];
        }
        sync_cube();
        sums[unit] = own;
        sync_cube();
    }
}

#[cube(launch_unchecked)]
fn sum_parts(counts: &[u32], out: &mut [u32], n: u32) {
    let unit = UNIT_POS as usize;
    let part = CUBE_POS;
    let mut sums = Shared::<[u32]>::new_slice(256usize);
    sums[unit] = sum_of_unit(counts, part * PART + unit * PER_UNIT, n as usize);
    accumulate(&mut sums, unit);
    if unit == 255usize {
        out[part] = sums[unit];
    }
}

#[cube(launch_unchecked)]
fn offsets_in_parts(counts: &[u32], begins: &[u32], out: &mut [u32], n: u32, #[comptime] several: bool) {
    let unit = UNIT_POS as usize;
    let part = CUBE_POS;
    let n = n as usize;
    let first = part * PART + unit * PER_UNIT;
    let mut sums = Shared::<[u32]>::new_slice(256usize);
    let sum = sum_of_unit(counts, first, n);
    sums[unit] = sum;
    accumulate(&mut sums, unit);
    let mut before = sums[unit] - sum;
    if comptime!(several) {
        before += begins[part];
    }
    #[unroll]
    for k in 0..PER_UNIT {
        let i = first + k;
        if i <= n {
            out[i] = before;
        }
        if i < n {
            before += counts[i];
        }
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
