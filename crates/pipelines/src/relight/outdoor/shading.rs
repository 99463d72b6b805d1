//! Loss of the scene model: `C = S · A ⊙ max(0, Lᵀ b(N)) + (1 − o) · sky(d)` in linear light, compared in sRGB, and its gradient. With a
//! sun apart, its light, the sky's and that of surfaces around (see [`super::sun`]) take the place of `S · max(0, Lᵀ b(N))`, and are given.
//!
//! Per ray, the field composites albedo `A` (premultiplied by the opacity `o`), shadow `S` (1 where nothing is hit) and the normal that a
//! head of the network says, whose direction `N` counts. Light `L` `[9, 3]` and sky `[16, 3]` are of the ray's session. In training, the
//! normal is that of the surfaces as they were learned, which the head is taught; with suns apart it bends from there to what the suns show.

use super::sun::{BOUNCED, SUN, level};
use super::visibility::{Ambient, Visibility, of_normal, spread};
use diorama_geom::color::LUMINANCE;
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
/// Luminance of albedo that few surfaces exceed.
const BRIGHTEST: f32 = 0.9;
/// Opacity below which a ray shows no surface, and above which it shows little else.
const FAINT: f32 = 0.05;
const SOLID: f32 = 0.5;
/// Length below which a vector has no direction.
const SHORTEST: f32 = 1e-12;
/// Value in sRGB from which a photograph may be clipped.
const CLIPPED: f32 = 0.99;
/// Directions in which irradiance must not be negative.
const DIRECTIONS: usize = 64;

/// Weights of the terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    pub huber: f32,
    /// Error beyond which a pixel counts less (Geman–McClure), in sRGB; 0: all count alike.
    pub robust: f32,
    /// Deviation of the shadow from 1.
    pub shadow: f32,
    /// Deviation of the shadow from the traced one.
    pub traced: f32,
    pub negative: f32,
    /// Albedos beyond what surfaces have.
    pub gauge: f32,
    /// Angle between the head's normal and the surface's.
    pub tie: f32,
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
}

/// Sun of a surface point, the shares of its light and the sky's that reach the point, and light from sky and surfaces.
#[derive(Clone, Copy)]
pub struct Sunlit<'a> {
    pub sun: &'a [f32],
    pub reach: [f32; 2],
    /// By spherical harmonics of the normal.
    pub ambient: [Vec3; 9],
    /// Light of lamps that arrives.
    pub of_lamps: Vec3,
}

/// What a ray shows: a point and its normal; none where it meets nothing. `depth` is `Σ w t`.
fn surface(normal: &[f32], (opacity, depth): (f32, f32), origin: &[f32], dir: &[f32]) -> Option<(Vec3, Vec3)> {
    let point = Vec3::from_slice(origin) + Vec3::from_slice(dir) * (depth / opacity.max(FAINT));
    (opacity >= FAINT).then(|| (point, Vec3::from(unit(normal).0)))
}

/// Shares of a sun's and the sky's light that reach a surface, `[sun, sky]`.
fn reach(visibility: &Visibility, sun: &[f32], (point, normal): (Vec3, Vec3)) -> [f32; 2] {
    let toward = Vec3::from_slice(sun);
    let direct = if normal.dot(toward) > 0.0 { visibility.from_sun(point, normal, toward) } else { 1.0 };
    [direct, visibility.from_sky(&visibility.corners(point, normal), normal)]
}

/// The light of a sun, perhaps more suns after it, and what is around at what a ray shows; `sky` `[9, 3]` is that of the light.
pub fn sunlit<'a>(
    (visibility, ambient): (&Visibility, &Ambient),
    (suns, sky): (&'a [f32], &[f32]),
    normal: &[f32],
    hit: (f32, f32),
    (origin, dir): (&[f32], &[f32]),
) -> Sunlit<'a> {
    let (sun, lamps) = suns.split_at(SUN);
    match surface(normal, hit, origin, dir) {
        None => Sunlit { sun, reach: [1.0; 2], ambient: [Vec3::ZERO; 9], of_lamps: Vec3::ZERO },
        Some(at) => {
            let corners = visibility.corners(at.0, at.1);
            let from_lamp = |lamp: &[f32]| {
                let facing = at.1.dot(Vec3::from_slice(lamp));
                let arrives = if facing > 0.0 { facing * visibility.from_sun(at.0, at.1, Vec3::from_slice(lamp)) } else { 0.0 };
                arrives * Vec3::from_slice(&lamp[3..])
            };
            let lamps: Vec3 = lamps.chunks_exact(SUN).map(from_lamp).sum();
            Sunlit { sun, reach: reach(visibility, sun, at), ambient: ambient.around(&corners, sky), of_lamps: lamps }
        }
    }
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

/// Direction and length of a vector; straight up if there is none.
fn unit(v: &[f32]) -> ([f32; 3], f32) {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    (if length > SHORTEST { [v[0] / length, v[1] / length, v[2] / length] } else { [0.0, 0.0, 1.0] }, length)
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
fn received(values: &[f32], s: &Shaded, sunlit: Option<Sunlit>, k: usize) -> f32 {
    sunlit.map_or(values[3] * s.lit[k].max(0.0), |l| l.received(&s.normal, values[3])[k])
}

/// Light of a sun that reaches a surface without shadows.
fn unhidden(sun: &[f32], normal: &[f32; 3]) -> Vec3 {
    Vec3::from_slice(&sun[3..]) * (0..3).map(|a| normal[a] * sun[a]).sum::<f32>().max(0.0)
}

impl Sunlit<'_> {
    /// Light that a white surface sends of which a share of the suns is not hidden by what is too small to be traced.
    fn received(&self, normal: &[f32; 3], share: f32) -> Vec3 {
        share * self.direct(normal) + of_normal(&self.ambient, Vec3::from(*normal))
    }

    /// Gradient of [`Sunlit::received`] by the normal, for gradients `d` by its channels; lamps have none.
    fn by_normal(&self, normal: &[f32; 3], share: f32, d: Vec3) -> [f32; 3] {
        let n = Vec3::from(*normal);
        let toward = Vec3::from_slice(self.sun);
        let of_sun = if n.dot(toward) > 0.0 { share * self.reach[0] * Vec3::from_slice(&self.sun[3..]).dot(d) } else { 0.0 };
        let ambient = of_normal(&self.ambient, n);
        let d = Vec3::select(ambient.cmpgt(Vec3::ZERO), d, Vec3::ZERO);
        let bent = sh_light::basis_gradient(n.as_dvec3()).into_iter().zip(&self.ambient).map(|(b, v)| v.dot(d) * b.as_vec3());
        (of_sun * toward + bent.sum::<Vec3>()).to_array()
    }

    /// Light of the suns that a white surface sends where nothing small hides them.
    fn direct(&self, normal: &[f32; 3]) -> Vec3 {
        self.reach[0] * unhidden(self.sun, normal) + self.of_lamps
    }
}

/// Share of the light of a sun and a sky that reaches a surface; `lit` is that of the whole sky, `sent` what surfaces send where they hide it.
fn arriving(sun: &[f32], reach: [f32; 2], normal: &[f32; 3], lit: [f32; 3], sent: Vec3) -> f32 {
    let (direct, sky) = (unhidden(sun, normal), Vec3::from(lit).max(Vec3::ZERO));
    let all = gray(&(direct + sky).to_array()).max(1e-6);
    (gray(&(reach[0] * direct + reach[1] * sky + (1.0 - reach[1]) * sent).to_array()) / all).clamp(0.0, 1.0)
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
    let irradiance: [f32; 3] = std::array::from_fn(|k| received(values, &s, sunlit, k));
    let rgb = std::array::from_fn(|k| values[k] * irradiance[k] + (1.0 - opacity) * s.sky[k].max(0.0));
    let shadow = match sunlit {
        Some(_) if opacity < FAINT => 1.0,
        Some(l) => arriving(l.sun, [values[3] * l.reach[0], l.reach[1]], &s.normal, s.lit, Vec3::ZERO),
        None => values[3],
    };
    RayColor { rgb, irradiance, shadow }
}

/// What the shadow's head reads of a sun apart: its direction; zeros where there is none.
pub fn sun_code(sun: &[f32]) -> [f32; 9] {
    let is_there = sun[3..SUN].iter().any(|v| *v > 0.0);
    std::array::from_fn(|i| if is_there && i < 3 { sun[i] } else { 0.0 })
}

/// Luminance of a color or coefficient.
pub fn gray(c: &[f32]) -> f32 {
    (0..3).map(|k| LUMINANCE[k] * c[k]).sum()
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
    /// Normal of a ray's surface: as it was learned, else, or where it bends, what the head says.
    fn normal(&self, r: usize, out: &RayOutputs) -> [f32; 3] {
        let own = &self.normals[3 * r..3 * r + 3];
        let is_given = !self.bends && own.iter().any(|v| *v != 0.0);
        unit(if is_given { own } else { &out.values[r * CHANNELS + NORMAL..][..3] }).0
    }

    /// Sun of a ray and what of its light arrives.
    fn sunlit(&self, r: usize, out: &RayOutputs) -> Option<Sunlit<'_>> {
        let (s, l, at) = (self.suns.as_ref()?, self.light[r] as usize, 3 * r..3 * r + 3);
        let light = (&s.values[SUN * l..][..SUN], &self.lights[LIGHT * l..][..LIGHT]);
        let hit = (out.opacity[r], out.depth[r]);
        Some(sunlit((s.visibility, &s.ambients[l]), light, &self.normal(r, out), hit, (&s.origins[at.clone()], &self.dirs[at])))
    }

    /// Share of the light of a ray's sun and sky that arrives; none where the ray meets no surface.
    fn traced(&self, r: usize, out: &RayOutputs) -> Option<f32> {
        let t = self.traced.as_ref().filter(|_| out.opacity[r] > SOLID)?;
        let (sun, sky, at) = (&t.suns[SUN * r..][..SUN], &t.skies[LIGHT * r..][..LIGHT], 3 * r..3 * r + 3);
        let normal = self.normal(r, out);
        let hit = surface(&normal, (out.opacity[r], out.depth[r]), &t.origins[at.clone()], &self.dirs[at])?;
        let lit = irradiance(sky, &sh_light::basis(DVec3::from(normal.map(f64::from))));
        Some(arriving(sun, reach(t.visibility, sun, hit), &normal, lit, BOUNCED * level(sun, sky)))
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
        let (mut white, mut plain) = ([0.0; 3], [0.0; 3]);
        for k in 0..3 {
            white[k] = received(values, &s, sunlit, k);
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
        let d_values = &mut d.values[r * CHANNELS..][..CHANNELS];
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
                d_values[3] += dc * values[k] * l.direct(&s.normal)[k];
            }
            if sunlit.is_none() && s.lit[k] > 0.0 {
                d_values[3] += dc * values[k] * s.lit[k];
                let d_lit = dc * shadow * values[k];
                (0..9).for_each(|i| tables.lights[light_of * LIGHT + 3 * i + k] += d_lit * s.basis[i] as f32);
            }
            let of_sky = &mut tables.skies[light_of * SKY..][..SKY];
            sky_gradient(of_sky, k, &s.sky, &s.sky_basis, dc * (1.0 - opacity), share);
        }
        if let Some(l) = sunlit.filter(|_| self.bends) {
            let said = unit(&values[NORMAL..]);
            add_direction(&mut d_values[NORMAL..], l.by_normal(&s.normal, shadow, d_white), said);
        }
        (loss, squared as f64 / 3.0, errors.iter().fold(0.0, |m, e| m.max(e.abs())))
    }

    /// What the heads of normal and shadow are taught besides the color; adds gradients.
    fn teach(&self, r: usize, ray: &RayIn, d: &mut RayGradients, share: f32) -> f64 {
        let (w, values, mut loss) = (self.weights, ray.values, 0.0);
        let d_values = &mut d.values[r * CHANNELS..][..CHANNELS];
        let (want, weight) = ray.traced.map_or((1.0, w.shadow), |t| (t, w.traced));
        let off = values[3] - want;
        loss += (share * weight * off * off) as f64;
        d_values[3] += 2.0 * share * weight * off;
        let (said, learned) = (unit(&values[NORMAL..]), &self.normals[3 * r..3 * r + 3]);
        if said.1 > SHORTEST && learned.iter().any(|v| *v != 0.0) {
            loss += (share * w.tie * (1.0 - (0..3).map(|a| said.0[a] * learned[a]).sum::<f32>())) as f64;
            add_direction(&mut d_values[NORMAL..], [0, 1, 2].map(|a| -share * w.tie * learned[a]), said);
        }
        loss
    }

    /// Penalty of albedos so bright that light would have to be dark: of the brightest twentieth, where that begins above [`BRIGHTEST`].
    fn gauge(&self, out: &RayOutputs, gradients: &mut RayGradients, share: f32) -> f64 {
        let luminance = |r: usize| gray(&out.values[r * CHANNELS..][..3]);
        let surfaces: Vec<usize> = (0..out.opacity.len()).filter(|r| self.counts[*r] > 0.0 && out.opacity[*r] > 0.5).collect();
        let mut sorted: Vec<f32> = surfaces.iter().map(|r| luminance(*r)).collect();
        sorted.sort_by(f32::total_cmp);
        let Some(from) = sorted.get(sorted.len() * 19 / 20).filter(|l| **l > BRIGHTEST) else { return 0.0 };
        let mut loss = 0.0;
        for r in surfaces.into_iter().filter(|r| luminance(*r) >= *from) {
            let (e, part) = (luminance(r) - BRIGHTEST, share * self.weights.gauge);
            loss += (part * e * e) as f64;
            gradients.values[r * CHANNELS..].iter_mut().zip(LUMINANCE).for_each(|(d, w)| *d += 2.0 * part * e * w);
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
            skies: vec![0.0; self.skies.len()],
            gains: vec![0.0; self.gains.len()],
            ..SceneGradients::default()
        };
        let share = 1.0 / self.counts.iter().sum::<f32>().max(1.0);
        let (mut loss, mut mse, mut worst) = (0.0, 0.0, Vec::with_capacity(rays));
        let reached = (0..rays).into_par_iter().map(|r| (self.sunlit(r, out), self.traced(r, out)));
        for (r, (sunlit, traced)) in reached.collect::<Vec<_>>().into_iter().enumerate() {
            let values = &out.values[r * CHANNELS..][..CHANNELS];
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
        loss += self.gauge(out, gradients, share);
        if !worst.is_empty() {
            let at = worst.len() / 2;
            tables.median = *worst.select_nth_unstable_by(at, f32::total_cmp).1;
        }
        tables.mse = mse;
        *self.out.lock().expect("no other thread holds it") = tables;
        loss
    }
}
