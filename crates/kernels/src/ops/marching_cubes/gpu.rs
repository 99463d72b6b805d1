//! One unit per grid point: it owns the crossings on the edges that begin there and the triangles of the cell above it.
//! A first pass counts them, a scan gives their places, and a second pass writes them.
#![allow(clippy::collapsible_if)] // the outer one is decided when a kernel is made, the inner one when it runs

use super::CaseTable;
use crate::gpu::{Buffer, Gpu, GpuError, launch};
use crate::ops::scan;
use cubecl::prelude::*;

/// Numbers per case: how many triangles, and the edges of at most twelve.
const CASE: usize = 40;
const CASES: usize = 256;

/// Vertices `[V, 3]` in grid coordinates (x, y, z) and faces `[T, 3]` of densities `[nz, ny, nx]`.
///
/// # Errors
/// When the device was lost or is full.
pub fn extract(
    gpu: &Gpu,
    table: &CaseTable,
    density: &Buffer,
    (nx, ny, nz): (usize, usize, usize),
    level: f32,
) -> Result<(Buffer, Buffer<u32>), GpuError> {
    let n = nx * ny * nz;
    assert_eq!(density.len(), n, "marching cubes: {nx} x {ny} x {nz}");
    let mut cases = vec![0u32; CASES * CASE];
    for (case, triangles) in table.triangles.iter().enumerate() {
        cases[case * CASE] = triangles.len() as u32;
        for (i, e) in triangles.iter().flatten().enumerate() {
            cases[case * CASE + 1 + i] = (e.corner * 8 + e.direction) as u32;
        }
    }
    let cases = gpu.upload(&cases);
    // Vertices lie along the axes, or along all seven directions.
    let diagonals = table.directions.len() > 3;
    let (crossings, triangles) = (gpu.empty(n), gpu.empty(n));
    let size = (nx as u32, ny as u32, nz as u32);
    launch!(
        gpu,
        count,
        n,
        [density => n, cases => CASES * CASE, crossings => n, triangles => n],
        size.0,
        size.1,
        size.2,
        level,
        diagonals,
    );
    let (first_vertex, first_face) = (scan::gpu::exclusive(gpu, &crossings), scan::gpu::exclusive(gpu, &triangles));
    let (v, t) = (last(gpu, &first_vertex)?, last(gpu, &first_face)?);
    let (vertices, faces) = (gpu.empty(v * 3), gpu.empty(t * 3));
    if v > 0 {
        launch!(
            gpu,
            write,
            n,
            [
                density => n,
                cases => CASES * CASE,
                first_vertex => n + 1,
                first_face => n + 1,
                vertices => v * 3,
                faces => t * 3,
            ],
            size.0,
            size.1,
            size.2,
            level,
            diagonals,
        );
    }
    Ok((vertices, faces))
}

fn last(gpu: &Gpu, offsets: &Buffer<u32>) -> Result<usize, GpuError> {
    Ok(gpu.read(offsets)?.last().copied().unwrap_or(0) as usize)
}

/// Whether the edge from point `i` in a direction lies in the grid and crosses the level.
#[cube]
fn crosses(density: &[f32], i: usize, #[comptime] direction: usize, nx: usize, ny: usize, nz: usize, level: f32) -> u32 {
    let mut fits = true;
    if comptime!(direction & 1 != 0) {
        fits = fits && i % nx + 1 < nx;
    }
    if comptime!(direction & 2 != 0) {
        fits = fits && i / nx % ny + 1 < ny;
    }
    if comptime!(direction & 4 != 0) {
        fits = fits && i / (nx * ny) + 1 < nz;
    }
    let mut crossed = 0u32;
    if fits {
        let mut there = 0u32;
        if density[i] > level {
            crossed = 1u32;
        }
        if density[i + step(direction, nx, ny)] > level {
            there = 1u32;
        }
        crossed ^= there;
    }
    crossed
}

/// From a point to the next one in a direction.
#[cube]
fn step(#[comptime] direction: usize, nx: usize, ny: usize) -> usize {
    comptime!(direction & 1) + nx * comptime!(direction >> 1 & 1) + nx * ny * comptime!(direction >> 2)
}

/// Which corners of the cell above point `i` lie inside.
#[cube]
fn case_of(density: &[f32], i: usize, nx: usize, slice: usize, level: f32) -> u32 {
    let mut inside = 0u32;
    #[unroll]
    for c in 0..8usize {
        let at = i + c % 2 + nx * (c / 2 % 2) + slice * (c / 4);
        if density[at] > level {
            inside |= 1u32 << comptime!(c as u32);
        }
    }
    inside
}

#[cube(launch_unchecked)]
fn count(
    density: &[f32],
    cases: &[u32],
    crossings: &mut [u32],
    triangles: &mut [u32],
    nx: u32,
    ny: u32,
    nz: u32,
    level: f32,
    #[comptime] diagonals: bool,
) {
    let i = ABSOLUTE_POS;
    let nx = nx as usize;
    let ny = ny as usize;
    let nz = nz as usize;
    let slice = nx * ny;
    if i >= slice * nz {
        terminate!();
    }
    let mut n = 0u32;
    #[unroll]
    for d in 1..8usize {
        if comptime!(diagonals || d == 1 || d == 2 || d == 4) {
            n += crosses(density, i, d, nx, ny, nz, level);
        }
    }
    crossings[i] = n;
    let mut t = 0u32;
    if i % nx + 1 < nx && i / nx % ny + 1 < ny && i / slice + 1 < nz {
        t = cases[case_of(density, i, nx, slice, level) as usize * CASE];
    }
    triangles[i] = t;
}

#[cube(launch_unchecked)]
fn write(
    density: &[f32],
    cases: &[u32],
    first_vertex: &[u32],
    first_face: &[u32],
    vertices: &mut [f32],
    faces: &mut [u32],
    nx: u32,
    ny: u32,
    nz: u32,
    level: f32,
    #[comptime] diagonals: bool,
) {
    let i = ABSOLUTE_POS;
    let nx = nx as usize;
    let ny = ny as usize;
    let nz = nz as usize;
    let slice = nx * ny;
    if i >= slice * nz {
        terminate!();
    }
    let x = i % nx;
    let y = i / nx % ny;
    let z = i / slice;
    let mut at = first_vertex[i] as usize * 3;
    #[unroll]
    for d in 1..8usize {
        if comptime!(diagonals || d == 1 || d == 2 || d == 4) {
            if crosses(density, i, d, nx, ny, nz, level) == 1 {
                let along = (level - density[i]) / (density[i + step(d, nx, ny)] - density[i]);
                vertices[at] = f32::cast_from(x) + along * comptime!((d & 1) as f32);
                vertices[at + 1] = f32::cast_from(y) + along * comptime!((d >> 1 & 1) as f32);
                vertices[at + 2] = f32::cast_from(z) + along * comptime!((d >> 2) as f32);
                at += 3;
            }
        }
    }
    if x + 1 < nx && y + 1 < ny && z + 1 < nz {
        let case = case_of(density, i, nx, slice, level) as usize * CASE;
        let to = first_face[i] as usize * 3;
        for k in 0..cases[case] as usize * 3 {
            let e = cases[case + 1 + k] as usize;
            let c = e / 8;
            let p = i + c % 2 + nx * (c / 2 % 2) + slice * (c / 4);
            // The point's crossings in lower directions come first.
            let mut id = first_vertex[p];
            #[unroll]
            for d in 1..7usize {
                if comptime!(diagonals || d == 1 || d == 2 || d == 4) {
                    if d < e % 8 {
                        id += crosses(density, p, d, nx, ny, nz, level);
                    }
                }
            }
            faces[to + k] = id;
        }
    }
}
