//! Plain loop.

use super::words_per_pixel;
use diorama_geom::PixelFormat;

/// `[R, 4]` for the pixels `at` `[R]` of `words`.
pub fn gather(format: PixelFormat, words: &[u32], at: &[usize]) -> Vec<f64> {
    let value = |i: usize, k: usize| match format {
        PixelFormat::Unorm8 => (words[i] >> (8 * k) & 255) as f64 / 255.0,
        _ => {
            let bits = words[i * words_per_pixel(format) + k / 2] >> (16 * (k % 2)) & 0xffff;
            if format == PixelFormat::Unorm16 { bits as f64 / 65535.0 } else { half(bits) }
        }
    };
    at.iter().flat_map(|&i| (0..4).map(move |k| (i, k))).map(|(i, k)| value(i, k)).collect()
}

/// A finite binary16 number: a sign, five bits of exponent, ten of fraction.
fn half(bits: u32) -> f64 {
    let (exponent, fraction) = ((bits >> 10 & 31) as i32, (bits & 1023) as f64 / 1024.0);
    let magnitude = if exponent == 0 { fraction * 2f64.powi(-14) } else { (1.0 + fraction) * 2f64.powi(exponent - 15) };
    if bits >> 15 == 1 { -magnitude } else { magnitude }
}
