//! Vectors of three numbers on the device, and numbers that are stored as bits.

use cubecl::prelude::*;

#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct V3 {
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

#[cube]
pub(crate) fn float(words: &[u32], at: usize) -> f32 {
    f32::reinterpret(words[at])
}

/// Three adjacent numbers.
#[cube]
pub(crate) fn read(words: &[u32], at: usize) -> V3 {
    V3 { x: float(words, at), y: float(words, at + 1), z: float(words, at + 2) }
}

#[cube]
pub(crate) fn dot(a: V3, b: V3) -> f32 {
    a.x * b.x + a.y * b.y + a.z * b.z
}

#[cube]
pub(crate) fn cross(a: V3, b: V3) -> V3 {
    V3 { x: a.y * b.z - a.z * b.y, y: a.z * b.x - a.x * b.z, z: a.x * b.y - a.y * b.x }
}

#[cube]
pub(crate) fn sub(a: V3, b: V3) -> V3 {
    V3 { x: a.x - b.x, y: a.y - b.y, z: a.z - b.z }
}

/// `a + s b`
#[cube]
pub(crate) fn along(a: V3, s: f32, b: V3) -> V3 {
    V3 { x: a.x + s * b.x, y: a.y + s * b.y, z: a.z + s * b.z }
}

#[cube]
pub(crate) fn scale(a: V3, s: f32) -> V3 {
    V3 { x: a.x * s, y: a.y * s, z: a.z * s }
}

/// Product of each component.
#[cube]
pub(crate) fn times(a: V3, b: V3) -> V3 {
    V3 { x: a.x * b.x, y: a.y * b.y, z: a.z * b.z }
}

/// The vector scaled to length 1; `+z` in place of one without length.
#[cube]
pub(crate) fn unit(v: V3) -> V3 {
    let squared = dot(v, v);
    let s = 1.0 / max(squared, 1.2e-38).sqrt();
    V3 { x: v.x * s, y: v.y * s, z: select(squared > 0.0, v.z * s, 1.0f32) }
}

/// Luminance of linear RGB (Rec. 709).
#[cube]
pub(crate) fn luminance(c: V3) -> f32 {
    0.2126 * c.x + 0.7152 * c.y + 0.0722 * c.z
}

/// Affine transform of a direction, rows `[axis][x, y, z, 1]` from `at` on.
#[cube]
pub(crate) fn transform_direction(words: &[u32], at: usize, d: V3) -> V3 {
    V3 { x: dot(read(words, at), d), y: dot(read(words, at + 4), d), z: dot(read(words, at + 8), d) }
}

/// Affine transform of a point.
#[cube]
pub(crate) fn transform_point(words: &[u32], at: usize, p: V3) -> V3 {
    let d = transform_direction(words, at, p);
    V3 { x: d.x + float(words, at + 3), y: d.y + float(words, at + 7), z: d.z + float(words, at + 11) }
}

/// Transform of a normal by the inverse of its surface's transform.
#[cube]
pub(crate) fn transform_normal(words: &[u32], inverse: usize, n: V3) -> V3 {
    let a = along(scale(read(words, inverse), n.x), n.y, read(words, inverse + 4));
    along(a, n.z, read(words, inverse + 8))
}
