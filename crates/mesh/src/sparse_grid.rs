//! Densities in sparse blocks of 32³ grid points, and the surface in them: memory and time follow the surface, not the box.
//!
//! A grid point has the field's density where its block may hold matter, and 0 elsewhere, also outside of the box: each point is evaluated
//! once, so that blocks agree on their common faces and the surface is closed.

use crate::extract::{Grid, Method};
use diorama_geom::Mesh;
use diorama_geom::field_query::FieldQuery;
use diorama_kernels::ops::marching_cubes::{CaseTable, cpu::Mesher};
use rayon::prelude::*;
use std::collections::{BTreeSet, HashMap};

/// Grid points along an edge of a block.
pub const BLOCK: usize = 32;
/// Points of a block, and with the first layer of the blocks behind it.
const POINTS: usize = BLOCK * BLOCK * BLOCK;
const EDGE: usize = BLOCK + 1;
/// Blocks per query of the field, and per parallel round of extraction.
const AT_ONCE: usize = 8;
const ROUND: usize = 256;

/// Sampled densities of a region.
#[derive(Clone, Debug)]
pub struct SparseGrid {
    grid: Grid,
    /// Densities `[32, 32, 32]` (z, y, x) of the blocks that may hold matter.
    blocks: HashMap<[i32; 3], Vec<f32>>,
}

/// Blocks of a grid whose box, one cell wider on each side, may hold matter: `may_hold` receives lowest and highest corner.
pub fn candidates(grid: &Grid, may_hold: &(dyn Fn([f32; 3], [f32; 3]) -> bool + Sync)) -> Vec<[i32; 3]> {
    let n = grid.points().map(|p| p.div_ceil(BLOCK));
    let cell = grid.cell();
    let holds = |b: &[i32; 3]| {
        let at = |k: usize, points: f32| grid.min[k] + (b[k] as f32 * BLOCK as f32 + points) * cell;
        may_hold(std::array::from_fn(|k| at(k, -1.0)), std::array::from_fn(|k| at(k, EDGE as f32)))
    };
    let place = |i: usize| [i % n[0], i / n[0] % n[1], i / n[0] / n[1]].map(|v| v as i32);
    (0..n[0] * n[1] * n[2]).into_par_iter().map(place).filter(holds).collect()
}

/// Bytes of the densities of so many blocks.
pub fn bytes(blocks: usize) -> u64 {
    (blocks * POINTS * size_of::<f32>()) as u64
}

impl SparseGrid {
    /// Evaluates a field in `blocks` (see [`candidates`]); `progress` receives the blocks done and their number, and stops
    /// the work by returning false.
    pub fn sample(field: &dyn FieldQuery, grid: &Grid, blocks: &[[i32; 3]], progress: &mut dyn FnMut(usize, usize) -> bool) -> SparseGrid {
        let (cell, limits) = (grid.cell(), grid.points());
        let mut out = HashMap::with_capacity(blocks.len());
        let (mut points, mut sigma) = (Vec::with_capacity(AT_ONCE * POINTS), vec![0.0; AT_ONCE * POINTS]);
        for (i, part) in blocks.chunks(AT_ONCE).enumerate() {
            points.clear();
            for b in part {
                let first = b.map(|v| v as usize * BLOCK);
                points.extend((0..POINTS).map(|i| {
                    let p = [i % BLOCK, i / BLOCK % BLOCK, i / BLOCK / BLOCK];
                    std::array::from_fn(|k| grid.min[k] + (first[k] + p[k]) as f32 * cell)
                }));
            }
            field.density(&points, &mut sigma[..points.len()]);
            for (b, values) in part.iter().zip(sigma.chunks_exact(POINTS)) {
                let mut values = values.to_vec();
                let inside = |i: usize| {
                    let p = [i % BLOCK, i / BLOCK % BLOCK, i / BLOCK / BLOCK];
                    (0..3).all(|k| b[k] as usize * BLOCK + p[k] < limits[k])
                };
                // Blocks on the border reach beyond the box.
                if (0..3).any(|k| (b[k] as usize + 1) * BLOCK > limits[k]) {
                    values.iter_mut().enumerate().filter(|(i, _)| !inside(*i)).for_each(|(_, v)| *v = 0.0);
                }
                out.insert(*b, values);
            }
            if !progress(i * AT_ONCE + part.len(), blocks.len()) {
                break;
            }
        }
        SparseGrid { grid: *grid, blocks: out }
    }

    /// The grid that was sampled.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Density that a share of the sampled points does not exceed; 0 without points.
    pub fn quantile(&self, share: f64) -> f32 {
        // Every seventh point: 7 divides no power of two, so all columns are met.
        let mut all: Vec<f32> = self.blocks.values().flat_map(|b| b.iter().step_by(7).copied()).collect();
        if all.is_empty() {
            return 0.0;
        }
        let at = ((all.len() - 1) as f64 * share.clamp(0.0, 1.0)) as usize;
        *all.select_nth_unstable_by(at, f32::total_cmp).1
    }

    /// The surface where the density equals `level`, in world coordinates, with faces outward, closed where the box cuts it. Vertices lie
    /// at the level between grid points, or without `interpolate` halfway between them.
    pub fn surface(&self, level: f32, method: Method, interpolate: bool) -> Mesh {
        let table = method.table();
        // A cell belongs to the block of its first corner; its other corners may lie in the seven blocks behind.
        let cells: BTreeSet<[i32; 3]> =
            self.blocks.keys().flat_map(|b| (0..8).map(move |c| [b[2] - (c >> 2 & 1), b[1] - (c >> 1 & 1), b[0] - (c & 1)])).collect();
        let cells: Vec<[i32; 3]> = cells.into_iter().map(|[z, y, x]| [x, y, z]).collect();
        let mut joined = Joined::default();
        for round in cells.chunks(ROUND) {
            let parts: Vec<Part> = round.par_iter().filter_map(|b| self.block_surface(*b, &table, level, interpolate)).collect();
            parts.into_iter().for_each(|p| joined.add(p));
        }
        Mesh { positions: joined.positions, faces: joined.faces, ..Mesh::default() }
    }

    /// Values `[33, 33, 33]` of a block's cells; `None` where no block is sampled or all lie on one side of the level.
    fn values(&self, b: [i32; 3], level: f32) -> Option<Vec<f32>> {
        let parts: [Option<&Vec<f32>>; 8] = std::array::from_fn(|c| self.blocks.get(&std::array::from_fn(|k| b[k] + (c >> k & 1) as i32)));
        let mut values = vec![0.0f32; EDGE * EDGE * EDGE];
        for z in 0..EDGE {
            for y in 0..EDGE {
                let row = &mut values[(z * EDGE + y) * EDGE..][..EDGE];
                let (part, from) = ((y / BLOCK) << 1 | (z / BLOCK) << 2, (z % BLOCK * BLOCK + y % BLOCK) * BLOCK);
                if let Some(p) = parts[part] {
                    row[..BLOCK].copy_from_slice(&p[from..from + BLOCK]);
                }
                if let Some(p) = parts[part | 1] {
                    row[BLOCK] = p[from];
                }
            }
        }
        let inside = values.iter().filter(|v| **v > level).count();
        (inside > 0 && inside < values.len()).then_some(values)
    }

    fn block_surface(&self, b: [i32; 3], table: &CaseTable, level: f32, interpolate: bool) -> Option<Part> {
        let mut values = self.values(b, level)?;
        let level = if interpolate {
            level
        } else {
            values.iter_mut().for_each(|v| *v = (*v > level) as u32 as f32);
            0.5
        };
        let mut mesher = Mesher::new(table, EDGE, EDGE, level);
        values.chunks_exact(EDGE * EDGE).for_each(|slice| mesher.push(slice));
        let (cell, grid) = (self.grid.cell() as f64, &self.grid);
        let highest: [f32; 3] = std::array::from_fn(|k| grid.max[k].max(grid.min[k] + cell as f32));
        let world = |p: &[f32; 3]| {
            // Whole numbers plus the same fraction: blocks find the same position for a common vertex.
            let at = |k: usize| (grid.min[k] as f64 + (b[k] as f64 * BLOCK as f64 + p[k] as f64) * cell) as f32;
            // The layer of empty points around the box lies outside of it.
            std::array::from_fn(|k| at(k).clamp(grid.min[k], highest[k]))
        };
        let key = |p: &[f32; 3]| p.iter().any(|v| *v == 0.0 || *v == BLOCK as f32).then(|| place_of(b, p));
        let (positions, keys) = mesher.positions.iter().map(|p| (world(p), key(p))).unzip();
        Some(Part { positions, keys, faces: mesher.faces })
    }
}

/// Bits of a vertex's place in grid coordinates, the same in all blocks that share it.
fn place_of(b: [i32; 3], p: &[f32; 3]) -> [u64; 3] {
    std::array::from_fn(|k| (b[k] as f64 * BLOCK as f64 + p[k] as f64 + 0.0).to_bits())
}

/// Surface of a block's cells.
struct Part {
    positions: Vec<[f32; 3]>,
    /// Places of the vertices on the block's faces, which other blocks share.
    keys: Vec<Option<[u64; 3]>>,
    faces: Vec<[u32; 3]>,
}

/// The blocks' surfaces in one mesh.
#[derive(Default)]
struct Joined {
    positions: Vec<[f32; 3]>,
    faces: Vec<[u32; 3]>,
    shared: HashMap<[u64; 3], u32>,
}

impl Joined {
    fn add(&mut self, part: Part) {
        let number = part.positions.iter().zip(part.keys).map(|(p, key)| {
            let next = self.positions.len() as u32;
            let at = key.map_or(next, |key| *self.shared.entry(key).or_insert(next));
            if at == next {
                self.positions.push(*p);
            }
            at
        });
        let numbers: Vec<u32> = number.collect();
        let faces = part.faces.iter().map(|f| f.map(|i| numbers[i as usize]));
        // A vertex exactly on a grid point is shared by the edges that end there.
        self.faces.extend(faces.filter(|f| f[0] != f[1] && f[1] != f[2] && f[0] != f[2]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::extract;

    /// Balls whose density falls through 1 at their surface.
    struct Balls(Vec<([f32; 3], f32)>);

    impl Balls {
        fn distance(&self, p: [f32; 3]) -> f32 {
            let to = |(c, r): &([f32; 3], f32)| (0..3).map(|k| (p[k] - c[k]).powi(2)).sum::<f32>().sqrt() - r;
            self.0.iter().map(to).fold(f32::INFINITY, f32::min)
        }
    }

    impl FieldQuery for Balls {
        fn density(&self, points: &[[f32; 3]], sigma: &mut [f32]) {
            points.iter().zip(sigma).for_each(|(p, s)| *s = (1.0 - 8.0 * self.distance(*p)).max(0.0));
        }

        fn color(&self, _: &[[f32; 3]], _: &[[f32; 3]], rgb_srgb: &mut [[f32; 3]]) {
            rgb_srgb.fill([0.5; 3]);
        }
    }

    fn balls() -> (Balls, Grid) {
        let balls = Balls(vec![([0.1, 0.0, -0.2], 0.53), ([0.9, 0.8, 0.7], 0.17), ([-0.9, 0.7, 0.9], 0.3)]);
        (balls, Grid { min: [-1.1, -1.0, -1.05], max: [1.1, 1.0, 1.05], resolution: 150 })
    }

    fn sampled(field: &Balls, grid: &Grid) -> (SparseGrid, usize, usize) {
        let may_hold = |lo: [f32; 3], hi: [f32; 3]| {
            let center = std::array::from_fn(|k| 0.5 * (lo[k] + hi[k]));
            let radius = 0.5 * (0..3).map(|k| (hi[k] - lo[k]).powi(2)).sum::<f32>().sqrt();
            field.distance(center) < radius + 0.2
        };
        let (some, all) = (candidates(grid, &may_hold), candidates(grid, &|_, _| true));
        (SparseGrid::sample(field, grid, &some, &mut |_, _| true), some.len(), all.len())
    }

    #[test]
    fn sparse_blocks_give_the_surface_of_the_dense_grid() {
        let (field, grid) = balls();
        let (sparse, some, all) = sampled(&field, &grid);
        assert!(some < all, "{some} {all}");
        for method in [Method::Cubes, Method::Tetrahedra] {
            let got = sparse.surface(1.0, method, true);
            let want = extract::extract(&field, &grid, 1.0, method, &mut |_, _| {});
            assert_eq!((got.faces.len(), got.positions.len()), (want.faces.len(), want.positions.len()));
            assert!((got.volume() - want.volume()).abs() < 1e-5 * want.volume(), "{} {}", got.volume(), want.volume());
            // The third ball reaches out of the box, where the surface is closed.
            assert!(got.is_watertight());
        }
    }

    #[test]
    fn without_interpolation_vertices_lie_halfway_between_grid_points() {
        let (field, grid) = balls();
        let (sparse, ..) = sampled(&field, &grid);
        for method in [Method::Cubes, Method::Tetrahedra] {
            let mesh = sparse.surface(1.0, method, false);
            assert!(mesh.is_watertight());
            let halves = |p: &[f32; 3]| {
                (0..3).all(|k| {
                    ((p[k] - grid.min[k]) / grid.cell() * 2.0).fract().min(1.0) < 0.01
                        || ((p[k] - grid.min[k]) / grid.cell() * 2.0).fract() > 0.99
                })
            };
            let inner = |p: &&[f32; 3]| (0..3).all(|k| p[k] > grid.min[k] && p[k] < grid.max[k]);
            assert!(mesh.positions.iter().filter(inner).all(halves));
        }
    }

    #[test]
    fn quantiles_are_of_the_sampled_points() {
        let (field, grid) = balls();
        let (sparse, ..) = sampled(&field, &grid);
        assert_eq!(sparse.quantile(0.0), 0.0);
        let high = sparse.quantile(1.0);
        assert!((4.0..5.3).contains(&high), "{high}");
    }
}
