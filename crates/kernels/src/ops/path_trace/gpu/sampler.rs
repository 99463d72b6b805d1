//! The CPU's random numbers, bit for bit.

use cubecl::prelude::*;

/// Two numbers in `[0, 1)`.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Pair {
    pub first: f32,
    pub second: f32,
}

/// A hash of good avalanche.
#[cube]
pub fn hash(x: u32) -> u32 {
    let a = (x ^ (x >> 16)) * 0x7feb_352du32;
    let b = (a ^ (a >> 15)) * 0x846c_a68bu32;
    b ^ (b >> 16)
}

/// Owen scrambling of reversed bits.
#[cube]
fn scramble_reversed(x: u32, seed: u32) -> u32 {
    let a = x + seed;
    let b = a ^ (a * 0x6c50_b47cu32);
    let c = b ^ (b * 0xb82f_1e52u32);
    let d = c ^ (c * 0xc7af_e638u32);
    d ^ (d * 0x8d22_f6e6u32)
}

/// Sobol's second dimension with reversed bits.
#[cube]
fn pascal(x: u32) -> u32 {
    let a = x ^ ((x >> 1) & 0x5555_5555u32);
    let b = a ^ ((a >> 2) & 0x3333_3333u32);
    let c = b ^ ((b >> 4) & 0x0f0f_0f0fu32);
    let d = c ^ ((c >> 8) & 0x00ff_00ffu32);
    d ^ ((d >> 16) & 0x0000_ffffu32)
}

#[cube]
fn unit(bits: u32) -> f32 {
    f32::cast_from(bits >> 8) * comptime!(1.0 / (1u32 << 24) as f32)
}

/// The pair of a dimension of sample `index`, for the seed of a pixel.
#[cube]
pub fn pair(seed: u32, index: u32, dimension: u32) -> Pair {
    let salted = hash(seed ^ (dimension * 0x9e37_79b9u32));
    let shuffled = scramble_reversed(index.reverse_bits(), salted).reverse_bits();
    let first = scramble_reversed(shuffled, hash(salted ^ 0x68bc_21ebu32));
    let second = scramble_reversed(pascal(shuffled), hash(salted ^ 0x02e5_be93u32));
    Pair { first: unit(first.reverse_bits()), second: unit(second.reverse_bits()) }
}

/// The number of a dimension of sample `index` that pays no regard to other samples.
#[cube]
pub fn one(seed: u32, index: u32, dimension: u32) -> f32 {
    unit(hash(seed ^ (index * 0x85eb_ca6bu32) ^ (dimension * 0x9e37_79b9u32)))
}
