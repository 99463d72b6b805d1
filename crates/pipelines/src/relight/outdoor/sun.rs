//! The sun of a session apart from its sky: `E = P V max(0, n · s) + O max(0, Lᵀ b(n)) + (1 − O) B`, with the sun's direction `s` and power
//! `P`, its visibility `V`, the sky's harmonics `L`, openness `O`, and light `B` from surfaces that hide the sky. Directions are searched,
//! the rest then is linear.

use super::visibility::{Visibility, spread};
use diorama_geom::glam::Vec3;
use diorama_geom::sh_light;
use rayon::prelude::*;

/// Numbers of a sun: direction, power and light from surfaces, RGB each.
pub const SUN: usize = 9;
/// Candidates over the sphere of which those above the horizon are tried.
const CANDIDATES: usize = 600;
/// Radii in radians of the circles about the best direction that are tried afterwards, and directions on each.
const CIRCLES: [f32; 5] = [0.1, 0.05, 0.025, 0.0125, 0.006];
const AROUND: usize = 10;
/// Unknowns: sun, nine of the sky, surfaces.
const UNKNOWNS: usize = 11;
/// Pull of the unknowns toward 0, per pixel.
const RIDGE: f64 = 1e-4;
/// Linear light below which errors do not count more.
const DARK: f32 = 0.02;

/// A pixel that shows a surface.
#[derive(Clone, Copy, Debug)]
pub struct Lit {
    pub point: Vec3,
    pub normal: Vec3,
    pub albedo: Vec3,
    /// Linear light of the photograph.
    pub seen: Vec3,
}

/// Light that explains pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Fitted {
    /// Direction, power, light from surfaces.
    pub sun: [f32; SUN],
    /// `[9, 3]`
    pub sky: [f32; 27],
    /// Mean squared error, about that of sRGB.
    pub error: f64,
}

/// The light of pixels. Without a direction to begin with, the whole sky is searched.
pub fn fit(pixels: &[Lit], visibility: &Visibility, near: Option<Vec3>) -> Fitted {
    let open: Vec<f32> = pixels.par_iter().map(|p| visibility.from_sky(p.point, p.normal)).collect();
    let best_of = |directions: Vec<Vec3>| {
        let tried = directions.into_par_iter().map(|d| solve(pixels, &open, visibility, d));
        tried.reduce_with(|a, b| if b.error < a.error { b } else { a }).expect("a direction")
    };
    let all = || (0..CANDIDATES).map(|i| spread(i, CANDIDATES).as_vec3()).filter(|d| d.z > 0.03).collect();
    let mut best = best_of(near.map_or_else(all, |d| vec![d]));
    for radius in CIRCLES {
        let center = Vec3::new(best.sun[0], best.sun[1], best.sun[2]);
        let (a, b) = center.any_orthonormal_pair();
        let (sin, cos) = radius.sin_cos();
        let circle = (0..AROUND).map(|i| {
            let (y, x) = (i as f32 / AROUND as f32 * std::f32::consts::TAU).sin_cos();
            (cos * center + sin * (x * a + y * b)).normalize()
        });
        let next = best_of(circle.collect());
        if next.error < best.error {
            best = next;
        }
    }
    best
}

/// Least squares for one direction.
fn solve(pixels: &[Lit], open: &[f32], visibility: &Visibility, direction: Vec3) -> Fitted {
    let mut sums = [[[0.0f64; UNKNOWNS + 1]; UNKNOWNS]; 3];
    let mut squares = 0.0;
    for (p, &o) in pixels.iter().zip(open) {
        let facing = p.normal.dot(direction).max(0.0);
        let sun = if facing > 0.0 { facing * visibility.from_sun(p.point, p.normal, direction) } else { 0.0 };
        let basis = sh_light::basis(p.normal.as_dvec3());
        let row: [f64; UNKNOWNS] = std::array::from_fn(|i| match i {
            0 => sun as f64,
            10 => (1.0 - o) as f64,
            _ => o as f64 * basis[i - 1],
        });
        for k in 0..3 {
            // The derivative of sRGB at what is seen.
            let weight = 0.44 * p.seen[k].max(DARK).powf(-0.58);
            let (a, y) = ((weight * p.albedo[k]) as f64, (weight * p.seen[k]) as f64);
            for (i, line) in sums[k].iter_mut().enumerate() {
                (i..UNKNOWNS).for_each(|j| line[j] += a * a * row[i] * row[j]);
                line[UNKNOWNS] += a * row[i] * y;
            }
            squares += y * y;
        }
    }
    let n = pixels.len().max(1) as f64;
    let mut found = Fitted { sun: [0.0; SUN], sky: [0.0; 27], error: squares / (3.0 * n) };
    found.sun[..3].copy_from_slice(&direction.to_array());
    for (k, sums) in sums.iter_mut().enumerate() {
        (0..UNKNOWNS).for_each(|i| {
            sums[i][i] += RIDGE * n;
            (0..i).for_each(|j| sums[i][j] = sums[j][i]);
        });
        // A sun or surfaces that would take light away are left out.
        let mut out = Vec::new();
        let x = loop {
            let x = without(sums, &out);
            match [0, 10].into_iter().find(|i| x[*i] < 0.0) {
                Some(i) => out.push(i),
                None => break x,
            }
        };
        (found.sun[3 + k], found.sun[6 + k]) = (x[0] as f32, x[10] as f32);
        (0..9).for_each(|i| found.sky[3 * i + k] = x[1 + i] as f32);
        // ‖y − Ax‖² = ‖y‖² − 2 xᵀAᵀy + xᵀAᵀA x.
        let explained: f64 =
            (0..UNKNOWNS).map(|i| x[i] * (2.0 * sums[i][UNKNOWNS] - (0..UNKNOWNS).map(|j| sums[i][j] * x[j]).sum::<f64>())).sum();
        found.error -= explained / (3.0 * n);
    }
    found
}

/// Solution of symmetric equations in which some unknowns are 0, by elimination.
fn without(equations: &[[f64; UNKNOWNS + 1]; UNKNOWNS], out: &[usize]) -> [f64; UNKNOWNS] {
    let mut m = *equations;
    for &i in out {
        m[i] = [0.0; UNKNOWNS + 1];
        m.iter_mut().for_each(|row| row[i] = 0.0);
        m[i][i] = 1.0;
    }
    for i in 0..UNKNOWNS {
        let pivot = m[i];
        for row in &mut m[i + 1..] {
            let factor = row[i] / pivot[i];
            (i..=UNKNOWNS).for_each(|j| row[j] -= factor * pivot[j]);
        }
    }
    let mut x = [0.0; UNKNOWNS];
    for i in (0..UNKNOWNS).rev() {
        x[i] = (m[i][UNKNOWNS] - (i + 1..UNKNOWNS).map(|j| m[i][j] * x[j]).sum::<f64>()) / m[i][i];
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_engine::fields::DensityQuery;
    use diorama_engine::samplers::occupancy::Occupancy;
    use diorama_geom::glam::DVec3;
    use diorama_geom::rng::Rng;
    use diorama_geom::sh_light::ShLight;

    /// A plate with a tower.
    struct Tower;

    fn is_inside(p: Vec3) -> bool {
        (0.1..0.2).contains(&p.z) || ((p - 0.5).abs().truncate().max_element() < 0.1 && (0.2..0.6).contains(&p.z))
    }

    impl DensityQuery for Tower {
        fn density(&self, model: &[f32], sigma: &mut [f32]) {
            sigma.iter_mut().zip(model.chunks_exact(3)).for_each(|(s, p)| *s = 2000.0 * is_inside(Vec3::from_slice(p)) as u8 as f32);
        }
    }

    #[test]
    fn the_sun_is_found_where_it_stands() {
        let visibility = Visibility::of(&Tower, &Occupancy::new(64, 1, false), (0.0, 1.0), 64);
        let (sun, power) = (Vec3::new(0.5, -0.6, 0.7).normalize(), Vec3::new(0.9, 0.8, 0.6));
        let mut sky = ShLight::uniform([0.2, 0.25, 0.35]);
        sky.0[2] = [0.1; 3];
        let rng = Rng::new(5, 5);
        let pixels: Vec<Lit> = (0..3000)
            .map(|i| {
                let at = |k: u64| rng.uniform(8 * i + k);
                let (point, normal) = match i % 4 {
                    0..2 => (Vec3::new(at(0), at(1), 0.2), Vec3::Z),
                    2 => (Vec3::new(0.4 + 0.2 * at(0), 0.4, 0.2 + 0.4 * at(1)), Vec3::NEG_Y),
                    _ => (Vec3::new(0.6, 0.4 + 0.2 * at(0), 0.2 + 0.4 * at(1)), Vec3::X),
                };
                let albedo = Vec3::new(0.2 + 0.5 * at(2), 0.3 + 0.3 * at(3), 0.5);
                let lit = Vec3::from(sky.shade(DVec3::from(normal)).map(|v| v as f32)) * visibility.from_sky(point, normal);
                let direct = power * normal.dot(sun).max(0.0) * visibility.from_sun(point, normal, sun);
                Lit { point, normal, albedo, seen: albedo * (lit + direct) }
            })
            .collect();
        let found = fit(&pixels, &visibility, None);
        let direction = Vec3::from_slice(&found.sun[..3]);
        assert!(direction.angle_between(sun).to_degrees() < 2.0, "{direction} {sun}");
        assert!((Vec3::from_slice(&found.sun[3..6]) - power).abs().max_element() < 0.05, "{found:?}");
        // From nearby, only the neighborhood is searched.
        let again = fit(&pixels, &visibility, Some((sun + Vec3::new(0.05, 0.0, 0.0)).normalize()));
        assert!(Vec3::from_slice(&again.sun[..3]).angle_between(sun).to_degrees() < 2.0);
    }
}
