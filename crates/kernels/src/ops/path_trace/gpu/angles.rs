//! Angles in turns by polynomials, because devices' own functions may have few digits; see the CPU's.

use crate::gpu::vector::V3;
use cubecl::prelude::*;
use std::f32::consts::{FRAC_PI_2, PI};

/// A point of the unit circle.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Circle {
    pub sine: f32,
    pub cosine: f32,
}

/// Sine and cosine of an angle in turns.
#[cube]
pub fn sin_cos_turns(turns: f32) -> Circle {
    let quarters = 4.0 * (turns - turns.floor());
    let nearest = (quarters + 0.5).floor();
    let quadrant = u32::cast_from(nearest) & 3;
    let x = (quarters - nearest) * FRAC_PI_2;
    let x2 = x * x;
    let sine = x + x * x2 * (-1.666_665_5e-1f32 + x2 * (8.332_161e-3 + x2 * -1.951_529_6e-4f32));
    let cosine = 1.0f32 - 0.5f32 * x2 + x2 * x2 * (4.166_664_6e-2 + x2 * (-1.388_731_6e-3f32 + x2 * 2.443_315_7e-5));
    let is_even = (quadrant & 1) == 0;
    let a = select(is_even, sine, cosine);
    let b = select(is_even, cosine, sine);
    Circle { sine: select(quadrant >= 2, -a, a), cosine: select(quadrant == 1 || quadrant == 2, -b, b) }
}

/// Arc cosine of a number, which is first brought into −1 to 1.
#[cube]
pub fn arc_cosine(x: f32) -> f32 {
    let size = min(x.abs(), 1.0);
    let a = 0.006_670_09 - size * 0.001_262_491_1;
    let b = 0.030_891_88 + size * (-0.017_088_126f32 + size * a);
    let c = 0.088_978_98 + size * (-0.050_174_303f32 + size * b);
    let d = FRAC_PI_2 + size * (-0.214_598_8f32 + size * c);
    let angle = (1.0 - size).sqrt() * d;
    select(x < 0.0, PI - angle, angle)
}

/// Angle of `(sine, cosine)` times any length in turns, −½ to ½; 0 without length.
#[cube]
pub fn turns_of(sine: f32, cosine: f32) -> f32 {
    let s = sine.abs();
    let c = cosine.abs();
    let x = min(s, c) / max(max(s, c), 1.2e-38);
    let x2 = x * x;
    let a = -0.016_165_737f32 + x2 * 0.002_866_225_8;
    let b = -0.075_289_64f32 + x2 * (0.042_909_615 + x2 * a);
    let e = -0.142_089f32 + x2 * (0.106_562_64 + x2 * b);
    let p = -0.333_331_44f32 + x2 * (0.199_935_51 + x2 * e);
    let eighth = (x + x * x2 * p) * comptime!(0.5 / PI);
    let quarter = select(s <= c, eighth, 0.25 - eighth);
    let half = select(cosine < 0.0, 0.5 - quarter, quarter);
    select(sine < 0.0, -half, half)
}

/// An orthonormal frame: two vectors beside a third.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Frame {
    pub s: V3,
    pub t: V3,
    pub n: V3,
}

/// The frame whose third vector is `n`.
#[cube]
pub fn frame(n: V3) -> Frame {
    let sign = select(n.z < 0.0, -1.0f32, 1.0f32);
    let a = -1.0f32 / (sign + n.z);
    let b = n.x * n.y * a;
    Frame { s: V3 { x: 1.0 + sign * n.x * n.x * a, y: sign * b, z: -sign * n.x }, t: V3 { x: b, y: sign + n.y * n.y * a, z: -n.y }, n }
}
