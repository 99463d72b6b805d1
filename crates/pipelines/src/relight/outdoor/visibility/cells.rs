//! Optical depths of the cells of a cube, most of which are empty, and rays through them.

use diorama_engine::fields::DensityQuery;
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_geom::glam::Vec3;
use diorama_kernels::ops::march::OccupancyBits;
use rayon::prelude::*;

/// Cells per axis of a block, and cells of one. Blocks in which nothing is are not kept, and rays skip them.
const BLOCK: usize = 8;
const IN_BLOCK: usize = BLOCK.pow(3);
/// Place of a block that is not kept.
const NOWHERE: u32 = u32::MAX;
/// Share of a cell that must be opaque for it not to be empty, and optical depth of a cell at most.
const LEAST: f32 = 0.05;
const DEEPEST: f32 = 3.0;
/// Optical depth beyond which nothing passes, and at which a ray is said to meet something: half of its light is gone.
const OPAQUE: f32 = 6.0;
const HALF: f32 = std::f32::consts::LN_2;
/// Length of a step in cells.
const STEP: f32 = 0.7;
/// Cells in two numbers of a checkpoint, and depth of a solid cell of runs that knew only solid and empty ones, 16 to a number.
const PACKED: usize = 2;
const SOLID: f32 = 2.0;
const BITS: usize = 16;

/// Optical depths `[n³]` of a cube in model space, x fastest.
pub struct Cells {
    pub low: f32,
    pub size: f32,
    pub n: usize,
    /// Of each block, where its cells are in `depths`, in units of [`DEEPEST`] over 255.
    places: Vec<u32>,
    depths: Vec<u8>,
    /// One bit per cell: whether from its center on to the next centers something is not empty.
    near: Vec<u64>,
    /// Whether something in a block, or next to it, is not empty.
    blocks: Vec<bool>,
}

impl Cells {
    /// Of a field where its occupancy grid agrees and something may be, in a cube given by its lowest corner and edge.
    pub fn of(
        field: &dyn DensityQuery,
        occupancy: &Occupancy,
        (low, size): (f32, f32),
        n: usize,
        may_be: &(dyn Fn([f32; 3]) -> bool + Sync),
    ) -> Cells {
        let cell = size / n as f32;
        let mut cells = Cells::empty((low, size), n);
        for z in 0..n {
            let at = |i: usize| [i % n, i / n, z].map(|k| low + (k as f32 + 0.5) * cell);
            let live: Vec<usize> = (0..n * n).into_par_iter().filter(|i| is_occupied(occupancy.bits(), at(*i)) && may_be(at(*i))).collect();
            let corner = |p: [f32; 3], k: usize| [0, 1, 2].map(|a| p[a] + cell * (0.5 * (k >> a & 1) as f32 - 0.25));
            let points: Vec<f32> = live.iter().flat_map(|i| (0..8).map(move |k| (*i, k))).flat_map(|(i, k)| corner(at(i), k)).collect();
            let mut sigma = vec![0.0; points.len() / 3];
            field.density(&points, &mut sigma);
            for (i, s) in live.iter().zip(sigma.chunks_exact(8)) {
                let opaque = s.iter().map(|s| 1.0 - (-s * cell).exp()).sum::<f32>() / 8.0;
                if opaque > LEAST {
                    cells.set([i % n, i / n, z], -(1.0 - opaque).max(1e-6).ln());
                }
            }
        }
        cells.finished()
    }

    pub fn empty((low, size): (f32, f32), n: usize) -> Cells {
        let blocks = n.div_ceil(BLOCK).pow(3);
        let near = vec![0; n.pow(3).div_ceil(64)];
        Cells { low, size, n, places: vec![NOWHERE; blocks], depths: Vec::new(), near, blocks: vec![false; blocks] }
    }

    /// The same from [`Cells::numbers`]; none where these are not of `n` cells per axis.
    pub fn from_numbers(numbers: &[f32], cube: (f32, f32), n: usize) -> Option<Cells> {
        let (_, numbers) = numbers.split_first().filter(|(first, _)| **first == n as f32)?;
        let mut cells = Cells::empty(cube, n);
        for block in numbers.chunks(1 + IN_BLOCK / PACKED) {
            let place = cells.places.get_mut(block[0] as usize).filter(|p| block.len() == 1 + IN_BLOCK / PACKED && **p == NOWHERE)?;
            *place = (cells.depths.len() / IN_BLOCK) as u32;
            cells.depths.extend(block[1..].iter().flat_map(|v| (*v as u16).to_le_bytes()));
        }
        Some(cells.finished())
    }

    /// Of runs that knew only solid and empty cells: a bit for each.
    pub fn from_bits(numbers: &[f32], cube: (f32, f32), n: usize) -> Option<Cells> {
        let mut cells = Cells::empty(cube, n);
        for i in (0..n.pow(3)).filter(|i| numbers.get(i / BITS).is_some_and(|v| *v as u64 >> (i % BITS) & 1 == 1)) {
            cells.set([i % n, i / n % n, i / n / n], SOLID);
        }
        (numbers.len() == n.pow(3).div_ceil(BITS)).then(|| cells.finished())
    }

    /// Cells per axis and the blocks that are kept as numbers of a checkpoint, `1 + [blocks, 257]`: which block, then its cells, two to a number.
    pub fn numbers(&self) -> Vec<f32> {
        let kept = self.places.iter().enumerate().filter(|(_, p)| **p != NOWHERE);
        let of = |(b, p): (usize, &u32)| {
            let cells = self.depths[IN_BLOCK * *p as usize..][..IN_BLOCK].chunks_exact(PACKED);
            std::iter::once(b as f32).chain(cells.map(|c| u16::from_le_bytes([c[0], c[1]]) as f32))
        };
        std::iter::once(self.n as f32).chain(kept.flat_map(of)).collect()
    }

    /// A block of a cell, and the cell's index in it.
    fn block(&self, at: [usize; 3]) -> (usize, usize) {
        let index = |at: [usize; 3], edge: usize| (at[2] * edge + at[1]) * edge + at[0];
        (index(at.map(|v| v / BLOCK), self.n.div_ceil(BLOCK)), index(at.map(|v| v % BLOCK), BLOCK))
    }

    fn set(&mut self, at: [usize; 3], depth: f32) {
        let (block, i) = self.block(at);
        if self.places[block] == NOWHERE {
            self.places[block] = (self.depths.len() / IN_BLOCK) as u32;
            self.depths.resize(self.depths.len() + IN_BLOCK, 0);
        }
        self.depths[IN_BLOCK * self.places[block] as usize + i] = (255.0 * (depth / DEEPEST).min(1.0)).ceil() as u8;
    }

    /// With what rays skip by.
    fn finished(mut self) -> Cells {
        let (n, edge) = (self.n, self.n.div_ceil(BLOCK));
        for (b, place) in self.places.iter().enumerate().filter(|(_, p)| **p != NOWHERE) {
            let low = [b % edge, b / edge % edge, b / edge / edge].map(|v| v * BLOCK);
            let cells = &self.depths[IN_BLOCK * *place as usize..][..IN_BLOCK];
            for i in (0..IN_BLOCK).filter(|i| cells[*i] > 0) {
                let at = [low[0] + i % BLOCK, low[1] + i / BLOCK % BLOCK, low[2] + i / BLOCK / BLOCK];
                // Interpolation reaches one cell far.
                for k in 0..8 {
                    let b = [0, 1, 2].map(|a| (if k >> a & 1 == 0 { at[a].saturating_sub(1) } else { (at[a] + 1).min(n - 1) }) / BLOCK);
                    self.blocks[(b[2] * edge + b[1]) * edge + b[0]] = true;
                    let c = [0, 1, 2].map(|a| at[a].saturating_sub(k >> a & 1));
                    let c = (c[2] * n + c[1]) * n + c[0];
                    self.near[c / 64] |= 1 << (c % 64);
                }
            }
        }
        self
    }

    /// A point of model space in cells.
    pub fn at(&self, point: Vec3) -> Vec3 {
        (point - self.low) * (self.n as f32 / self.size)
    }

    /// Optical depth of a cell's edge at a point, interpolated between the centers of cells; `at` is in cells.
    fn depth(&self, at: Vec3) -> f32 {
        let p = at - 0.5;
        let (base, f) = (p.floor(), p - p.floor());
        let n = self.n as i32;
        let at = [base.x, base.y, base.z].map(|v| v.max(0.0) as usize);
        let at = (at[2] * self.n + at[1]) * self.n + at[0];
        if self.near[at / 64] >> (at % 64) & 1 == 0 {
            return 0.0;
        }
        let get = |k: i32| {
            let q = [base.x as i32 + (k & 1), base.y as i32 + (k >> 1 & 1), base.z as i32 + (k >> 2)];
            let (block, i) = self.block(q.map(|v| v.clamp(0, n - 1) as usize));
            let place = self.places[block];
            if place == NOWHERE { 0.0 } else { self.depths[IN_BLOCK * place as usize + i] as f32 }
        };
        let along = |k: i32| get(k) * (1.0 - f.x) + get(k + 1) * f.x;
        let all = (along(0) * (1.0 - f.y) + along(2) * f.y) * (1.0 - f.z) + (along(4) * (1.0 - f.y) + along(6) * f.y) * f.z;
        all * (DEEPEST / 255.0)
    }

    /// Share of light that passes from a point in cells toward a direction, and where it meets what hides the rest.
    pub fn pass(&self, from: Vec3, dir: Vec3) -> (f32, Vec3) {
        let (edge, n) = (self.n.div_ceil(BLOCK), self.n as f32);
        let (mut at, mut depth, mut first, mut half) = (from, 0.0, None, None);
        while at.min_element() >= 0.0 && at.max_element() < n {
            let b = [at.x, at.y, at.z].map(|v| v as usize / BLOCK);
            if self.blocks[(b[2] * edge + b[1]) * edge + b[0]] {
                let more = STEP * self.depth(at);
                depth += more;
                if more > 0.0 {
                    first = first.or(Some(at));
                }
                if depth > HALF {
                    half = half.or(Some(at));
                }
                if depth > OPAQUE {
                    return (0.0, half.unwrap_or(at));
                }
                at += dir * STEP;
                continue;
            }
            // To the block's far side.
            let low = Vec3::from(b.map(|v| (v * BLOCK) as f32));
            let far = Vec3::select(dir.cmpgt(Vec3::ZERO), low + BLOCK as f32, low);
            let t = (far - at) / dir;
            let leave = [t.x, t.y, t.z].into_iter().filter(|t| t.is_finite()).fold(f32::INFINITY, f32::min);
            at += dir * (leave.max(0.0) + 0.01);
        }
        ((-depth).exp(), half.or(first).unwrap_or(at))
    }
}

/// Whether an occupancy grid holds a point to be occupied.
fn is_occupied(bits: &OccupancyBits, p: [f32; 3]) -> bool {
    let n = bits.resolution;
    for c in 0..bits.cascades {
        let (low, size) = OccupancyBits::cube(c);
        let at = p.map(|v| (v - low) / size);
        if at.iter().all(|v| (0.0..1.0).contains(v)) {
            let [x, y, z] = at.map(|v| (v * n as f32) as usize);
            return bits.get(((c * n + z) * n + y) * n + x);
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_survive_a_checkpoint() {
        let mut cells = Cells::empty((-1.0, 2.0), 20);
        let set = [([0, 0, 0], 0.1), ([19, 3, 7], 1.0), ([8, 9, 19], 5.0), ([9, 9, 19], 0.5)];
        set.into_iter().for_each(|(at, depth)| cells.set(at, depth));
        let cells = cells.finished();
        let numbers = cells.numbers();
        let back = Cells::from_numbers(&numbers, (-1.0, 2.0), 20).expect("20 cells");
        assert!(back.near == cells.near && back.blocks == cells.blocks && cells.near.iter().any(|w| *w != 0));
        for (at, want) in set {
            let center = Vec3::from(at.map(|v| v as f32 + 0.5));
            assert!((back.depth(center) - f32::min(want, DEEPEST)).abs() < DEEPEST / 255.0, "{at:?}");
            assert_eq!(back.depth(center), cells.depth(center));
        }
        assert!(Cells::from_numbers(&numbers[..300], (-1.0, 2.0), 20).is_none());
        // As many blocks per axis, and more.
        assert!([24, 40].into_iter().all(|n| Cells::from_numbers(&numbers, (-1.0, 2.0), n).is_none()));
    }

    #[test]
    fn bits_of_former_runs_are_solid_cells() {
        let mut bits = vec![0.0; 16usize.pow(3) / BITS];
        bits[(5 * 16 + 4) * 16 / BITS] = 8.0;
        let cells = Cells::from_bits(&bits, (0.0, 1.0), 16).expect("16 cells");
        assert!((cells.depth(Vec3::new(3.5, 4.5, 5.5)) - SOLID).abs() < 0.02);
        assert_eq!(cells.depth(Vec3::new(5.5, 4.5, 5.5)), 0.0);
        assert!(Cells::from_bits(&bits[1..], (0.0, 1.0), 16).is_none());
    }

    /// What is learned half transparent lets light through as it does.
    #[test]
    fn thin_matter_hides_part_of_the_light() {
        struct Haze;
        impl DensityQuery for Haze {
            fn density(&self, model: &[f32], sigma: &mut [f32]) {
                for (s, p) in sigma.iter_mut().zip(model.chunks_exact(3)) {
                    *s = if (0.25..0.75).contains(&p[2]) { 1.4 } else { 0.0 };
                }
            }
        }
        let cells = Cells::of(&Haze, &Occupancy::new(16, 1, false), (0.0, 1.0), 16, &|_| true);
        let (passes, meets) = cells.pass(Vec3::new(8.0, 8.0, 0.1), Vec3::Z);
        assert!((passes - (-0.7f32).exp()).abs() < 0.03, "{passes}");
        assert!((meets.z - 12.0).abs() < 2.0, "half is gone at the far end: {meets}");
    }
}
