//! Places of samples in the coordinates that a field reads, and their gradients.

use super::GpuRays;
use crate::gpu::{Buffer, Gpu, launch};
use crate::ops::composite::gpu::GpuPacked;
use cubecl::prelude::*;

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
    pub(crate) fn arg(self) -> (u32, f32) {
        match self {
            Space::Model => (0, 1.0),
            Space::Cube(width) => (1, width),
            Space::Contracted(width) => (2, width),
            Space::Centred(width) => (3, width),
            Space::ContractedCentred(width) => (4, width),
        }
    }
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
pub(crate) fn put(out: &mut [f32], at: usize, x: f32, y: f32, z: f32, width: f32, #[comptime] kind: u32) {
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
