//! Marching cubes or tetrahedra over a [`FieldQuery`], a few slices at a time. Memory holds two slices of density plus the surface, at any
//! resolution.

use diorama_geom::Mesh;
use diorama_geom::field_query::FieldQuery;
use diorama_kernels::ops::marching_cubes::{self, CaseTable, cpu::Mesher};
use diorama_kernels::ops::marching_tetrahedra;

/// Extraction algorithm.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// Marching cubes: fewest faces.
    #[default]
    Cubes,
    /// Marching tetrahedra: about twice the faces, no ambiguous cases.
    Tetrahedra,
}

impl Method {
    pub(crate) fn table(self) -> CaseTable {
        match self {
            Method::Cubes => marching_cubes::case_table(),
            Method::Tetrahedra => marching_tetrahedra::case_table(),
        }
    }
}

impl std::str::FromStr for Method {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        match s {
            "mc" => Ok(Method::Cubes),
            "mt" => Ok(Method::Tetrahedra),
            _ => Err(format!("extract {s:?}: expected mc (marching cubes) or mt (marching tetrahedra)")),
        }
    }
}

/// Region and resolution of an extraction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// Lowest and highest corner in the world.
    pub min: [f32; 3],
    pub max: [f32; 3],
    /// Cells along the longest side.
    pub resolution: usize,
}

impl Grid {
    /// Edge of a cell.
    pub fn cell(&self) -> f32 {
        let longest = (0..3).map(|k| self.max[k] - self.min[k]).fold(0.0, f32::max);
        longest / self.resolution as f32
    }

    /// Grid points per axis.
    pub fn points(&self) -> [usize; 3] {
        let cell = self.cell();
        std::array::from_fn(|k| ((self.max[k] - self.min[k]) / cell - 1e-4).ceil().max(1.0) as usize + 1)
    }
}

/// Grid points per query of the field.
const BATCH: usize = 1 << 18;

/// Extracts the surface where the density equals `level`, in world coordinates, with faces outward. Space outside the box counts as empty,
/// so the surface is closed where the box cuts it. `progress` is called with the slices done and the total.
pub fn extract(field: &dyn FieldQuery, grid: &Grid, level: f32, method: Method, progress: &mut dyn FnMut(usize, usize)) -> Mesh {
    let [nx, ny, _] = grid.points();
    let cell = grid.cell();
    // One empty layer around the box closes the surface.
    let (px, py) = (nx + 2, ny + 2);
    let table = method.table();
    let mut mesher = Mesher::new(&table, px, py, level);
    let empty = vec![0.0f32; px * py];
    mesher.push(&empty);
    let mut slice = vec![0.0f32; px * py];
    each_slab(field, grid, progress, &mut |slab| {
        for values in slab.chunks_exact(nx * ny) {
            slice.fill(0.0);
            for y in 0..ny {
                slice[(y + 1) * px + 1..][..nx].copy_from_slice(&values[y * nx..(y + 1) * nx]);
            }
            mesher.push(&slice);
        }
    });
    mesher.push(&empty);
    // The empty layer lies one cell outside the box: move the vertices on it back onto the box.
    let world =
        |p: &[f32; 3]| std::array::from_fn(|k| (grid.min[k] + (p[k] - 1.0) * cell).clamp(grid.min[k], grid.max[k].max(grid.min[k] + cell)));
    let positions = mesher.positions.iter().map(world).collect();
    Mesh { positions, faces: mesher.faces, ..Mesh::default() }
}

/// Densities `[nz, ny, nx]` at the points of a grid.
pub fn sample(field: &dyn FieldQuery, grid: &Grid, progress: &mut dyn FnMut(usize, usize)) -> Vec<f32> {
    let mut sigma = Vec::with_capacity(grid.points().iter().product());
    each_slab(field, grid, progress, &mut |slab| sigma.extend_from_slice(slab));
    sigma
}

/// Passes the densities on, a few slices at a time, in ascending order.
fn each_slab(field: &dyn FieldQuery, grid: &Grid, progress: &mut dyn FnMut(usize, usize), take: &mut dyn FnMut(&[f32])) {
    let [nx, ny, nz] = grid.points();
    let cell = grid.cell();
    let at_once = (BATCH / (nx * ny)).clamp(1, nz);
    let (mut points, mut sigma) = (Vec::new(), Vec::new());
    for z0 in (0..nz).step_by(at_once) {
        let z1 = (z0 + at_once).min(nz);
        points.clear();
        for z in z0..z1 {
            for y in 0..ny {
                for x in 0..nx {
                    points.push([grid.min[0] + x as f32 * cell, grid.min[1] + y as f32 * cell, grid.min[2] + z as f32 * cell]);
                }
            }
        }
        sigma.resize(points.len(), 0.0);
        field.density(&points, &mut sigma);
        take(&sigma);
        progress(z1, nz);
    }
}

/// Extracts the surface from densities in memory, in world coordinates; it is open where the box cuts it.
pub fn from_densities(sigma: &[f32], grid: &Grid, level: f32) -> Mesh {
    let cell = grid.cell();
    let (mut positions, faces) = marching_cubes::cpu::surface(&marching_cubes::case_table(), sigma, grid.points(), level);
    positions.iter_mut().for_each(|p| *p = std::array::from_fn(|k| grid.min[k] + p[k] * cell));
    Mesh { positions, faces, ..Mesh::default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Density of a sphere and of a box: a steep ramp through the level at the surface.
    enum Shape {
        Sphere { radius: f32 },
        Box { half: [f32; 3] },
    }

    impl Shape {
        /// Signed distance, negative inside.
        fn distance(&self, p: [f32; 3]) -> f32 {
            match self {
                Shape::Sphere { radius } => (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt() - radius,
                Shape::Box { half } => {
                    let q: [f32; 3] = std::array::from_fn(|k| p[k].abs() - half[k]);
                    let out = q.map(|v| v.max(0.0));
                    (out[0] * out[0] + out[1] * out[1] + out[2] * out[2]).sqrt() + q[0].max(q[1]).max(q[2]).min(0.0)
                }
            }
        }
    }

    impl FieldQuery for Shape {
        fn density(&self, points: &[[f32; 3]], sigma: &mut [f32]) {
            for (p, s) in points.iter().zip(sigma) {
                *s = (10.0 - 40.0 * self.distance(*p)).max(0.0);
            }
        }
        fn color(&self, _: &[[f32; 3]], _: &[[f32; 3]], rgb: &mut [[f32; 3]]) {
            rgb.fill([0.5; 3]);
        }
    }

    const GRID: Grid = Grid { min: [-1.0; 3], max: [1.0; 3], resolution: 48 };

    /// Distance from a point to the mesh's triangles.
    fn nearest(mesh: &Mesh, p: [f32; 3]) -> f32 {
        mesh.faces.iter().map(|f| triangle_distance(p, f.map(|i| mesh.positions[i as usize]))).fold(f32::INFINITY, f32::min)
    }

    /// Distance to a triangle: to its plane where the foot lies inside, else to the nearest edge.
    fn triangle_distance(p: [f32; 3], t: [[f32; 3]; 3]) -> f32 {
        use diorama_geom::mesh::{cross, sub};
        let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let n = cross(sub(t[1], t[0]), sub(t[2], t[0]));
        let inside = (0..3).all(|k| dot(cross(sub(t[(k + 1) % 3], t[k]), sub(p, t[k])), n) >= 0.0);
        if inside && dot(n, n) > 0.0 {
            return (dot(sub(p, t[0]), n) / dot(n, n).sqrt()).abs();
        }
        let edge = |a: [f32; 3], b: [f32; 3]| {
            let d = sub(b, a);
            let s = (dot(sub(p, a), d) / dot(d, d).max(1e-20)).clamp(0.0, 1.0);
            let q = sub(p, std::array::from_fn(|k| a[k] + s * d[k]));
            dot(q, q).sqrt()
        };
        edge(t[0], t[1]).min(edge(t[1], t[2])).min(edge(t[2], t[0]))
    }

    #[test]
    fn a_sphere_is_met_within_half_a_voxel_both_ways() {
        let shape = Shape::Sphere { radius: 0.7 };
        for method in [Method::Cubes, Method::Tetrahedra] {
            let mesh = extract(&shape, &GRID, 10.0, method, &mut |_, _| {});
            let cell = GRID.cell();
            assert!(mesh.is_watertight());
            for p in &mesh.positions {
                assert!(shape.distance(*p).abs() <= 0.5 * cell);
            }
            // From the surface to the mesh.
            for i in 0..500 {
                let z = 1.0 - (2.0 * i as f32 + 1.0) / 500.0;
                let (r, a) = ((1.0 - z * z).sqrt(), i as f32 * 2.399_963);
                let p = [0.7 * r * a.cos(), 0.7 * r * a.sin(), 0.7 * z];
                assert!(nearest(&mesh, p) <= 0.5 * cell, "a hole near {p:?}");
            }
        }
    }

    #[test]
    fn a_box_is_met_within_half_a_voxel_and_its_edges_within_one_and_a_fifth() {
        let half = [0.6, 0.45, 0.3];
        let shape = Shape::Box { half };
        let mesh = extract(&shape, &GRID, 10.0, Method::Cubes, &mut |_, _| {});
        let cell = GRID.cell();
        assert!(mesh.is_watertight());
        for p in &mesh.positions {
            assert!(shape.distance(*p).abs() <= 0.5 * cell, "{p:?}");
        }
        for c in 0..8 {
            let corner: [f32; 3] = std::array::from_fn(|k| if c >> k & 1 == 1 { half[k] } else { -half[k] });
            assert!(nearest(&mesh, corner) <= 1.2 * cell, "{}", nearest(&mesh, corner) / cell);
        }
        // Face centers lie on the mesh.
        for k in 0..6 {
            let mut p = [0.01, 0.02, 0.03];
            p[k / 2] = if k % 2 == 0 { half[k / 2] } else { -half[k / 2] };
            assert!(nearest(&mesh, p) <= 0.5 * cell);
        }
        // Faces outward: positive volume close to the box's.
        let exact = half.iter().map(|h| 2.0 * *h as f64).product::<f64>();
        assert!((mesh.volume() / exact - 1.0).abs() < 0.05, "{} {exact}", mesh.volume());
    }

    #[test]
    fn what_the_box_cuts_is_closed() {
        let grid = Grid { min: [-0.5, -1.0, -1.0], max: [0.5, 1.0, 1.0], resolution: 40 };
        let mesh = extract(&Shape::Sphere { radius: 0.7 }, &grid, 10.0, Method::Cubes, &mut |_, _| {});
        assert!(mesh.is_watertight());
        let (lo, hi) = mesh.bounds().unwrap();
        assert!(lo[0] >= -0.5 && hi[0] <= 0.5 + 1e-6);
    }
}
