//! Triangles that optimized tetrahedra and marching cubes need for the same mean error.

use diorama_geom::Mesh;
use diorama_kernels::ops::sign_change_loss;
use diorama_kernels::ops::tetrahedral_surface::{self, Surface};
use diorama_mesh::extract::{Grid, from_densities};
use diorama_mesh::tetrahedral_fit::{FitOptions, MeshTarget, Target, fit, mean_distance};
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

/// Mesh of the vertices and faces of an OBJ file, centered, its longest side 1.6 long.
fn obj(name: &str) -> Option<Mesh> {
    let path = std::env::var("DIORAMA_TEST_DATA").ok().map(|d| std::path::PathBuf::from(d).join(name)).filter(|p| p.is_file());
    let Some(path) = path else {
        assert!(std::env::var("DIORAMA_REQUIRE_DATA").is_err(), "DIORAMA_TEST_DATA/{name} is required");
        println!("skipped: no test data");
        return None;
    };
    let (text, mut mesh) = (std::fs::read_to_string(path).unwrap(), Mesh::default());
    for line in text.lines() {
        let mut words = line.split_whitespace();
        match words.next() {
            Some("v") => mesh.positions.push(words.map(|w| w.parse().unwrap()).collect::<Vec<f32>>().try_into().unwrap()),
            Some("f") => {
                let corners: Vec<u32> = words.map(|w| w.split('/').next().unwrap().parse::<u32>().unwrap() - 1).collect();
                mesh.faces.extend((2..corners.len()).map(|k| [corners[0], corners[k - 1], corners[k]]));
            }
            _ => {}
        }
    }
    let (lo, hi) = mesh.bounds().unwrap();
    let size = (0..3).map(|k| hi[k] - lo[k]).fold(0.0, f32::max);
    mesh.positions.iter_mut().for_each(|p| *p = std::array::from_fn(|k| (p[k] - 0.5 * (lo[k] + hi[k])) * 1.6 / size));
    Some(mesh)
}

#[test]
#[ignore = "minutes; needs DIORAMA_TEST_DATA/meshes"]
fn a_fitted_cow_needs_fewer_triangles_than_marching_cubes() {
    let Some(mesh) = obj("meshes/spot/spot.obj") else { return };
    assert!(mesh.is_watertight());
    let target = MeshTarget::new(&mesh, 40_000);
    let one_way = |m: &Mesh| mean_distance(m, &target, 4);
    let both_ways = |m: &Mesh| 0.5 * (one_way(m) + mean_distance(&mesh, &MeshTarget::new(m, 0), 3));
    let (resolutions, options) = ([16, 24, 32, 48, 64, 96, 128], FitOptions { steps: 400, ..FitOptions::default() });
    for (name, error) in [("spot, both ways", &both_ways as &dyn Fn(&Mesh) -> f64), ("spot, mesh to target", &one_way)] {
        for [_, after] in ratios(name, &target, &resolutions, &[13, 20, 26], &options, error) {
            assert!(after <= 0.6, "{name}: {after}");
        }
    }
}

/// Median milliseconds of `work`.
fn median_ms(mut work: impl FnMut()) -> f64 {
    let mut times: Vec<f64> = (0..31)
        .map(|_| {
            let start = std::time::Instant::now();
            work();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[15]
}

#[test]
#[ignore = "a measurement"]
fn time_of_extraction_and_gradients() {
    for n in [26, 52] {
        let start = std::time::Instant::now();
        let grid = TetrahedralGrid::lattice(n, EDGE);
        let build = start.elapsed().as_secs_f64() * 1e3;
        let sphere = Sphere { radius: 0.8 };
        let of_sphere: Vec<f32> = grid.rest.iter().map(|p| -sphere.signed_distance(*p)).collect();
        for (name, s) in [("sphere", of_sphere), ("random", grid.random_distances(0))] {
            let (t, p) = (&grid.topology, vec![[0.1; 3]; grid.vertices()]);
            let (mut surface, mut positions) = (Surface::default(), grid.rest.clone());
            let deform = median_ms(|| grid.deform(&p, &mut positions));
            let extract = median_ms(|| tetrahedral_surface::cpu::extract(t, &s, &positions, &mut surface));
            let d = vec![[1.0; 3]; surface.positions.len()];
            let (mut d_s, mut d_p) = (vec![0.0; s.len()], vec![[0.0; 3]; s.len()]);
            let backward = median_ms(|| {
                d_s.fill(0.0);
                d_p.fill([0.0; 3]);
                tetrahedral_surface::cpu::backward(t, &surface, (&s, &positions), &d, (&mut d_s, &mut d_p));
                grid.deform_backward(&p, &mut d_p);
            });
            let sign = median_ms(|| {
                assert!(sign_change_loss::cpu::value(t, &surface, &s) > 0.0);
                sign_change_loss::cpu::backward(t, &surface, &s, 0.2, &mut d_s);
            });
            println!(
                "n {n}, {name}: {} tetrahedra, {} edges, {} faces; build {build:.0} ms, deform {deform:.2} ms, extract {extract:.2} ms, \
                 backward {backward:.2} ms, sign change loss {sign:.2} ms",
                t.cells().len(),
                t.edges().len(),
                surface.faces.len()
            );
        }
    }
}
