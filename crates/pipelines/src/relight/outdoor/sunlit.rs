//! Light of a sun, and of all that is around, at what a ray shows.

use super::sun::{SUN, gray};
use super::visibility::{Ambient, Gathered, Visibility};
use diorama_geom::glam::Vec3;

/// Channel of the share that is left of a sun whose traced ray passes.
pub const LEFT: usize = 7;
/// Share of a sun that no photograph has which arrives where its traced ray passes, `a + b LEFT`. What takes light from the suns of photographs
/// often takes none from another, and what takes none from theirs may take some of another's. Least squares in sRGB under the sun apart of
/// generated streets, of 64×48, 160×90 and 320×180 pixels alike.
pub(super) const ARRIVES: [f32; 2] = [0.27, 0.63];
/// Opacity below which a ray shows no surface.
pub const FAINT: f32 = 0.05;
/// Length below which a vector has no direction.
pub(super) const SHORTEST: f32 = 1e-12;

/// Sun of a surface point, the share of its light that reaches the point, and light from sky and surfaces.
#[derive(Clone, Copy)]
pub struct Sunlit<'a> {
    pub sun: &'a [f32],
    pub reach: f32,
    /// Whether it is the sun of a light of training.
    pub is_learned: bool,
    pub ambient: Gathered,
    /// Light of lamps whose traced rays pass.
    pub of_lamps: Vec3,
}

/// What a ray shows: a point and its normal; none where it meets nothing. `depth` is `Σ w t`.
pub(super) fn surface(normal: &[f32], (opacity, depth): (f32, f32), origin: &[f32], dir: &[f32]) -> Option<(Vec3, Vec3)> {
    let point = Vec3::from_slice(origin) + Vec3::from_slice(dir) * (depth / opacity.max(FAINT));
    (opacity >= FAINT).then(|| (point, Vec3::from(unit(normal).0)))
}

/// Share of a sun's light that reaches a surface.
pub(super) fn direct(visibility: &Visibility, sun: &[f32], (point, normal): (Vec3, Vec3)) -> f32 {
    let toward = Vec3::from_slice(sun);
    if normal.dot(toward) > 0.0 { visibility.from_sun(point, normal, toward) } else { 1.0 }
}

/// The light of a sun, perhaps more suns after it, and what is around at what a ray shows, from so many directions with a seed; the flag says
/// whether the light is one of training.
pub fn sunlit<'a>(
    (visibility, ambient): (&Visibility, &Ambient),
    (suns, is_learned): (&'a [f32], bool),
    (looks, seed): (usize, u32),
    normal: &[f32],
    hit: (f32, f32),
    (origin, dir): (&[f32], &[f32]),
) -> Sunlit<'a> {
    let (sun, lamps) = suns.split_at(SUN);
    match surface(normal, hit, origin, dir) {
        None => Sunlit { sun, reach: 1.0, is_learned, ambient: Gathered::NONE, of_lamps: Vec3::ZERO },
        Some(at) => {
            let from_lamp = |lamp: &[f32]| {
                let facing = at.1.dot(Vec3::from_slice(lamp));
                let arrives = if facing > 0.0 { facing * visibility.from_sun(at.0, at.1, Vec3::from_slice(lamp)) } else { 0.0 };
                arrives * Vec3::from_slice(&lamp[3..])
            };
            let of_lamps = lamps.chunks_exact(SUN).map(from_lamp).sum();
            let ambient = ambient.gathered(at.1, visibility.looks(at.0, at.1, looks, seed));
            Sunlit { sun, reach: direct(visibility, sun, at), is_learned, ambient, of_lamps }
        }
    }
}

/// Light of a sun that reaches a surface without shadows.
pub(super) fn unhidden(sun: &[f32], normal: &[f32; 3]) -> Vec3 {
    Vec3::from_slice(&sun[3..]) * facing(sun, normal)
}

/// Cosine between a normal and a sun; 0 behind.
pub(super) fn facing(sun: &[f32], normal: &[f32; 3]) -> f32 {
    (0..3).map(|a| normal[a] * sun[a]).sum::<f32>().max(0.0)
}

impl Sunlit<'_> {
    /// Light that a white surface sends where the field says these values.
    pub(super) fn received(&self, normal: &[f32; 3], values: &[f32]) -> Vec3 {
        let of_lamps = if self.is_learned { Vec3::ZERO } else { passing(values) * self.of_lamps };
        self.arrives(values) * unhidden(self.sun, normal) + of_lamps + self.ambient.at(Vec3::from(*normal))
    }

    /// Share of the sun's light that arrives.
    pub(super) fn arrives(&self, values: &[f32]) -> f32 {
        if self.is_learned { values[3] } else { self.reach * passing(values) }
    }

    /// Gradient of [`Sunlit::received`] by the normal, for gradients `d` by its channels; lamps have none.
    pub(super) fn by_normal(&self, normal: &[f32; 3], values: &[f32], d: Vec3) -> [f32; 3] {
        let n = Vec3::from(*normal);
        let toward = Vec3::from_slice(self.sun);
        let of_sun = if n.dot(toward) > 0.0 { self.arrives(values) * Vec3::from_slice(&self.sun[3..]).dot(d) } else { 0.0 };
        let d = Vec3::select(self.ambient.at(n).cmpgt(Vec3::ZERO), d, Vec3::ZERO);
        (of_sun * toward + Vec3::from(self.ambient.slope.map(|s| s.dot(d)))).to_array()
    }
}

/// Share of an unknown sun's light that arrives where its traced ray passes.
pub(super) fn passing(values: &[f32]) -> f32 {
    ARRIVES[0] + ARRIVES[1] * values[LEFT]
}

/// Share of the light of a sun and a sky that reaches a surface, of which so much of the sun's and `soft` arrives; `lit` is the light of the
/// whole sky.
pub(super) fn arriving(sun: &[f32], reach: f32, normal: &[f32; 3], lit: [f32; 3], soft: Vec3) -> f32 {
    let direct = unhidden(sun, normal);
    let all = gray(&(direct + Vec3::from(lit).max(Vec3::ZERO)).to_array()).max(1e-6);
    (gray(&(reach * direct + soft).to_array()) / all).clamp(0.0, 1.0)
}

/// What the shadow's head reads of a sun apart: its direction; zeros where there is none.
pub fn sun_code(sun: &[f32]) -> [f32; 9] {
    let is_there = sun[3..SUN].iter().any(|v| *v > 0.0);
    std::array::from_fn(|i| if is_there && i < 3 { sun[i] } else { 0.0 })
}

/// Direction and length of a vector; straight up if there is none.
pub(super) fn unit(v: &[f32]) -> ([f32; 3], f32) {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    (if length > SHORTEST { [v[0] / length, v[1] / length, v[2] / length] } else { [0.0, 0.0, 1.0] }, length)
}
