//! Which light reaches the learned surfaces: shadows of a sun through cells that are solid, and how open points are to the sky.

use diorama_engine::fields::DensityQuery;
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::sh_light::{self, ShLight};
use diorama_kernels::ops::march::OccupancyBits;
use rayon::prelude::*;

/// Cells per axis of the grid that holds openness.
const OPEN_CELLS: usize = 64;
/// Directions in which openness looks, and points in a cell from which it does.
const DIRECTIONS: usize = 64;
const POINTS: usize = 3;
/// Cells per axis of the blocks that shadow rays skip where nothing is solid.
const BLOCK: usize = 8;
/// Share of a cell that must be opaque for it to be solid.
const SOLID: f32 = 0.5;
/// Optical depth of a solid cell.
const DEPTH: f32 = 2.0;
/// Cells that a ray starts off its surface, along the normal and along its own direction.
const LIFT: (f32, f32) = (1.5, 1.0);
/// Length of a step in cells.
const STEP: f32 = 0.7;
/// Bits in a number of a checkpoint.
const PACKED: usize = 16;

/// Solid cells `[n³]` of a cube in model space, x fastest.
#[derive(Clone)]
pub struct Visibility {
    low: f32,
    size: f32,
    n: usize,
    solid: Vec<u8>,
    /// Whether something in a block, or next to it, is solid.
    blocks: Vec<bool>,
    /// Irradiance under a sky of radiance 1 as spherical harmonics, where a point of the cell is free, `[OPEN_CELLS³]`.
    open: Vec<Option<[f32; 9]>>,
}

/// Length of [`Visibility::numbers`] for `n` cells per axis.
pub fn numbers_len(n: usize) -> usize {
    n.pow(3).div_ceil(PACKED)
}

impl Visibility {
    /// Cells of a cube (lowest corner and edge) in which a field is dense and its occupancy grid agrees.
    pub fn of(field: &dyn DensityQuery, occupancy: &Occupancy, (low, size): (f32, f32), n: usize) -> Visibility {
        let cell = size / n as f32;
        let mut solid = vec![0; n.pow(3)];
        solid.chunks_mut(n * n).enumerate().for_each(|(z, plane)| {
            let at = |i: usize| [i % n, i / n, z].map(|k| low + (k as f32 + 0.5) * cell);
            let live: Vec<usize> = (0..n * n).filter(|i| is_occupied(occupancy.bits(), at(*i))).collect();
            let corner = |p: [f32; 3], k: usize| [0, 1, 2].map(|a| p[a] + cell * (0.5 * (k >> a & 1) as f32 - 0.25));
            let points: Vec<f32> = live.iter().flat_map(|i| (0..8).map(move |k| (*i, k))).flat_map(|(i, k)| corner(at(i), k)).collect();
            let mut sigma = vec![0.0; points.len() / 3];
            field.density(&points, &mut sigma);
            for (i, s) in live.iter().zip(sigma.chunks_exact(8)) {
                let opaque = s.iter().map(|s| 1.0 - (-s * cell).exp()).sum::<f32>() / 8.0;
                plane[*i] = (opaque > SOLID) as u8;
            }
        });
        Visibility::new(solid, (low, size), n)
    }

    /// The same from [`Visibility::numbers`].
    pub fn from_numbers(numbers: &[f32], cube: (f32, f32), n: usize) -> Visibility {
        let solid = (0..n.pow(3)).map(|i| (numbers[i / PACKED] as u32 >> (i % PACKED) & 1) as u8).collect();
        Visibility::new(solid, cube, n)
    }

    /// Solid cells as whole numbers that hold one bit each of several cells.
    pub fn numbers(&self) -> Vec<f32> {
        self.solid.chunks(PACKED).map(|c| c.iter().enumerate().fold(0u32, |sum, (i, s)| sum | (*s as u32) << i) as f32).collect()
    }

    fn new(solid: Vec<u8>, (low, size): (f32, f32), n: usize) -> Visibility {
        let edge = n.div_ceil(BLOCK);
        let mut blocks = vec![false; edge.pow(3)];
        for i in (0..solid.len()).filter(|i| solid[*i] > 0) {
            let at = [i % n, i / n % n, i / n / n];
            // Interpolation reaches one cell far.
            for k in 0..8 {
                let b = [0, 1, 2].map(|a| (if k >> a & 1 == 0 { at[a].saturating_sub(1) } else { (at[a] + 1).min(n - 1) }) / BLOCK);
                blocks[(b[2] * edge + b[1]) * edge + b[0]] = true;
            }
        }
        let mut all = Visibility { low, size, n, solid, blocks, open: Vec::new() };
        all.open = (0..OPEN_CELLS.pow(3)).into_par_iter().map(|i| all.openness(i)).collect();
        all
    }

    fn cell(&self) -> f32 {
        self.size / self.n as f32
    }

    /// How solid a point is, 0 to 1, interpolated between the centers of cells; `at` is in cells.
    fn solidity(&self, at: Vec3) -> f32 {
        let p = at - 0.5;
        let (base, f) = (p.floor(), p - p.floor());
        let n = self.n as i32;
        let get = |k: i32| {
            let q = [base.x as i32 + (k & 1), base.y as i32 + (k >> 1 & 1), base.z as i32 + (k >> 2)].map(|v| v.clamp(0, n - 1));
            self.solid[((q[2] * n + q[1]) * n + q[0]) as usize] as f32
        };
        let along = |k: i32| get(k) * (1.0 - f.x) + get(k + 1) * f.x;
        (along(0) * (1.0 - f.y) + along(2) * f.y) * (1.0 - f.z) + (along(4) * (1.0 - f.y) + along(6) * f.y) * f.z
    }

    /// Share of light that passes from a point in cells toward a direction.
    fn transmittance(&self, from: Vec3, dir: Vec3) -> f32 {
        let (edge, n) = (self.n.div_ceil(BLOCK), self.n as f32);
        let (mut at, mut depth) = (from, 0.0);
        while at.min_element() >= 0.0 && at.max_element() < n {
            let b = [at.x, at.y, at.z].map(|v| v as usize / BLOCK);
            if self.blocks[(b[2] * edge + b[1]) * edge + b[0]] {
                depth += STEP * DEPTH * self.solidity(at);
                if depth > 6.0 {
                    return 0.0;
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
        (-depth).exp()
    }

    /// Share of the light from a direction that reaches a surface.
    pub fn from_sun(&self, point: Vec3, normal: Vec3, direction: Vec3) -> f32 {
        let at = (point - self.low) / self.cell();
        self.transmittance(at + LIFT.0 * normal + LIFT.1 * direction, direction)
    }

    /// Openness of a cell: `∫ V max(0, n · ω) / π dω` as spherical harmonics of the normal.
    fn openness(&self, cell: usize) -> Option<[f32; 9]> {
        let at = [cell % OPEN_CELLS, cell / OPEN_CELLS % OPEN_CELLS, cell / OPEN_CELLS / OPEN_CELLS].map(|k| k as f32);
        let edge = self.n as f32 / OPEN_CELLS as f32;
        // Only cells near something solid matter.
        let reach = (1.5 * edge).ceil() as i32;
        let center = (Vec3::from(at) + 0.5) * edge;
        let near = |d: i32, a: f32| ((a as i32 + d).clamp(0, self.n as i32 - 1)) as usize;
        let is_near = (-reach..=reach).any(|z| {
            (-reach..=reach).any(|y| {
                let row = (near(z, center.z) * self.n + near(y, center.y)) * self.n;
                self.solid[row + near(-reach, center.x)..=row + near(reach, center.x)].contains(&1)
            })
        });
        if !is_near {
            return None;
        }
        // Golden-ratio points in the cell.
        let points = (1..30).map(|k| (Vec3::from(at) + (k as f32 * Vec3::new(0.819_172_5, 0.671_043_6, 0.549_700_5)).fract()) * edge);
        let free: Vec<Vec3> = points.filter(|p| self.solidity(*p) < 0.05).take(POINTS).collect();
        if free.is_empty() {
            return None;
        }
        let mut seen = ShLight::DARK;
        let share = 4.0 * std::f64::consts::PI / (DIRECTIONS * free.len()) as f64;
        for (i, p) in (0..DIRECTIONS).flat_map(|i| free.iter().map(move |p| (i, p))) {
            let d = spread(i, DIRECTIONS);
            seen.add_sun(d, [share * self.transmittance(*p, d.as_vec3()) as f64, 0.0, 0.0]);
        }
        Some(std::array::from_fn(|i| seen.0[i][0] as f32))
    }

    /// Share of an even sky's light that reaches a surface.
    pub fn from_sky(&self, point: Vec3, normal: Vec3) -> f32 {
        let edge = self.size / OPEN_CELLS as f32;
        let p = (point - self.low) / edge + 0.5 * normal - 0.5;
        let (base, f) = (p.floor(), p - p.floor());
        let basis = sh_light::basis(normal.as_dvec3());
        let (mut sum, mut weights) = (0.0, 0.0);
        for k in 0..8 {
            let corner = [k & 1, k >> 1 & 1, k >> 2];
            let q = [0, 1, 2].map(|a| base[a] as i32 + corner[a]);
            if q.iter().any(|v| !(0..OPEN_CELLS as i32).contains(v)) {
                continue;
            }
            let at = (q[2] as usize * OPEN_CELLS + q[1] as usize) * OPEN_CELLS + q[0] as usize;
            if let Some(open) = &self.open[at] {
                let weight: f32 = [0, 1, 2].map(|a| if corner[a] == 1 { f[a] } else { 1.0 - f[a] }).iter().product::<f32>() + 1e-4;
                sum += weight * (0..9).map(|i| open[i] * basis[i] as f32).sum::<f32>();
                weights += weight;
            }
        }
        if weights > 0.0 { (sum / weights).clamp(0.0, 1.0) } else { 1.0 }
    }
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

    #[test]
    fn corners_are_less_open_than_the_plain() {
        let v = corner();
        let [far, near] = [0.05, 0.47].map(|x| v.from_sky(Vec3::new(x, 0.5, 0.25), Vec3::Z));
        // A wall of height h at distance d hides (1 − d / √(d² + h²)) / 2 of what a plain receives, if it is long.
        assert!((far - 0.83).abs() < 0.1 && (near - 0.55).abs() < 0.12, "{far} {near}");
        let side = v.from_sky(Vec3::new(0.5, 0.5, 0.5), Vec3::NEG_X);
        assert!((side - 0.72).abs() < 0.1, "{side}");
    }

    #[test]
    fn solid_cells_survive_a_checkpoint() {
        let v = corner();
        let numbers = v.numbers();
        assert_eq!(numbers.len(), numbers_len(64));
        let back = Visibility::from_numbers(&numbers, (0.0, 1.0), 64);
        assert!(back.solid == v.solid && v.solid.contains(&1));
    }
}
