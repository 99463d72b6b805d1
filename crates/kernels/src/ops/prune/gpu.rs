//! One unit per ray, in two passes: the first decides which samples stay, the second packs them where a scan of their counts puts them.

mod join;

use super::Pruning;
use crate::gpu::{Buffer, Gpu, launch};
use crate::ops::composite::gpu::GpuPacked;
use crate::ops::march::gpu::bounded;
use crate::ops::scan;
use cubecl::prelude::*;

use join::gather;
pub use join::{Joined, join, sum};

/// The samples that stay.
pub struct Pruned {
    pub packed: GpuPacked,
    /// Share of light that passes all samples, left out or not, `[R]`.
    pub light: Buffer,
    /// Index of each among the samples before.
    source: Buffer<u32>,
}

/// Keeps what [`Pruning`] leaves of samples with densities `[S]`, as many as `capacity` holds; rays that lose others
/// for want of room are marked in `cut`. Densities that no light reaches become −1. `before`: share of light `[R]` that reaches the
/// first sample of each ray, all of it without `before`.
pub fn prune(
    gpu: &Gpu,
    p: &GpuPacked,
    (sigma, before): (&Buffer, Option<&Buffer>),
    limits: &Pruning,
    cut: &Buffer<u32>,
    capacity: usize,
) -> Pruned {
    let (n, s) = (p.rays(), p.t.len());
    let arriving = before.map_or_else(|| gpu.empty(0), |b| b.clone());
    let counts = gpu.empty(n);
    let (kept, light) = (gpu.empty(s), gpu.empty(n));
    // Finite also after multiplication by a length.
    let thin = limits.thin.min(1e30);
    launch!(
        gpu,
        mark_kept,
        n,
        [p.offsets => n + 1, p.dt => s, arriving => arriving.len(), sigma => s, kept => s, counts => n, light => n],
        n as u32,
        limits.stop,
        limits.min_alpha,
        thin,
        limits.min_weight,
        before.is_some(),
    );
    let whole = scan::gpu::exclusive(gpu, &counts);
    let offsets = bounded(gpu, &whole, cut, capacity);
    let (t, dt, source) = (gpu.empty(capacity), gpu.empty(capacity), gpu.empty(capacity));
    launch!(
        gpu,
        compact,
        n,
        [
            p.offsets => n + 1,
            p.t => s,
            p.dt => s,
            kept => s,
            offsets => n + 1,
            t => capacity,
            dt => capacity,
            source => capacity,
        ],
        n as u32,
    );
    Pruned { packed: GpuPacked { offsets, t, dt }, light, source }
}

impl Pruned {
    /// Rows `[capacity, width]` of the samples that stay, of those of all `[S, width]`.
    pub fn take(&self, gpu: &Gpu, all: &Buffer, width: usize) -> Buffer {
        self.taken(gpu, all, width, width)
    }

    /// Features `[L, capacity, F]` of the samples that stay, of those of all `[L, S, F]`, for `width` = `L F`.
    pub fn take_levels(&self, gpu: &Gpu, all: &Buffer, width: usize, per_level: usize) -> Buffer {
        self.taken(gpu, all, width, per_level)
    }

    fn taken(&self, gpu: &Gpu, all: &Buffer, width: usize, per_level: usize) -> Buffer {
        let samples = all.len() / width;
        gather(gpu, &self.packed.rows(), (&self.source, samples), [all, &gpu.empty(0)], width, per_level)
    }
}

#[cube(launch_unchecked)]
fn mark_kept(
    offsets: &[u32],
    dt: &[f32],
    before: &[f32],
    sigma: &mut [f32],
    kept: &mut [u32],
    counts: &mut [u32],
    lights: &mut [f32],
    rays: u32,
    stop: f32,
    min_alpha: f32,
    thin: f32,
    min_weight: f32,
    #[comptime] resumed: bool,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let mut light = 1.0f32;
    if comptime!(resumed) {
        light = before[r];
    }
    let mut count = 0u32;
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        let mut stays = 0u32;
        if light < stop {
            sigma[i] = -1.0f32;
        } else {
            let alpha = 1.0 - (-(sigma[i] * dt[i])).exp();
            let weight = light * alpha;
            light -= weight;
            if alpha >= min(min_alpha, thin * dt[i]) && weight >= min_weight {
                stays = 1u32;
            }
        }
        kept[i] = stays;
        count += stays;
    }
    counts[r] = count;
    lights[r] = light;
}

#[cube(launch_unchecked)]
fn compact(
    offsets: &[u32],
    t: &[f32],
    dt: &[f32],
    kept: &[u32],
    to: &[u32],
    to_t: &mut [f32],
    to_dt: &mut [f32],
    source: &mut [u32],
    rays: u32,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let mut next = to[r] as usize;
    let end = to[r + 1] as usize;
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        if kept[i] == 1 && next < end {
            to_t[next] = t[i];
            to_dt[next] = dt[i];
            source[next] = u32::cast_from(i);
            next += 1;
        }
    }
}
