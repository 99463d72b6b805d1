//! Deformable tetrahedral grid: a body-centered cubic lattice or a given one, with bounded offsets of its vertices.
//!
//! The lattice of n³ cubes has the (n + 1)³ corners and n³ centers of the cubes as vertices. Each face between two cubes gives four
//! tetrahedra around the edge between their centers, each face of the boundary two: 12 n³ in all, of equal volume `cell³ / 12`.

use diorama_geom::Tetrahedra;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::tetrahedral_surface::Topology;
use rayon::prelude::*;

/// Length of the longest offset in the lattice, in cells. No offsets below 1 / (2 √6) = 0.204, half the width of the cells at the
/// boundary, invert one; the others are wider, and bear 0.25.
pub const LATTICE_OFFSET: f32 = 0.2;

/// Edge of the box around an object of unit size that the lattice fills.
pub const BOX_EDGE: f32 = 2.1;

/// Vertices, connections, and limits of offsets. A vertex with the parameters `p` lies at `rest + limit · tanh|p| · p / |p|`: its offsets fill
/// a ball, because a cube of the same size would let tetrahedra invert.
#[derive(Clone, Debug)]
pub struct TetrahedralGrid {
    pub topology: Topology,
    /// Positions without offset `[V, 3]`.
    pub rest: Vec<[f32; 3]>,
    /// Length of the longest offset of each vertex `[V]`.
    pub limits: Vec<f32>,
    /// Edge of a cube; for other grids that of cubes with 12 tetrahedra of the mean volume.
    pub cell: f32,
}

impl TetrahedralGrid {
    /// The lattice of `n³` cubes that fills the cube of edge `edge` around the origin.
    ///
    /// # Panics
    /// When `n` is 0 or more than 256.
    pub fn lattice(n: usize, edge: f32) -> TetrahedralGrid {
        let (grid, cell) = (lattice(n, edge), edge / n as f32);
        let limits = vec![LATTICE_OFFSET * cell; grid.positions.len()];
        TetrahedralGrid { topology: Topology::new(grid.positions.len(), grid.cells), rest: grid.positions, limits, cell }
    }

    /// A grid of other origin, whose cells have positive volume (as [`Tetrahedra::orient`] leaves them), scaled by `scale`.
    ///
    /// A cell inverts only if its corners meet a plane on the way, so it stays positive while no corner moves by half its width, the least
    /// distance of parallel planes around it. Offsets are limited to 0.98 of that, which is [`LATTICE_OFFSET`] at the lattice's boundary.
    pub fn new(grid: Tetrahedra, scale: f32) -> TetrahedralGrid {
        let rest: Vec<[f32; 3]> = grid.positions.iter().map(|p| p.map(|v| v * scale)).collect();
        let grid = Tetrahedra { positions: rest, cells: grid.cells };
        let mut limits = vec![f32::INFINITY; grid.positions.len()];
        let mut volume = 0.0;
        for (i, cell) in grid.cells.iter().enumerate() {
            volume += grid.volume(i);
            let limit = (0.98 * 0.5 * width(cell.map(|i| grid.positions[i as usize]))) as f32;
            cell.iter().for_each(|i| limits[*i as usize] = limits[*i as usize].min(limit));
        }
        // Vertices without cells stay.
        limits.iter_mut().filter(|l| l.is_infinite()).for_each(|l| *l = 0.0);
        let cell = (12.0 * volume / grid.cells.len().max(1) as f64).cbrt() as f32;
        TetrahedralGrid { topology: Topology::new(grid.positions.len(), grid.cells), rest: grid.positions, limits, cell }
    }

    /// Number of vertices.
    pub fn vertices(&self) -> usize {
        self.rest.len()
    }

    /// Distances to begin with where nothing is known: uniform in −0.1 to 0.9, inside positive `[V]`.
    pub fn random_distances(&self, seed: u64) -> Vec<f32> {
        let rng = Rng::new(seed, 0x5df);
        (0..self.vertices() as u64).into_par_iter().map(|i| rng.uniform(i) - 0.1).collect()
    }

    /// Positions of the vertices for parameters of their offsets.
    ///
    /// # Shapes
    /// parameters, positions: `[V, 3]`.
    ///
    /// # Panics
    /// When the shapes differ.
    pub fn deform(&self, parameters: &[[f32; 3]], positions: &mut [[f32; 3]]) {
        assert!(parameters.len() == self.vertices() && positions.len() == self.vertices(), "tetrahedral grid: vertices");
        positions.par_iter_mut().with_min_len(4096).enumerate().for_each(|(i, p)| {
            let (share, _) = share(parameters[i]);
            *p = std::array::from_fn(|k| self.rest[i][k] + self.limits[i] * share * parameters[i][k]);
        });
    }

    /// Turns gradients of the positions into those of the parameters, in place.
    ///
    /// # Shapes
    /// parameters, d: `[V, 3]`.
    ///
    /// # Panics
    /// When the shapes differ.
    pub fn deform_backward(&self, parameters: &[[f32; 3]], d: &mut [[f32; 3]]) {
        assert!(parameters.len() == self.vertices() && d.len() == self.vertices(), "tetrahedral grid: vertices");
        d.par_iter_mut().with_min_len(4096).enumerate().filter(|(_, d)| **d != [0.0; 3]).for_each(|(i, d)| {
            let (p, (share, slope)) = (parameters[i], share(parameters[i]));
            let along = (0..3).map(|k| p[k] * d[k]).sum::<f32>();
            *d = std::array::from_fn(|k| self.limits[i] * (share * d[k] + slope * along * p[k]));
        });
    }
}

/// `tanh r / r` for `r = |p|`, and its derivative by r divided by r.
fn share(p: [f32; 3]) -> (f32, f32) {
    let square = p.iter().map(|v| v * v).sum::<f32>();
    if square < 1e-2 {
        // Series: the exact quotients cancel.
        return (1.0 - square / 3.0 + square * square * (2.0 / 15.0), -2.0 / 3.0 + square * (8.0 / 15.0));
    }
    let r = square.sqrt();
    let tanh = r.tanh();
    (tanh / r, (1.0 - tanh * tanh - tanh / r) / square)
}

/// Least distance of two parallel planes with a tetrahedron between them: through a corner and the face across, or through opposite edges.
fn width(corners: [[f32; 3]; 4]) -> f64 {
    let p = corners.map(|c| glam::DVec3::from(c.map(f64::from)));
    let volume = (p[1] - p[0]).dot((p[2] - p[0]).cross(p[3] - p[0])).abs();
    let faces = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]].map(|[a, b, c]| (p[b] - p[a]).cross(p[c] - p[a]).length());
    let opposite = [[0, 1, 2, 3], [0, 2, 1, 3], [0, 3, 1, 2]].map(|[a, b, c, d]| (p[b] - p[a]).cross(p[d] - p[c]).length());
    volume / faces.into_iter().chain(opposite).fold(f64::MIN_POSITIVE, f64::max)
}

/// Body-centered cubic lattice of `n³` cubes around the origin, corners first, all cells with positive volume.
///
/// # Panics
/// When `n` is 0 or more than 256.
pub fn lattice(n: usize, edge: f32) -> Tetrahedra {
    assert!((1..=256).contains(&n), "tetrahedral grid: {n} cells along an axis; expected 1 to 256");
    let cell = edge / n as f32;
    let place = |i: usize, n: usize| [i % n, i / n % n, i / n / n];
    let corners = (n + 1).pow(3);
    let at = |p: [usize; 3], shift: f32| p.map(|v| (v as f32 + shift) * cell - 0.5 * edge);
    let positions = (0..corners).map(|i| at(place(i, n + 1), 0.0)).chain((0..n.pow(3)).map(|i| at(place(i, n), 0.5))).collect();
    let corner = |p: [usize; 3]| ((p[2] * (n + 1) + p[1]) * (n + 1) + p[0]) as u32;
    let center = |p: [usize; 3]| (corners + (p[2] * n + p[1]) * n + p[0]) as u32;
    let mut cells = Vec::with_capacity(12 * n.pow(3));
    for cube in (0..n.pow(3)).map(|i| place(i, n)) {
        for axis in 0..3 {
            // Counter-clockwise seen from above, around the face on the side `side` of the cube.
            let ring = |side: usize| {
                [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[u, v]| {
                    let mut p = cube;
                    (p[axis], p[(axis + 1) % 3], p[(axis + 2) % 3]) = (p[axis] + side, p[(axis + 1) % 3] + u, p[(axis + 2) % 3] + v);
                    corner(p)
                })
            };
            let (own, [a, b, c, d]) = (center(cube), ring(1));
            if cube[axis] + 1 < n {
                let mut next = cube;
                next[axis] += 1;
                let next = center(next);
                cells.extend([[own, next, a, b], [own, next, b, c], [own, next, c, d], [own, next, d, a]]);
            } else {
                cells.extend([[own, a, b, c], [own, a, c, d]]);
            }
            if cube[axis] == 0 {
                let [a, b, c, d] = ring(0);
                cells.extend([[own, a, c, b], [own, a, d, c]]);
            }
        }
    }
    Tetrahedra { positions, cells }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn counts_and_volumes_are_right() {
        for n in [1, 2, 5] {
            let grid = lattice(n, 2.1);
            assert_eq!((grid.positions.len(), grid.cells.len()), (n.pow(3) + (n + 1).pow(3), 12 * n.pow(3)));
            let volume = (2.1 / n as f64).powi(3) / 12.0;
            assert!((0..grid.cells.len()).all(|i| (grid.volume(i) / volume - 1.0).abs() < 1e-4));
            let whole = TetrahedralGrid::lattice(n, 2.1);
            // Euler's number of a ball: V − E + F − T = 1, with 4 T = 2 F − (12 n² on the boundary).
            let faces = (4 * grid.cells.len() + 12 * n * n) / 2;
            assert_eq!(grid.positions.len() + faces, whole.topology.edges().len() + grid.cells.len() + 1);
        }
    }

    /// Least volume that a search finds for offsets of the corners up to `limits` long, relative to that without. The volume is linear in
    /// each corner, whose worst offset for given others is against its gradient; from random starts the corners take turns.
    fn least_volume(corners: [[f32; 3]; 4], limits: [f64; 4], seed: u64) -> f64 {
        let volume = |p: [DVec3; 4]| (p[1] - p[0]).dot((p[2] - p[0]).cross(p[3] - p[0]));
        let (rest, rng) = (corners.map(|c| DVec3::from(c.map(f64::from))), Rng::new(seed, 1));
        let mut least = f64::INFINITY;
        for start in 0..20 {
            let random = |i: usize| DVec3::from_array([0, 1, 2].map(|k| rng.normal((start * 4 + i as u64) * 3 + k) as f64)).normalize();
            let mut p: [DVec3; 4] = std::array::from_fn(|i| rest[i] + random(i) * limits[i]);
            for turn in 0..40 {
                let i = turn % 4;
                let slope = |axis: DVec3| {
                    let mut q = p;
                    q[i] += axis;
                    volume(q) - volume(p)
                };
                p[i] = rest[i] - DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z)).normalize_or_zero() * limits[i];
            }
            least = least.min(volume(p));
        }
        least / volume(rest)
    }

    #[test]
    fn no_offset_within_the_limit_inverts_a_tetrahedron() {
        // All shapes and orientations of cells occur in 3³ cubes.
        let grid = lattice(3, 3.0);
        let at = |limit: f64| {
            let of = |(i, c): (usize, &[u32; 4])| least_volume(c.map(|i| grid.positions[i as usize]), [limit; 4], i as u64);
            grid.cells.par_iter().enumerate().map(of).reduce(|| f64::INFINITY, f64::min)
        };
        let [within, below, above] = [LATTICE_OFFSET as f64, 0.204, 0.2045].map(at);
        // The search finds the inversions just above half the width of the cells.
        assert!(within > 0.01 && below > 0.0 && above < 0.0, "{within} {below} {above}");
    }

    #[test]
    fn offsets_as_large_along_each_axis_would_invert_some() {
        let grid = lattice(3, 3.0);
        let volume = |p: [DVec3; 4]| (p[1] - p[0]).dot((p[2] - p[0]).cross(p[3] - p[0]));
        // The volume is linear in each coordinate, so the least is at one of the 2¹² combinations of largest offsets.
        let least = |limit: f64, corners: [[f32; 3]; 4]| {
            let sign = |bits: usize, bit: usize| if bits >> bit & 1 == 1 { limit } else { -limit };
            let moved = |bits: usize, i: usize| {
                DVec3::from(corners[i].map(f64::from)) + DVec3::from_array([0, 1, 2].map(|k| sign(bits, 3 * i + k)))
            };
            (0..1 << 12).map(|bits| volume(std::array::from_fn(|i| moved(bits, i)))).fold(f64::INFINITY, f64::min)
        };
        let at = |limit: f64| grid.cells.iter().map(|c| least(limit, c.map(|i| grid.positions[i as usize]))).fold(f64::INFINITY, f64::min);
        assert!(at(LATTICE_OFFSET as f64) < 0.0 && at(0.124) > 0.0, "{} {}", at(LATTICE_OFFSET as f64), at(0.124));
    }

    #[test]
    fn offsets_of_other_grids_invert_nothing() {
        let rng = Rng::new(3, 0);
        let mut grid = lattice(3, 3.0);
        for (i, p) in grid.positions.as_flattened_mut().iter_mut().enumerate() {
            *p += 0.3 * (rng.uniform(i as u64) - 0.5);
        }
        let whole = TetrahedralGrid::new(grid.clone(), 1.0);
        assert!((whole.cell - 1.0).abs() < 0.05);
        for (i, cell) in grid.cells.iter().enumerate() {
            let limits = cell.map(|i| whole.limits[i as usize] as f64);
            assert!(limits.iter().all(|l| *l > 0.01));
            assert!(least_volume(cell.map(|i| grid.positions[i as usize]), limits, i as u64) > 0.0);
        }
        // The lattice's own limit, at its boundary; half its cells' width inside.
        let plain = TetrahedralGrid::new(lattice(3, 1.5), 2.0);
        let (least, most) = plain.limits.iter().fold((f32::MAX, 0.0f32), |(a, b), l| (a.min(*l), b.max(*l)));
        assert!((least - LATTICE_OFFSET).abs() < 1e-3 && (most - 0.245).abs() < 1e-3, "{least} {most}");
    }

    #[test]
    fn offsets_have_the_gradient_of_central_differences() {
        let grid = TetrahedralGrid::lattice(1, 2.0);
        let rng = Rng::new(5, 0);
        let random = |stream: u64| -> Vec<[f32; 3]> {
            (0..9).map(|i| std::array::from_fn(|k| 4.0 * rng.uniform(stream * 100 + i * 3 + k as u64) - 2.0)).collect()
        };
        let (mut parameters, d) = (random(1), random(2));
        // Both sides of the series' range, and its middle.
        (parameters[0], parameters[1], parameters[2]) = ([0.0; 3], [0.05, -0.03, 0.02], [0.09, -0.06, 0.02]);
        let loss = |p: &[[f32; 3]]| {
            let mut at = vec![[0.0; 3]; 9];
            grid.deform(p, &mut at);
            at.as_flattened().iter().zip(d.as_flattened()).map(|(p, d)| *p as f64 * *d as f64).sum::<f64>()
        };
        let mut got = d.clone();
        grid.deform_backward(&parameters, &mut got);
        for i in 0..27 {
            let mut p = parameters.clone();
            p.as_flattened_mut()[i] += 1e-2;
            let up = loss(&p);
            p.as_flattened_mut()[i] -= 2e-2;
            let want = (up - loss(&p)) / 2e-2;
            assert!((got.as_flattened()[i] as f64 - want).abs() < 1e-3, "{i}: {} {want}", got.as_flattened()[i]);
        }
    }
}
