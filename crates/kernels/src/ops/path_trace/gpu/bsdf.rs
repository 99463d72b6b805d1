//! Reflection of opaque surfaces, as on the CPU. Directions are in the frame of the shading normal.

use super::angles::sin_cos_turns;
use super::sampler::Pair;
use crate::gpu::vector::{V3, along, dot, float, luminance, scale, unit};
use crate::ops::path_trace::bsdf::{DIELECTRIC, SHARPEST, SIZE};
use cubecl::prelude::*;
use std::f32::consts::PI;

/// What scatters light at a point that is seen from one direction.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Bsdf {
    pub outgoing: V3,
    alpha: f32,
    straight: V3,
    grazing: V3,
    diffuse: V3,
    glossy: f32,
    is_matte: bool,
}

/// Reflection times the cosine, and the density with which the direction is drawn.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Value {
    pub color: V3,
    pub density: f32,
}

/// Reflected shares for light along the normal and for grazing light.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Shares {
    straight: f32,
    grazing: f32,
}

#[cube]
fn unit_interval(v: f32) -> f32 {
    clamp(v, 0.0, 1.0)
}

/// `(1 − cos)⁵`
#[cube]
pub fn schlick(cosine: f32) -> f32 {
    let m = unit_interval(1.0 - cosine);
    m * m * m * m * m
}

#[cube]
fn share(words: &[u32], at: usize, row: f32, column: f32) -> f32 {
    let low = min(u32::cast_from(row), comptime!(SIZE as u32 - 2));
    let left = min(u32::cast_from(column), comptime!(SIZE as u32 - 2));
    let fy = row - f32::cast_from(low);
    let fx = column - f32::cast_from(left);
    let first = at + (low * comptime!(SIZE as u32) + left) as usize * 2;
    let next = first + comptime!(2 * SIZE);
    let above = float(words, first) * (1.0 - fx) + float(words, first + 2) * fx;
    let below = float(words, next) * (1.0 - fx) + float(words, next + 2) * fx;
    above * (1.0 - fy) + below * fy
}

/// The CPU's table, which begins at `table`, bilinear between entries.
#[cube]
fn shares(words: &[u32], table: usize, cosine: f32, alpha: f32) -> Shares {
    let row = unit_interval(alpha.sqrt()) * comptime!(SIZE as f32 - 1.0);
    let column = unit_interval(cosine) * comptime!(SIZE as f32 - 1.0);
    Shares { straight: share(words, table, row, column), grazing: share(words, table + 1, row, column) }
}

/// Of white microfacets the share `scale` is left; the rest meets others, and is colored once more.
#[cube]
fn gain(f0: f32, scale: f32) -> f32 {
    1.0 + f0 * (1.0 / scale - 1.0)
}

#[cube]
fn straight_of(c: f32, metallic: f32, coat: f32, scale: f32) -> f32 {
    let dielectric = DIELECTRIC * coat;
    dielectric + (c * gain(c, scale) - dielectric) * metallic
}

#[cube]
fn grazing_of(c: f32, metallic: f32, coat: f32, scale: f32) -> f32 {
    let dielectric = (1.0 - DIELECTRIC) * coat;
    dielectric + ((1.0 - c) * gain(c, scale) - dielectric) * metallic
}

/// Scattering of light towards `outgoing`, which is above the surface. `table` is where the table of shares begins.
#[cube]
pub fn bsdf(words: &[u32], table: usize, color: V3, roughness: f32, metalness: f32, specular: f32, outgoing: V3) -> Bsdf {
    let alpha = clamp(roughness * roughness, SHARPEST, 1.0);
    let metallic = unit_interval(metalness);
    let base = V3 { x: unit_interval(color.x), y: unit_interval(color.y), z: unit_interval(color.z) };
    let is_plain = specular <= 0.0 && metallic == 0.0;
    let by = shares(words, table, outgoing.z, alpha);
    let coat = select(is_plain, 0.0f32, unit_interval(specular) * gain(DIELECTRIC, by.straight));
    let straight = V3 {
        x: straight_of(base.x, metallic, coat, by.straight),
        y: straight_of(base.y, metallic, coat, by.straight),
        z: straight_of(base.z, metallic, coat, by.straight),
    };
    let grazing = V3 {
        x: grazing_of(base.x, metallic, coat, by.straight),
        y: grazing_of(base.y, metallic, coat, by.straight),
        z: grazing_of(base.z, metallic, coat, by.straight),
    };
    let surface = (DIELECTRIC * by.straight + (1.0 - DIELECTRIC) * by.grazing) * coat;
    let diffuse = scale(base, (1.0 - metallic) * max(1.0 - surface, 0.0));
    let reflected = luminance(along(scale(straight, by.straight), by.grazing, grazing));
    let matte = luminance(diffuse);
    let glossy = select(reflected + matte > 0.0, reflected / max(reflected + matte, 1.2e-38), 1.0f32);
    Bsdf { outgoing, alpha, straight, grazing, diffuse, glossy, is_matte: is_plain && matte > 0.0 }
}

/// Smith's auxiliary function Λ.
#[cube]
fn lambda(alpha: f32, v: V3) -> f32 {
    let tan2 = (v.x * v.x + v.y * v.y) / (v.z * v.z);
    0.5 * ((1.0 + alpha * alpha * tan2).sqrt() - 1.0)
}

/// Reflection times the cosine of `incoming`, and the density with which [`draw`] draws it.
#[cube]
pub fn evaluate(b: &Bsdf, incoming: V3) -> Value {
    let o = b.outgoing;
    let cosine = max(incoming.z, 0.0);
    let matte = cosine / PI;
    let mut color = scale(b.diffuse, matte);
    let mut density = matte;
    if !b.is_matte && cosine > 0.0 {
        let half = unit(V3 { x: o.x + incoming.x, y: o.y + incoming.y, z: o.z + incoming.z });
        let a2 = b.alpha * b.alpha;
        let q = half.x * half.x + half.y * half.y + half.z * half.z * a2;
        let d = a2 / (PI * q * q) / (4.0 * o.z);
        let lambda_o = lambda(b.alpha, o);
        let fresnel = schlick(dot(o, half));
        let lobe = d / (1.0 + lambda_o + lambda(b.alpha, incoming));
        color = along(along(color, lobe, b.straight), lobe * fresnel, b.grazing);
        density = b.glossy * d / (1.0 + lambda_o) + (1.0 - b.glossy) * matte;
    }
    Value { color, density }
}

/// A direction from two numbers in `[0, 1)`; it may lie below the surface, where its density is 0.
#[cube]
pub fn draw(b: &Bsdf, random: Pair) -> V3 {
    let o = b.outgoing;
    if random.first < b.glossy {
        // A normal among those that are visible.
        let stretched = unit(V3 { x: b.alpha * o.x, y: b.alpha * o.y, z: o.z });
        let around = sin_cos_turns(random.first / b.glossy);
        let z = (1.0 - random.second) * (1.0 + stretched.z) - stretched.z;
        let sine = unit_interval(1.0 - z * z).sqrt();
        let half = unit(V3 {
            x: b.alpha * (sine * around.cosine + stretched.x),
            y: b.alpha * (sine * around.sine + stretched.y),
            z: max(z + stretched.z, 0.0),
        });
        let twice = 2.0 * dot(o, half);
        unit(V3 { x: twice * half.x - o.x, y: twice * half.y - o.y, z: twice * half.z - o.z })
    } else {
        let squared = (random.first - b.glossy) / (1.0 - b.glossy);
        let around = sin_cos_turns(random.second);
        let radius = squared.sqrt();
        V3 { x: radius * around.cosine, y: radius * around.sine, z: max(1.0 - squared, 0.0).sqrt() }
    }
}
