//! Loss of the scene model: `C = S · A ⊙ max(0, Lᵀ b(N)) + (1 − o) · sky(d)` in linear light, compared in sRGB, and its gradient.
//!
//! Per ray, the field composites albedo `A` (premultiplied by the opacity `o`), shadow `S` (1 where nothing is hit) and the normal
//! `−Σ w ∇σ`, whose direction `N` counts. Light `L` `[9, 3]` and sky `[16, 3]` are of the ray's session.

use diorama_geom::glam::DVec3;
use diorama_geom::sh_light;
use diorama_kernels::ops::field_step::{BatchLoss, RayGradients, RayOutputs};
use diorama_kernels::ops::spherical_harmonics;
use std::sync::Mutex;

/// Numbers of a light, `[9, 3]`.
pub const LIGHT: usize = 27;
/// Degree of the sky's spherical harmonics, and its numbers `[16, 3]`.
const SKY_DEGREE: usize = 4;
pub const SKY: usize = 48;
/// Channels: albedo, shadow, normal.
pub const CHANNELS: usize = 7;
/// Directions in which irradiance must not be negative.
const DIRECTIONS: usize = 64;

/// Weights of the terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    pub huber: f32,
    /// Error beyond which a pixel counts less (Geman–McClure), in sRGB; 0: all count alike.
    pub robust: f32,
    pub orientation: f32,
    pub shadow: f32,
    pub negative: f32,
    pub distortion: f32,
}

/// What the rays of a step are compared with.
pub struct SceneLoss<'a> {
    pub weights: Weights,
    /// sRGB, `[R, 3]`.
    pub target: &'a [f32],
    /// Share with which each ray counts, `[R]`.
    pub counts: &'a [f32],
    /// Of unit length, `[R, 3]`.
    pub dirs: &'a [f32],
    /// Light of each ray, `[R]`, and its photograph.
    pub light: &'a [u32],
    pub image: &'a [u32],
    /// `[lights, 9, 3]`, `[lights, 16, 3]`, logarithms of the gains `[images, 3]`.
    pub lights: &'a [f32],
    pub skies: &'a [f32],
    pub gains: &'a [f32],
    pub out: Mutex<SceneGradients>,
}

/// Gradients of the tables, and figures of the step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SceneGradients {
    pub lights: Vec<f32>,
    pub skies: Vec<f32>,
    pub gains: Vec<f32>,
    /// Mean squared error in sRGB of the pixels that count.
    pub mse: f64,
    /// Median over the pixels of the greatest error of a channel.
    pub median: f32,
}

/// sRGB of linear light and its derivative; beyond 0 and 1 the curve goes on.
fn encode(linear: f32) -> (f32, f32) {
    if linear <= 0.003_130_8 {
        return (12.92 * linear, 12.92);
    }
    (1.055 * linear.powf(1.0 / 2.4) - 0.055, 1.055 / 2.4 * linear.powf(1.0 / 2.4 - 1.0))
}

/// Value and derivative of the Huber loss, quadratic below `width`: both scaled such that it is `e²` near zero.
fn huber(e: f32, width: f32) -> (f32, f32) {
    let a = e.abs();
    if a <= width { (e * e, 2.0 * e) } else { (width * (2.0 * a - width), 2.0 * width * e.signum()) }
}

/// Irradiance over π of a white surface with a normal, by channel.
fn irradiance(light: &[f32], basis: &[f64; 9]) -> [f32; 3] {
    std::array::from_fn(|k| (0..9).map(|i| light[3 * i + k] * basis[i] as f32).sum())
}

/// A color as the model explains it, and what its gradient needs.
struct Shaded {
    normal: [f32; 3],
    length: f32,
    basis: [f64; 9],
    /// Irradiance before it is cut off at 0.
    lit: [f32; 3],
    sky: [f32; 3],
    sky_basis: [f32; 16],
}

/// Normal, light and sky of a ray.
fn shade(values: &[f32], dir: &[f32], light: &[f32], sky: &[f32]) -> Shaded {
    let n = [values[4], values[5], values[6]];
    let length = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
    let normal = if length > 1e-12 { n.map(|v| v / length) } else { [0.0, 0.0, 1.0] };
    let basis = sh_light::basis(DVec3::from(normal.map(f64::from)));
    let mut sky_basis = [0.0; 16];
    spherical_harmonics::cpu::forward(SKY_DEGREE, dir, &mut sky_basis);
    let of_sky = std::array::from_fn(|k| (0..16).map(|i| sky[3 * i + k] * sky_basis[i]).sum());
    Shaded { normal, length, basis, lit: irradiance(light, &basis), sky: of_sky, sky_basis }
}

/// Linear color of composited values `[7]` under a light and before a sky.
pub fn color(values: &[f32], opacity: f32, dir: &[f32], light: &[f32], sky: &[f32]) -> [f32; 3] {
    let s = shade(values, dir, light, sky);
    std::array::from_fn(|k| values[3] * values[k] * s.lit[k].max(0.0) + (1.0 - opacity) * s.sky[k].max(0.0))
}

/// Gradient of the basis functions with respect to the normal, `[9]` rows of `[x, y, z]`.
fn basis_gradient(n: [f32; 3]) -> [[f32; 3]; 9] {
    let [x, y, z] = n;
    let (a, b, c, d) = (0.488_602_5, 1.092_548_4, 0.315_391_57, 0.546_274_2);
    [
        [0.0; 3],
        [0.0, a, 0.0],
        [0.0, 0.0, a],
        [a, 0.0, 0.0],
        [b * y, b * x, 0.0],
        [0.0, b * z, b * y],
        [0.0, 0.0, 6.0 * c * z],
        [b * z, 0.0, b * x],
        [2.0 * d * x, -2.0 * d * y, 0.0],
    ]
}

impl SceneLoss<'_> {
    /// One ray: its loss; adds gradients. `share` is its part of the sum. Returns the loss, the squared error and the largest error.
    fn ray(&self, r: usize, out: &RayOutputs, d: &mut RayGradients, tables: &mut SceneGradients, share: f32) -> (f64, f64, f32) {
        let (values, opacity, dir) = (&out.values[r * CHANNELS..][..CHANNELS], out.opacity[r], &self.dirs[3 * r..3 * r + 3]);
        let (l, image) = (self.light[r] as usize, self.image[r] as usize);
        let (light, sky) = (&self.lights[l * LIGHT..][..LIGHT], &self.skies[l * SKY..][..SKY]);
        let s = shade(values, dir, light, sky);
        let (shadow, gain) = (values[3], self.gains.get(3 * image..3 * image + 3));
        let w = self.weights;
        let (mut errors, mut d_colors) = ([0.0; 3], [0.0; 3]);
        let (mut lit, mut plain) = ([0.0; 3], [0.0; 3]);
        for k in 0..3 {
            lit[k] = s.lit[k].max(0.0);
            plain[k] = shadow * values[k] * lit[k] + (1.0 - opacity) * s.sky[k].max(0.0);
            let factor = gain.map_or(1.0, |g| g[k].exp());
            let (srgb, slope) = encode(factor * plain[k]);
            errors[k] = srgb - self.target[3 * r + k];
            d_colors[k] = slope * factor;
        }
        let squared: f32 = errors.iter().map(|e| e * e).sum();
        // Weight of the ray, held constant: iteratively reweighted least squares.
        let trust = if w.robust > 0.0 { (w.robust * w.robust / (w.robust * w.robust + squared)).powi(2) } else { 1.0 };
        let part = share * self.counts[r] * trust;
        let mut loss = 0.0;
        let (d_values, mut d_normal) = (&mut d.values[r * CHANNELS..][..CHANNELS], [0.0f32; 3]);
        let slopes = basis_gradient(s.normal);
        for k in 0..3 {
            let (value, slope) = huber(errors[k], w.huber);
            loss += (part * value / 3.0) as f64;
            let dc = part * slope / 3.0 * d_colors[k];
            if gain.is_some() {
                tables.gains[3 * image + k] += dc * plain[k];
            }
            d_values[k] += dc * shadow * lit[k];
            d_values[3] += dc * values[k] * lit[k];
            if s.lit[k] > 0.0 {
                let d_lit = dc * shadow * values[k];
                for i in 0..9 {
                    tables.lights[l * LIGHT + 3 * i + k] += d_lit * s.basis[i] as f32;
                    (0..3).for_each(|a| d_normal[a] += d_lit * light[3 * i + k] * slopes[i][a]);
                }
            }
            if s.sky[k] > 0.0 {
                d.opacity[r] -= dc * s.sky[k];
                (0..16).for_each(|i| tables.skies[l * SKY + 3 * i + k] += dc * (1.0 - opacity) * s.sky_basis[i]);
            } else {
                // Light is never negative; the pull brings it back.
                (0..16).for_each(|i| tables.skies[l * SKY + 3 * i + k] += share * 0.1 * s.sky[k] * s.sky_basis[i]);
            }
        }
        loss += (share * w.shadow * (1.0 - shadow) * (1.0 - shadow)) as f64;
        d_values[3] -= share * 2.0 * w.shadow * (1.0 - shadow);
        let facing = (0..3).map(|a| s.normal[a] * dir[a]).sum::<f32>();
        if facing > 0.0 && s.length > 1e-12 {
            loss += (share * w.orientation * facing * facing) as f64;
            (0..3).for_each(|a| d_normal[a] += share * 2.0 * w.orientation * facing * dir[a]);
        }
        if s.length > 1e-12 {
            let radial: f32 = (0..3).map(|a| s.normal[a] * d_normal[a]).sum();
            (0..3).for_each(|a| d_values[4 + a] += (d_normal[a] - radial * s.normal[a]) / s.length);
        }
        (loss, squared as f64 / 3.0, errors.iter().fold(0.0, |m, e| m.max(e.abs())))
    }

    /// Penalty of negative irradiance, the same directions for every light.
    fn negative(&self, tables: &mut SceneGradients) -> f64 {
        let mut loss = 0.0;
        let lights = self.lights.len() / LIGHT;
        for i in 0..DIRECTIONS {
            let z = 1.0 - 2.0 * (i as f64 + 0.5) / DIRECTIONS as f64;
            let (r, turn) = ((1.0 - z * z).sqrt(), i as f64 * 2.399_963_229_728_653);
            let basis = sh_light::basis(DVec3::new(r * turn.cos(), r * turn.sin(), z));
            for l in 0..lights {
                let light = &self.lights[l * LIGHT..][..LIGHT];
                let part = self.weights.negative / (DIRECTIONS * lights * 3) as f32;
                for (k, e) in irradiance(light, &basis).into_iter().enumerate().filter(|(_, e)| *e < 0.0) {
                    loss += (part * e * e) as f64;
                    (0..9).for_each(|i| tables.lights[l * LIGHT + 3 * i + k] += 2.0 * part * e * basis[i] as f32);
                }
            }
        }
        loss
    }
}

impl BatchLoss for SceneLoss<'_> {
    fn batch(&self, out: &RayOutputs, gradients: &mut RayGradients) -> f64 {
        let rays = out.opacity.len();
        let mut tables = SceneGradients {
            lights: vec![0.0; self.lights.len()],
            skies: vec![0.0; self.skies.len()],
            gains: vec![0.0; self.gains.len()],
            ..SceneGradients::default()
        };
        let share = 1.0 / self.counts.iter().sum::<f32>().max(1.0);
        let (mut loss, mut mse, mut worst) = (0.0, 0.0, Vec::with_capacity(rays));
        for r in (0..rays).filter(|r| self.counts[*r] > 0.0) {
            let (value, squared, error) = self.ray(r, out, gradients, &mut tables, share);
            loss += value;
            mse += squared * (share * self.counts[r]) as f64;
            worst.push(error);
        }
        loss += self.negative(&mut tables);
        if !worst.is_empty() {
            let at = worst.len() / 2;
            tables.median = *worst.select_nth_unstable_by(at, f32::total_cmp).1;
        }
        tables.mse = mse;
        *self.out.lock().expect("no other thread holds it") = tables;
        loss
    }

    fn distortion(&self) -> f32 {
        self.weights.distortion
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    struct Case {
        values: Vec<f32>,
        opacity: Vec<f32>,
        dirs: Vec<f32>,
        target: Vec<f32>,
        lights: Vec<f32>,
        skies: Vec<f32>,
        gains: Vec<f32>,
    }

    const RAYS: usize = 5;

    fn case() -> Case {
        let rng = Rng::new(3, 1);
        let draw = |n: usize, stream: u64| (0..n).map(|i| rng.uniform(stream * 1000 + i as u64)).collect::<Vec<f32>>();
        let mut values = draw(RAYS * CHANNELS, 1);
        values.chunks_exact_mut(CHANNELS).for_each(|v| v[4..].iter_mut().for_each(|n| *n = 20.0 * (*n - 0.5)));
        let mut dirs: Vec<f32> = draw(RAYS * 3, 2).iter().map(|d| d - 0.5).collect();
        dirs.chunks_exact_mut(3).for_each(|d| {
            let l = d.iter().map(|v| v * v).sum::<f32>().sqrt();
            d.iter_mut().for_each(|v| *v /= l);
        });
        let signed = |n: usize, stream: u64, by: f32| draw(n, stream).iter().map(|v| by * (v - 0.3)).collect::<Vec<f32>>();
        Case {
            values,
            opacity: draw(RAYS, 3),
            dirs,
            target: draw(RAYS * 3, 4),
            lights: signed(2 * LIGHT, 5, 2.0),
            skies: signed(2 * SKY, 6, 1.0),
            gains: signed(3 * RAYS, 7, 0.4),
        }
    }

    fn run(c: &Case) -> (f64, RayGradients, SceneGradients) {
        let loss = SceneLoss {
            weights: Weights { huber: 0.4, robust: 0.0, orientation: 0.3, shadow: 0.2, negative: 0.5, distortion: 0.0 },
            target: &c.target,
            counts: &[1.0, 0.5, 1.0, 0.0, 1.0],
            dirs: &c.dirs,
            light: &[0, 1, 1, 0, 1],
            image: &[0, 1, 2, 3, 4],
            lights: &c.lights,
            skies: &c.skies,
            gains: &c.gains,
            out: Mutex::default(),
        };
        let mut d = RayGradients::default();
        d.clear(RAYS, CHANNELS);
        let out = RayOutputs { values: &c.values, opacity: &c.opacity, depth: &[0.0; RAYS] };
        let value = loss.batch(&out, &mut d);
        (value, d, loss.out.into_inner().unwrap())
    }

    /// Compares a gradient with central differences of the loss.
    fn check(name: &str, of: fn(&mut Case) -> &mut Vec<f32>, got: &[f32], step: f32) {
        let mut compared = 0;
        for i in 0..got.len() {
            let at = |by: f32| {
                let mut c = case();
                of(&mut c)[i] += by;
                run(&c).0
            };
            let (a, b) = (at(step), at(-step));
            let want = (a - b) / (2.0 * step as f64);
            // Not across a kink of max(0, ·).
            let curvature = ((a + b - 2.0 * run(&case()).0) / (step * step) as f64).abs();
            if curvature * (step as f64) < 0.05 * want.abs() + 0.02 {
                compared += (want.abs() > 1e-4) as usize;
                assert!((got[i] as f64 - want).abs() < 0.02 * want.abs() + 2e-3, "{name} {i}: {} {want}", got[i]);
            }
        }
        assert!(compared * 4 > got.len(), "{name}: {compared} of {}", got.len());
    }

    #[test]
    fn gradients_are_those_of_the_loss() {
        let (_, d, tables) = run(&case());
        check("values", |c| &mut c.values, &d.values, 3e-3);
        check("opacity", |c| &mut c.opacity, &d.opacity, 3e-3);
        check("lights", |c| &mut c.lights, &tables.lights, 3e-3);
        check("gains", |c| &mut c.gains, &tables.gains, 3e-3);
    }

    #[test]
    fn the_light_of_a_perfect_explanation_has_no_loss() {
        let mut c = case();
        for r in 0..RAYS {
            let l = [0, 1, 1, 0, 1][r];
            let (light, sky) = (&c.lights[l * LIGHT..][..LIGHT], &c.skies[l * SKY..][..SKY]);
            let rgb = color(&c.values[r * CHANNELS..][..CHANNELS], c.opacity[r], &c.dirs[3 * r..3 * r + 3], light, sky);
            (0..3).for_each(|k| c.target[3 * r + k] = encode(rgb[k] * c.gains[3 * r + k].exp()).0);
        }
        let tables = run(&c).2;
        assert!(tables.mse < 1e-10 && tables.median < 1e-5, "{tables:?}");
    }

    #[test]
    fn pixels_that_fit_badly_count_less() {
        let c = case();
        let with = |robust: f32| {
            let loss = SceneLoss {
                weights: Weights { huber: 1.0, robust, orientation: 0.0, shadow: 0.0, negative: 0.0, distortion: 0.0 },
                target: &c.target,
                counts: &[1.0; RAYS],
                dirs: &c.dirs,
                light: &[0; RAYS],
                image: &[0; RAYS],
                lights: &c.lights,
                skies: &c.skies,
                gains: &[],
                out: Mutex::default(),
            };
            let mut d = RayGradients::default();
            d.clear(RAYS, CHANNELS);
            loss.batch(&RayOutputs { values: &c.values, opacity: &c.opacity, depth: &[0.0; RAYS] }, &mut d)
        };
        assert!(with(0.05) < 0.2 * with(0.0), "{} {}", with(0.05), with(0.0));
    }
}
