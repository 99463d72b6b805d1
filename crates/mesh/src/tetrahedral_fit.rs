//! Fits the surface of a tetrahedral grid to a target: distances and offsets that make the mean squared distance of the surface to the
//! target least, by Adam.

use crate::closest_point::ClosestPoint;
use crate::tetrahedral_grid::TetrahedralGrid;
use diorama_geom::Mesh;
use diorama_geom::mesh::{cross, sub};
use diorama_kernels::ops::adam::{self, Adam};
use diorama_kernels::ops::tetrahedral_surface::{self, Surface};
use rayon::prelude::*;

/// A closed surface with distances.
pub trait Target: Sync {
    /// The point of the target closest to `p`.
    fn closest(&self, p: [f32; 3]) -> [f32; 3];

    /// Distance to the target, negative inside.
    fn signed_distance(&self, p: [f32; 3]) -> f32;
}

impl Target for ClosestPoint {
    fn closest(&self, p: [f32; 3]) -> [f32; 3] {
        self.nearest(p).point
    }

    fn signed_distance(&self, p: [f32; 3]) -> f32 {
        ClosestPoint::signed_distance(self, p)
    }
}

/// Settings of a fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitOptions {
    pub steps: usize,
    /// First learning rate of the distances (in cells) and of the offsets' parameters; it falls to a hundredth.
    pub rate: f32,
    /// Samples per triangle: the centers of `subdivision²` parts.
    pub subdivision: usize,
}

impl Default for FitOptions {
    fn default() -> Self {
        FitOptions { steps: 300, rate: 0.02, subdivision: 3 }
    }
}

/// Distances and offsets of a grid's vertices, and the surface that they give.
#[derive(Clone, Debug)]
pub struct Fitted {
    /// Inside positive, in cells `[V]`.
    pub distances: Vec<f32>,
    /// Parameters of the offsets `[V, 3]`.
    pub offsets: Vec<[f32; 3]>,
    pub mesh: Mesh,
}

/// Fits the surface to `target`, beginning with the target's own distances at the grid's vertices. Zero steps give that surface.
pub fn fit(grid: &TetrahedralGrid, target: &dyn Target, options: &FitOptions) -> Fitted {
    let n = grid.vertices();
    let mut distances: Vec<f32> = grid.rest.par_iter().map(|p| -target.signed_distance(*p) / grid.cell).collect();
    let (mut offsets, mut positions) = (vec![[0.0f32; 3]; n], grid.rest.clone());
    let (mut d_s, mut d_positions) = (vec![0.0f32; n], vec![[0.0f32; 3]; n]);
    let mut moments = [n, n, 3 * n, 3 * n].map(|len| vec![0.0f32; len]);
    let mut surface = Surface::default();
    for step in 0..options.steps {
        grid.deform(&offsets, &mut positions);
        tetrahedral_surface::cpu::extract(&grid.topology, &distances, &positions, &mut surface);
        let d_vertices = gradient(&surface.positions, &surface.faces, target, options.subdivision);
        d_s.fill(0.0);
        d_positions.fill([0.0; 3]);
        let gradients = (&mut d_s[..], &mut d_positions[..]);
        tetrahedral_surface::cpu::backward(&grid.topology, &surface, (&distances, &positions), &d_vertices, gradients);
        grid.deform_backward(&offsets, &mut d_positions);
        let rate = options.rate * 0.01f32.powf(step as f32 / options.steps as f32);
        let (adam, t) = (Adam { rate, beta2: 0.95, ..Adam::default() }, step as u32 + 1);
        let [m_s, v_s, m_p, v_p] = &mut moments;
        adam::cpu::dense(&adam, t, &mut distances, m_s, v_s, &d_s);
        adam::cpu::dense(&adam, t, offsets.as_flattened_mut(), m_p, v_p, d_positions.as_flattened());
    }
    grid.deform(&offsets, &mut positions);
    tetrahedral_surface::cpu::extract(&grid.topology, &distances, &positions, &mut surface);
    let mesh = Mesh { positions: surface.positions, faces: surface.faces, ..Mesh::default() };
    Fitted { distances, offsets, mesh }
}

/// Barycentric coordinates of the centers of the `n²` equal parts of a triangle.
fn centers(n: usize) -> Vec<[f32; 3]> {
    let mut out = Vec::with_capacity(n * n);
    for a in 0..n {
        for b in 0..n - a {
            let of = |third: f32| {
                let (u, v) = ((a as f32 + third) / n as f32, (b as f32 + third) / n as f32);
                [1.0 - u - v, u, v]
            };
            out.push(of(1.0 / 3.0));
            if a + b + 1 < n {
                out.push(of(2.0 / 3.0));
            }
        }
    }
    out
}

/// Double area of a triangle.
fn double_area([a, b, c]: [[f32; 3]; 3]) -> f32 {
    let n = cross(sub(b, a), sub(c, a));
    (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt()
}

fn blend(corners: [[f32; 3]; 3], weights: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|k| (0..3).map(|i| weights[i] * corners[i][k]).sum())
}

/// Gradient of the mean squared distance to the target over the area, areas and closest points held.
fn gradient(positions: &[[f32; 3]], faces: &[[u32; 3]], target: &dyn Target, subdivision: usize) -> Vec<[f32; 3]> {
    let samples = centers(subdivision);
    let of = |f: &[u32; 3]| {
        let corners = f.map(|i| positions[i as usize]);
        let weight = double_area(corners) / samples.len() as f32;
        let mut d = [[0.0f32; 3]; 3];
        for w in &samples {
            let p = blend(corners, *w);
            let away = sub(p, target.closest(p));
            (0..9).for_each(|i| d[i / 3][i % 3] += weight * w[i / 3] * away[i % 3]);
        }
        d
    };
    let of_faces: Vec<[[f32; 3]; 3]> = faces.par_iter().with_min_len(64).map(of).collect();
    let mut out = vec![[0.0; 3]; positions.len()];
    for (f, d) in faces.iter().zip(&of_faces) {
        for (i, d) in f.iter().zip(d) {
            (0..3).for_each(|k| out[*i as usize][k] += d[k]);
        }
    }
    out
}

/// Mean distance of the mesh's surface to the target, over its area, from `subdivision²` samples of each triangle; infinite for a mesh
/// without area.
pub fn mean_distance(mesh: &Mesh, target: &dyn Target, subdivision: usize) -> f64 {
    let samples = centers(subdivision);
    let of = |f: &[u32; 3]| {
        let corners = f.map(|i| mesh.positions[i as usize]);
        let sum: f64 = samples.iter().map(|w| target.signed_distance(blend(corners, *w)).abs() as f64).sum();
        let area = double_area(corners) as f64;
        (area * sum / samples.len() as f64, area)
    };
    let parts: Vec<(f64, f64)> = mesh.faces.par_iter().with_min_len(64).map(of).collect();
    let (sum, area) = parts.iter().fold((0.0, 0.0), |(s, a), (ds, da)| (s + ds, a + da));
    if area > 0.0 { sum / area } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn centers_are_spread_evenly() {
        for n in 1..6 {
            let c = centers(n);
            assert_eq!(c.len(), n * n);
            for k in 0..3 {
                assert!((c.iter().map(|w| w[k]).sum::<f32>() / c.len() as f32 - 1.0 / 3.0).abs() < 1e-5);
                assert!(c.iter().all(|w| w[k] > 0.0));
            }
        }
    }
}
