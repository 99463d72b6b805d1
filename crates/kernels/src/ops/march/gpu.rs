//! Rays are walked twice, one unit each: first to count their samples, then, with their places known,
//! to write them. The walk is the CPU's.

use super::{MarchConfig, OccupancyBits};
use crate::gpu::{Buffer, CUBE, Gpu, units};
use crate::ops::composite::gpu::GpuPacked;
use crate::ops::scan;
use cubecl::prelude::*;

const _: () = assert!(super::BLOCK == 8, "the kernel's blocks are 8 cells wide");

/// Occupancy on the device: one bit per cell, one word per block of 8³ cells.
pub struct GpuOccupancy {
    resolution: usize,
    cascades: usize,
    bits: Buffer,
    blocks: Buffer,
}

impl GpuOccupancy {
    pub fn upload(gpu: &Gpu, grid: &OccupancyBits) -> Self {
        let bits: Vec<u32> = grid.bits.iter().flat_map(|w| [*w as u32, (*w >> 32) as u32]).collect();
        let blocks: Vec<u32> = grid.blocks.iter().map(|b| *b as u32).collect();
        GpuOccupancy { resolution: grid.resolution, cascades: grid.cascades, bits: gpu.upload_u32(&bits), blocks: gpu.upload_u32(&blocks) }
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

/// Packed samples, and the cells `[capacity]` that they lie in. Samples that find no room are left out, the last rays' first.
pub fn march(gpu: &Gpu, grid: &GpuOccupancy, rays: &GpuRays, config: &MarchConfig, capacity: usize) -> (GpuPacked, Buffer) {
    let n = rays.jitter.len();
    let counts = gpu.empty(n);
    let (t, dt, cells) = (gpu.empty(capacity), gpu.empty(capacity), gpu.empty(capacity));
    // SAFETY: units past the rays stop; samples beyond the capacity are not written.
    let launch = |offsets: &Buffer, write: bool| unsafe {
        walk::launch_unchecked(
            &gpu.client,
            units(n),
            CubeDim::new_1d(CUBE),
            grid.bits.arg(),
            grid.blocks.arg(),
            rays.origins.arg(),
            rays.dirs.arg(),
            rays.near_far.arg(),
            rays.jitter.arg(),
            offsets.arg(),
            counts.arg(),
            t.arg(),
            dt.arg(),
            cells.arg(),
            n as u32,
            grid.resolution as u32,
            grid.cascades as u32,
            config.max_samples as u32,
            capacity as u32,
            config.cone,
            config.dt_min,
            config.dt_max,
            rays.resumed,
            write,
        );
    };
    if n > 0 {
        launch(&gpu.zeros(n + 1), false);
    }
    let offsets = scan::gpu::exclusive(gpu, &counts);
    if n > 0 {
        launch(&offsets, true);
        // SAFETY: units past the offsets stop.
        unsafe {
            bound::launch_unchecked(&gpu.client, units(n + 1), CubeDim::new_1d(CUBE), offsets.arg(), (n + 1) as u32, capacity as u32)
        };
    }
    (GpuPacked { offsets, t, dt }, cells)
}

/// Midpoints of packed samples `[S, 3]`.
pub fn positions(gpu: &Gpu, rays: &GpuRays, samples: &GpuPacked) -> Buffer {
    let out = gpu.empty(samples.t.len() * 3);
    let n = samples.rays();
    if n > 0 {
        // SAFETY: offsets bound the samples.
        unsafe {
            place::launch_unchecked(
                &gpu.client,
                units(n),
                CubeDim::new_1d(CUBE),
                samples.offsets.arg(),
                samples.t.arg(),
                samples.dt.arg(),
                rays.origins.arg(),
                rays.dirs.arg(),
                out.arg(),
                n as u32,
            );
        }
    }
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
        t = max(near + (jitter - 0.5) * clamp(near * cone, dt_min, dt_max), near);
    }
    let mut count = 0u32;
    let mut x = Array::<f32>::new(3usize);
    let mut cell = Array::<u32>::new(3usize);
    while t < far && count < max_samples {
        let dt = clamp(t * cone, dt_min, dt_max);
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
        if reach >= 0.5 * size {
            t += dt;
        } else {
            let low = 0.5 - 0.5 * size;
            let scale = n / size;
            #[unroll]
            for k in 0..3usize {
                cell[k] = min(u32::cast_from((x[k] - low) * scale), resolution - 1);
            }
            let index = ((cascade * resolution + cell[2]) * resolution + cell[1]) * resolution + cell[0];
            if (bits[(index >> 5) as usize] >> (index & 31)) & 1 == 1 {
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

/// Offsets end where the memory does, so that no reader passes it.
#[cube(launch_unchecked)]
fn bound(offsets: &mut [u32], n: u32, capacity: u32) {
    if ABSOLUTE_POS < n as usize {
        offsets[ABSOLUTE_POS] = min(offsets[ABSOLUTE_POS], capacity);
    }
}

#[cube(launch_unchecked)]
fn place(offsets: &[u32], t: &[f32], dt: &[f32], origins: &[f32], dirs: &[f32], out: &mut [f32], rays: u32) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        let mid = t[i] + 0.5 * dt[i];
        #[unroll]
        for k in 0..3usize {
            out[i * 3 + k] = origins[r * 3 + k] + mid * dirs[r * 3 + k];
        }
    }
}
