//! Spherical harmonics of a light from pixels whose albedo, shadow and normal are known: robust least squares in sRGB.
//!
//! Minimizes `Σ ρ(enc(a · max(0, Lᵀ b(n)) + c) − y) + λ ‖L − s L̄‖²` by Gauss–Newton steps, first with Huber's ρ, then with that of Geman and
//! McClure, from which outliers hardly count; `c` is light from behind. The second term holds what the pixels do not determine (few normals) to the mean light L̄ of training, scaled by the best factor s per channel.

use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::DVec3;
use diorama_geom::sh_light::{self, ShLight};

/// A pixel that shows a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LitPixel {
    /// Linear albedo times shadow and opacity.
    pub reflected: [f32; 3],
    /// Linear light from behind, as far as the surface is not opaque.
    pub behind: [f32; 3],
    /// Of unit length.
    pub normal: [f32; 3],
    pub target_srgb: [f32; 3],
}

/// Gauss–Newton steps with each loss.
const STEPS: usize = 10;
/// Weight of the mean light, as a share of the mean curvature of the data term.
const PRIOR: f64 = 3e-3;
/// Linear value below which the slope of sRGB's curve counts as it is there.
const DARK: f64 = 0.01;
/// Errors beyond this multiple of their median count less; at least so much, in sRGB.
const ROBUST: f64 = 3.0;
const LEAST: f64 = 0.03;
/// Halvings of a step that makes the fit worse.
const HALVINGS: usize = 4;

/// sRGB of linear light and its slope, which goes on below 0 as at [`DARK`].
fn encode(linear: f64) -> (f64, f64) {
    let curve = |v: f64| if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    (curve(linear.clamp(0.0, 1.0)), 1.055 / 2.4 * linear.clamp(DARK, 1.0).powf(1.0 / 2.4 - 1.0))
}

/// Loss of an error.
#[derive(Clone, Copy)]
enum Robust {
    Huber,
    GemanMcClure,
}

impl Robust {
    /// Loss of an error of a size, both over the scale.
    fn cost(self, e: f64) -> f64 {
        match self {
            Robust::Huber if e <= 1.0 => e * e,
            Robust::Huber => 2.0 * e - 1.0,
            Robust::GemanMcClure => e * e / (e * e + 1.0),
        }
    }

    /// Weight of a squared error with the same slope.
    fn weight(self, e: f64) -> f64 {
        match self {
            Robust::Huber => 1.0 / e.max(1.0),
            Robust::GemanMcClure => 1.0 / (e * e + 1.0).powi(2),
        }
    }
}

struct Problem<'a> {
    pixels: &'a [LitPixel],
    bases: Vec<[f64; 9]>,
    mean: &'a ShLight,
}

impl Problem<'_> {
    /// Errors `[N, 3]` in sRGB.
    fn errors(&self, light: &ShLight) -> Vec<[f64; 3]> {
        let error = |(p, b): (&LitPixel, &[f64; 9])| {
            std::array::from_fn(|k| {
                let lit: f64 = (0..9).map(|i| light.0[i][k] * b[i]).sum();
                encode(p.reflected[k] as f64 * lit.max(0.0) + p.behind[k] as f64).0 - p.target_srgb[k] as f64
            })
        };
        self.pixels.iter().zip(&self.bases).map(error).collect()
    }

    /// Error beyond which pixels count less.
    fn scale(&self, errors: &[[f64; 3]]) -> f64 {
        let mut sizes: Vec<f64> = errors.iter().map(size).collect();
        let at = sizes.len() / 2;
        (ROBUST * *sizes.select_nth_unstable_by(at, f64::total_cmp).1).max(LEAST)
    }

    /// Sum of the robust errors.
    fn cost(errors: &[[f64; 3]], robust: Robust, scale: f64) -> f64 {
        errors.iter().map(|e| robust.cost(size(e) / scale)).sum()
    }

    /// The light after a full Gauss–Newton step.
    fn step(&self, light: &ShLight, errors: &[[f64; 3]], robust: Robust, scale: f64) -> ShLight {
        let mut next = *light;
        let channel = |k: usize| {
            let (mut a, mut rhs) = ([[0.0; 9]; 9], [0.0; 9]);
            for ((p, b), e) in self.pixels.iter().zip(&self.bases).zip(errors) {
                let trust = robust.weight(size(e) / scale);
                let reflected = p.reflected[k] as f64;
                let lit: f64 = (0..9).map(|i| light.0[i][k] * b[i]).sum();
                // A surface that the light leaves dark says so, unless it is not dark.
                if lit <= 0.0 && e[k] >= -LEAST {
                    continue;
                }
                let slope = encode(reflected * lit.max(0.0) + p.behind[k] as f64).1 * reflected;
                for i in 0..9 {
                    rhs[i] -= trust * slope * b[i] * e[k];
                    (0..9).for_each(|j| a[i][j] += trust * slope * slope * b[i] * b[j]);
                }
            }
            let weight = PRIOR * (0..9).map(|i| a[i][i]).sum::<f64>() / 9.0 + 1e-9;
            let (mut both, mut own) = (0.0, 1e-12);
            for i in 0..9 {
                both += light.0[i][k] * self.mean.0[i][k];
                own += self.mean.0[i][k] * self.mean.0[i][k];
            }
            for i in 0..9 {
                a[i][i] += weight;
                rhs[i] += weight * (both / own * self.mean.0[i][k] - light.0[i][k]);
            }
            solve(a, rhs)
        };
        for k in 0..3 {
            let change = channel(k);
            (0..9).for_each(|i| next.0[i][k] += change[i]);
        }
        next
    }
}

fn size(e: &[f64; 3]) -> f64 {
    (e.iter().map(|v| v * v).sum::<f64>() / 3.0).sqrt()
}

/// Solves a positive definite system by Cholesky's factors.
fn solve(mut a: [[f64; 9]; 9], mut b: [f64; 9]) -> [f64; 9] {
    for i in 0..9 {
        for j in 0..=i {
            let sum = a[i][j] - (0..j).map(|k| a[i][k] * a[j][k]).sum::<f64>();
            a[i][j] = if i == j { sum.max(1e-300).sqrt() } else { sum / a[j][j] };
        }
        b[i] = (b[i] - (0..i).map(|k| a[i][k] * b[k]).sum::<f64>()) / a[i][i];
    }
    for i in (0..9).rev() {
        b[i] = (b[i] - (i + 1..9).map(|k| a[k][i] * b[k]).sum::<f64>()) / a[i][i];
    }
    b
}

/// The mean light, scaled per channel so that the median pixel is as bright as its target.
fn first(pixels: &[LitPixel], bases: &[[f64; 9]], mean: &ShLight) -> ShLight {
    let mut light = *mean;
    for k in 0..3 {
        let ratio = |(p, b): (&LitPixel, &[f64; 9])| {
            let lit: f64 = (0..9).map(|i| mean.0[i][k] * b[i]).sum();
            let shown = p.reflected[k] as f64 * lit;
            (shown > 1e-4).then(|| (linear_from_srgb(p.target_srgb[k]) - p.behind[k]).max(0.0) as f64 / shown)
        };
        let mut ratios: Vec<f64> = pixels.iter().zip(bases).filter_map(ratio).collect();
        if !ratios.is_empty() {
            let at = ratios.len() / 2;
            let factor = *ratios.select_nth_unstable_by(at, f64::total_cmp).1;
            (0..9).for_each(|i| light.0[i][k] *= factor);
        }
    }
    light
}

/// The light of some pixels; the mean light without pixels. `begin` is a light to go on from.
pub fn light(pixels: &[LitPixel], mean: &ShLight, begin: Option<&ShLight>) -> ShLight {
    if pixels.is_empty() {
        return *mean;
    }
    let bases: Vec<[f64; 9]> = pixels.iter().map(|p| sh_light::basis(DVec3::from(p.normal.map(f64::from)))).collect();
    let mut light = begin.copied().unwrap_or_else(|| first(pixels, &bases, mean));
    let problem = Problem { pixels, bases, mean };
    for robust in [Robust::Huber, Robust::GemanMcClure] {
        for _ in 0..STEPS {
            let errors = problem.errors(&light);
            let scale = problem.scale(&errors);
            let (cost, full) = (Problem::cost(&errors, robust, scale), problem.step(&light, &errors, robust, scale));
            let shorter = |n: usize| light.mix(&full, 0.5f64.powi(n as i32));
            match (0..HALVINGS).map(shorter).find(|l| Problem::cost(&problem.errors(l), robust, scale) < cost) {
                Some(better) => light = better,
                None => break,
            }
        }
    }
    light
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::color::srgb_from_linear;
    use diorama_geom::rng::Rng;

    /// A light from above and one side, warmer there.
    fn truth() -> ShLight {
        let mut light = ShLight::uniform([0.5, 0.55, 0.6]);
        light.add_sun(DVec3::new(0.5, 0.3, 0.8).normalize(), [1.1, 0.9, 0.7]);
        light
    }

    /// Pixels of a scene with all normals of the upper half, lit by the true light; every `odd`-th shows something else.
    fn pixels(odd: usize) -> Vec<LitPixel> {
        let rng = Rng::new(5, 0);
        let draw = |i: usize, k: u64| rng.uniform(i as u64 * 8 + k);
        (0..3000)
            .map(|i| {
                let n = DVec3::new(draw(i, 0) as f64 - 0.5, draw(i, 1) as f64 - 0.5, 0.6 * draw(i, 2) as f64).normalize();
                let reflected: [f32; 3] = std::array::from_fn(|k| 0.1 + 0.5 * draw(i, 3 + k as u64));
                let lit = truth().shade(n);
                let target_srgb = match i.is_multiple_of(odd) {
                    true => [0.05, 0.9, 0.1],
                    false => std::array::from_fn(|k| srgb_from_linear((reflected[k] * lit[k].max(0.0) as f32 + 0.02).min(1.0))),
                };
                LitPixel { reflected, behind: [0.02; 3], normal: n.as_vec3().to_array(), target_srgb }
            })
            .collect()
    }

    /// Largest relative error of irradiance over the pixels' normals.
    fn error(got: &ShLight, pixels: &[LitPixel]) -> f64 {
        let of = |p: &LitPixel| {
            let n = DVec3::from(p.normal.map(f64::from));
            let (a, b) = (got.shade(n), truth().shade(n));
            (0..3).map(|k| (a[k] - b[k]).abs() / b[k].max(0.2)).fold(0.0, f64::max)
        };
        pixels.iter().map(of).fold(0.0, f64::max)
    }

    #[test]
    fn the_true_light_is_recovered() {
        let mut mean = ShLight::uniform([0.9; 3]);
        mean.0[2] = [0.3; 3];
        let clean = pixels(usize::MAX);
        let got = light(&clean[1..], &mean, None);
        assert!(error(&got, &clean) < 0.03, "{}", error(&got, &clean));
        // From another beginning, the same.
        let again = light(&clean[1..], &mean, Some(&ShLight::uniform([2.0, 0.3, 0.5])));
        assert!(error(&again, &clean) < 0.03, "{}", error(&again, &clean));
    }

    #[test]
    fn people_before_the_wall_do_not_light_it() {
        let mean = ShLight::uniform([0.9; 3]);
        let with_people = pixels(6);
        let got = light(&with_people, &mean, None);
        assert!(error(&got, &with_people) < 0.06, "{}", error(&got, &with_people));
    }

    #[test]
    fn what_one_wall_does_not_show_is_as_in_the_mean_light() {
        // All pixels have one normal: their irradiance is met, and the light keeps the form of the mean.
        let mut mean = ShLight::uniform([0.9; 3]);
        mean.0[2] = [0.3; 3];
        let wall: Vec<LitPixel> = (0..200)
            .map(|i| {
                let reflected = [0.2 + 0.002 * i as f32; 3];
                LitPixel {
                    reflected,
                    behind: [0.0; 3],
                    normal: [0.0, -1.0, 0.0],
                    target_srgb: reflected.map(|r| srgb_from_linear(0.5 * r)),
                }
            })
            .collect();
        let got = light(&wall, &mean, None);
        let facing = got.shade(DVec3::NEG_Y);
        assert!((facing[0] - 0.5).abs() < 5e-3, "{facing:?}");
        let (above, want) = (got.shade(DVec3::Z)[1] / facing[1], mean.shade(DVec3::Z)[1] / mean.shade(DVec3::NEG_Y)[1]);
        assert!((above - want).abs() < 0.1 * want, "{above} {want}");
        assert_eq!(light(&[], &mean, None), mean);
    }
}
