//! Cases of surfaces, for the tests of marching cubes and marching tetrahedra and for `bench check`.

#[cfg(feature = "gpu")]
use super::{CaseTable, cpu, gpu as on_gpu};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random_unit;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Densities of a grid, and the level at which the surface lies.
pub struct Case {
    pub size: [usize; 3],
    pub density: Vec<f32>,
    pub level: f32,
}

pub fn cases() -> [Case; 5] {
    let of = |size: [usize; 3]| Case { size, density: random_unit(size.iter().product(), 5), level: 0.4 };
    [[0, 3, 3], [1, 1, 1], [2, 2, 2], [7, 5, 6], [9, 13, 11]].map(of)
}

/// A crossing, named by the edge that it lies on: direction and lower point.
#[cfg(feature = "gpu")]
fn edge_of(p: &[f32]) -> (usize, [u32; 3]) {
    let direction = (0..3).filter(|&k| p[k].fract() > 0.0).map(|k| 1 << k).sum();
    (direction, [p[0] as u32, p[1] as u32, p[2] as u32])
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    check_surface(gpu, table, "marching cubes", &super::case_table())
}

/// The same vertices on the same edges, and the same triangles whichever vertex they begin with.
#[cfg(feature = "gpu")]
pub fn check_surface(gpu: &Gpu, table: &mut Table, op: &'static str, of_cells: &CaseTable) -> Result<(), GpuError> {
    for Case { size: [nx, ny, nz], density, level } in cases() {
        let mut mesher = cpu::Mesher::new(of_cells, nx, ny, level);
        density.chunks_exact((nx * ny).max(1)).for_each(|slice| mesher.push(slice));
        let (vertices, faces) = on_gpu::extract(gpu, of_cells, &gpu.upload(&density), (nx, ny, nz), level)?;
        let (vertices, faces) = (gpu.read(&vertices)?, gpu.read(&faces)?);
        let shape = format!("{nx}x{ny}x{nz}");
        let sorted = |vertices: &[f32]| {
            let mut all: Vec<_> = vertices.chunks_exact(3).map(|p| (edge_of(p), [p[0], p[1], p[2]])).collect();
            all.sort_by_key(|v| v.0);
            all.iter().flat_map(|v| v.1).collect::<Vec<f32>>()
        };
        let want = sorted(mesher.positions.as_flattened());
        table.close(op, "vertices", &shape, &gpu.upload(&sorted(&vertices)), &wide(&want))?;
        let triangles = |vertices: &[f32], faces: &[u32]| {
            let edge = |v: u32| edge_of(&vertices[v as usize * 3..][..3]);
            let mut all: Vec<_> = faces.chunks_exact(3).map(|f| [edge(f[0]), edge(f[1]), edge(f[2])]).collect();
            all.iter_mut().for_each(|t| {
                let least = (0..3).min_by_key(|&k| t[k]).unwrap_or(0);
                t.rotate_left(least);
            });
            all.sort();
            all
        };
        let same = triangles(&vertices, &faces) == triangles(mesher.positions.as_flattened(), mesher.faces.as_flattened());
        let outcome = if same { Ok(0.0) } else { Err("other triangles than the CPU's".into()) };
        table.row(op, "faces", shape, outcome);
    }
    Ok(())
}
