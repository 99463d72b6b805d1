//! One unit per grid point: it owns the crossings on its three edges and the triangles of the cell above it.
//! Counted first, then, with their places known, written.

use super::{case_table, edge_corners};
use crate::gpu::{Buffer, CUBE, Gpu, GpuError, units};
use crate::ops::scan;
use cubecl::prelude::*;

/// Numbers per case: how many triangles, and the edges of at most five.
const CASE: usize = 16;

/// Vertices `[V, 3]` in grid coordinates (x, y, z) and faces `[T, 3]` of densities `[nz, ny, nx]`.
///
/// # Errors
/// When the device was lost or is full.
pub fn extract(gpu: &Gpu, density: &Buffer, (nx, ny, nz): (usize, usize, usize), level: f32) -> Result<(Buffer, Buffer), GpuError> {
    let n = nx * ny * nz;
    assert_eq!(density.len(), n, "marching cubes: {nx} x {ny} x {nz}");
    let mut cases = vec![0u32; 256 * CASE];
    for (case, triangles) in case_table().iter().enumerate() {
        cases[case * CASE] = triangles.len() as u32;
        for (i, e) in triangles.iter().flatten().enumerate() {
            cases[case * CASE + 1 + i] = *e as u32;
        }
    }
    let corners: Vec<u32> = (0..12).map(|e| edge_corners(e).0 as u32).collect();
    let (cases, corners) = (gpu.upload_u32(&cases), gpu.upload_u32(&corners));
    let (crossings, triangles) = (gpu.empty(n), gpu.empty(n));
    let (cubes, cube) = (units(n), CubeDim::new_1d(CUBE));
    let size = (nx as u32, ny as u32, nz as u32);
    if n > 0 {
        // SAFETY: units past the points stop; neighbours are read inside the grid.
        unsafe {
            count::launch_unchecked(
                &gpu.client,
                cubes.clone(),
                cube,
                density.arg(),
                cases.arg(),
                crossings.arg(),
                triangles.arg(),
                size.0,
                size.1,
                size.2,
                level,
            );
        }
    }
    let (first_vertex, first_face) = (scan::gpu::exclusive(gpu, &crossings), scan::gpu::exclusive(gpu, &triangles));
    let (v, t) = (last(gpu, &first_vertex)?, last(gpu, &first_face)?);
    let (vertices, faces) = (gpu.empty(v * 3), gpu.empty(t * 3));
    if v > 0 {
        // SAFETY: as above; what is written was counted.
        unsafe {
            write::launch_unchecked(
                &gpu.client,
                cubes,
                cube,
                density.arg(),
                cases.arg(),
                corners.arg(),
                first_vertex.arg(),
                first_face.arg(),
                vertices.arg(),
                faces.arg(),
                size.0,
                size.1,
                size.2,
                level,
            );
        }
    }
    Ok((vertices, faces))
}

fn last(gpu: &Gpu, offsets: &Buffer) -> Result<usize, GpuError> {
    Ok(gpu.read_u32(offsets)?.last().copied().unwrap_or(0) as usize)
}

/// Whether the density crosses the level along the edge from point `i` to the one `step` on.
#[cube]
fn crosses(density: &[f32], i: usize, step: usize, level: f32) -> u32 {
    let mut here = 0u32;
    let mut there = 0u32;
    if density[i] > level {
        here = 1u32;
    }
    if density[i + step] > level {
        there = 1u32;
    }
    here ^ there
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
fn count(density: &[f32], cases: &[u32], crossings: &mut [u32], triangles: &mut [u32], nx: u32, ny: u32, nz: u32, level: f32) {
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
    let mut n = 0u32;
    if x + 1 < nx {
        n += crosses(density, i, 1usize, level);
    }
    if y + 1 < ny {
        n += crosses(density, i, nx, level);
    }
    if z + 1 < nz {
        n += crosses(density, i, slice, level);
    }
    crossings[i] = n;
    let mut t = 0u32;
    if x + 1 < nx && y + 1 < ny && z + 1 < nz {
        t = cases[case_of(density, i, nx, slice, level) as usize * CASE];
    }
    triangles[i] = t;
}

#[cube(launch_unchecked)]
fn write(
    density: &[f32],
    cases: &[u32],
    corners: &[u32],
    first_vertex: &[u32],
    first_face: &[u32],
    vertices: &mut [f32],
    faces: &mut [u32],
    nx: u32,
    ny: u32,
    nz: u32,
    level: f32,
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
    for axis in 0..3usize {
        let mut step = 1usize;
        let mut within = x + 1 < nx;
        if comptime!(axis == 1) {
            step = nx;
            within = y + 1 < ny;
        }
        if comptime!(axis == 2) {
            step = slice;
            within = z + 1 < nz;
        }
        let mut crossed = 0u32;
        if within {
            crossed = crosses(density, i, step, level);
        }
        if crossed == 1 {
            vertices[at] = f32::cast_from(x);
            vertices[at + 1] = f32::cast_from(y);
            vertices[at + 2] = f32::cast_from(z);
            vertices[at + axis] += (level - density[i]) / (density[i + step] - density[i]);
            at += 3;
        }
    }
    if x + 1 < nx && y + 1 < ny && z + 1 < nz {
        let case = case_of(density, i, nx, slice, level) as usize * CASE;
        let to = first_face[i] as usize * 3;
        for k in 0..cases[case] as usize * 3 {
            let e = cases[case + 1 + k] as usize;
            let c = corners[e] as usize;
            let px = x + c % 2;
            let py = y + c / 2 % 2;
            let p = i + c % 2 + nx * (c / 2 % 2) + slice * (c / 4);
            // The point's crossings along x and y come before that along z.
            let mut id = first_vertex[p];
            if e >= 4 && px + 1 < nx {
                id += crosses(density, p, 1usize, level);
            }
            if e >= 8 && py + 1 < ny {
                id += crosses(density, p, nx, level);
            }
            faces[to + k] = id;
        }
    }
}
