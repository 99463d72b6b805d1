//! Loss of the scene model: `C = S · A ⊙ max(0, Lᵀ b(N)) + (1 − o) · sky(d)` in linear light, compared in sRGB, and its gradient. With a
//! sun apart, its light, the sky's and that of surfaces around (see [`super::sun`]) take the place of `S · max(0, Lᵀ b(N))`, and are given.
//!
//! What of the sun arrives at a surface is traced, `T`, through surfaces that are learned, so shadows are a little off, and albedo must not make
//! up for it. In the lights of training, the field therefore says itself what arrives, `V`, near `T` wherever photographs agree. For any other
//! sun it says what is left where the traced ray passes, of which small things take a share: `T s`, learned from `V`.
//!
//! Per ray, the field composites albedo `A` (premultiplied by the opacity `o`), shadow `S` (1 where nothing is hit) and the normal that a
//! head of the network says, whose direction `N` counts. Light `L` `[9, 3]` and sky `[16, 3]` are of the ray's session. In training, the
//! normal is that of the surfaces as they were learned, which the head is taught; with suns apart it bends from there to what the suns show.

use super::sun::{BOUNCED, SUN, gray, level};
use super::sunlit::{FAINT, LEFT, SHORTEST, Sunlit, arriving, direct, facing, sunlit, surface, unhidden, unit};
use super::visibility::{Ambient, Visibility, spread};
use diorama_geom::color::{LUMINANCE, linear_from_srgb};
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::sh_light;
use diorama_kernels::ops::field_step::{BatchLoss, RayGradients, RayOutputs};
use diorama_kernels::ops::spherical_harmonics;
use rayon::prelude::*;
use std::sync::Mutex;

/// Numbers of a light, `[9, 3]`.
pub const LIGHT: usize = 27;
/// Degree of the sky's spherical harmonics, and its numbers `[16, 3]`.
const SKY_DEGREE: usize = 4;
pub const SKY: usize = 48;
/// Channels: albedo, shadow, normal.
pub const CHANNELS: usize = 7;
/// First channel of the normal.
pub const NORMAL: usize = 4;
/// Channels where suns are apart: the share that is left of a sun whose traced ray passes, besides.
pub const SUNLIT_CHANNELS: usize = 8;
/// Luminance of albedo that few surfaces exceed.
const BRIGHTEST: f32 = 0.9;
/// Opacity above which a ray shows little but a surface.
const SOLID: f32 = 0.5;
/// Difference from the traced shadow up to which the square counts.
const TRACED_WIDTH: f32 = 0.1;
/// Quantile that is learned of what arrives from suns whose traced rays pass.
const QUANTILE: f32 = 0.7;
/// Value in sRGB from which a photograph may be clipped.
const CLIPPED: f32 = 0.99;
/// Natural logarithm of the linear colors of two pixels up to which they look alike, and color below which that says nothing.
const ALIKE: f32 = 0.1;
const DARKEST: f32 = 0.01;
/// Directions in which a ray's surface looks for sky and other surfaces.
const LOOKS: usize = 16;
/// Directions in which irradiance must not be negative.
const DIRECTIONS: usize = 64;

/// Weights of the terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    pub huber: f32,
    /// Error beyond which a pixel counts less (Geman–McClure), in sRGB; 0: all count alike.
    pub robust: f32,
    /// Deviation of the shadow from 1; with suns apart, from the traced one, and of what is left of any sun from all.
    pub shadow: f32,
    /// Deviation of the shadow from the traced one; with suns apart, of what is left of any sun from what is of those of training.
    pub traced: f32,
    pub negative: f32,
    /// Albedos beyond what surfaces have.
    pub gauge: f32,
    /// Angle between the head's normal and the surface's.
    pub tie: f32,
    /// Albedo that differs between the two rays of a pair which look alike; 0: rays are no pairs.
    pub retinex: f32,
}

/// What the rays of a step are compared with.
pub struct SceneLoss<'a> {
    pub weights: Weights,
    /// sRGB, `[R, 3]`.
    pub target: &'a [f32],
    /// Share with which each ray's color counts, `[R]`.
    pub counts: &'a [f32],
    /// Normals of the surfaces in model space, `[R, 3]`; 0 where they are not known.
    pub normals: &'a [f32],
    /// Of unit length, `[R, 3]`.
    pub dirs: &'a [f32],
    /// Light of each ray, `[R]`, and its photograph.
    pub light: &'a [u32],
    pub image: &'a [u32],
    /// `[lights, 9, 3]`, `[lights, 16, 3]`, logarithms of the gains `[images, 3]`.
    pub lights: &'a [f32],
    pub skies: &'a [f32],
    pub gains: &'a [f32],
    /// Suns apart; none: the shadow that the field says.
    pub suns: Option<Suns<'a>>,
    /// Whether normals bend from those of the surfaces to what the suns apart show: what is too small for distances has sides too.
    pub bends: bool,
    /// Light that shadows are traced in, for the field to learn them.
    pub traced: Option<TracedLight<'a>>,
    pub out: Mutex<SceneGradients>,
}

/// Suns of the lights, and what hides them.
#[derive(Clone, Copy)]
pub struct Suns<'a> {
    /// `[lights, 6]`: direction, power.
    pub values: &'a [f32],
    /// Of the sky and of surfaces in each light.
    pub ambients: &'a [Ambient],
    pub visibility: &'a Visibility,
    /// Of the rays, `[R, 3]`.
    pub origins: &'a [f32],
    /// Of the directions in which surfaces look.
    pub seed: u32,
}

/// A sun and a sky of each ray, with what hides them.
#[derive(Clone, Copy)]
pub struct TracedLight<'a> {
    /// `[R, 6]`: direction, power.
    pub suns: &'a [f32],
    /// `[R, 9, 3]`
    pub skies: &'a [f32],
    pub visibility: &'a Visibility,
    /// Of the rays, `[R, 3]`.
    pub origins: &'a [f32],
    /// Of the directions in which surfaces look.
    pub seed: u32,
}

/// Gradients of the tables, and figures of the step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SceneGradients {
    pub lights: Vec<f32>,
    /// `[lights, 6]`, of the power alone; empty where suns are not apart.
    pub suns: Vec<f32>,
    pub skies: Vec<f32>,
    pub gains: Vec<f32>,
    /// Mean squared error in sRGB of the pixels that count.
    pub mse: f64,
    /// Median over the pixels of the greatest error of a channel.
    pub median: f32,
}

/// sRGB of linear light and its derivative; beyond 0 and 1 the curve goes on.
pub(super) fn encode(linear: f32) -> (f32, f32) {
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

/// Weight of a ray with a squared error, held constant: iteratively reweighted least squares (Geman–McClure).
fn trust(squared: f32, robust: f32) -> f32 {
    if robust > 0.0 { (robust * robust / (robust * robust + squared)).powi(2) } else { 1.0 }
}

/// Adds the gradient of a channel of a sky for the gradient `d` of its color; light that is negative is pulled back to 0.
fn sky_gradient(to: &mut [f32], k: usize, sky: &[f32; 3], basis: &[f32; 16], d: f32, share: f32) {
    let d = if sky[k] > 0.0 { d } else { share * 0.1 * sky[k] };
    (0..16).for_each(|i| to[3 * i + k] += d * basis[i]);
}

/// Radiance of a sky in a direction, and the basis functions there.
fn sky_at(sky: &[f32], dir: &[f32]) -> ([f32; 3], [f32; 16]) {
    let mut basis = [0.0; 16];
    spherical_harmonics::cpu::forward(SKY_DEGREE, dir, &mut basis);
    (std::array::from_fn(|k| (0..16).map(|i| sky[3 * i + k] * basis[i]).sum()), basis)
}

/// Radiance of a sky `[16, 3]` in a direction.
pub fn sky_toward(sky: &[f32], dir: &[f32]) -> [f32; 3] {
    sky_at(sky, dir).0
}

/// Irradiance over π of a white surface with a normal, by channel.
fn irradiance(light: &[f32], basis: &[f64; 9]) -> [f32; 3] {
    std::array::from_fn(|k| (0..9).map(|i| light[3 * i + k] * basis[i] as f32).sum())
}

/// A color as the model explains it, and what its gradient needs.
struct Shaded {
    normal: [f32; 3],
    basis: [f64; 9],
    /// Irradiance before it is cut off at 0.
    lit: [f32; 3],
    sky: [f32; 3],
    sky_basis: [f32; 16],
}

/// Adds the gradient of a vector of which only the direction counts.
fn add_direction(d: &mut [f32], gradient: [f32; 3], (direction, length): ([f32; 3], f32)) {
    if length > SHORTEST {
        let radial: f32 = (0..3).map(|a| direction[a] * gradient[a]).sum();
        (0..3).for_each(|a| d[a] += (gradient[a] - radial * direction[a]) / length);
    }
}

/// Normal, light and sky of a ray.
fn shade(normal: &[f32], dir: &[f32], light: &[f32], sky: &[f32]) -> Shaded {
    let normal = unit(normal).0;
    let basis = sh_light::basis(DVec3::from(normal.map(f64::from)));
    let (of_sky, sky_basis) = sky_at(sky, dir);
    Shaded { normal, basis, lit: irradiance(light, &basis), sky: of_sky, sky_basis }
}

/// Light that a white surface sends, with its shadow.
fn received(values: &[f32], s: &Shaded, sunlit: Option<Sunlit>) -> [f32; 3] {
    sunlit.map_or(s.lit.map(|lit| values[3] * lit.max(0.0)), |l| l.received(&s.normal, values).to_array())
}

/// Color of a ray, and what makes it.
pub struct RayColor {
    /// Linear.
    pub rgb: [f32; 3],
    /// Light that a white surface would send, shadow included.
    pub irradiance: [f32; 3],
    /// Share of the light that arrives.
    pub shadow: f32,
}

/// Linear color of composited values under a light and before a sky.
pub fn color(values: &[f32], opacity: f32, dir: &[f32], light: &[f32], sky: &[f32], sunlit: Option<Sunlit>) -> RayColor {
    let s = shade(&values[NORMAL..], dir, light, sky);
    let irradiance = received(values, &s, sunlit);
    let rgb = std::array::from_fn(|k| values[k] * irradiance[k] + (1.0 - opacity) * s.sky[k].max(0.0));
    let shadow = match sunlit {
        Some(_) if opacity < FAINT => 1.0,
        Some(l) => arriving(l.sun, l.arrives(values), &s.normal, s.lit, l.ambient.from_sky(light)),
        None => values[3],
    };
    RayColor { rgb, irradiance, shadow }
}

/// What the loss of a ray reads.
#[derive(Clone, Copy)]
struct RayIn<'a> {
    values: &'a [f32],
    opacity: f32,
    normal: [f32; 3],
    sunlit: Option<Sunlit<'a>>,
    /// Share of the light that arrives as traced.
    traced: Option<f32>,
}

impl SceneLoss<'_> {
    fn channels(&self) -> usize {
        if self.suns.is_some() { SUNLIT_CHANNELS } else { CHANNELS }
    }

    /// Normal of a ray's surface: as it was learned, else, or where it bends, what the head says.
    fn normal(&self, r: usize, out: &RayOutputs) -> [f32; 3] {
        let own = &self.normals[3 * r..3 * r + 3];
        let is_given = !self.bends && own.iter().any(|v| *v != 0.0);
        unit(if is_given { own } else { &out.values[r * self.channels() + NORMAL..][..3] }).0
    }

    /// Sun of a ray and what of its light arrives.
    fn sunlit(&self, r: usize, out: &RayOutputs) -> Option<Sunlit<'_>> {
        let (s, l, at) = (self.suns.as_ref()?, self.light[r] as usize, 3 * r..3 * r + 3);
        let (light, looks) = ((&s.values[SUN * l..][..SUN], true), (LOOKS, s.seed));
        let hit = (out.opacity[r], out.depth[r]);
        Some(sunlit((s.visibility, &s.ambients[l]), light, looks, &self.normal(r, out), hit, (&s.origins[at.clone()], &self.dirs[at])))
    }

    /// Share of the light of a ray's sun and sky that arrives; none where the ray meets no surface.
    fn traced(&self, r: usize, out: &RayOutputs) -> Option<f32> {
        let t = self.traced.as_ref().filter(|_| out.opacity[r] > SOLID)?;
        let (sun, sky, at) = (&t.suns[SUN * r..][..SUN], &t.skies[LIGHT * r..][..LIGHT], 3 * r..3 * r + 3);
        let normal = self.normal(r, out);
        let hit = surface(&normal, (out.opacity[r], out.depth[r]), &t.origins[at.clone()], &self.dirs[at])?;
        let lit = irradiance(sky, &sh_light::basis(DVec3::from(normal.map(f64::from))));
        let open = t.visibility.from_sky(hit.0, hit.1, LOOKS, t.seed);
        let soft = open * Vec3::from(lit).max(Vec3::ZERO) + (1.0 - open) * BOUNCED * level(sun, sky);
        Some(arriving(sun, direct(t.visibility, sun, hit), &normal, lit, soft))
    }

    /// One ray: its loss; adds gradients. `share` is its part of the sum. Returns the loss, the squared error and the largest error.
    fn ray(&self, r: usize, ray: &RayIn, d: &mut RayGradients, tables: &mut SceneGradients, share: f32) -> (f64, f64, f32) {
        let RayIn { values, opacity, normal, sunlit, .. } = *ray;
        let dir = &self.dirs[3 * r..3 * r + 3];
        let (light_of, image) = (self.light[r] as usize, self.image[r] as usize);
        let (light, sky) = (&self.lights[light_of * LIGHT..][..LIGHT], &self.skies[light_of * SKY..][..SKY]);
        let s = shade(&normal, dir, light, sky);
        let (shadow, gain) = (values[3], self.gains.get(3 * image..3 * image + 3));
        let w = self.weights;
        let (mut errors, mut d_colors) = ([0.0; 3], [0.0; 3]);
        let (white, mut plain) = (received(values, &s, sunlit), [0.0; 3]);
        for k in 0..3 {
            plain[k] = values[k] * white[k] + (1.0 - opacity) * s.sky[k].max(0.0);
            let factor = gain.map_or(1.0, |g| g[k].exp());
            let (srgb, slope) = encode(factor * plain[k]);
            let target = self.target[3 * r + k];
            // How much brighter than white something is, no photograph tells.
            errors[k] = if target >= CLIPPED && srgb > target { 0.0 } else { srgb - target };
            d_colors[k] = slope * factor;
        }
        let squared: f32 = errors.iter().map(|e| e * e).sum();
        let part = share * self.counts[r] * trust(squared, w.robust);
        let mut loss = 0.0;
        let d_values = &mut d.values[r * self.channels()..][..self.channels()];
        let mut d_white = Vec3::ZERO;
        for k in 0..3 {
            let (value, slope) = huber(errors[k], w.huber);
            loss += (part * value / 3.0) as f64;
            let dc = part * slope / 3.0 * d_colors[k];
            if gain.is_some() {
                tables.gains[3 * image + k] += dc * plain[k];
            }
            d_values[k] += dc * white[k];
            d_white[k] = dc * values[k];
            if let Some(l) = sunlit {
                d_values[3] += dc * values[k] * unhidden(l.sun, &s.normal)[k];
            }
            if sunlit.is_none() && s.lit[k] > 0.0 {
                d_values[3] += dc * values[k] * s.lit[k];
                let d_lit = dc * shadow * values[k];
                (0..9).for_each(|i| tables.lights[light_of * LIGHT + 3 * i + k] += d_lit * s.basis[i] as f32);
            }
            let of_sky = &mut tables.skies[light_of * SKY..][..SKY];
            sky_gradient(of_sky, k, &s.sky, &s.sky_basis, dc * (1.0 - opacity), share);
        }
        if let Some(l) = sunlit {
            let (by_power, ambient) = (l.arrives(values) * facing(l.sun, &normal), l.ambient.at(Vec3::from(normal)));
            for k in 0..3 {
                tables.suns[SUN * light_of + 3 + k] += d_white[k] * by_power * (l.sun[3 + k] > 0.0) as u8 as f32;
                if ambient[k] > 0.0 {
                    (0..9).for_each(|i| tables.lights[LIGHT * light_of + 3 * i + k] += d_white[k] * l.ambient.of_sky[i]);
                }
            }
        }
        if let Some(l) = sunlit.filter(|_| self.bends) {
            let said = unit(&values[NORMAL..]);
            add_direction(&mut d_values[NORMAL..], l.by_normal(&s.normal, values, d_white), said);
        }
        (loss, squared as f64 / 3.0, errors.iter().fold(0.0, |m, e| m.max(e.abs())))
    }

    /// What the heads of normal and shadow are taught besides the color; adds gradients.
    fn teach(&self, r: usize, ray: &RayIn, d: &mut RayGradients, share: f32) -> f64 {
        let (w, values, mut loss) = (self.weights, ray.values, 0.0);
        let d_values = &mut d.values[r * self.channels()..][..self.channels()];
        if let Some(l) = &ray.sunlit {
            // Where no photograph has a sun, small things take nothing of one.
            let off = values[LEFT] - 1.0;
            loss += (share * w.shadow * off * off) as f64;
            d_values[LEFT] += 2.0 * share * w.shadow * off;
            // Of what faces no sun, photographs tell nothing.
            if ray.opacity > SOLID && unhidden(l.sun, &ray.normal) != Vec3::ZERO {
                let off = values[3] - (1.0 - ray.opacity * (1.0 - l.reach));
                let (value, slope) = huber(off, TRACED_WIDTH);
                loss += (share * w.shadow * value) as f64;
                d_values[3] += share * w.shadow * slope;
                // A high quantile: shade that no ray found must not darken what is in another sun.
                let (value, slope) = huber(values[LEFT] - values[3], TRACED_WIDTH);
                let side = if slope < 0.0 { 2.0 * QUANTILE } else { 2.0 * (1.0 - QUANTILE) };
                let part = share * w.traced * l.reach * side;
                loss += (part * value) as f64;
                d_values[LEFT] += part * slope;
            }
        } else {
            let (want, weight) = ray.traced.map_or((1.0, w.shadow), |t| (t, w.traced));
            let off = values[3] - want;
            loss += (share * weight * off * off) as f64;
            d_values[3] += 2.0 * share * weight * off;
        }
        let (said, learned) = (unit(&values[NORMAL..]), &self.normals[3 * r..3 * r + 3]);
        if said.1 > SHORTEST && learned.iter().any(|v| *v != 0.0) {
            loss += (share * w.tie * (1.0 - (0..3).map(|a| said.0[a] * learned[a]).sum::<f32>())) as f64;
            add_direction(&mut d_values[NORMAL..], [0, 1, 2].map(|a| -share * w.tie * learned[a]), said);
        }
        loss
    }

    /// Penalty of albedos so bright that light would have to be dark: of the brightest twentieth, where that begins above [`BRIGHTEST`].
    fn gauge(&self, out: &RayOutputs, gradients: &mut RayGradients, share: f32) -> f64 {
        let luminance = |r: usize| gray(&out.values[r * self.channels()..][..3]);
        let surfaces: Vec<usize> = (0..out.opacity.len()).filter(|r| self.counts[*r] > 0.0 && out.opacity[*r] > 0.5).collect();
        let mut sorted: Vec<f32> = surfaces.iter().map(|r| luminance(*r)).collect();
        sorted.sort_by(f32::total_cmp);
        let Some(from) = sorted.get(sorted.len() * 19 / 20).filter(|l| **l > BRIGHTEST) else { return 0.0 };
        let mut loss = 0.0;
        for r in surfaces.into_iter().filter(|r| luminance(*r) >= *from) {
            let (e, part) = (luminance(r) - BRIGHTEST, share * self.weights.gauge);
            loss += (part * e * e) as f64;
            gradients.values[r * self.channels()..].iter_mut().zip(LUMINANCE).for_each(|(d, w)| *d += 2.0 * part * e * w);
        }
        loss
    }

    /// Retinex prior: where the two pixels of a pair look alike, their albedo does. Adds gradients.
    fn alike(&self, out: &RayOutputs, gradients: &mut RayGradients, share: f32) -> f64 {
        let (c, w, mut loss) = (self.channels(), self.weights.retinex, 0.0);
        let logarithm = |r: usize, k: usize| linear_from_srgb(self.target[3 * r + k]).max(DARKEST).ln();
        for (a, b) in (1..out.opacity.len()).step_by(2).map(|b| (b - 1, b)) {
            let is_seen = [a, b].iter().all(|r| self.counts[*r] > 0.0 && out.opacity[*r] > SOLID);
            if w == 0.0 || !is_seen || (0..3).any(|k| (logarithm(a, k) - logarithm(b, k)).abs() > ALIKE) {
                continue;
            }
            for k in 0..3 {
                let off = out.values[c * a + k] - out.values[c * b + k];
                loss += (share * w * off * off) as f64;
                gradients.values[c * a + k] += 2.0 * share * w * off;
                gradients.values[c * b + k] -= 2.0 * share * w * off;
            }
        }
        loss
    }

    /// Penalty of negative irradiance, the same directions for every light.
    fn negative(&self, tables: &mut SceneGradients) -> f64 {
        let mut loss = 0.0;
        let lights = self.lights.len() / LIGHT;
        for i in 0..DIRECTIONS {
            let basis = sh_light::basis(spread(i, DIRECTIONS));
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
            suns: vec![0.0; self.suns.map_or(0, |s| s.values.len())],
            skies: vec![0.0; self.skies.len()],
            gains: vec![0.0; self.gains.len()],
            ..SceneGradients::default()
        };
        let share = 1.0 / self.counts.iter().sum::<f32>().max(1.0);
        let (mut loss, mut mse, mut worst) = (0.0, 0.0, Vec::with_capacity(rays));
        let reached = (0..rays).into_par_iter().map(|r| (self.sunlit(r, out), self.traced(r, out)));
        for (r, (sunlit, traced)) in reached.collect::<Vec<_>>().into_iter().enumerate() {
            let values = &out.values[r * self.channels()..][..self.channels()];
            let ray = RayIn { values, opacity: out.opacity[r], normal: self.normal(r, out), sunlit, traced };
            loss += self.teach(r, &ray, gradients, 1.0 / rays as f32);
            if self.counts[r] > 0.0 {
                let (value, squared, error) = self.ray(r, &ray, gradients, &mut tables, share);
                loss += value;
                mse += squared * (share * self.counts[r]) as f64;
                worst.push(error);
            }
        }
        if self.suns.is_none() {
            loss += self.negative(&mut tables);
        }
        loss += self.gauge(out, gradients, share) + self.alike(out, gradients, share);
        if !worst.is_empty() {
            let at = worst.len() / 2;
            tables.median = *worst.select_nth_unstable_by(at, f32::total_cmp).1;
        }
        tables.mse = mse;
        *self.out.lock().expect("no other thread holds it") = tables;
        loss
    }
}
