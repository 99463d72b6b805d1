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
/// Cells above its surface at which what a ray meets begins to count, and farthest along the ray that this is.
const LIFT: f32 = 1.0;
const FARTHEST: f32 = 8.0;
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
        Visibility { low, size, n, solid, near, blocks }
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
        let along = (LIFT / facing.max(1e-3)).min(FARTHEST);
        (point - self.low) / self.cell() + along * direction + (LIFT - along * facing) * normal
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
mod tests {
    use super::*;

    fn basis(n: Vec3) -> [f32; 9] {
        sh_light::basis(n.as_dvec3()).map(|b| b as f32)
    }

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
        let open = |point: Vec3, normal: Vec3| v.from_sky(point, normal, 512, 0);
        let [far, near] = [0.05, 0.47].map(|x| open(Vec3::new(x, 0.5, 0.25), Vec3::Z));
        // A wall of height h at distance d hides (1 − d / √(d² + h²)) / 2 of what a plain receives, if it is long.
        assert!((far - 0.83).abs() < 0.1 && (near - 0.55).abs() < 0.12, "{far} {near}");
        let side = open(Vec3::new(0.5, 0.5, 0.5), Vec3::NEG_X);
        assert!((side - 0.72).abs() < 0.1, "{side}");
    }

    /// Open space under a sky of which the upper half is seen, before a ground that sends what the sky would.
    #[test]
    fn light_in_the_open_is_that_of_the_sky_and_changes_with_the_normal_as_it_does() {
        let empty = Visibility::new(vec![0; 64], (0.0, 1.0), 16);
        let mut sky = [0.0; 27];
        (0..27).for_each(|i| sky[i] = [0.9, 0.2, 0.1][i % 3] * [1.0, -0.1, 0.3, 0.2, 0.04, -0.03, 0.05, 0.02, -0.06][i / 3]);
        let ambient = Ambient { sky: sky.to_vec(), radiosity: Radiosity::dark() };
        let normal = Vec3::new(0.1, -0.2, 1.0).normalize();
        // Of directions below, which see the ground, few count for a surface that looks up.
        let light = |n: Vec3| (0..9).map(|i| basis(n)[i] * Vec3::from_slice(&sky[3 * i..])).sum::<Vec3>();
        let got = ambient.gathered(normal, empty.looks(Vec3::splat(0.5), normal, 8192, 1));
        assert!((got.light - light(normal)).abs().max_element() < 0.03, "{} {}", got.light, light(normal));
        for side in [Vec3::X, Vec3::Y] {
            let turned = (normal + 0.05 * side).normalize();
            let (want, by) = (light(turned) - light(normal), got.at(turned) - got.light);
            assert!((want - by).abs().max_element() < 0.15 * want.abs().max_element() + 1e-3, "{want} {by}");
        }
        assert!(got.open > 0.97);
    }

    #[test]
    fn what_hides_the_sky_sends_its_own_light() {
        let v = corner();
        let (point, up) = (Vec3::new(0.47, 0.5, 0.25), Vec3::Z);
        let with = |cells: Vec3| {
            let radiosity = Radiosity { cells: vec![cells; SIDES * OPEN_CELLS.pow(3)], ground: Vec3::ZERO };
            Ambient { sky: vec![0.0; 27], radiosity }.gathered(up, v.looks(point, up, 2048, 0))
        };
        let (dark, lit) = (with(Vec3::ZERO), with(Vec3::new(1.0, 0.5, 0.0)));
        assert_eq!(dark.light, Vec3::ZERO);
        assert!((lit.light - (1.0 - lit.open) * Vec3::new(1.0, 0.5, 0.0)).abs().max_element() < 0.02, "{lit:?}");
        // The wall stands at +x: a surface that turns there receives more of it.
        assert!(lit.slope[0].x > 0.1 && lit.at(Vec3::new(0.1, 0.0, 0.995)).x > lit.light.x, "{lit:?}");
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
