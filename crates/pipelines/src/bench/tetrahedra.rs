//! `diorama bench tetrahedra`: triangles that fitted tetrahedra and marching cubes need for the same mean error.

use crate::error::{PipelineError, Result};
use diorama_data::model_file;
use diorama_geom::Mesh;
use diorama_mesh::extract::{Grid, from_densities};
use diorama_mesh::repair;
use diorama_mesh::tetrahedral_fit::{FitOptions, MeshTarget, Target, fit, mean_distance};
use diorama_mesh::tetrahedral_grid::{BOX_EDGE, TetrahedralGrid};
use rayon::prelude::*;
use serde::Serialize;
use std::path::Path;
use std::time::Instant;

/// Cells of the grids of marching cubes, with which the others are compared, and of the lattices of tetrahedra.
const CUBES: [usize; 8] = [12, 16, 24, 32, 48, 64, 96, 128];
const LATTICES: [usize; 3] = [13, 20, 26];
/// Length of the longest side of a mesh, in the box of the lattice.
const SIDE: f32 = 1.6;
/// Points on a mesh that the fitted surface comes close to, and steps of the fit.
const POINTS: usize = 40_000;
const STEPS: usize = 400;
/// Samples per side of a triangle, for errors.
const SAMPLES: usize = 4;
const BACK: usize = 3;

/// A lattice before and after its vertices were fitted.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Compared {
    pub lattice: usize,
    pub triangles: usize,
    pub error: f64,
    /// Triangles over those of marching cubes at the same error.
    pub ratio: f64,
    pub fitted_triangles: usize,
    pub fitted_error: f64,
    pub fitted_ratio: f64,
    pub seconds: f64,
}

/// The comparison for one shape.
#[derive(Clone, Debug, Serialize)]
pub struct TetrahedraReport {
    pub shape: String,
    /// Triangles and errors of marching cubes.
    pub cubes: Vec<(usize, f64)>,
    pub lattices: Vec<Compared>,
}

struct Sphere;

impl Sphere {
    const RADIUS: f32 = 0.8;
}

impl Target for Sphere {
    fn closest(&self, p: [f32; 3]) -> [f32; 3] {
        let length = p.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-20);
        p.map(|v| v * Self::RADIUS / length)
    }

    fn signed_distance(&self, p: [f32; 3]) -> f32 {
        p.iter().map(|v| v * v).sum::<f32>().sqrt() - Self::RADIUS
    }
}

/// Compares on a sphere of radius 0.8.
pub fn sphere() -> TetrahedraReport {
    compare("sphere", &Sphere, &|m| mean_distance(m, &Sphere, SAMPLES), &[6, 8, 13])
}

/// Compares on a closed mesh from a file; errors are means of the distances from the surface to the mesh and back.
///
/// # Errors
/// When the file cannot be read, or its mesh is not closed.
pub fn mesh(file: &Path) -> Result<TetrahedraReport> {
    let mesh = closed(file)?;
    let target = MeshTarget::new(&mesh, POINTS);
    let error = |m: &Mesh| 0.5 * (mean_distance(m, &target, SAMPLES) + mean_distance(&mesh, &MeshTarget::new(m, 0), BACK));
    let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Ok(compare(&name, &target, &error, &LATTICES))
}

/// A model's triangles as one mesh, centered, its longest side [`SIDE`] long.
fn closed(file: &Path) -> Result<Mesh> {
    let model = model_file::read(file)?.model;
    let mut mesh = Mesh::default();
    for instance in &model.instances {
        let first = mesh.positions.len() as u32;
        let part = &model.parts[instance.part].mesh;
        let moved = |p: &[f32; 3]| instance.world_from_part.transform_point3(glam::DVec3::from(p.map(f64::from))).as_vec3().to_array();
        mesh.positions.extend(part.positions.iter().map(moved));
        mesh.faces.extend(part.faces.iter().map(|f| f.map(|i| i + first)));
    }
    repair::weld(&mut mesh);
    if !mesh.is_watertight() {
        return Err(PipelineError::Usage(format!("{}: the mesh is not closed; distances need an inside", file.display())));
    }
    let (lo, hi) = mesh.bounds().unwrap_or_default();
    let size = (0..3).map(|k| hi[k] - lo[k]).fold(1e-12, f32::max);
    mesh.positions.iter_mut().for_each(|p| *p = std::array::from_fn(|k| (p[k] - 0.5 * (lo[k] + hi[k])) * SIDE / size));
    Ok(mesh)
}

fn compare(shape: &str, target: &dyn Target, error: &dyn Fn(&Mesh) -> f64, lattices: &[usize]) -> TetrahedraReport {
    let cubes: Vec<(usize, f64)> = CUBES.iter().map(|r| of_cubes(target, *r)).map(|m| (m.faces.len(), error(&m))).collect();
    let of = |n: &usize| {
        let grid = TetrahedralGrid::lattice(*n, BOX_EDGE);
        let plain = fit(&grid, target, &FitOptions { steps: 0, ..FitOptions::default() }).mesh;
        let start = Instant::now();
        let fitted = fit(&grid, target, &FitOptions { steps: STEPS, ..FitOptions::default() }).mesh;
        let seconds = start.elapsed().as_secs_f64();
        let (before, after) = (error(&plain), error(&fitted));
        Compared {
            lattice: *n,
            triangles: plain.faces.len(),
            error: before,
            ratio: plain.faces.len() as f64 / triangles_at(&cubes, before),
            fitted_triangles: fitted.faces.len(),
            fitted_error: after,
            fitted_ratio: fitted.faces.len() as f64 / triangles_at(&cubes, after),
            seconds,
        }
    };
    TetrahedraReport { shape: shape.into(), lattices: lattices.iter().map(of).collect(), cubes }
}

/// Marching cubes with linear interpolation of the target's exact distances.
fn of_cubes(target: &dyn Target, resolution: usize) -> Mesh {
    let half = 0.5 * BOX_EDGE;
    let grid = Grid { min: [-half; 3], max: [half; 3], resolution };
    let ([nx, ny, nz], cell) = (grid.points(), grid.cell());
    let place = |i: usize| [i % nx, i / nx % ny, i / nx / ny].map(|v| v as f32 * cell - half);
    let values: Vec<f32> = (0..nx * ny * nz).into_par_iter().map(|i| -target.signed_distance(place(i))).collect();
    from_densities(&values, &grid, 0.0)
}

/// Triangles at which a curve of (triangles, error), ascending in triangles, has `error`: linear in logarithms, its ends extended.
fn triangles_at(curve: &[(usize, f64)], error: f64) -> f64 {
    let at = curve.iter().position(|c| c.1 < error).unwrap_or(curve.len()).clamp(1, curve.len() - 1);
    let logarithms = |c: (usize, f64)| ((c.0 as f64).ln(), c.1.ln());
    let ((t0, e0), (t1, e1)) = (logarithms(curve[at - 1]), logarithms(curve[at]));
    (t0 + (error.ln() - e0) / (e1 - e0) * (t1 - t0)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_is_read_between_and_beyond_its_points() {
        // Error falls with the inverse of the triangles.
        let curve = [(100, 1e-2), (400, 2.5e-3), (1600, 6.25e-4)];
        for (error, triangles) in [(5e-3, 200.0), (1e-3, 1000.0), (2e-2, 50.0), (1e-4, 10_000.0)] {
            assert!((triangles_at(&curve, error) / triangles - 1.0).abs() < 1e-9, "{error}");
        }
    }
}
