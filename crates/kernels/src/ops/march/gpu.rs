//! Rays are walked twice, one unit each: first to count their samples, then, with their places known,
//! to write them. The walk is the CPU's.

pub mod occupancy;
mod positions;

use super::{MarchConfig, OccupancyBits};
use crate::gpu::{Buffer, Gpu, GpuError, launch};
use crate::ops::composite::gpu::GpuPacked;
use crate::ops::scan;
use cubecl::prelude::*;
use positions::put;

pub use positions::{Space, positions, positions_backward, to_space};

const _: () = assert!(super::BLOCK == 8, "the kernel's blocks are 8 cells wide");

/// Occupancy on the device: one bit per cell, one word per block of 8³ cells.
pub struct GpuOccupancy {
    resolution: usize,
    cascades: usize,
    bits: Buffer<u32>,
    blocks: Buffer<u32>,
}

impl GpuOccupancy {
    pub fn upload(gpu: &Gpu, grid: &OccupancyBits) -> Self {
        let bits: Vec<u32> = grid.bits.iter().flat_map(|w| [*w as u32, (*w >> 32) as u32]).collect();
        let blocks: Vec<u32> = grid.blocks.iter().map(|b| *b as u32).collect();
        GpuOccupancy { resolution: grid.resolution, cascades: grid.cascades, bits: gpu.upload(&bits), blocks: gpu.upload(&blocks) }
    }
}

impl GpuOccupancy {
    fn cells(&self) -> usize {
        self.resolution.pow(3) * self.cascades
    }

    /// Words of bits and blocks in which this differs from another grid.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn differences(&self, gpu: &Gpu, other: &OccupancyBits) -> Result<usize, GpuError> {
        let other = GpuOccupancy::upload(gpu, other);
        let mut wrong = 0;
        for (a, b) in [(&self.bits, &other.bits), (&self.blocks, &other.blocks)] {
            wrong += gpu.read(a)?.iter().zip(gpu.read(b)?).filter(|(a, b)| **a != *b).count();
        }
        Ok(wrong)
    }
}

/// Rays on the device, as [`super::MarchRays`].
pub struct GpuRays {
    pub origins: Buffer,
    pub dirs: Buffer,
    pub near_far: Buffer,
    pub jitter: Buffer,
    pub resumed: bool,
}

impl GpuRays {
    pub fn upload(gpu: &Gpu, r: &super::MarchRays) -> Self {
        GpuRays {
            origins: gpu.upload(r.origins),
            dirs: gpu.upload(r.dirs),
            near_far: gpu.upload(r.near_far),
            jitter: gpu.upload(r.jitter),
            resumed: r.resumed,
        }
    }
}

/// What a march gives.
pub struct GpuMarched {
    pub packed: GpuPacked,
    /// Cells `[capacity]` that the samples lie in.
    pub cells: Buffer<u32>,
    /// 1 for each ray that lost samples because they found no room, `[R]`.
    pub cut: Buffer<u32>,
}

/// Packed samples. Those that find no room are left out, the last rays' first.
pub fn march(gpu: &Gpu, grid: &GpuOccupancy, rays: &GpuRays, config: &MarchConfig, capacity: usize) -> GpuMarched {
    let n = rays.jitter.len();
    let counts = gpu.empty(n);
    let (t, dt, cells) = (gpu.empty(capacity), gpu.empty(capacity), gpu.empty(capacity));
    let pass = |offsets: &Buffer<u32>, write: bool| {
        launch!(
            gpu,
            walk,
            n,
            [
                grid.bits => grid.cells() / 32,
                grid.blocks => grid.cells() / 512,
                rays.origins => n * 3,
                rays.dirs => n * 3,
                rays.near_far => n * 2,
                rays.jitter => n,
                offsets => n + 1,
                counts => n,
                t => capacity,
                dt => capacity,
                cells => capacity,
            ],
            n as u32,
            grid.resolution as u32,
            grid.cascades as u32,
            config.max_samples as u32,
            capacity as u32,
            config.cone,
            config.dt_min,
            config.dt_max,
            config.disparity_from,
            config.unbounded as u32,
            rays.resumed,
            write,
        );
    };
    pass(&gpu.zeros(n + 1), false);
    let whole = scan::gpu::exclusive(gpu, &counts);
    let cut = gpu.zeros(n);
    pass(&whole, true);
    let offsets = bounded(gpu, &whole, &cut, capacity);
    GpuMarched { packed: GpuPacked { offsets, t, dt }, cells, cut }
}

/// Offsets that end where the memory does, so that no reader passes it; rays that lose samples are marked.
pub(crate) fn bounded(gpu: &Gpu, offsets: &Buffer<u32>, cut: &Buffer<u32>, capacity: usize) -> Buffer<u32> {
    let n = offsets.len();
    let out = gpu.empty(n);
    launch!(gpu, bound, n, [offsets => n, out => n, cut => n - 1], n as u32, capacity as u32);
    out
}

#[cube(launch_unchecked)]
fn walk(
    bits: &[u32],
    blocks: &[u32],
    origins: &[f32],
    dirs: &[f32],
    near_far: &[f32],
    jitters: &[f32],
    offsets: &[u32],
    counts: &mut [u32],
    ts: &mut [f32],
    dts: &mut [f32],
    cells: &mut [u32],
    rays: u32,
    resolution: u32,
    cascades: u32,
    max_samples: u32,
    capacity: u32,
    cone: f32,
    dt_min: f32,
    dt_max: f32,
    disparity_from: f32,
    unbounded: u32,
    #[comptime] resumed: bool,
    #[comptime] write: bool,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let mut o = Array::<f32>::new(3usize);
    let mut d = Array::<f32>::new(3usize);
    #[unroll]
    for k in 0..3usize {
        o[k] = origins[r * 3 + k];
        d[k] = dirs[r * 3 + k];
    }
    let near = near_far[r * 2];
    let far = near_far[r * 2 + 1];
    let jitter = jitters[r];
    let n = f32::cast_from(resolution);
    let mut t = near;
    if comptime!(!resumed) {
        t = max(near + (jitter - 0.5) * step(near, cone, dt_min, dt_max, disparity_from), near);
    }
    let mut count = 0u32;
    let mut x = Array::<f32>::new(3usize);
    let mut cell = Array::<u32>::new(3usize);
    while t < far && count < max_samples {
        let dt = step(t, cone, dt_min, dt_max, disparity_from);
        let mid = t + 0.5 * dt;
        let mut reach = 0.0f32;
        #[unroll]
        for k in 0..3usize {
            x[k] = o[k] + mid * d[k];
            reach = max(reach, (x[k] - 0.5).abs());
        }
        let mut cascade = 0u32;
        let mut size = 1.0f32;
        while cascade + 1 < cascades && (reach >= 0.5 * size || dt * n > size) {
            cascade += 1;
            size *= 2.0;
        }
        let beyond = reach >= 0.5 * size;
        if beyond && unbounded == 0 {
            t += dt;
        } else {
            let low = 0.5 - 0.5 * size;
            let scale = n / size;
            #[unroll]
            for k in 0..3usize {
                // What lies beyond the outermost cascade counts to the cells at its walls.
                cell[k] = min(u32::cast_from(max((x[k] - low) * scale, 0.0)), resolution - 1);
            }
            let index = ((cascade * resolution + cell[2]) * resolution + cell[1]) * resolution + cell[0];
            if beyond || (bits[(index >> 5) as usize] >> (index & 31)) & 1 == 1 {
                if comptime!(write) {
                    let to = offsets[r] + count;
                    if to < capacity {
                        ts[to as usize] = t;
                        dts[to as usize] = dt;
                        cells[to as usize] = index;
                    }
                }
                count += 1;
                t += dt;
            } else {
                // Past the cell, or past its block if that is empty.
                let side = resolution / 8;
                let block = ((cascade * side + cell[2] / 8) * side + cell[1] / 8) * side + cell[0] / 8;
                let mut edge = 1u32;
                if blocks[block as usize] == 0 {
                    edge = 8u32;
                }
                let mut exit = 1e30f32;
                #[unroll]
                for k in 0..3usize {
                    if d[k] != 0.0 {
                        let mut wall = cell[k] / edge;
                        if d[k] > 0.0 {
                            wall += 1;
                        }
                        exit = min(exit, (low + f32::cast_from(wall * edge) / scale - o[k]) * (1.0 / d[k]));
                    }
                }
                let jump = exit + (jitter - 0.5) * dt;
                if jump > t {
                    t = jump;
                } else {
                    t += dt;
                }
            }
        }
    }
    if comptime!(!write) {
        counts[r] = count;
    }
}

/// [`MarchConfig::step`].
#[cube]
fn step(t: f32, cone: f32, dt_min: f32, dt_max: f32, disparity_from: f32) -> f32 {
    clamp(t * cone * max(t / disparity_from, 1.0), dt_min, dt_max)
}

#[cube(launch_unchecked)]
fn bound(offsets: &[u32], out: &mut [u32], cut: &mut [u32], n: u32, capacity: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    out[i] = min(offsets[i], capacity);
    if i > 0 && offsets[i] > capacity {
        cut[i - 1] = 1u32;
    }
}
