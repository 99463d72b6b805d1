//! Light that surfaces reflect, by the split-sum approximation (Karis 2013, "Real Shading in Unreal Engine 4"): the integral over the light
//! is one lookup in maps that [`cube_prefilter`](super::cube_prefilter) blurred, the integral over the lobe one in a table.
//!
//! The material is that of glTF's metallic roughness (GGX with `α = r²`, height-correlated Smith, Schlick), with the compensation of lost
//! energy that [`path_trace`](super::path_trace) uses (Turquin 2019), so that both renderers agree. With `F = 0.04 (1 − m) + kd m`, shares
//! `A, B` of the table at `(n·v, r)` and `g = 1 / (A + B) − 1`:
//!
//! `out = (1 − o) · (kd (1 − m) (1 − (0.04 A + B)(1 + 0.04 g)) · diffuse + (F A + B)(1 + F g) · specular)`
//!
//! where `specular` is looked up along the mirrored view at the level of the roughness ([`level_of`]), `diffuse` along the normal.

pub mod cpu;
pub mod reference;
mod table;
#[cfg(test)]
mod tests;

pub use table::Table;

/// Reflectance of dielectrics at normal incidence.
pub const DIELECTRIC: f32 = 0.04;
/// Least roughness: that of the finest level of the blurred light.
pub const SMOOTHEST: f32 = 0.08;
/// Roughness of the last level but one; levels between are spaced evenly.
pub const MIDDLE: f32 = 0.5;
/// Least cosine between normal and view that the table is asked for.
pub const GRAZING: f32 = 1e-3;
/// Cosine below which the shading normal bends toward that of the face.
pub const BEND: f32 = 0.1;

/// Roughness of each of `levels` levels of blurred light.
pub fn roughness_of(level: usize, levels: usize) -> f32 {
    match level + 1 {
        last if last == levels => 1.0,
        _ => SMOOTHEST + (MIDDLE - SMOOTHEST) * level as f32 / (levels - 2).max(1) as f32,
    }
}

/// Fractional level for a roughness, and its slope.
#[inline(always)]
pub fn level_of(roughness: f32, levels: usize) -> (f32, f32) {
    let before_last = (levels - 2) as f32;
    if roughness < MIDDLE {
        let slope = before_last / (MIDDLE - SMOOTHEST);
        ((roughness - SMOOTHEST) * slope, slope)
    } else {
        let slope = 1.0 / (1.0 - MIDDLE);
        (before_last + (roughness - MIDDLE) * slope, slope)
    }
}

/// Surface points, all `[P, 3]` flat: unit normals, unit directions to the camera, base color, and occlusion, roughness, metalness.
#[derive(Clone, Copy, Debug)]
pub struct Points<'a> {
    pub normal: &'a [f32],
    pub view: &'a [f32],
    pub kd: &'a [f32],
    pub ks: &'a [f32],
}

/// Blurred light at the points, `[P, 3]` each.
#[derive(Clone, Copy, Debug)]
pub struct Light<'a> {
    pub diffuse: &'a [f32],
    pub specular: &'a [f32],
}

/// Gradients of what a color depends on, `[P, 3]` each, overwritten.
#[derive(Debug)]
pub struct Gradients<'a> {
    pub normal: &'a mut [f32],
    pub kd: &'a mut [f32],
    pub ks: &'a mut [f32],
    pub diffuse: &'a mut [f32],
    pub specular: &'a mut [f32],
}
