//! The sun of a session apart from its sky: `E = P V max(0, n · s) + O max(0, Lᵀ b(n)) + (1 − O) B`, with the sun's direction `s` and power
//! `P`, its visibility `V`, the sky's harmonics `L`, openness `O`, and light `B` from surfaces that hide the sky, a share of what a level one
//! receives. Directions are searched, the rest then is linear.

use super::visibility::{Visibility, spread};
use diorama_geom::color::srgb_from_linear;
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::sh_light;
use rayon::prelude::*;

/// Numbers of a sun: direction, power and light from surfaces, RGB each.
pub const SUN: usize = 9;
/// Candidates over the sphere of which those above the horizon are tried.
const CANDIDATES: usize = 600;
/// Most pixels by which directions are tried.
const SEARCH_PIXELS: usize = 1500;
/// Radii in radians of the circles about the best direction that are tried afterwards, and directions on each.
const CIRCLES: [f32; 5] = [0.1, 0.05, 0.025, 0.0125, 0.006];
const AROUND: usize = 10;
/// Unknowns: sun, nine of the sky.
const UNKNOWNS: usize = 10;
/// Light that surfaces send to each other over what a level white one receives: about their albedo.
pub const BOUNCED: f32 = 0.25;
/// Pull of the unknowns toward 0, per pixel: of the sun and the even sky, and of the sky's first and second band, as normals of few directions
/// tell little of them.
const RIDGE: [f64; 3] = [1e-4, 2e-3, 5e-3];
/// Albedo on the mean before anything is known, and luminance of the brightest twentieth.
const FIRST_ALBEDO: f32 = 0.3;
const BRIGHT: f32 = 0.7;
/// Times that lights and albedos are found in turn, and after which the sun's direction is followed only.
const ROUNDS: usize = 5;
const SEARCHED: usize = 1;
const SETTLING: usize = 15;
/// Difference in sRGB beyond which pixels count less and less, and rounds in which that is weighed.
const TRUSTED: f32 = 0.15;
const REWEIGHTED: usize = 3;
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
    /// How much the pixel counts: shadows that are a little off must not blur what is told apart.
    pub trust: f32,
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

/// A surface point and its linear color in each light.
#[derive(Clone, Debug)]
pub struct Seen {
    pub point: Vec3,
    pub normal: Vec3,
    pub colors: Vec<Vec3>,
}

/// Lights that explain how surfaces look in each of them, and the albedo of each point. Both are found in turn; how bright albedo is, and
/// its tint, is chosen such that its brightest twentieth has a luminance of 0.7 and the lights together are white.
pub fn tell_apart(seen: &[Seen], visibility: &Visibility) -> (Vec<Fitted>, Vec<Vec3>) {
    let lights = seen.first().map_or(0, |s| s.colors.len());
    let open: Vec<f32> = seen.par_iter().map(|p| visibility.from_sky(p.point, p.normal)).collect();
    let mean = |of: &dyn Fn(&Seen) -> Vec3| seen.iter().map(of).sum::<Vec3>() / seen.len().max(1) as f32;
    let means: Vec<Vec3> = (0..lights).map(|l| mean(&|s| s.colors[l]).max(Vec3::splat(1e-4))).collect();
    let relative = |s: &Seen| s.colors.iter().zip(&means).map(|(c, m)| *c / *m).sum::<Vec3>() / lights as f32;
    let mut albedos: Vec<Vec3> = seen.iter().map(|s| FIRST_ALBEDO * relative(s)).collect();
    let mut fitted: Vec<Fitted> = Vec::new();
    for round in 0..ROUNDS {
        fitted = (0..lights)
            .map(|l| {
                // Shadows are in the first albedos, so the sun is looked for twice.
                let known = (round > SEARCHED).then(|| Vec3::from_slice(&fitted[l].sun));
                fit(&lit(seen, &albedos, l, None), visibility, known)
            })
            .collect();
        // Light and albedo approach each other slowly; meanwhile suns stay where they are.
        for _ in 0..SETTLING {
            albedos = seen.par_iter().zip(&open).zip(&albedos).map(|((s, o), a)| explained(s, *o, *a, &fitted, visibility)).collect();
            set_scale(&mut fitted, &mut albedos);
            fitted = (0..lights)
                .into_par_iter()
                .map(|l| {
                    let trusted = lit(seen, &albedos, l, Some((&fitted[l], &open, visibility)));
                    solve(&trusted, &open, visibility, Vec3::from_slice(&fitted[l].sun))
                })
                .collect();
        }
    }
    (fitted, albedos)
}

/// Surface points of given albedo in one light, each trusted as an explanation of it says.
fn lit(seen: &[Seen], albedos: &[Vec3], light: usize, by: Option<(&Fitted, &[f32], &Visibility)>) -> Vec<Lit> {
    let of = |(i, (s, a)): (usize, (&Seen, &Vec3))| {
        let trust = by.map_or(1.0, |(f, open, v)| trust(*a * f.irradiance(s.point, s.normal, open[i], v), s.colors[light]));
        Lit { point: s.point, normal: s.normal, albedo: *a, seen: s.colors[light], trust }
    };
    seen.iter().zip(albedos).enumerate().map(of).collect()
}

/// Albedo of a point that lights explain best, open to a share of the sky; `before` says which lights to trust.
fn explained(s: &Seen, open: f32, before: Vec3, fitted: &[Fitted], visibility: &Visibility) -> Vec3 {
    let (mut a, mut b) = (Vec3::ZERO, Vec3::splat(1e-6));
    for (f, c) in fitted.iter().zip(&s.colors) {
        let white = f.irradiance(s.point, s.normal, open, visibility);
        // The derivative of sRGB at what is seen, squared.
        let weight = Vec3::from(c.max(Vec3::splat(DARK)).to_array().map(|v| v.powf(-1.16))) * trust(before * white, *c);
        (a, b) = (a + weight * white * *c, b + weight * white * white);
    }
    (a / b).max(Vec3::ZERO)
}

/// Shares brightness and tint between lights and albedos.
fn set_scale(fitted: &mut [Fitted], albedos: &mut [Vec3]) {
    let above = |f: &Fitted| {
        let up = sh_light::basis(DVec3::Z);
        let sky = |k: usize| (0..9).map(|i| f.sky[3 * i + k] * up[i] as f32).sum::<f32>().max(0.0);
        Vec3::new(sky(0), sky(1), sky(2)) + Vec3::from_slice(&f.sun[3..]) * f.sun[2].max(0.0)
    };
    let light = fitted.iter().map(above).sum::<Vec3>().max(Vec3::splat(1e-6));
    let luminance = Vec3::new(0.2126, 0.7152, 0.0722);
    let tint = light / light.dot(luminance);
    let mut bright: Vec<f32> = albedos.iter().map(|a| (*a * tint).dot(luminance)).collect();
    bright.sort_by(f32::total_cmp);
    let by = tint * BRIGHT / bright.get(bright.len() * 19 / 20).copied().unwrap_or(BRIGHT).max(1e-3);
    albedos.iter_mut().for_each(|a| *a *= by);
    for f in fitted {
        (0..3).for_each(|k| {
            f.sun[3 + k] /= by[k];
            f.sun[6 + k] /= by[k];
            (0..9).for_each(|i| f.sky[3 * i + k] /= by[k]);
        });
    }
}

impl Fitted {
    /// Irradiance over π of a white surface, open to a share of the sky.
    fn irradiance(&self, point: Vec3, normal: Vec3, open: f32, visibility: &Visibility) -> Vec3 {
        let toward = Vec3::from_slice(&self.sun);
        let facing = normal.dot(toward).max(0.0);
        let direct = if facing > 0.0 { facing * visibility.from_sun(point, normal, toward) } else { 0.0 };
        let basis = sh_light::basis(normal.as_dvec3());
        Vec3::from(std::array::from_fn(|k| {
            let sky: f32 = (0..9).map(|i| self.sky[3 * i + k] * basis[i] as f32).sum();
            direct * self.sun[3 + k] + open * sky.max(0.0) + (1.0 - open) * self.sun[6 + k]
        }))
    }
}

/// Spherical harmonics of a sun's light, `[9, 3]`.
pub fn harmonics(sun: &[f32]) -> [f32; 27] {
    let mut light = diorama_geom::sh_light::ShLight::DARK;
    let power = [3, 4, 5].map(|k| sun[k] as f64 * std::f64::consts::PI);
    light.add_sun(DVec3::from([0, 1, 2].map(|k| sun[k] as f64)), power);
    std::array::from_fn(|i| light.0[i / 3][i % 3] as f32)
}

/// The light of pixels. Without a direction to begin with, the whole sky is searched.
pub fn fit(pixels: &[Lit], visibility: &Visibility, near: Option<Vec3>) -> Fitted {
    let open = |pixels: &[Lit]| -> Vec<f32> { pixels.par_iter().map(|p| visibility.from_sky(p.point, p.normal)).collect() };
    let few: Vec<Lit> = pixels.iter().step_by(pixels.len().div_ceil(SEARCH_PIXELS).max(1)).copied().collect();
    let few_open = open(&few);
    let best_of = |directions: Vec<Vec3>| {
        let tried = directions.into_par_iter().map(|d| solve(&few, &few_open, visibility, d));
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
    let (all, mut trusted) = (open(pixels), pixels.to_vec());
    for _ in 0..REWEIGHTED {
        let found = solve(&trusted, &all, visibility, Vec3::from_slice(&best.sun));
        let trust = |(p, o): (&Lit, &f32)| trust(p.albedo * found.irradiance(p.point, p.normal, *o, visibility), p.seen);
        let trusts: Vec<f32> = pixels.par_iter().zip(&all).map(trust).collect();
        trusted.iter_mut().zip(trusts).for_each(|(p, t)| p.trust = t);
    }
    solve(&trusted, &all, visibility, Vec3::from_slice(&best.sun))
}

/// How much a pixel counts that should look like another color (Geman–McClure in about sRGB).
fn trust(got: Vec3, seen: Vec3) -> f32 {
    let shown = |v: f32| srgb_from_linear(v.clamp(0.0, 1.0));
    let squared: f32 = (0..3).map(|k| (shown(got[k]) - shown(seen[k])).powi(2)).sum();
    (TRUSTED * TRUSTED / (TRUSTED * TRUSTED + squared)).powi(2)
}

/// Least squares for one direction.
fn solve(pixels: &[Lit], open: &[f32], visibility: &Visibility, direction: Vec3) -> Fitted {
    let mut sums = [[[0.0f64; UNKNOWNS + 1]; UNKNOWNS]; 3];
    let mut squares = 0.0;
    let up = sh_light::basis(DVec3::Z);
    for (p, &o) in pixels.iter().zip(open) {
        let facing = p.normal.dot(direction).max(0.0);
        let sun = if facing > 0.0 { facing * visibility.from_sun(p.point, p.normal, direction) } else { 0.0 };
        let basis = sh_light::basis(p.normal.as_dvec3());
        let sent = (BOUNCED * (1.0 - o)) as f64;
        let row: [f64; UNKNOWNS] = std::array::from_fn(|i| match i {
            0 => sun as f64 + sent * direction.z.max(0.0) as f64,
            _ => o as f64 * basis[i - 1] + sent * up[i - 1],
        });
        for k in 0..3 {
            // The derivative of sRGB at what is seen.
            let weight = p.trust.sqrt() * 0.44 * p.seen[k].max(DARK).powf(-0.58);
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
            sums[i][i] += n * RIDGE[[0, 0, 1, 1, 1, 2, 2, 2, 2, 2][i]];
            (0..i).for_each(|j| sums[i][j] = sums[j][i]);
        });
        // A sun that would take light away is left out.
        let all = without(sums, &[]);
        let x = if all[0] < 0.0 { without(sums, &[0]) } else { all };
        found.sun[3 + k] = x[0] as f32;
        (0..9).for_each(|i| found.sky[3 * i + k] = x[1 + i] as f32);
        // ‖y − Ax‖² = ‖y‖² − 2 xᵀAᵀy + xᵀAᵀA x.
        let explained: f64 =
            (0..UNKNOWNS).map(|i| x[i] * (2.0 * sums[i][UNKNOWNS] - (0..UNKNOWNS).map(|j| sums[i][j] * x[j]).sum::<f64>())).sum();
        found.error -= explained / (3.0 * n);
    }
    set_bounced(&mut found.sun, &found.sky);
    found
}

/// Gives a sun the light that surfaces send, from its own power and that of its sky `[9, 3]`.
pub fn set_bounced(sun: &mut [f32], sky: &[f32]) {
    let up = sh_light::basis(DVec3::Z);
    for k in 0..3 {
        let above: f32 = (0..9).map(|i| sky[3 * i + k] * up[i] as f32).sum();
        sun[6 + k] = BOUNCED * (sun[3 + k] * sun[2].max(0.0) + above.max(0.0));
    }
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
                Lit { point, normal, albedo, seen: albedo * (lit + direct), trust: 1.0 }
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
