//! Which light reaches the learned surfaces: shadows of a sun through cells that are solid, and what points see around them, sky or surfaces.

use diorama_engine::fields::DensityQuery;
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::sh_light::{self, ShLight};
use diorama_kernels::ops::march::OccupancyBits;
use rayon::prelude::*;

/// Cells per axis of the grid that holds what points see around them.
pub const OPEN_CELLS: usize = 64;
/// Directions in which points look, and points of a cell that do.
const DIRECTIONS: usize = 96;
const POINTS: usize = 2;
/// Cells per axis of the blocks that shadow rays skip where nothing is solid.
const BLOCK: usize = 8;
/// Share of a cell that must be opaque for it to be solid.
const SOLID: f32 = 0.5;
/// Optical depth of a solid cell, and beyond which nothing passes.
const DEPTH: f32 = 2.0;
const OPAQUE: f32 = 6.0;
/// Cells above its surface at which what a ray meets begins to count, and farthest along the ray that this is.
const LIFT: f32 = 1.5;
const FARTHEST: f32 = 8.0;
/// Length of a step in cells.
const STEP: f32 = 0.7;
/// Bits in a number of a checkpoint.
const PACKED: usize = 16;
/// Share of the light of a direction from which surfaces in it matter.
const SEEN: f32 = 0.05;
/// The surface that a ray downward meets outside of the cube.
pub const GROUND: u32 = u32::MAX;
/// From irradiance over π to radiance, by band of the spherical harmonics.
const RADIANCE: [f32; 9] = [1.0, 1.5, 1.5, 1.5, 4.0, 4.0, 4.0, 4.0, 4.0];

/// Solid cells `[n³]` of a cube in model space, x fastest, and what is seen between them.
pub struct Visibility {
    low: f32,
    size: f32,
    n: usize,
    /// One bit per cell.
    solid: Vec<u64>,
    /// Whether something in a block, or next to it, is solid.
    blocks: Vec<bool>,
    /// View of each cell of `[OPEN_CELLS³]` near something solid; [`NONE`] for the others.
    view_of: Vec<u32>,
    views: Vec<Surroundings>,
}

const NONE: u32 = u32::MAX;

/// What the points of a cell see around them.
struct Surroundings {
    /// Irradiance over π under a sky of radiance 1, as spherical harmonics of the normal.
    even: [f32; 9],
    /// The same for each coefficient of a sky, given as irradiance over π; `[normal, sky]`.
    sky: [[f32; 9]; 9],
    seen: Vec<SeenSurface>,
}

/// Surfaces of a cell of `[OPEN_CELLS³]`, or [`GROUND`], seen in a direction; and the share of that direction's light that is theirs.
struct SeenSurface {
    cell: u32,
    direction: u16,
    share: f32,
}

/// Cells of `[OPEN_CELLS³]` around a point that count for it, by view and weight.
#[derive(Clone, Copy, Default)]
pub struct Corners([(u32, f32); 8], usize);

/// Light of the sky and of surfaces where there are views, `[views, 9, 3]`: irradiance over π as spherical harmonics of the normal.
#[derive(Clone, Default)]
pub struct Ambient(Vec<[Vec3; 9]>);

/// Length of [`Visibility::numbers`] for `n` cells per axis.
pub fn numbers_len(n: usize) -> usize {
    n.pow(3).div_ceil(PACKED)
}

impl Visibility {
    /// Cells of a cube (lowest corner and edge) in which a field is dense and its occupancy grid agrees.
    pub fn of(field: &dyn DensityQuery, occupancy: &Occupancy, (low, size): (f32, f32), n: usize) -> Visibility {
        let cell = size / n as f32;
        let mut solid = vec![0u64; n.pow(3).div_ceil(64)];
        for z in 0..n {
            let at = |i: usize| [i % n, i / n, z].map(|k| low + (k as f32 + 0.5) * cell);
            let live: Vec<usize> = (0..n * n).into_par_iter().filter(|i| is_occupied(occupancy.bits(), at(*i))).collect();
            let corner = |p: [f32; 3], k: usize| [0, 1, 2].map(|a| p[a] + cell * (0.5 * (k >> a & 1) as f32 - 0.25));
            let points: Vec<f32> = live.iter().flat_map(|i| (0..8).map(move |k| (*i, k))).flat_map(|(i, k)| corner(at(i), k)).collect();
            let mut sigma = vec![0.0; points.len() / 3];
            field.density(&points, &mut sigma);
            for (i, s) in live.iter().zip(sigma.chunks_exact(8)) {
                let opaque = s.iter().map(|s| 1.0 - (-s * cell).exp()).sum::<f32>() / 8.0;
                let at = z * n * n + i;
                solid[at / 64] |= ((opaque > SOLID) as u64) << (at % 64);
            }
        }
        Visibility::new(solid, (low, size), n)
    }

    /// The same from [`Visibility::numbers`].
    pub fn from_numbers(numbers: &[f32], cube: (f32, f32), n: usize) -> Visibility {
        let mut solid = vec![0u64; n.pow(3).div_ceil(64)];
        numbers.iter().enumerate().for_each(|(i, v)| solid[PACKED * i / 64] |= (*v as u64) << (PACKED * i % 64));
        Visibility::new(solid, cube, n)
    }

    /// Solid cells as numbers that a checkpoint keeps, 16 to each.
    pub fn numbers(&self) -> Vec<f32> {
        (0..numbers_len(self.n)).map(|i| (self.solid[PACKED * i / 64] >> (PACKED * i % 64) & 0xffff) as f32).collect()
    }

    fn new(solid: Vec<u64>, (low, size): (f32, f32), n: usize) -> Visibility {
        let edge = n.div_ceil(BLOCK);
        let mut blocks = vec![false; edge.pow(3)];
        let set = solid
            .iter()
            .enumerate()
            .filter(|w| *w.1 != 0)
            .flat_map(|(w, bits)| (0..64).filter(move |b| bits >> b & 1 == 1).map(move |b| 64 * w + b));
        for i in set {
            let at = [i % n, i / n % n, i / n / n];
            // Interpolation reaches one cell far.
            for k in 0..8 {
                let b = [0, 1, 2].map(|a| (if k >> a & 1 == 0 { at[a].saturating_sub(1) } else { (at[a] + 1).min(n - 1) }) / BLOCK);
                blocks[(b[2] * edge + b[1]) * edge + b[0]] = true;
            }
        }
        let mut all = Visibility { low, size, n, solid, blocks, view_of: vec![NONE; OPEN_CELLS.pow(3)], views: Vec::new() };
        let found: Vec<(usize, Surroundings)> =
            (0..OPEN_CELLS.pow(3)).into_par_iter().filter_map(|i| Some((i, all.surroundings(i)?))).collect();
        for (i, view) in found {
            all.view_of[i] = all.views.len() as u32;
            all.views.push(view);
        }
        all
    }

    fn cell(&self) -> f32 {
        self.size / self.n as f32
    }

    fn is_solid(&self, i: usize) -> bool {
        self.solid[i / 64] >> (i % 64) & 1 == 1
    }

    /// How solid a point is, 0 to 1, interpolated between the centers of cells; `at` is in cells.
    fn solidity(&self, at: Vec3) -> f32 {
        let p = at - 0.5;
        let (base, f) = (p.floor(), p - p.floor());
        let n = self.n as i32;
        let get = |k: i32| {
            let q = [base.x as i32 + (k & 1), base.y as i32 + (k >> 1 & 1), base.z as i32 + (k >> 2)].map(|v| v.clamp(0, n - 1));
            self.is_solid(((q[2] * n + q[1]) * n + q[0]) as usize) as u8 as f32
        };
        let along = |k: i32| get(k) * (1.0 - f.x) + get(k + 1) * f.x;
        (along(0) * (1.0 - f.y) + along(2) * f.y) * (1.0 - f.z) + (along(4) * (1.0 - f.y) + along(6) * f.y) * f.z
    }

    /// Share of light that passes from a point in cells toward a direction, and where it first meets something.
    fn pass(&self, from: Vec3, dir: Vec3) -> (f32, Vec3) {
        let (edge, n) = (self.n.div_ceil(BLOCK), self.n as f32);
        let (mut at, mut depth, mut first) = (from, 0.0, None);
        while at.min_element() >= 0.0 && at.max_element() < n {
            let b = [at.x, at.y, at.z].map(|v| v as usize / BLOCK);
            if self.blocks[(b[2] * edge + b[1]) * edge + b[0]] {
                let more = STEP * DEPTH * self.solidity(at);
                if more > 0.0 {
                    first = first.or(Some(at));
                }
                depth += more;
                if depth > OPAQUE {
                    return (0.0, first.unwrap_or(at));
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
        ((-depth).exp(), first.unwrap_or(at))
    }

    /// Share of the light from a direction that reaches a surface.
    pub fn from_sun(&self, point: Vec3, normal: Vec3, direction: Vec3) -> f32 {
        // On the ray, not beside it: off to the side, shadows would be shifted.
        let facing = normal.dot(direction).max(0.0);
        let along = (LIFT / facing.max(1e-3)).min(FARTHEST);
        let beside = (LIFT - along * facing) * normal;
        self.pass((point - self.low) / self.cell() + along * direction + beside, direction).0
    }

    /// Whether a block with something solid touches a cell of `[OPEN_CELLS³]` or one next to it.
    fn is_near_solid(&self, at: [usize; 3]) -> bool {
        let (edge, blocks) = (self.n as f32 / OPEN_CELLS as f32, self.n.div_ceil(BLOCK));
        let range = |k: usize| {
            let block = |v: f32| ((v * edge).clamp(0.0, self.n as f32 - 1.0) as usize) / BLOCK;
            block(at[k] as f32 - 1.0)..=block(at[k] as f32 + 2.0)
        };
        let along = |z: usize, y: usize| range(0).any(|x| self.blocks[(z * blocks + y) * blocks + x]);
        range(2).any(|z| range(1).any(|y| along(z, y)))
    }

    /// What is seen from a cell: none where nothing is near, or no point is free.
    fn surroundings(&self, cell: usize) -> Option<Surroundings> {
        let at = [cell % OPEN_CELLS, cell / OPEN_CELLS % OPEN_CELLS, cell / OPEN_CELLS / OPEN_CELLS];
        if !self.is_near_solid(at) {
            return None;
        }
        let edge = self.n as f32 / OPEN_CELLS as f32;
        let corner = Vec3::from(at.map(|k| k as f32));
        // Golden-ratio points in the cell.
        let points = (1..30).map(|k| (corner + (k as f32 * Vec3::new(0.819_172_5, 0.671_043_6, 0.549_700_5)).fract()) * edge);
        let free: Vec<Vec3> = points.filter(|p| self.solidity(*p) < 0.05).take(POINTS).collect();
        if free.is_empty() {
            return None;
        }
        let mut out = Surroundings { even: [0.0; 9], sky: [[0.0; 9]; 9], seen: Vec::new() };
        let each = 1.0 / free.len() as f32;
        for i in 0..DIRECTIONS {
            let (basis, weights) = looks(i);
            let d = spread(i, DIRECTIONS).as_vec3();
            for p in &free {
                let (open, first) = self.pass(*p, d);
                (0..9).for_each(|j| out.even[j] += each * open * weights[j]);
                // What lies below and outside of the cube is ground, not sky.
                let (open, cell) = if open > SEEN && d.z < 0.0 { (0.0, GROUND) } else { (open, self.open_cell(first / edge)) };
                for j in 0..9 {
                    (0..9).for_each(|k| out.sky[j][k] += each * open * weights[j] * RADIANCE[k] * basis[k]);
                }
                if open < 1.0 - SEEN {
                    out.seen.push(SeenSurface { cell, direction: i as u16, share: each * (1.0 - open) });
                }
            }
        }
        Some(out)
    }

    /// The cell of `[OPEN_CELLS³]` at a point given in such cells.
    fn open_cell(&self, at: Vec3) -> u32 {
        let [x, y, z] = at.to_array().map(|v| v.clamp(0.0, OPEN_CELLS as f32 - 1.0) as u32);
        (z * OPEN_CELLS as u32 + y) * OPEN_CELLS as u32 + x
    }

    /// The cell of `[OPEN_CELLS³]` in which a point of model space lies.
    pub fn cell_of(&self, point: Vec3) -> u32 {
        self.open_cell((point - self.low) * (OPEN_CELLS as f32 / self.size))
    }

    /// The views that count for a surface.
    pub fn corners(&self, point: Vec3, normal: Vec3) -> Corners {
        let edge = self.size / OPEN_CELLS as f32;
        let p = (point - self.low) / edge + 0.5 * normal - 0.5;
        let (base, f) = (p.floor(), p - p.floor());
        let mut out = Corners::default();
        let mut weights = 0.0;
        for k in 0..8 {
            let corner = [k & 1, k >> 1 & 1, k >> 2];
            let q = [0, 1, 2].map(|a| base[a] as i32 + corner[a]);
            if q.iter().any(|v| !(0..OPEN_CELLS as i32).contains(v)) {
                continue;
            }
            let view = self.view_of[(q[2] as usize * OPEN_CELLS + q[1] as usize) * OPEN_CELLS + q[0] as usize];
            if view != NONE {
                let weight: f32 = [0, 1, 2].map(|a| if corner[a] == 1 { f[a] } else { 1.0 - f[a] }).iter().product::<f32>() + 1e-4;
                out.0[out.1] = (view, weight);
                out.1 += 1;
                weights += weight;
            }
        }
        out.0[..out.1].iter_mut().for_each(|c| c.1 /= weights);
        out
    }

    /// Share of an even sky's light that reaches a surface.
    pub fn from_sky(&self, corners: &Corners, normal: Vec3) -> f32 {
        let basis = basis(normal);
        let of = |v: u32| (0..9).map(|i| self.views[v as usize].even[i] * basis[i]).sum::<f32>();
        if corners.1 == 0 { 1.0 } else { corners.each().map(|(v, w)| w * of(v)).sum::<f32>().clamp(0.0, 1.0) }
    }

    /// Light that reaches a surface for each coefficient of a sky, all as irradiance over π.
    pub fn sky_row(&self, corners: &Corners, normal: Vec3) -> [f32; 9] {
        let basis = basis(normal);
        if corners.1 == 0 {
            return basis;
        }
        let mut row = [0.0; 9];
        for (v, w) in corners.each() {
            for (of_sky, b) in self.views[v as usize].sky.iter().zip(basis) {
                (0..9).for_each(|i| row[i] += w * b * of_sky[i]);
            }
        }
        row
    }

    /// Light of a sky `[9, 3]` and of surfaces of which `radiosity` over π is given by cell, and of the ground outside.
    pub fn ambient(&self, sky: &[f32], radiosity: &[Vec3], ground: Vec3) -> Ambient {
        let weights: Vec<[f32; 9]> = (0..DIRECTIONS).map(|i| looks(i).1).collect();
        let of = |s: &Surroundings| {
            let mut out: [Vec3; 9] = std::array::from_fn(|j| (0..9).map(|i| s.sky[j][i] * Vec3::from_slice(&sky[3 * i..])).sum());
            for seen in &s.seen {
                let sent = seen.share * if seen.cell == GROUND { ground } else { radiosity[seen.cell as usize] };
                (0..9).for_each(|j| out[j] += weights[seen.direction as usize][j] * sent);
            }
            out
        };
        Ambient(self.views.par_iter().map(of).collect())
    }
}

impl Corners {
    fn each(&self) -> impl Iterator<Item = (u32, f32)> {
        self.0[..self.1].iter().copied()
    }
}

impl Ambient {
    /// Irradiance over π of a surface; `sky` `[9, 3]` where nothing is near.
    pub fn at(&self, corners: &Corners, normal: Vec3, sky: &[f32]) -> Vec3 {
        of_normal(&self.around(corners, sky), normal)
    }

    /// The same as spherical harmonics of the normal, whatever that is.
    pub fn around(&self, corners: &Corners, sky: &[f32]) -> [Vec3; 9] {
        match corners.1 {
            0 => std::array::from_fn(|i| Vec3::from_slice(&sky[3 * i..])),
            _ => std::array::from_fn(|i| corners.each().map(|(v, w)| w * self.0[v as usize][i]).sum()),
        }
    }
}

/// Irradiance over π of a surface by spherical harmonics of its normal.
pub fn of_normal(around: &[Vec3; 9], normal: Vec3) -> Vec3 {
    basis(normal).iter().zip(around).map(|(b, v)| *b * *v).sum::<Vec3>().max(Vec3::ZERO)
}

fn basis(normal: Vec3) -> [f32; 9] {
    sh_light::basis(normal.as_dvec3()).map(|b| b as f32)
}

/// Basis functions of a direction in which points look, and irradiance over π that a radiance of 1 in its part of the sphere gives.
fn looks(i: usize) -> ([f32; 9], [f32; 9]) {
    let d = spread(i, DIRECTIONS);
    let mut light = ShLight::DARK;
    light.add_sun(d, [4.0 * std::f64::consts::PI / DIRECTIONS as f64, 0.0, 0.0]);
    (sh_light::basis(d).map(|b| b as f32), std::array::from_fn(|j| light.0[j][0] as f32))
}

/// Direction `i` of `n` that are spread evenly over the sphere.
pub fn spread(i: usize, n: usize) -> DVec3 {
    let z = 1.0 - 2.0 * (i as f64 + 0.5) / n as f64;
    let (r, turn) = ((1.0 - z * z).sqrt(), i as f64 * 2.399_963_229_728_653);
    DVec3::new(r * turn.cos(), r * turn.sin(), z)
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

    /// A plate at z = 0.25 and a wall on it at x = 0.5, each 0.1 thick.
    struct Corner;

    impl DensityQuery for Corner {
        fn density(&self, model: &[f32], sigma: &mut [f32]) {
            for (s, p) in sigma.iter_mut().zip(model.chunks_exact(3)) {
                let is_plate = (0.15..0.25).contains(&p[2]);
                let is_wall = (0.5..0.6).contains(&p[0]) && (0.25..0.75).contains(&p[2]);
                *s = if is_plate || is_wall { 1000.0 } else { 0.0 };
            }
        }
    }

    fn corner() -> Visibility {
        Visibility::of(&Corner, &Occupancy::new(64, 1, false), (0.0, 1.0), 64)
    }

    #[test]
    fn the_wall_shadows_what_lies_behind_it() {
        let (v, up) = (corner(), Vec3::Z);
        let sun = Vec3::new(1.0, 0.0, 1.0).normalize();
        // The shadow of a wall half as high as the cube reaches as far.
        for (x, want) in [(0.05, 0.0), (0.2, 0.0), (0.42, 0.0), (0.7, 1.0), (0.9, 1.0)] {
            let got = v.from_sun(Vec3::new(x, 0.5, 0.25), up, sun);
            assert!((got - want).abs() < 0.05, "{x}: {got}");
        }
        let other = Vec3::new(-1.0, 0.0, 1.0).normalize();
        assert!(v.from_sun(Vec3::new(0.2, 0.5, 0.25), up, other) > 0.95);
        assert!(v.from_sun(Vec3::new(0.5, 0.5, 0.5), Vec3::NEG_X, other) > 0.95);
    }

    /// Coarse cells and a low sun: the edge of the shadow lies where the ray from the edge of the wall meets the plate.
    #[test]
    fn shadows_are_not_shifted() {
        let (v, up) = (Visibility::of(&Corner, &Occupancy::new(16, 1, false), (0.0, 1.0), 16), Vec3::Z);
        // Half as high as the cube, the wall ends a shadow 0.4 before it.
        let sun = Vec3::new(1.0, 0.0, 1.25).normalize();
        for (x, is_lit) in [(0.07, true), (0.13, false), (0.2, false)] {
            let got = v.from_sun(Vec3::new(x, 0.5, 0.25), up, sun);
            assert!(if is_lit { got > 0.6 } else { got < 0.25 }, "{x}: {got}");
        }
    }

    #[test]
    fn corners_are_less_open_than_the_plain() {
        let v = corner();
        let open = |point: Vec3, normal: Vec3| v.from_sky(&v.corners(point, normal), normal);
        let [far, near] = [0.05, 0.47].map(|x| open(Vec3::new(x, 0.5, 0.25), Vec3::Z));
        // A wall of height h at distance d hides (1 − d / √(d² + h²)) / 2 of what a plain receives, if it is long.
        assert!((far - 0.83).abs() < 0.1 && (near - 0.55).abs() < 0.12, "{far} {near}");
        let side = open(Vec3::new(0.5, 0.5, 0.5), Vec3::NEG_X);
        assert!((side - 0.72).abs() < 0.1, "{side}");
    }

    #[test]
    fn solid_cells_survive_a_checkpoint() {
        let v = corner();
        let numbers = v.numbers();
        assert_eq!(numbers.len(), numbers_len(64));
        let back = Visibility::from_numbers(&numbers, (0.0, 1.0), 64);
        assert!(back.solid == v.solid && v.solid.iter().any(|w| *w != 0));
    }
}
