//! Samples of two marches of the same rays, one behind the other, as those of one.
//!
//! Offsets of both add up to the offsets of all: the samples of ray `r` move by what the other one has of the rays before, and of this
//! ray if it comes first.

use crate::gpu::{Buffer, Gpu, Rows, launch};
use crate::ops::composite::gpu::GpuPacked;
use crate::ops::march::gpu::bounded;
use cubecl::prelude::*;

/// Samples of both.
pub struct Joined {
    pub packed: GpuPacked,
    /// Index of each among those of the first, behind which those of the second count.
    source: Buffer<u32>,
    /// Samples that the first has memory for.
    split: usize,
}

/// Sum of numbers, one by one.
pub fn sum(gpu: &Gpu, a: &Buffer<u32>, b: &Buffer<u32>) -> Buffer<u32> {
    let n = a.len();
    let out = gpu.empty(n);
    launch!(gpu, add, n, [a => n, b => n, out => n], n as u32);
    out
}

/// Puts the samples of each ray of `second` behind those of `first`, as many as `capacity` holds; rays that lose others for want of room
/// are marked in `cut`.
///
/// # Panics
/// When they are not of as many rays.
pub fn join(gpu: &Gpu, first: &GpuPacked, second: &GpuPacked, cut: &Buffer<u32>, capacity: usize) -> Joined {
    assert_eq!(first.rays(), second.rays(), "samples of the same rays");
    let offsets = bounded(gpu, &sum(gpu, &first.offsets, &second.offsets), cut, capacity);
    let (n, split, more) = (first.rays(), first.t.len(), second.t.len());
    let (t, dt, source) = (gpu.empty(capacity), gpu.empty(capacity), gpu.empty(capacity));
    launch!(
        gpu,
        put_behind,
        n,
        [
            first.offsets => n + 1,
            first.t => split,
            first.dt => split,
            second.offsets => n + 1,
            second.t => more,
            second.dt => more,
            offsets => n + 1,
            t => capacity,
            dt => capacity,
            source => capacity,
        ],
        n as u32,
        split as u32,
    );
    Joined { packed: GpuPacked { offsets, t, dt }, source, split }
}

impl Joined {
    /// Rows `[capacity, width]` of both, of those of each `[S, width]`.
    pub fn take(&self, gpu: &Gpu, of: [&Buffer; 2], width: usize) -> Buffer {
        self.take_levels(gpu, of, width, width)
    }

    /// Features `[L, capacity, F]` of both, of those of each `[L, S, F]`, for `width` = `L F`.
    pub fn take_levels(&self, gpu: &Gpu, of: [&Buffer; 2], width: usize, per_level: usize) -> Buffer {
        gather(gpu, &self.packed.rows(), (&self.source, self.split), of, width, per_level)
    }
}

/// Features `[L, capacity, F]` that `source` picks from those of a first `[L, split, F]`, and behind them of a second `[L, S, F]`, for `width` =
/// `L F`.
pub(super) fn gather(
    gpu: &Gpu,
    rows: &Rows,
    (source, split): (&Buffer<u32>, usize),
    [first, second]: [&Buffer; 2],
    width: usize,
    per_level: usize,
) -> Buffer {
    let (n, more) = (rows.most * width, second.len() / width);
    let out = gpu.empty(n);
    launch!(
        gpu,
        gather_both,
        n,
        [rows.live => rows.at + 1, source => rows.most, first => split * width, second => more * width, out => n],
        rows.place(),
        split as u32,
        more as u32,
        rows.most as u32,
        width as u32,
        per_level as u32,
    );
    out
}

#[cube(launch_unchecked)]
fn add(a: &[u32], b: &[u32], out: &mut [u32], n: u32) {
    if ABSOLUTE_POS < n as usize {
        out[ABSOLUTE_POS] = a[ABSOLUTE_POS] + b[ABSOLUTE_POS];
    }
}

#[cube(launch_unchecked)]
fn put_behind(
    first: &[u32],
    first_t: &[f32],
    first_dt: &[f32],
    second: &[u32],
    second_t: &[f32],
    second_dt: &[f32],
    to: &[u32],
    t: &mut [f32],
    dt: &mut [f32],
    source: &mut [u32],
    rays: u32,
    split: u32,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let mut next = to[r] as usize;
    let end = to[r + 1] as usize;
    for i in first[r] as usize..first[r + 1] as usize {
        if next < end {
            t[next] = first_t[i];
            dt[next] = first_dt[i];
            source[next] = u32::cast_from(i);
            next += 1;
        }
    }
    for i in second[r] as usize..second[r + 1] as usize {
        if next < end {
            t[next] = second_t[i];
            dt[next] = second_dt[i];
            source[next] = split + u32::cast_from(i);
            next += 1;
        }
    }
}

#[cube(launch_unchecked)]
fn gather_both(
    live: &[u32],
    source: &[u32],
    first: &[f32],
    second: &[f32],
    out: &mut [f32],
    at: u32,
    split: u32,
    more: u32,
    most: u32,
    width: u32,
    per_level: u32,
) {
    let i = ABSOLUTE_POS;
    let f = per_level as usize;
    let per = live[at as usize] as usize * f;
    if per == 0 || i >= per * (width as usize / f) {
        terminate!();
    }
    let level = i / per;
    let row = i % per / f;
    let to = (level * most as usize + row) * f + i % f;
    let from = source[row];
    if from < split {
        out[to] = first[(level * split as usize + from as usize) * f + i % f];
    } else {
        out[to] = second[(level * more as usize + (from - split) as usize) * f + i % f];
    }
}
