//! One unit per ray, in two passes of the same march as the CPU's: the first counts a ray's samples, the second writes them where a
//! scan of the counts puts them.

mod positions;

use super::{MarchConfig, OccupancyBits};
use crate::gpu::{Buffer, Gpu, GpuError, launch};
use crate::ops::composite::gpu::GpuPacked;
use crate::ops::scan;
use cubecl::prelude::*;

pub(crate) use positions::put;
pub use positions::{positions, positions_backward, to_space};

const _: () = assert!(super::BLOCK == 8, "the kernel's blocks are 8 cells wide");

/// Occupancy on the device: one bit per cell, one word per block of 8³ cells.
pub struct GpuOccupancy {
    pub(crate) resolution: usize,
    pub(crate) cascades: usize,
    pub(crate) bits: Buffer<u32>,
    pub(crate) blocks: Buffer<u32>,
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
    pub fn differences(&self, gpu: &Gpu, other: &GpuOccupancy) -> Result<usize, GpuError> {
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
    /// Offsets of the samples, had there been room for all, `[R + 1]`.
    pub whole: Buffer<u32>,
    /// Cells `[capacity]` that the samples lie in.
    pub cells: Buffer<u32>,
    /// 1 for each ray that lost samples for want of room, `[R]`.
    pub cut: Buffer<u32>,
}

/// Packed samples, as many as `capacity` holds; the last rays lose theirs first.
pub fn march(gpu: &Gpu, grid: &GpuOccupancy, rays: &GpuRays, config: &MarchConfig, capacity: usize) -> GpuMarched {
    let n = rays.jitter.len();
    let counts = gpu.empty(n);
    let (t, dt, cells) = (gpu.empty(capacity), gpu.empty(capacity), gpu.empty(capacity));
    let pass = |offsets: &Buffer<u32>, write: bool| {
        launch!(
            gpu,
            march_rays,
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
    GpuMarched { packed: GpuPacked { offsets, t, dt }, whole, cells, cut }
}

/// The same rays from where a march of `size` samples at most left those that may go on: that took so many, and of whose light at least
/// `stop` is left. The others have no length.
pub fn go_on(gpu: &Gpu, rays: &GpuRays, marched: &GpuMarched, light: &Buffer, stop: f32, size: usize) -> GpuRays {
    let (n, p) = (rays.jitter.len(), &marched.packed);
    let (s, near_far) = (p.t.len(), gpu.empty(2 * n));
    launch!(
        gpu,
        resume,
        n,
        [rays.near_far => 2 * n, p.offsets => n + 1, p.t => s, p.dt => s, light => n, near_far => 2 * n],
        n as u32,
        size as u32,
        stop,
    );
    GpuRays { origins: rays.origins.clone(), dirs: rays.dirs.clone(), near_far, jitter: rays.jitter.clone(), resumed: true }
}

/// Offsets limited to the capacity, so that no reader exceeds it; rays that lose samples are marked in `cut`.
pub(crate) fn bounded(gpu: &Gpu, offsets: &Buffer<u32>, cut: &Buffer<u32>, capacity: usize) -> Buffer<u32> {
    let n = offsets.len();
    let out = gpu.empty(n);
    launch!(gpu, bound, n, [offsets => n, out => n, cut => n - 1], n as u32, capacity as u32);
    out
}

/// The cube of a cascade that a sample reads, around the center of model space.
#[derive(CubeType)]
struct Cube {
    cascade: u32,
    size: f32,
    /// Whether the sample lies beyond it.
    is_beyond: bool,
}

/// The finest cascade that holds a point and whose cells are no shorter than the step `dt`; the coarsest where there is none.
#[cube]
fn cube_around(x: &Array<f32>, dt: f32, resolution: u32, cascades: u32) -> Cube {
    let mut reach = 0.0f32;
    #[unroll]
    for k in 0..3usize {
        reach = max(reach, (x[k] - 0.5).abs());
    }
    let mut cascade = 0u32;
    let mut size = 1.0f32;
    while cascade + 1 < cascades && (reach >= 0.5 * size || dt * f32::cast_from(resolution) > size) {
        cascade += 1;
        size *= 2.0;
    }
    Cube { cascade, size, is_beyond: reach >= 0.5 * size }
}

/// The point of a ray at distance `t`.
#[cube]
fn put_point(o: &Array<f32>, d: &Array<f32>, t: f32, x: &mut Array<f32>) {
    #[unroll]
    for k in 0..3usize {
        x[k] = o[k] + t * d[k];
    }
}

/// Place of a cell, or of a block, in memory, with so many of them per side of a cascade.
#[cube]
fn index_of(x: u32, y: u32, z: u32, cascade: u32, side: u32) -> u32 {
    ((cascade * side + z) * side + y) * side + x
}

/// The cell that holds a point, and its place in memory. What lies beyond the outermost cascade counts to the cells at its walls.
#[cube]
fn put_cell(x: &Array<f32>, cube: &Cube, resolution: u32, cell: &mut Array<u32>) -> u32 {
    let low = 0.5 - 0.5 * cube.size;
    let scale = f32::cast_from(resolution) / cube.size;
    #[unroll]
    for k in 0..3usize {
        cell[k] = min(u32::cast_from(max((x[k] - low) * scale, 0.0)), resolution - 1);
    }
    index_of(cell[0], cell[1], cell[2], cube.cascade, resolution)
}

/// Distance at which a ray leaves an empty cell, or its block if all of that is empty.
#[cube]
fn exit_of_empty(o: &Array<f32>, d: &Array<f32>, cell: &Array<u32>, cube: &Cube, blocks: &[u32], resolution: u32) -> f32 {
    let block = index_of(cell[0] / 8, cell[1] / 8, cell[2] / 8, cube.cascade, resolution / 8);
    let mut edge = 1u32;
    if blocks[block as usize] == 0 {
        edge = 8u32;
    }
    let low = 0.5 - 0.5 * cube.size;
    let scale = f32::cast_from(resolution) / cube.size;
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
    exit
}

#[cube(launch_unchecked)]
fn march_rays(
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
    let mut x = Array::<f32>::new(3usize);
    let mut cell = Array::<u32>::new(3usize);
    #[unroll]
    for k in 0..3usize {
        o[k] = origins[r * 3 + k];
        d[k] = dirs[r * 3 + k];
    }
    let near = near_far[r * 2];
    let far = near_far[r * 2 + 1];
    let jitter = jitters[r];
    let mut t = near;
    if comptime!(!resumed) {
        t = max(near + (jitter - 0.5) * step(near, cone, dt_min, dt_max, disparity_from), near);
    }
    let mut count = 0u32;
    while t < far && count < max_samples {
        let dt = step(t, cone, dt_min, dt_max, disparity_from);
        put_point(&o, &d, t + 0.5 * dt, &mut x);
        let cube = cube_around(&x, dt, resolution, cascades);
        if cube.is_beyond && unbounded == 0 {
            t += dt;
        } else {
            let index = put_cell(&x, &cube, resolution, &mut cell);
            if cube.is_beyond || (bits[(index >> 5) as usize] >> (index & 31)) & 1 == 1 {
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
                let jump = exit_of_empty(&o, &d, &cell, &cube, blocks, resolution) + (jitter - 0.5) * dt;
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

#[cube(launch_unchecked)]
fn resume(near_far: &[f32], offsets: &[u32], t: &[f32], dt: &[f32], light: &[f32], out: &mut [f32], rays: u32, size: u32, stop: f32) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let far = near_far[r * 2 + 1];
    let mut near = far;
    // A ray that was cut took fewer.
    if offsets[r + 1] - offsets[r] == size && light[r] >= stop {
        let last = offsets[r + 1] as usize - 1;
        near = t[last] + dt[last];
    }
    out[r * 2] = near;
    out[r * 2 + 1] = far;
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
