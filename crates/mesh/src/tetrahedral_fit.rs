//! Fits the surface of a tetrahedral grid to a target: distances and offsets that make the mean squared distance least, from the surface to
//! the target and from points of the target to the surface, by Adam.

use crate::closest_point::{SignedDistance, TriangleTree};
use crate::tetrahedral_grid::TetrahedralGrid;
use diorama_geom::Mesh;
use diorama_geom::mesh::{cross, sub};
use diorama_geom::rng::Rng;
use diorama_kernels::ops::adam::{self, Adam};
use diorama_kernels::ops::tetrahedral_surface::{self, Surface};
use rayon::prelude::*;

/// A closed surface with distances.
pub trait Target: Sync {
    /// The point of the target closest to `p`.
    fn closest(&self, p: [f32; 3]) -> [f32; 3];

    /// Distance to the target, negative inside.
    fn signed_distance(&self, p: [f32; 3]) -> f32;

    /// Points spread evenly over the target, to which the surface comes close; without them only the surface's own points count.
    fn points(&self) -> &[[f32; 3]] {
        &[]
    }
}

/// A closed mesh as a target.
pub struct MeshTarget {
    distance: SignedDistance,
    points: Vec<[f32; 3]>,
}

impl MeshTarget {
    /// With `points` points spread evenly over the area, which the fitted surface comes close to.
    ///
    /// # Panics
    /// When the mesh has no faces.
    pub fn new(mesh: &Mesh, points: usize) -> MeshTarget {
        let corners = |f: &[u32; 3]| f.map(|i| mesh.positions[i as usize]);
        let mut sum = 0.0;
        let areas: Vec<f64> = mesh.faces.iter().map(|f| double_area(corners(f)) as f64).map(|area| (sum += area, sum).1).collect();
        let rng = Rng::new(0, 0xf17);
        let point = |i: usize| {
            let at = sum * (i as f64 + 0.5) / points as f64;
            let face = areas.partition_point(|a| *a < at).min(areas.len() - 1);
            let (u, v) = (rng.uniform(2 * i as u64).sqrt(), rng.uniform(2 * i as u64 + 1));
            blend(corners(&mesh.faces[face]), [1.0 - u, u * (1.0 - v), u * v])
        };
        MeshTarget { distance: SignedDistance::new(mesh), points: (0..points).map(point).collect() }
    }
}

impl Target for MeshTarget {
    fn closest(&self, p: [f32; 3]) -> [f32; 3] {
        self.distance.nearest(p).point
    }

    fn signed_distance(&self, p: [f32; 3]) -> f32 {
        self.distance.at(p)
    }

    fn points(&self) -> &[[f32; 3]] {
        &self.points
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
        let mesh = Mesh { positions: std::mem::take(&mut surface.positions), faces: std::mem::take(&mut surface.faces), ..Mesh::default() };
        let mut d_vertices = gradient_to_target(&mesh, target, options.subdivision);
        add_gradient_from_points(&mesh, target.points(), &mut d_vertices);
        (surface.positions, surface.faces) = (mesh.positions, mesh.faces);
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

/// Gradient of the squared distance to the target over the area, areas and closest points held.
fn gradient_to_target(mesh: &Mesh, target: &dyn Target, subdivision: usize) -> Vec<[f32; 3]> {
    let samples = centers(subdivision);
    let of = |f: &[u32; 3]| {
        let corners = f.map(|i| mesh.positions[i as usize]);
        let weight = double_area(corners) / samples.len() as f32;
        let mut d = [[0.0f32; 3]; 3];
        for w in &samples {
            let p = blend(corners, *w);
            let away = sub(p, target.closest(p));
            (0..9).for_each(|i| d[i / 3][i % 3] += weight * w[i / 3] * away[i % 3]);
        }
        d
    };
    let of_faces: Vec<[[f32; 3]; 3]> = mesh.faces.par_iter().with_min_len(64).map(of).collect();
    let mut out = vec![[0.0; 3]; mesh.positions.len()];
    mesh.faces.iter().zip(&of_faces).for_each(|(f, d)| add(f, d, &mut out));
    out
}

/// Adds the gradient of the squared distance of points to the surface, as much in all as the surface's area weighs.
fn add_gradient_from_points(mesh: &Mesh, points: &[[f32; 3]], out: &mut [[f32; 3]]) {
    if points.is_empty() || mesh.faces.is_empty() {
        return;
    }
    let tree = TriangleTree::new(mesh);
    let area: f64 = mesh.faces.iter().map(|f| double_area(f.map(|i| mesh.positions[i as usize])) as f64).sum();
    let weight = (area / points.len() as f64) as f32;
    let of = |p: &[f32; 3]| {
        let c = tree.nearest(*p);
        let away = sub(c.point, *p);
        (c.face, c.weights.map(|w| away.map(|v| weight * w * v)))
    };
    let of_points: Vec<(u32, [[f32; 3]; 3])> = points.par_iter().with_min_len(64).map(of).collect();
    of_points.iter().for_each(|(face, d)| add(&mesh.faces[*face as usize], d, out));
}

fn add(face: &[u32; 3], d: &[[f32; 3]; 3], out: &mut [[f32; 3]]) {
    for (i, d) in face.iter().zip(d) {
        (0..3).for_each(|k| out[*i as usize][k] += d[k]);
    }
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
