//! Which light reaches the learned surfaces: shadows of a sun through cells that are solid, and what points see around them, sky or surfaces.

use diorama_engine::fields::DensityQuery;
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::sh_light;
use diorama_kernels::ops::march::OccupancyBits;
use rayon::prelude::*;

/// Cells per axis of the grid that holds what surfaces send.
pub const OPEN_CELLS: usize = 64;
/// Sides of a cell that send light of their own: ground and the wall that stands on it do not look alike.
pub const SIDES: usize = 6;
/// Cells per axis of the blocks that shadow rays skip where nothing is solid.
const BLOCK: usize = 8;
/// Share of a cell that must be opaque for it to be solid.
const SOLID: f32 = 0.5;
/// Optical depth of a solid cell, and beyond which nothing passes.
const DEPTH: f32 = 2.0;
const OPAQUE: f32 = 6.0;
/// Cells above its surface at which what a ray meets begins to count: the least, and more where surfaces are noisy; and how many times as far
/// along the ray that is at most.
const LIFTS: [f32; 3] = [1.0, 2.0, 3.0];
const FARTHEST: f32 = 8.0;
/// Cells within which a ray meets its own surface, share of light that then does not pass, and least cosine of the ray to the normal.
const OWN: f32 = 3.0;
const OWN_HIDES: f32 = 0.5;
const OWN_FACING: f32 = 0.1;
/// Share of rays that may meet their own surface, as rough ones do, before rays begin higher; and then that may still do so.
const ROUGH: f32 = 0.2;
const SMOOTH: f32 = 0.05;
/// Directions of these rays.
const TRIED: usize = 64;
/// Length of a step in cells.
const STEP: f32 = 0.7;
/// Bits in a number of a checkpoint.
const PACKED: usize = 16;
/// Share of the light of a direction from which surfaces in it matter.
const SEEN: f32 = 0.05;
/// Turn between directions in which points look, and least cosines of them to the normal, and of those by which light changes with the normal.
const GOLDEN: f32 = 0.618_034;
const LEAST_FACING: f32 = 0.01;
const LEAST_SLOPING: f32 = 0.2;
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
    /// The same of cells from whose center on to the next centers something is solid.
    near: Vec<u64>,
    /// Whether something in a block, or next to it, is solid.
    blocks: Vec<bool>,
    /// Of [`LIFTS`].
    lift: f32,
}

/// What a surface sees in one direction.
pub struct Look {
    pub direction: Vec3,
    /// Cosine to the normal.
    pub facing: f32,
    /// Share of light that passes; of the sky's, none does from below, where the ground outside is.
    pub passes: f32,
    pub open: f32,
    /// Cell of `[OPEN_CELLS³]`, or [`GROUND`], of what hides the rest.
    pub cell: u32,
}

/// What surfaces send, over π, by cell of `[OPEN_CELLS³]`, and the ground outside.
#[derive(Clone)]
pub struct Radiosity {
    /// `[OPEN_CELLS³, SIDES]`, by the side that surfaces face ([`sides`]).
    pub cells: Vec<Vec3>,
    pub ground: Vec3,
}

/// Light of a sky `[9, 3]`, given as irradiance over π, and of surfaces.
#[derive(Clone)]
pub struct Ambient {
    pub sky: Vec<f32>,
    pub radiosity: Radiosity,
}

/// Irradiance over π of a surface from sky and surfaces, for normals near its own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gathered {
    pub normal: Vec3,
    pub light: Vec3,
    /// What of it each coefficient of the sky gives.
    pub of_sky: [f32; 9],
    /// Derivatives with respect to the normal's axes.
    pub slope: [Vec3; 3],
    /// Share of an even sky's light that arrives.
    pub open: f32,
}

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
        let (mut blocks, mut near) = (vec![false; edge.pow(3)], vec![0u64; solid.len()]);
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
                let c = [0, 1, 2].map(|a| at[a].saturating_sub(k >> a & 1));
                let c = (c[2] * n + c[1]) * n + c[0];
                near[c / 64] |= 1 << (c % 64);
            }
        }
        Visibility { low, size, n, solid, near, blocks, lift: LIFTS[0] }
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
        let at = [base.x, base.y, base.z].map(|v| v.max(0.0) as usize);
        let at = (at[2] * self.n + at[1]) * self.n + at[0];
        if self.near[at / 64] >> (at % 64) & 1 == 0 {
            return 0.0;
        }
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

    /// Beginning in cells of a ray from a surface: on the ray, not beside it, where shadows would be shifted.
    fn lifted(&self, point: Vec3, normal: Vec3, direction: Vec3, facing: f32) -> Vec3 {
        let along = self.lift * (1.0 / facing.max(1e-3)).min(FARTHEST);
        (point - self.low) / self.cell() + along * direction + (self.lift - along * facing) * normal
    }

    /// Lets rays from surfaces, given by points and normals, begin as high as it takes: distances that are learned from few or small photographs
    /// are off by more than a cell, and walls would shadow themselves. Where no height takes it, surfaces are rough, and rays begin low.
    pub fn lift_from(&mut self, surfaces: &[(Vec3, Vec3)]) {
        let mut own_hits = |lift: f32| {
            self.lift = lift;
            self.own_hits(surfaces)
        };
        let is_noisy = own_hits(LIFTS[0]) > ROUGH && LIFTS[1..].iter().any(|lift| own_hits(*lift) <= SMOOTH);
        if !is_noisy {
            self.lift = LIFTS[0];
        }
    }

    /// Share of rays toward the sky that meet their own surface.
    fn own_hits(&self, surfaces: &[(Vec3, Vec3)]) -> f32 {
        let toward: Vec<Vec3> = (0..TRIED).map(|i| spread(i, TRIED).as_vec3()).collect();
        let is_hit = |(i, (point, normal)): (usize, &(Vec3, Vec3))| {
            let direction = toward[i % TRIED];
            let facing = normal.dot(direction);
            (direction.z > 0.0 && facing > OWN_FACING).then(|| {
                let from = self.lifted(*point, *normal, direction, facing);
                let (passes, first) = self.pass(from, direction);
                1.0 - passes > OWN_HIDES && (first - from).length() < OWN
            })
        };
        let hits: Vec<bool> = surfaces.par_iter().enumerate().filter_map(is_hit).collect();
        hits.iter().filter(|h| **h).count() as f32 / hits.len().max(1) as f32
    }

    /// Cells above surfaces at which rays begin.
    pub fn lift(&self) -> f32 {
        self.lift
    }

    /// The same with rays that begin as many cells above surfaces.
    pub fn lifted_by(self, lift: f32) -> Visibility {
        Visibility { lift, ..self }
    }

    /// Share of the light from a direction that reaches a surface.
    pub fn from_sun(&self, point: Vec3, normal: Vec3, direction: Vec3) -> f32 {
        self.pass(self.lifted(point, normal, direction, normal.dot(direction).max(0.0)), direction).0
    }

    /// What a surface sees in `n` directions whose density is the cosine over π; which they are depends on the point and a seed.
    pub fn looks(&self, point: Vec3, normal: Vec3, n: usize, seed: u32) -> impl Iterator<Item = Look> {
        let (a, b) = normal.any_orthonormal_pair();
        let bits = point.to_array().iter().fold(seed ^ 0x9e37_79b9, |h, v| (h ^ v.to_bits()).wrapping_mul(0x85eb_ca6b).rotate_left(13));
        let (turn, shift) = ((bits & 0xffff) as f32 / 65_536.0, (bits >> 16) as f32 / 65_536.0);
        let edge = self.n as f32 / OPEN_CELLS as f32;
        (0..n).map(move |i| {
            let square = (i as f32 + shift) / n as f32;
            let (y, x) = (std::f32::consts::TAU * (turn + i as f32 * GOLDEN)).sin_cos();
            let facing = (1.0 - square).max(LEAST_FACING * LEAST_FACING).sqrt();
            let direction = square.sqrt() * (x * a + y * b) + facing * normal;
            let (passes, first) = self.pass(self.lifted(point, normal, direction, facing), direction);
            let (open, cell) = if passes > SEEN && direction.z < 0.0 { (0.0, GROUND) } else { (passes, self.open_cell(first / edge)) };
            Look { direction, facing, passes, open, cell }
        })
    }

    /// Share of an even sky's light that reaches a surface.
    pub fn from_sky(&self, point: Vec3, normal: Vec3, n: usize, seed: u32) -> f32 {
        self.looks(point, normal, n, seed).map(|l| l.passes).sum::<f32>() / n as f32
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
}

impl Radiosity {
    /// That of surfaces that send nothing.
    pub fn dark() -> Radiosity {
        Radiosity { cells: vec![Vec3::ZERO; SIDES * OPEN_CELLS.pow(3)], ground: Vec3::ZERO }
    }

    /// What a cell sends to where a look into it comes from.
    pub fn toward(&self, look: &Look) -> Vec3 {
        places(look).into_iter().map(|(place, share)| share * self.of(place)).sum()
    }

    /// What a cell sends to one side, or the ground, of those of [`places`].
    pub fn of(&self, place: u32) -> Vec3 {
        if place == GROUND { self.ground } else { self.cells[place as usize] }
    }
}

/// Sides of an ambient cube (McTaggart 2004), +x, −x, +y and so on, that a unit vector points to, and their shares, its squares.
pub fn sides(v: Vec3) -> [(usize, f32); 3] {
    let v = v.to_array();
    std::array::from_fn(|a| (2 * a + (v[a] < 0.0) as usize, v[a] * v[a]))
}

/// Places of `[OPEN_CELLS³, SIDES]`, or [`GROUND`], that a look sees, and their shares.
pub fn places(look: &Look) -> [(u32, f32); 3] {
    let of = |(side, share)| if look.cell == GROUND { (GROUND, share) } else { (SIDES as u32 * look.cell + side as u32, share) };
    sides(-look.direction).map(of)
}

impl Ambient {
    /// Light that arrives from where a surface looks.
    pub fn gathered(&self, normal: Vec3, looks: impl Iterator<Item = Look>) -> Gathered {
        let mut out = Gathered { normal, open: 0.0, ..Gathered::NONE };
        let mut n = 0.0;
        for look in looks {
            let mut radiance = (1.0 - look.open) * if look.open < 1.0 - SEEN { self.radiosity.toward(&look) } else { Vec3::ZERO };
            if look.open > 0.0 {
                for ((r, s), of_sky) in radiances(look.direction).iter().zip(self.sky.chunks_exact(3)).zip(&mut out.of_sky) {
                    *of_sky += look.open * r;
                    radiance += look.open * r * Vec3::from_slice(s);
                }
            }
            out.light += radiance;
            out.open += look.passes;
            let by = radiance / look.facing.max(LEAST_SLOPING);
            out.slope = [0, 1, 2].map(|k| out.slope[k] + look.direction[k] * by);
            n += 1.0;
        }
        let (light, open) = (out.light / n, out.open / n);
        Gathered { light, open, of_sky: out.of_sky.map(|v| v / n), slope: out.slope.map(|s| s / n), ..out }
    }
}

impl Gathered {
    /// Of a place that nothing reaches.
    pub const NONE: Gathered = Gathered { normal: Vec3::Z, light: Vec3::ZERO, of_sky: [0.0; 9], slope: [Vec3::ZERO; 3], open: 1.0 };

    /// Irradiance over π for a normal near the surface's.
    pub fn at(&self, normal: Vec3) -> Vec3 {
        let turned = normal - self.normal;
        (self.light + turned.x * self.slope[0] + turned.y * self.slope[1] + turned.z * self.slope[2]).max(Vec3::ZERO)
    }
}

/// Radiance in a direction for each coefficient of a sky that is given as irradiance over π.
pub fn radiances(direction: Vec3) -> [f32; 9] {
    let basis = sh_light::basis(direction.as_dvec3());
    std::array::from_fn(|k| RADIANCE[k] * basis[k] as f32)
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
#[path = "visibility_tests.rs"]
mod tests;
