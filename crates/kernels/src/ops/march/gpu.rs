//! Rays are walked twice, one unit each: first to count their samples, then, with their places known,
//! to write them. The walk is the CPU's.

pub mod occupancy;
pub mod prune;

use super::{MarchConfig, OccupancyBits};
use crate::gpu::{Buffer, Gpu, GpuError, launch};
use crate::ops::composite::gpu::GpuPacked;
use crate::ops::scan;
use cubecl::prelude::*;

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

/// Coordinates in which positions are given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Space {
    /// As the rays'.
    Model,
    /// The cube of this width around the model cube's centre as `[0, 1]³`.
    Cube(f32),
    /// All of space, contracted beyond the cube of this width, as `[0, 1]³`.
    Contracted(f32),
    /// As [`Space::Cube`], but as `[−1, 1]³`.
    Centred(f32),
    /// As [`Space::Contracted`], but as `[−1, 1]³`.
    ContractedCentred(f32),
}

impl Space {
    /// Kind and width, for a launch.
    fn arg(self) -> (u32, f32) {
        match self {
            Space::Model => (0, 1.0),
            Space::Cube(width) => (1, width),
            Space::Contracted(width) => (2, width),
            Space::Centred(width) => (3, width),
            Space::ContractedCentred(width) => (4, width),
        }
    }
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
fn bounded(gpu: &Gpu, offsets: &Buffer<u32>, cut: &Buffer<u32>, capacity: usize) -> Buffer<u32> {
    let n = offsets.len();
    let out = gpu.empty(n);
    launch!(gpu, bound, n, [offsets => n, out => n, cut => n - 1], n as u32, capacity as u32);
    out
}

/// Midpoints of packed samples `[S, 3]`.
pub fn positions(gpu: &Gpu, rays: &GpuRays, samples: &GpuPacked, space: Space) -> Buffer {
    let (n, s) = (samples.rays(), samples.t.len());
    let out = gpu.empty(s * 3);
    let (kind, width) = space.arg();
    launch!(
        gpu,
        place,
        n,
        [samples.offsets => n + 1, samples.t => s, samples.dt => s, rays.origins => n * 3, rays.dirs => n * 3, out => s * 3],
        n as u32,
        width,
        kind,
    );
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

/// Model points `[N, 3]` as coordinates of a space.
pub fn to_space(gpu: &Gpu, points: &Buffer, space: Space) -> Buffer {
    let n = points.len() / 3;
    let out = gpu.empty(n * 3);
    let (kind, width) = space.arg();
    launch!(gpu, convert, n, [points => n * 3, out => n * 3], n as u32, width, kind);
    out
}

/// Gradients of origins and directions `[R, 3]`, given those of positions `[S, 3]` in a space.
pub fn positions_backward(gpu: &Gpu, rays: &GpuRays, samples: &GpuPacked, d: &Buffer, space: Space) -> (Buffer, Buffer) {
    let (n, s) = (samples.rays(), samples.t.len());
    let (d_origins, d_dirs) = (gpu.empty(n * 3), gpu.empty(n * 3));
    let (kind, width) = space.arg();
    launch!(
        gpu,
        pull,
        n,
        [
            samples.offsets => n + 1,
            samples.t => s,
            samples.dt => s,
            rays.origins => n * 3,
            rays.dirs => n * 3,
            d => s * 3,
            d_origins => n * 3,
            d_dirs => n * 3,
        ],
        n as u32,
        width,
        kind,
    );
    (d_origins, d_dirs)
}

/// Writes a model point as coordinates of a space.
#[cube]
fn put(out: &mut [f32], at: usize, x: f32, y: f32, z: f32, width: f32, #[comptime] kind: u32) {
    if comptime!(kind == 0) {
        out[at] = x;
        out[at + 1] = y;
        out[at + 2] = z;
    }
    if comptime!(kind == 1) {
        out[at] = (x - 0.5) / width + 0.5;
        out[at + 1] = (y - 0.5) / width + 0.5;
        out[at + 2] = (z - 0.5) / width + 0.5;
    }
    if comptime!(kind == 2 || kind == 4) {
        let cx = 2.0 / width * (x - 0.5);
        let cy = 2.0 / width * (y - 0.5);
        let cz = 2.0 / width * (z - 0.5);
        let m = max(max(cx.abs(), cy.abs()), cz.abs());
        let mut s = 0.25f32;
        let mut middle = 0.5f32;
        if comptime!(kind == 4) {
            s = 0.5f32;
            middle = 0.0f32;
        }
        if m > 1.0 {
            s *= (2.0 - 1.0 / m) / m;
        }
        out[at] = cx * s + middle;
        out[at + 1] = cy * s + middle;
        out[at + 2] = cz * s + middle;
    }
    if comptime!(kind == 3) {
        out[at] = 2.0 * (x - 0.5) / width;
        out[at + 1] = 2.0 * (y - 0.5) / width;
        out[at + 2] = 2.0 * (z - 0.5) / width;
    }
}

#[cube(launch_unchecked)]
fn convert(points: &[f32], out: &mut [f32], n: u32, width: f32, #[comptime] kind: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    put(out, i * 3, points[i * 3], points[i * 3 + 1], points[i * 3 + 2], width, kind);
}

/// The sum of `d · ∂put/∂point` over a ray's samples, and the same times their distances.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube(launch_unchecked)]
fn pull(
    offsets: &[u32],
    t: &[f32],
    dt: &[f32],
    origins: &[f32],
    dirs: &[f32],
    d: &[f32],
    d_origins: &mut [f32],
    d_dirs: &mut [f32],
    rays: u32,
    width: f32,
    #[comptime] kind: u32,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let mut near = Array::<f32>::new(3usize);
    let mut far = Array::<f32>::new(3usize);
    let mut point = Array::<f32>::new(3usize);
    #[unroll]
    for k in 0..3usize {
        near[k] = 0.0;
        far[k] = 0.0;
    }
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        let mid = t[i] + 0.5 * dt[i];
        let mut scale = 1.0f32;
        let mut greatest = 0usize;
        let mut pulled = 0.0f32;
        if comptime!(kind == 1) {
            scale = 1.0 / width;
        }
        if comptime!(kind == 3) {
            scale = 2.0 / width;
        }
        if comptime!(kind == 2 || kind == 4) {
            // Contracted: c = s(m) x with m the greatest coordinate's size, which has a slope of its own.
            let mut m = 0.0f32;
            let mut along = 0.0f32;
            #[unroll]
            for k in 0..3usize {
                let x = 2.0 / width * (origins[r * 3 + k] + mid * dirs[r * 3 + k] - 0.5);
                point[k] = x;
                along += d[i * 3 + k] * x;
                if x.abs() >= m {
                    m = x.abs();
                    greatest = k;
                }
            }
            scale = 0.5 / width;
            if comptime!(kind == 4) {
                scale = 1.0 / width;
            }
            if m > 1.0 {
                pulled = scale * (2.0 / m - 2.0) / (m * m) * along;
                scale *= (2.0 - 1.0 / m) / m;
                if point[greatest] < 0.0 {
                    pulled = -pulled;
                }
            }
        }
        #[unroll]
        for k in 0..3usize {
            let mut g = scale * d[i * 3 + k];
            if comptime!(kind == 2 || kind == 4) {
                if greatest == k {
                    g += pulled;
                }
            }
            near[k] += g;
            far[k] += mid * g;
        }
    }
    #[unroll]
    for k in 0..3usize {
        d_origins[r * 3 + k] = near[k];
        d_dirs[r * 3 + k] = far[k];
    }
}

#[cube(launch_unchecked)]
fn place(
    offsets: &[u32],
    t: &[f32],
    dt: &[f32],
    origins: &[f32],
    dirs: &[f32],
    out: &mut [f32],
    rays: u32,
    width: f32,
    #[comptime] kind: u32,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let ox = origins[r * 3];
    let oy = origins[r * 3 + 1];
    let oz = origins[r * 3 + 2];
    let dx = dirs[r * 3];
    let dy = dirs[r * 3 + 1];
    let dz = dirs[r * 3 + 2];
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        let mid = t[i] + 0.5 * dt[i];
        put(out, i * 3, ox + mid * dx, oy + mid * dy, oz + mid * dz, width, kind);
    }
}
