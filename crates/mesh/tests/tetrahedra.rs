//! Triangles that optimized tetrahedra and marching cubes need for the same mean error.

use diorama_geom::Mesh;
use diorama_mesh::extract::{Grid, from_densities};
use diorama_mesh::tetrahedral_fit::{FitOptions, Target, fit, mean_distance};
use diorama_mesh::tetrahedral_grid::TetrahedralGrid;
use rayon::prelude::*;

struct Sphere {
    radius: f32,
}

impl Target for Sphere {
    fn closest(&self, p: [f32; 3]) -> [f32; 3] {
        let length = p.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-20);
        p.map(|v| v * self.radius / length)
    }

    fn signed_distance(&self, p: [f32; 3]) -> f32 {
        p.iter().map(|v| v * v).sum::<f32>().sqrt() - self.radius
    }
}

/// Edge of the box, as the grid's.
const EDGE: f32 = 2.1;

/// Marching cubes with linear interpolation of the target's exact distances.
fn cubes(target: &dyn Target, resolution: usize) -> Mesh {
    let grid = Grid { min: [-EDGE / 2.0; 3], max: [EDGE / 2.0; 3], resolution };
    let ([nx, ny, nz], cell) = (grid.points(), grid.cell());
    let place = |i: usize| [i % nx, i / nx % ny, i / nx / ny].map(|v| v as f32 * cell - EDGE / 2.0);
    let values: Vec<f32> = (0..nx * ny * nz).into_par_iter().map(|i| -target.signed_distance(place(i))).collect();
    from_densities(&values, &grid, 0.0)
}

/// Triangles at which the curve of `(triangles, error)`, ascending in triangles, has `error`: linear in logarithms, its ends extended.
fn triangles_at(curve: &[(f64, f64)], error: f64) -> f64 {
    let at = curve.iter().position(|c| c.1 < error).unwrap_or(curve.len()).clamp(1, curve.len() - 1);
    let ([t0, e0], [t1, e1]) = ([curve[at - 1].0.ln(), curve[at - 1].1.ln()], [curve[at].0.ln(), curve[at].1.ln()]);
    (t0 + (error.ln() - e0) / (e1 - e0) * (t1 - t0)).exp()
}

/// Prints and returns, for each grid, the ratio of triangles to those of marching cubes at equal error: before and after the fit.
fn ratios(
    name: &str,
    target: &dyn Target,
    resolutions: &[usize],
    grids: &[usize],
    options: &FitOptions,
    error: &dyn Fn(&Mesh) -> f64,
) -> Vec<[f64; 2]> {
    let curve: Vec<(f64, f64)> = resolutions.iter().map(|r| cubes(target, *r)).map(|m| (m.faces.len() as f64, error(&m))).collect();
    for (r, (triangles, error)) in resolutions.iter().zip(&curve) {
        println!("{name}: cubes {r:3}: {triangles:6} triangles, error {error:.3e}");
    }
    let of = |n: &usize| {
        let grid = TetrahedralGrid::lattice(*n, EDGE);
        [0, options.steps].map(|steps| {
            let start = std::time::Instant::now();
            let mesh = fit(&grid, target, &FitOptions { steps, ..*options }).mesh;
            let secs = start.elapsed().as_secs_f64();
            assert!(mesh.is_watertight());
            let (triangles, error) = (mesh.faces.len() as f64, error(&mesh));
            let ratio = triangles / triangles_at(&curve, error);
            println!("{name}: lattice {n:2}, {steps:4} steps: {triangles:6} triangles, error {error:.3e}, ratio {ratio:.3}, {secs:.1} s");
            ratio
        })
    };
    grids.iter().map(of).collect()
}

#[test]
fn a_fitted_sphere_needs_fewer_triangles_than_marching_cubes() {
    let sphere = Sphere { radius: 0.8 };
    let error = |m: &Mesh| mean_distance(m, &sphere, 5);
    for [before, after] in ratios("sphere", &sphere, &[6, 8, 12, 16, 24, 32, 48, 64], &[6, 8], &FitOptions::default(), &error) {
        // Unoptimized tetrahedra need more.
        assert!(before > 1.3, "{before}");
        assert!(after <= 0.6, "{after}");
    }
}
