//! [`Rng`] on the device, bit for bit, in pairs of 32-bit numbers.

use cubecl::prelude::*;
use diorama_geom::rng::Rng;

/// A 64-bit number.
#[derive(CubeType, Clone, Copy)]
pub(crate) struct Wide {
    pub high: u32,
    pub low: u32,
}

/// The upper and lower half, for a launch.
pub(crate) fn halves(v: u64) -> (u32, u32) {
    ((v >> 32) as u32, v as u32)
}

/// A stream's key, for a launch.
pub(crate) fn key(rng: &Rng) -> (u32, u32) {
    halves(rng.key())
}

#[cube]
pub(crate) fn product(a: &Wide, b: &Wide) -> Wide {
    Wide { high: a.low.mul_hi(b.low) + a.low * b.high + a.high * b.low, low: a.low * b.low }
}

#[cube]
pub(crate) fn sum(a: &Wide, b: &Wide) -> Wide {
    let low = a.low + b.low;
    let mut high = a.high + b.high;
    if low < a.low {
        high += 1;
    }
    Wide { high, low }
}

/// `z ^ (z >> by)` for `by` from 1 to 31.
#[cube]
fn fold(z: &Wide, #[comptime] by: u32) -> Wide {
    Wide { high: z.high ^ (z.high >> by), low: z.low ^ ((z.low >> by) | (z.high << comptime!(32 - by))) }
}

#[cube]
fn mix(z: &Wide) -> Wide {
    let a = product(&fold(z, 30u32), &Wide { high: 0xbf58_476du32, low: 0x1ce4_e5b9u32 });
    let b = product(&fold(&a, 27u32), &Wide { high: 0x94d0_49bbu32, low: 0x1331_11ebu32 });
    fold(&b, 31u32)
}

/// [`Rng::bits`]
#[cube]
pub(crate) fn bits(key: &Wide, counter: &Wide) -> Wide {
    let z = mix(&sum(&product(counter, &Wide { high: 0x9e37_79b9u32, low: 0x7f4a_7c15u32 }), key));
    mix(&Wide { high: key.high ^ z.high, low: key.low ^ z.low })
}

/// [`Rng::uniform`]
#[cube]
pub(crate) fn uniform(key: &Wide, counter: &Wide) -> f32 {
    f32::cast_from(bits(key, counter).high >> 8) * comptime!(1.0 / (1u32 << 24) as f32)
}

/// [`Rng::below`] for `n` that fits 32 bits.
#[cube]
pub(crate) fn below(key: &Wide, counter: &Wide, n: u32) -> u32 {
    let b = bits(key, counter);
    let low = b.high * n;
    let mut high = b.high.mul_hi(n);
    let carried = low + b.low.mul_hi(n);
    if carried < low {
        high += 1;
    }
    high
}

/// A 32-bit number as a wide one.
#[cube]
pub(crate) fn widened(low: u32) -> Wide {
    Wide { high: 0u32, low }
}
