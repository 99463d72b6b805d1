//! Which light reaches the learned surfaces: shadows of a sun through cells with optical depths, and what points see around them, sky or surfaces.

use diorama_engine::fields::DensityQuery;
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::sh_light;
use diorama_kernels::ops::ray_generation::PosedCamera;
use rayon::prelude::*;

mod cells;

use cells::Cells;

/// Cells per axis of the grid that holds what surfaces send.
pub const OPEN_CELLS: usize = 64;
/// Sides of a cell that send light of their own: ground and the wall that stands on it do not look alike.
pub const SIDES: usize = 6;
/// Cells above its surface at which what a ray meets begins to count: the least, and more where surfaces are noisy; and how many times as far
/// along the ray that is at most.
const LIFTS: [f32; 3] = [1.0, 2.0, 3.0];
const FARTHEST: f32 = 8.0;
/// Cells within which a ray meets its own surface, share of light that then does not pass, and least cosine of the ray to the normal.
const OWN: f32 = 3.0;
const OWN_HIDES: f32 = 0.5;
const OWN_FACING: f32 = 0.1;
/// Share of rays that may meet their own surface, and share of those that do from the lowest beginning that may be left at the highest.
const SMOOTH: f32 = 0.08;
const HELPED: f32 = 0.5;
/// Directions of these rays.
const TRIED: usize = 64;
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

/// What hides light, and where rays from surfaces begin.
pub struct Visibility {
    cells: Cells,
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
}

impl Visibility {
    /// What a field holds in a cube (lowest corner and edge) where its occupancy grid agrees, in `n` cells per axis, wherever it is.
    #[cfg(test)]
    pub fn of(field: &dyn DensityQuery, occupancy: &Occupancy, cube: (f32, f32), n: usize) -> Visibility {
        Visibility::new(Cells::of(field, occupancy, cube, n, &|_| true))
    }

    /// What a field holds in a cube (lowest corner and edge) where its occupancy grid agrees and a camera's picture shows it, in `n` cells per
    /// axis: of the rest, no photograph tells what is there, and it would cast shadows all the same.
    pub fn within(field: &dyn DensityQuery, occupancy: &Occupancy, cube: (f32, f32), n: usize, cameras: &[PosedCamera]) -> Visibility {
        let inverse: Vec<_> = cameras.iter().map(|c| (c.pose.inverse(), c.camera)).collect();
        let is_shown = |p: [f32; 3]| inverse.iter().any(|(pose, camera)| camera.shows(pose.point(DVec3::from(p.map(f64::from)))));
        Visibility::new(Cells::of(field, occupancy, cube, n, &is_shown))
    }

    /// The same from [`Visibility::numbers`]; none where these are not of `n` cells per axis.
    pub fn from_numbers(numbers: &[f32], cube: (f32, f32), n: usize) -> Option<Visibility> {
        Cells::from_numbers(numbers, cube, n).map(Visibility::new)
    }

    /// Of runs that knew only solid and empty cells.
    pub fn from_bits(numbers: &[f32], cube: (f32, f32), n: usize) -> Option<Visibility> {
        Cells::from_bits(numbers, cube, n).map(Visibility::new)
    }

    /// Cells as numbers that a checkpoint keeps.
    pub fn numbers(&self) -> Vec<f32> {
        self.cells.numbers()
    }

    fn new(cells: Cells) -> Visibility {
        Visibility { cells, lift: LIFTS[0] }
    }

    /// Beginning in cells of a ray from a surface: on the ray, not beside it, where shadows would be shifted.
    fn lifted(&self, point: Vec3, normal: Vec3, direction: Vec3, facing: f32) -> Vec3 {
        let along = self.lift * (1.0 / facing.max(1e-3)).min(FARTHEST);
        self.cells.at(point) + along * direction + (self.lift - along * facing) * normal
    }

    /// Lets rays from surfaces, given by points and normals, begin as high as it takes: distances that are learned from few or small photographs
    /// are off by more than a cell, and walls would shadow themselves. Where that helps little, surfaces are rough, and rays begin low.
    pub fn lift_from(&mut self, surfaces: &[(Vec3, Vec3)]) {
        let mut hits = [0.0; LIFTS.len()];
        for (hits, lift) in hits.iter_mut().zip(LIFTS) {
            self.lift = lift;
            *hits = self.own_hits(surfaces);
            if *hits <= SMOOTH {
                return;
            }
        }
        if hits[LIFTS.len() - 1] > HELPED * hits[0] {
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
                let (passes, first) = self.cells.pass(from, direction);
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
        self.cells.pass(self.lifted(point, normal, direction, normal.dot(direction).max(0.0)), direction).0
    }

    /// What a surface sees in `n` directions whose density is the cosine over π; which they are depends on the point and a seed.
    pub fn looks(&self, point: Vec3, normal: Vec3, n: usize, seed: u32) -> impl Iterator<Item = Look> {
        let (a, b) = normal.any_orthonormal_pair();
        let bits = point.to_array().iter().fold(seed ^ 0x9e37_79b9, |h, v| (h ^ v.to_bits()).wrapping_mul(0x85eb_ca6b).rotate_left(13));
        let (turn, shift) = ((bits & 0xffff) as f32 / 65_536.0, (bits >> 16) as f32 / 65_536.0);
        let edge = self.cells.n as f32 / OPEN_CELLS as f32;
        (0..n).map(move |i| {
            let square = (i as f32 + shift) / n as f32;
            let (y, x) = (std::f32::consts::TAU * (turn + i as f32 * GOLDEN)).sin_cos();
            let facing = (1.0 - square).max(LEAST_FACING * LEAST_FACING).sqrt();
            let direction = square.sqrt() * (x * a + y * b) + facing * normal;
            let (passes, first) = self.cells.pass(self.lifted(point, normal, direction, facing), direction);
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
        self.open_cell((point - self.cells.low) * (OPEN_CELLS as f32 / self.cells.size))
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
        let mut out = Gathered { normal, ..Gathered::NONE };
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
            let by = radiance / look.facing.max(LEAST_SLOPING);
            out.slope = [0, 1, 2].map(|k| out.slope[k] + look.direction[k] * by);
            n += 1.0;
        }
        Gathered { light: out.light / n, of_sky: out.of_sky.map(|v| v / n), slope: out.slope.map(|s| s / n), ..out }
    }
}

impl Gathered {
    /// Of a place that nothing reaches.
    pub const NONE: Gathered = Gathered { normal: Vec3::Z, light: Vec3::ZERO, of_sky: [0.0; 9], slope: [Vec3::ZERO; 3] };

    /// What arrives from a sky `[9, 3]` alone.
    pub fn from_sky(&self, sky: &[f32]) -> Vec3 {
        self.of_sky.iter().zip(sky.chunks_exact(3)).map(|(b, s)| *b * Vec3::from_slice(s)).sum::<Vec3>().max(Vec3::ZERO)
    }

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

#[cfg(test)]
#[path = "visibility_tests.rs"]
mod tests;
