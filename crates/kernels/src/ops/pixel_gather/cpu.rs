//! One multiplication per 8- or 16-bit value; half floats by the hardware's conversion where there is one.

use super::words_per_pixel;
use diorama_geom::PixelFormat;
use half::f16;

/// Floats of one pixel, of which the first words are given (the second counts where a pixel has two).
#[inline]
pub fn convert(format: PixelFormat, words: [u32; 2]) -> [f32; 4] {
    let sixteen = |k: usize| (words[k / 2] >> (16 * (k % 2))) as u16;
    match format {
        PixelFormat::Unorm8 => words[0].to_le_bytes().map(|v| v as f32 * (1.0 / 255.0)),
        PixelFormat::Unorm16 => std::array::from_fn(|k| sixteen(k) as f32 * (1.0 / 65535.0)),
        PixelFormat::Half => std::array::from_fn(|k| f16::from_bits(sixteen(k)).to_f32()),
    }
}

/// Fills `out` `[R, 4]` from the pixels `at` `[R]` of `words`.
pub fn gather(format: PixelFormat, words: &[u32], at: &[usize], out: &mut [f32]) {
    let n = words_per_pixel(format);
    for (&i, o) in at.iter().zip(out.chunks_exact_mut(4)) {
        o.copy_from_slice(&convert(format, [words[i * n], words[i * n + n - 1]]));
    }
}
