//! Random training pixels. Attempt `a` of ray `i` reads numbers `16 (first + i) + 1 + 3 a ..` of a random stream; a pixel that a mask
//! refuses is drawn again, up to [`ATTEMPTS`] times. Half of the rays go where errors are high if there is an [`ErrorMap`], and every
//! eighth ray goes through a pixel of known distance if there are any.
//!
//! Errors weigh the draw but not the loss: the objective shifts towards hard pixels, as in instant-ngp.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use super::error_map::ErrorMap;
use diorama_geom::rng::Rng;

/// Attempts to draw an unmasked pixel before a ray is left out.
pub const ATTEMPTS: u32 = 5;
/// Random numbers set aside per ray.
pub(crate) const NUMBERS: u32 = 16;
/// One training ray of so many goes through a pixel of known distance, where there are any.
pub const OBSERVED_EVERY: u32 = 8;
/// Rays of each 1024 that are drawn uniformly even with an error map.
pub(crate) const UNIFORM: u32 = 512;

/// Access to training pixels, wherever they lie.
pub trait PixelSource: Sync {
    fn images(&self) -> usize;
    fn size(&self, image: usize) -> (u32, u32);
    /// The pixel to take in place of one that is not stored: one close by, and always the same.
    fn snap(&self, _image: usize, x: u32, y: u32) -> (u32, u32) {
        (x, y)
    }
    /// Edge of the squares of which one pixel is stored.
    fn stride(&self) -> u32 {
        1
    }
    /// Straight RGBA in the photographs' own space: sRGB, or linear light, which may exceed 1.
    fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4];
    /// Whether the pixel may be trained on.
    fn counts(&self, image: usize, x: u32, y: u32) -> bool;
}

/// A pixel in which a point at a known distance is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    pub image: u32,
    pub x: u32,
    pub y: u32,
    /// From the camera, in model space.
    pub distance: f32,
}

/// Which pixels are drawn.
#[derive(Clone, Copy)]
pub struct Draw<'a> {
    pub rng: Rng,
    /// Counter of the first ray: the number of rays drawn so far.
    pub first: u64,
    pub error_map: Option<&'a ErrorMap>,
    /// Pixels of known distance.
    pub observations: &'a [Observation],
}

/// What transparent pixels are composited on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Backdrop {
    Color([f32; 3]),
    /// A random color for every ray.
    Random(Rng),
}
