//! Surfaces where rays meet them: interpolated, textured, and as light scatters there.

use super::angles::{Frame, frame};
use super::bsdf::{self, Bsdf, schlick};
use crate::gpu::vector::{
    V3, along, cross, dot, float, luminance, read, scale, sub, times, transform_direction, transform_normal, transform_point, unit,
};
use crate::ops::path_trace::tracer::PANE;
use crate::ops::ray_triangles::binary::NOTHING;
use crate::ops::ray_triangles::gpu::{Found, INSTANCE, PLACEMENT, WORLD_FROM_MESH};
use cubecl::prelude::*;

/// Words before the tables of surfaces: where each begins.
pub const HEADER: usize = 6;
pub const FACES: usize = 0;
pub const VERTICES: usize = 1;
pub const MATERIALS: usize = 2;
pub const TEXTURES: usize = 3;
/// Linear light of sRGB values, `[256]`.
pub const LINEAR: usize = 4;
/// Shares of light that microfacets reflect.
pub const SHARES: usize = 5;

/// Words of a face: corners, material, instance.
pub const FACE: usize = 5;
/// Words of a vertex: position, normal, tangent, texture coordinates, color.
pub const VERTEX: usize = 15;
/// Words of a material; its textures are of base color, metalness and roughness, normal and emission.
pub const MATERIAL: usize = 18;
pub const ROUGHNESS: usize = 4;
pub const METALLIC: usize = 5;
pub const SPECULAR: usize = 6;
pub const EMISSION: usize = 7;
pub const TRANSMISSION: usize = 10;
pub const NORMAL_SCALE: usize = 11;
/// 0: opaque, 1: holes below [`CUTOFF`], 2: blended.
pub const OPACITY: usize = 12;
pub const CUTOFF: usize = 13;
pub const OF_TEXTURES: usize = 14;
/// Words of a texture: its first texel, width, height, and what lies beyond along u and v.
pub const TEXTURE: usize = 5;
pub const REPEAT: u32 = 0;
pub const MIRROR: u32 = 1;
pub const CLAMP: u32 = 2;

/// A surface at a point.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Surface {
    pub position: V3,
    /// Of the triangle.
    pub flat: V3,
    /// Of shading.
    pub normal: V3,
    pub base: V3,
    pub roughness: f32,
    pub metallic: f32,
    pub specular: f32,
    pub emission: V3,
    pub opacity: f32,
    pub transmission: f32,
    pub instance: u32,
}

/// Where a path is, seen from the side that it came from.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Vertex {
    pub position: V3,
    pub flat: V3,
    pub frame: Frame,
    pub bsdf: Bsdf,
    /// Whether it is seen from above.
    pub is_seen: bool,
}

#[cube]
fn mix(a: f32, b: f32, c: f32, u: f32, v: f32) -> f32 {
    (1.0 - u - v) * a + u * b + v * c
}

/// An interpolated number of a triangle's corners.
#[cube]
fn mixed(s: &[u32], corners: &Corners, at: usize) -> f32 {
    mix(float(s, corners.a + at), float(s, corners.b + at), float(s, corners.c + at), corners.u, corners.v)
}

#[cube]
fn mixed3(s: &[u32], corners: &Corners, at: usize) -> V3 {
    V3 { x: mixed(s, corners, at), y: mixed(s, corners, at + 1), z: mixed(s, corners, at + 2) }
}

/// Where the corners of a triangle begin, and the weights of two.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Corners {
    a: usize,
    b: usize,
    c: usize,
    u: f32,
    v: f32,
}

/// Direction of u across a triangle and the sign of the direction against v; the sign is 0 where there is none.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Tangent {
    along: V3,
    sign: f32,
}

#[cube]
fn tangent_of(s: &[u32], c: &Corners) -> Tangent {
    let mut tangent = Tangent { along: mixed3(s, c, 6), sign: mixed(s, c, 9) };
    if tangent.sign == 0.0 {
        let e = sub(read(s, c.b), read(s, c.a));
        let f = sub(read(s, c.c), read(s, c.a));
        let ax = float(s, c.b + 10) - float(s, c.a + 10);
        let ay = float(s, c.b + 11) - float(s, c.a + 11);
        let bx = float(s, c.c + 10) - float(s, c.a + 10);
        let by = float(s, c.c + 11) - float(s, c.a + 11);
        let det = ax * by - bx * ay;
        if det != 0.0 {
            tangent.along = unit(scale(along(scale(e, by), -ay, f), 1.0 / det));
            tangent.sign = select(det < 0.0, 1.0f32, -1.0f32);
        }
    }
    tangent
}

/// Index of a texel that lies within the image.
#[cube]
fn wrapped(i: f32, size: u32, wrap: u32) -> u32 {
    let n = f32::cast_from(size);
    let period = select(wrap == MIRROR, 2.0 * n, n);
    let mut at = i - period * (i / period).floor();
    if at < 0.0 {
        at += period;
    }
    if at >= period {
        at -= period;
    }
    if at >= n {
        at = 2.0 * n - 1.0 - at;
    }
    if wrap == CLAMP {
        at = clamp(i, 0.0, n - 1.0);
    }
    min(u32::cast_from(max(at, 0.0)), size - 1)
}

/// Puts the four channels of each of a material's textures at a point into `values`; 1 where there is none.
#[cube]
fn put_textures(s: &[u32], texels: &[u32], material: usize, u: f32, v: f32, values: &mut Array<f32>) {
    for slot in 0..4usize {
        let mut r = 1.0f32;
        let mut g = 1.0f32;
        let mut b = 1.0f32;
        let mut a = 1.0f32;
        let texture = s[material + OF_TEXTURES + slot];
        if texture != NOTHING {
            r = 0.0;
            g = 0.0;
            b = 0.0;
            a = 0.0;
            let of = (s[TEXTURES] + texture * comptime!(TEXTURE as u32)) as usize;
            let width = s[of + 1];
            let height = s[of + 2];
            let x = u * f32::cast_from(width) - 0.5;
            let y = v * f32::cast_from(height) - 0.5;
            let is_linear = slot == 1 || slot == 2;
            for corner in 0..4u32 {
                let dx = f32::cast_from(corner & 1);
                let dy = f32::cast_from(corner >> 1);
                let column = wrapped(x.floor() + dx, width, s[of + 3]);
                let row = wrapped(y.floor() + dy, height, s[of + 4]);
                let fx = x - x.floor();
                let fy = y - y.floor();
                let weight = select(corner & 1 == 0, 1.0 - fx, fx) * select(corner >> 1 == 0, 1.0 - fy, fy);
                let texel = texels[(s[of] + row * width + column) as usize];
                r += weight * decoded(s, texel & 255, is_linear);
                g += weight * decoded(s, (texel >> 8) & 255, is_linear);
                b += weight * decoded(s, (texel >> 16) & 255, is_linear);
                a += weight * f32::cast_from(texel >> 24) / 255.0;
            }
        }
        values[slot * 4] = r;
        values[slot * 4 + 1] = g;
        values[slot * 4 + 2] = b;
        values[slot * 4 + 3] = a;
    }
}

#[cube]
fn decoded(s: &[u32], value: u32, is_linear: bool) -> f32 {
    let mut number = f32::cast_from(value) / 255.0;
    if !is_linear {
        number = float(s, (s[LINEAR] + value) as usize);
    }
    number
}

/// What a ray found.
#[cube]
pub fn surface(tree: &[u32], s: &[u32], texels: &[u32], found: &Found, #[comptime] textured: bool) -> Surface {
    let face = (s[FACES] + found.triangle * comptime!(FACE as u32)) as usize;
    let of_vertex = comptime!(VERTEX as u32);
    let corners = Corners {
        a: (s[VERTICES] + s[face] * of_vertex) as usize,
        b: (s[VERTICES] + s[face + 1] * of_vertex) as usize,
        c: (s[VERTICES] + s[face + 2] * of_vertex) as usize,
        u: found.u,
        v: found.v,
    };
    let material = (s[MATERIALS] + s[face + 3] * comptime!(MATERIAL as u32)) as usize;
    let a = read(s, corners.a);
    let mut flat = cross(sub(read(s, corners.b), a), sub(read(s, corners.c), a));
    let mut position = mixed3(s, &corners, 0);
    let mut normal = mixed3(s, &corners, 3);
    let mut instance = s[face + 4];
    let place = tree[1] as usize + found.placed as usize * PLACEMENT;
    if found.placed != NOTHING {
        position = transform_point(tree, place + WORLD_FROM_MESH, position);
        flat = transform_normal(tree, place, flat);
        normal = transform_normal(tree, place, normal);
        instance = tree[place + INSTANCE];
    }
    normal = unit(normal);
    let mut base = times(read(s, material), mixed3(s, &corners, 12));
    let mut alpha = float(s, material + 3);
    let mut roughness = float(s, material + ROUGHNESS);
    let mut metallic = float(s, material + METALLIC);
    let mut emission = read(s, material + EMISSION);
    if comptime!(textured) {
        let mut values = Array::<f32>::new(16usize);
        put_textures(s, texels, material, mixed(s, &corners, 10), mixed(s, &corners, 11), &mut values);
        base = times(base, V3 { x: values[0], y: values[1], z: values[2] });
        alpha *= values[3];
        roughness *= values[5];
        metallic *= values[6];
        emission = times(emission, V3 { x: values[12], y: values[13], z: values[14] });
        if s[material + OF_TEXTURES + 2] != NOTHING {
            let mut tangent = tangent_of(s, &corners);
            if found.placed != NOTHING {
                tangent.along = transform_direction(tree, place + WORLD_FROM_MESH, tangent.along);
            }
            if tangent.sign != 0.0 {
                let by = float(s, material + NORMAL_SCALE);
                let t = unit(along(tangent.along, -dot(normal, tangent.along), normal));
                let b = scale(cross(normal, t), select(tangent.sign < 0.0, -1.0f32, 1.0f32));
                let x = by * (2.0 * values[8] - 1.0);
                let y = by * (2.0 * values[9] - 1.0);
                normal = unit(along(along(scale(normal, 2.0 * values[10] - 1.0), x, t), y, b));
            }
        }
    }
    let mut opacity = 1.0f32;
    if s[material + OPACITY] == 1 {
        opacity = select(alpha >= float(s, material + CUTOFF), 1.0f32, 0.0f32);
    } else if s[material + OPACITY] == 2 {
        opacity = clamp(alpha, 0.0, 1.0);
    }
    Surface {
        position,
        flat: unit(flat),
        normal,
        base,
        roughness,
        metallic,
        specular: float(s, material + SPECULAR),
        emission,
        opacity,
        transmission: clamp(float(s, material + TRANSMISSION), 0.0, 1.0) * (1.0 - metallic),
        instance,
    }
}

/// Share of the light that a thin pane lets pass: neither reflected nor absorbed.
#[cube]
pub fn through(surface: &Surface, cosine: f32) -> V3 {
    let reflected = PANE + (1.0 - PANE) * schlick(cosine.abs());
    scale(surface.base, surface.transmission * (1.0 - reflected))
}

/// A coordinate beside a surface, from which rays do not meet it again.
#[cube]
fn beside(p: f32, normal: f32) -> f32 {
    let steps = i32::cast_from(256.0 * normal);
    let moved = f32::reinterpret(i32::reinterpret(p) + select(p < 0.0, -steps, steps));
    select(p.abs() < 0.03125, p + normal / 65536.0, moved)
}

/// A surface as a path from `direction` sees it.
#[cube]
pub fn vertex(s: &[u32], surface: &Surface, direction: V3) -> Vertex {
    let toward = scale(direction, -1.0);
    let side = select(dot(surface.flat, toward) < 0.0, -1.0f32, 1.0f32);
    let flat = scale(surface.flat, side);
    let mut normal = scale(surface.normal, side);
    // An interpolated normal may point away from where the surface is seen from: then it is bent just far enough.
    let cosine = dot(normal, toward);
    if cosine < 1e-3 {
        normal = unit(along(normal, 1e-3 - cosine, toward));
    }
    let frame = frame(normal);
    let outgoing = V3 { x: dot(frame.s, toward), y: dot(frame.t, toward), z: dot(frame.n, toward) };
    // Light that passes is not scattered.
    let base = scale(surface.base, 1.0 - surface.transmission);
    let bsdf = bsdf::bsdf(s, s[SHARES] as usize, base, surface.roughness, surface.metallic, surface.specular, outgoing);
    let position =
        V3 { x: beside(surface.position.x, flat.x), y: beside(surface.position.y, flat.y), z: beside(surface.position.z, flat.z) };
    Vertex { position, flat, frame, bsdf, is_seen: outgoing.z > 0.0 }
}

/// A direction of the world in the frame of a vertex.
#[cube]
pub fn local(f: &Frame, d: V3) -> V3 {
    V3 { x: dot(f.s, d), y: dot(f.t, d), z: dot(f.n, d) }
}

/// A direction of that frame in the world.
#[cube]
pub fn world(f: &Frame, d: V3) -> V3 {
    along(along(scale(f.s, d.x), d.y, f.t), d.z, f.n)
}

/// Probability with which a ray passes a pane.
#[cube]
pub fn chance_through(share: V3) -> f32 {
    clamp(luminance(share), 0.0, 0.98)
}
