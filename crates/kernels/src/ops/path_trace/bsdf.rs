//! Reflection of opaque surfaces: the metallic-roughness material of glTF 2.0 (appendix B) that loses no energy.
//!
//! A GGX lobe with Smith's height-correlated shadowing (Heitz 2014), scaled so that light which is scattered several times between
//! microfacets is kept (Turquin 2019, "Practical multiple scattering compensation for microfacet models"), above a Lambertian one, which
//! gets the share that the first one transmits. Directions are in the frame of the shading normal, which is +z, and point away
//! from the surface.

use super::vector::{dot, luminance, sin_cos_turns, unit};
use std::sync::OnceLock;

/// Reflectance of dielectrics at normal incidence (index of refraction 1.5).
pub(super) const DIELECTRIC: f32 = 0.04;
/// Smallest slope parameter α; below it, single-precision numbers do not resolve the lobe.
pub(super) const SHARPEST: f32 = 1e-3;
/// Entries per axis of the table of reflected shares.
pub(super) const SIZE: usize = 32;
/// Directions per entry and axis from which the table is computed.
const DRAWS: usize = 64;

/// Material at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Linear, 0 to 1.
    pub base_color: [f32; 3],
    pub roughness: f32,
    pub metallic: f32,
    /// Factor of the reflection at the surface of what is not metal.
    pub specular: f32,
}

/// What scatters light at a point that is seen from one direction.
#[derive(Clone, Copy, Debug)]
pub struct Bsdf {
    outgoing: [f32; 3],
    alpha: f32,
    /// Reflection of microfacets: `straight + grazing · (1 − cos)⁵`.
    straight: [f32; 3],
    grazing: [f32; 3],
    diffuse: [f32; 3],
    /// Probability of the microfacets' lobe.
    glossy: f32,
    /// Whether there are no microfacets.
    is_matte: bool,
}

/// A drawn direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drawn {
    pub incoming: [f32; 3],
    /// Reflection times the cosine, divided by the density.
    pub weight: [f32; 3],
    /// Density per steradian.
    pub density: f32,
}

/// `(1 − cos)⁵`
#[inline(always)]
fn schlick(cosine: f32) -> f32 {
    let m = (1.0 - cosine).clamp(0.0, 1.0);
    m * m * m * m * m
}

impl Bsdf {
    /// Scattering of light towards `outgoing`; none if that is below the surface.
    #[inline(always)]
    pub fn new(m: &Material, outgoing: [f32; 3]) -> Option<Bsdf> {
        if outgoing[2] <= 0.0 {
            return None;
        }
        let alpha = (m.roughness * m.roughness).clamp(SHARPEST, 1.0);
        let (metallic, base) = (m.metallic.clamp(0.0, 1.0), m.base_color.map(|c| c.clamp(0.0, 1.0)));
        if m.specular <= 0.0 && metallic == 0.0 {
            let none = [0.0; 3];
            let glossy = if luminance(base) > 0.0 { 0.0 } else { 1.0 };
            return Some(Bsdf { outgoing, alpha, straight: none, grazing: none, diffuse: base, glossy, is_matte: glossy == 0.0 });
        }
        let [scale, offset] = shares().at(outgoing[2], alpha);
        // Of white microfacets the share `scale` is left; the rest meets others, and is colored once more.
        let gain = |f0: f32| 1.0 + f0 * (1.0 / scale - 1.0);
        let mix = |dielectric: f32, metal: f32| dielectric + (metal - dielectric) * metallic;
        let coat = m.specular.clamp(0.0, 1.0) * gain(DIELECTRIC);
        let straight = base.map(|c| mix(DIELECTRIC * coat, c * gain(c)));
        let grazing = base.map(|c| mix((1.0 - DIELECTRIC) * coat, (1.0 - c) * gain(c)));
        let reflected = std::array::from_fn(|i| straight[i] * scale + grazing[i] * offset);
        let surface = (DIELECTRIC * scale + (1.0 - DIELECTRIC) * offset) * coat;
        let diffuse = base.map(|c| c * (1.0 - metallic) * (1.0 - surface).max(0.0));
        let (glossy, matte) = (luminance(reflected), luminance(diffuse));
        let glossy = if glossy + matte > 0.0 { glossy / (glossy + matte) } else { 1.0 };
        Some(Bsdf { outgoing, alpha, straight, grazing, diffuse, glossy, is_matte: false })
    }

    /// Reflection times the cosine of `incoming`, and the density with which [`Bsdf::draw`] draws it.
    #[inline(always)]
    pub fn evaluate(&self, incoming: [f32; 3]) -> ([f32; 3], f32) {
        let (o, i) = (self.outgoing, incoming);
        if i[2] <= 0.0 {
            return ([0.0; 3], 0.0);
        }
        if self.is_matte {
            let matte = i[2] / std::f32::consts::PI;
            return (self.diffuse.map(|d| matte * d), matte);
        }
        let half = unit(std::array::from_fn(|k| o[k] + i[k]));
        let d = self.distribution(half);
        let (lambda_o, lambda_i) = (self.lambda(o), self.lambda(i));
        let fresnel = schlick(dot(o, half));
        let lobe = d / (4.0 * o[2]) / (1.0 + lambda_o + lambda_i);
        let matte = i[2] / std::f32::consts::PI;
        let value = std::array::from_fn(|k| lobe * (self.straight[k] + self.grazing[k] * fresnel) + matte * self.diffuse[k]);
        let density = self.glossy * d / (4.0 * o[2]) / (1.0 + lambda_o) + (1.0 - self.glossy) * matte;
        (value, density)
    }

    /// Draws a direction from two numbers in `[0, 1)`; none if it is below the surface.
    #[inline(always)]
    pub fn draw(&self, [choice, random]: [f32; 2]) -> Option<Drawn> {
        let incoming = if choice < self.glossy {
            let half = self.draw_normal([choice / self.glossy, random]);
            let twice = 2.0 * dot(self.outgoing, half);
            unit(std::array::from_fn(|k| twice * half[k] - self.outgoing[k]))
        } else {
            let squared = (choice - self.glossy) / (1.0 - self.glossy);
            let (radius, [y, x]) = (squared.sqrt(), sin_cos_turns(random));
            [radius * x, radius * y, (1.0 - squared).max(0.0).sqrt()]
        };
        let (value, density) = self.evaluate(incoming);
        (density > 0.0).then(|| Drawn { incoming, weight: value.map(|v| v / density), density })
    }

    /// GGX: density of the microfacets' normals.
    #[inline(always)]
    fn distribution(&self, half: [f32; 3]) -> f32 {
        let a2 = self.alpha * self.alpha;
        // `cos² (α² − 1) + 1`, without the difference that cancels near the normal.
        let sine2 = half[0] * half[0] + half[1] * half[1];
        let q = sine2 + half[2] * half[2] * a2;
        a2 / (std::f32::consts::PI * q * q)
    }

    /// Smith's auxiliary function Λ.
    #[inline(always)]
    fn lambda(&self, v: [f32; 3]) -> f32 {
        let tan2 = (v[0] * v[0] + v[1] * v[1]) / (v[2] * v[2]);
        0.5 * ((1.0 + self.alpha * self.alpha * tan2).sqrt() - 1.0)
    }

    /// A normal among those that are visible (Dupuy and Benyoub 2023, spherical caps).
    #[inline(always)]
    fn draw_normal(&self, random: [f32; 2]) -> [f32; 3] {
        let stretched = unit([self.alpha * self.outgoing[0], self.alpha * self.outgoing[1], self.outgoing[2]]);
        let [sine_of_angle, cosine_of_angle] = sin_cos_turns(random[0]);
        let z = (1.0 - random[1]) * (1.0 + stretched[2]) - stretched[2];
        let sine = (1.0 - z * z).clamp(0.0, 1.0).sqrt();
        let half = [sine * cosine_of_angle + stretched[0], sine * sine_of_angle + stretched[1], z + stretched[2]];
        unit([self.alpha * half[0], self.alpha * half[1], half[2].max(0.0)])
    }
}

/// Shares of light that microfacets reflect after one bounce: `straight · scale + grazing · offset`, by the cosine of the outgoing direction and √α.
pub(super) struct Shares {
    pub(super) table: Vec<[f32; 2]>,
}

impl Shares {
    /// Bilinear between entries.
    #[inline(always)]
    fn at(&self, cosine: f32, alpha: f32) -> [f32; 2] {
        let place = |v: f32| {
            let x = v.clamp(0.0, 1.0) * (SIZE - 1) as f32;
            let low = (x as usize).min(SIZE - 2);
            (low, x - low as f32)
        };
        let ((row, fy), (column, fx)) = (place(alpha.sqrt()), place(cosine));
        let entry = |r: usize, c: usize| self.table[(row + r) * SIZE + column + c];
        std::array::from_fn(|k| {
            let across = |r: usize| entry(r, 0)[k] * (1.0 - fx) + entry(r, 1)[k] * fx;
            across(0) * (1.0 - fy) + across(1) * fy
        })
    }
}

/// The table, computed when it is first used, in some milliseconds.
pub(super) fn shares() -> &'static Shares {
    static SHARES: OnceLock<Shares> = OnceLock::new();
    SHARES.get_or_init(|| {
        // No light at all leaves along the surface, so the first cosine is a small one.
        let node = |i: usize| (i as f32 / (SIZE - 1) as f32).max(1e-3);
        let table = (0..SIZE * SIZE).map(|i| {
            let (rough, cosine) = (node(i / SIZE), node(i % SIZE));
            let outgoing = [(1.0 - cosine * cosine).sqrt(), 0.0, cosine];
            let white = Bsdf {
                outgoing,
                alpha: (rough * rough).max(SHARPEST),
                straight: [1.0; 3],
                grazing: [0.0; 3],
                diffuse: [0.0; 3],
                glossy: 1.0,
                is_matte: false,
            };
            let mut sums = [0.0f64; 2];
            for draw in 0..DRAWS * DRAWS {
                let random = [(draw / DRAWS) as f32 + 0.5, (draw % DRAWS) as f32 + 0.5].map(|v| v / DRAWS as f32);
                let half = white.draw_normal(random);
                let twice = 2.0 * dot(outgoing, half);
                let incoming: [f32; 3] = std::array::from_fn(|k| twice * half[k] - outgoing[k]);
                if incoming[2] > 0.0 {
                    let (lambda_o, lambda_i) = (white.lambda(outgoing), white.lambda(incoming));
                    let left = ((1.0 + lambda_o) / (1.0 + lambda_o + lambda_i)) as f64;
                    let fresnel = schlick(dot(outgoing, half)) as f64;
                    sums = [sums[0] + left, sums[1] + left * fresnel];
                }
            }
            sums.map(|s| (s / (DRAWS * DRAWS) as f64) as f32)
        });
        Shares { table: table.collect() }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of `[0, 1)²` that fill it evenly (the additive recurrence of Roberts 2018).
    fn points(n: usize) -> impl Iterator<Item = [f32; 2]> {
        (0..n).map(|i| [0.754_877_666_246_692_7, 0.569_840_290_998_053_2].map(|a: f64| (0.5 + a * i as f64).fract() as f32))
    }

    fn outgoing(cosine: f32) -> [f32; 3] {
        let sine = (1.0 - cosine * cosine).sqrt();
        [0.6 * sine, -0.8 * sine, cosine]
    }

    fn material(base: f32, roughness: f32, metallic: f32) -> Material {
        Material { base_color: [base, 0.5 * base, 0.2 * base], roughness, metallic, specular: 1.0 }
    }

    #[test]
    fn a_white_surface_in_a_white_furnace_is_invisible() {
        for metallic in [0.0, 0.4, 1.0] {
            for roughness in [0.05, 0.2, 0.5, 0.8, 1.0] {
                for cosine in [0.1, 0.3, 0.7, 1.0] {
                    let white = Material { base_color: [1.0; 3], roughness, metallic, specular: 1.0 };
                    let bsdf = Bsdf::new(&white, outgoing(cosine)).unwrap();
                    let n = 1 << 14;
                    let sum: f64 = points(n).filter_map(|p| bsdf.draw(p)).map(|d| d.weight[0] as f64).sum();
                    let share = sum / n as f64;
                    let bound = if metallic == 0.0 && roughness == 1.0 { 0.005 } else { 0.02 };
                    assert!((share - 1.0).abs() < bound, "metallic {metallic}, roughness {roughness}, cosine {cosine}: {share}");
                }
            }
        }
    }

    /// Sum of `f` over the hemisphere, in polar coordinates about the mirror direction for sharp lobes' sake.
    fn integral(center: [f32; 3], f: impl Fn([f32; 3]) -> f64) -> f64 {
        let (rows, columns) = (2000, 400);
        let side = unit([center[2], 0.0, -center[0]]);
        let up = [
            center[1] * side[2] - center[2] * side[1],
            center[2] * side[0] - center[0] * side[2],
            center[0] * side[1] - center[1] * side[0],
        ];
        let mut sum = 0.0;
        for r in 0..rows {
            // Denser near the center.
            let s = (r as f64 + 0.5) / rows as f64;
            let polar = std::f64::consts::PI * s * s;
            let weight = polar.sin() * 2.0 * std::f64::consts::PI * s / rows as f64 * std::f64::consts::TAU / columns as f64;
            for c in 0..columns {
                let azimuth = std::f64::consts::TAU * (c as f64 + 0.5) / columns as f64;
                let (a, b, d) = (polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos());
                let v = std::array::from_fn(|k| (a * side[k] as f64 + b * up[k] as f64 + d * center[k] as f64) as f32);
                if v[2] > 0.0 {
                    sum += weight * f(v);
                }
            }
        }
        sum
    }

    #[test]
    fn the_density_is_that_of_the_draws() {
        for (roughness, metallic) in [(0.15, 1.0), (0.4, 0.0), (0.9, 0.5)] {
            for cosine in [0.2, 0.8] {
                let o = outgoing(cosine);
                let bsdf = Bsdf::new(&material(0.8, roughness, metallic), o).unwrap();
                let mirror = [-o[0], -o[1], o[2]];
                let n = 1 << 14;
                let drawn: Vec<Drawn> = points(n).filter_map(|p| bsdf.draw(p)).collect();
                // The density's integral is the share of draws that leave the surface, and any function has the same mean both ways.
                let share = integral(mirror, |v| bsdf.evaluate(v).1 as f64);
                assert!((share - drawn.len() as f64 / n as f64).abs() < 4e-3, "{roughness} {metallic} {cosine}: {share} {}", drawn.len());
                for test in [|v: [f32; 3]| v[2] as f64, |v: [f32; 3]| (v[0] as f64).abs(), |v: [f32; 3]| (v[1] + 1.0) as f64] {
                    let want = integral(mirror, |v| test(v) * bsdf.evaluate(v).1 as f64);
                    let got = drawn.iter().map(|d| test(d.incoming)).sum::<f64>() / n as f64;
                    assert!((want - got).abs() < 6e-3, "{roughness} {metallic} {cosine}: {want} {got}");
                }
            }
        }
    }

    #[test]
    fn drawn_and_integrated_reflection_agree() {
        for (roughness, metallic) in [(0.2, 0.0), (0.5, 1.0), (1.0, 0.3)] {
            let o = outgoing(0.6);
            let bsdf = Bsdf::new(&material(0.9, roughness, metallic), o).unwrap();
            let n = 1 << 14;
            for channel in 0..3 {
                let want = integral([-o[0], -o[1], o[2]], |v| bsdf.evaluate(v).0[channel] as f64);
                let got = points(n).filter_map(|p| bsdf.draw(p)).map(|d| d.weight[channel] as f64).sum::<f64>() / n as f64;
                assert!((want - got).abs() < 4e-3, "{roughness} {metallic}: {want} {got}");
            }
        }
    }

    #[test]
    fn without_reflection_a_surface_is_lambertian() {
        let bsdf = Bsdf::new(&Material { specular: 0.0, ..material(0.8, 0.3, 0.0) }, outgoing(0.3)).unwrap();
        for v in [outgoing(0.9), outgoing(0.2)] {
            let (value, density) = bsdf.evaluate(v);
            assert!((value[0] - 0.8 * v[2] / std::f32::consts::PI).abs() < 1e-6 && (density - v[2] / std::f32::consts::PI).abs() < 1e-6);
        }
    }

    #[test]
    fn nothing_leaves_below_the_surface() {
        let m = material(0.5, 0.3, 0.2);
        assert!(Bsdf::new(&m, [0.6, 0.0, -0.8]).is_none());
        let bsdf = Bsdf::new(&m, outgoing(0.4)).unwrap();
        assert_eq!(bsdf.evaluate([0.6, 0.0, -0.8]), ([0.0; 3], 0.0));
        assert!(points(2000).filter_map(|p| bsdf.draw(p)).all(|d| d.incoming[2] > 0.0));
    }
}
