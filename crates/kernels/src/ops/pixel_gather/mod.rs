//! Colors of chosen pixels: packed RGBA frames to floats, alpha straight.
//!
//! A pixel is one word of 8-bit values, or two words of 16-bit values or half floats; red is lowest.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use diorama_geom::PixelFormat;

/// Words of 32 bits that a pixel takes.
pub fn words_per_pixel(format: PixelFormat) -> usize {
    format.bytes() / 4
}
