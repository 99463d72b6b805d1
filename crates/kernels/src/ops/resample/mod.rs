//! Change of an image's size, and blur, by separable filters: every one is a table of weights per axis ([`Weights`]), a small sparse matrix,
//! of which backward applies the transpose. Also [pixel shuffle](shuffle) (Shi et al. 2016).

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
pub mod shuffle;
#[cfg(test)]
mod tests;
mod weights;

pub use weights::Weights;

/// How values between pixels are made. All but [`Filter::Bilinear`] and [`Filter::Nearest`] average over the pixels that a smaller image's pixel covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// The pixel whose corner is nearest, as PyTorch's `nearest`.
    Nearest,
    /// Between the two next pixels, without averaging. With `align_corners` the outermost pixels' centers coincide, else the images' edges.
    Bilinear { align_corners: bool },
    /// A triangle as wide as two pixels of the smaller image.
    BilinearAntialiased,
    /// Keys' cubic with a = −0.5, as wide as four pixels of the smaller image (PIL, PyTorch's `antialias=True`).
    BicubicAntialiased,
    /// Mean of the pixels that an output pixel touches (adaptive average pooling).
    Area,
}

/// A finite impulse response along one axis: `up − 1` zeros after each pixel, padding by zeros, the filter, every `down`-th value.
#[derive(Clone, Copy, Debug)]
pub struct Fir<'a> {
    /// Weights, such as 1 3 3 1 divided by 8; times `up` where brightness shall stay.
    pub taps: &'a [f32],
    pub up: usize,
    pub down: usize,
    /// Zeros before the first and after the last pixel.
    pub padding: [usize; 2],
}

/// Tables of both axes and their transposes, made once per pair of sizes.
#[derive(Clone, Debug)]
pub struct Resample {
    pub vertical: Weights,
    pub horizontal: Weights,
    pub vertical_transposed: Weights,
    pub horizontal_transposed: Weights,
}

impl Resample {
    /// From `[H, W]` to `[H', W']`.
    pub fn new(filter: Filter, from: [usize; 2], to: [usize; 2]) -> Resample {
        Resample::of(Weights::filter(filter, from[0], to[0]), Weights::filter(filter, from[1], to[1]))
    }

    /// The same response along both axes of `[H, W]`.
    pub fn fir(fir: &Fir, from: [usize; 2]) -> Resample {
        Resample::of(Weights::fir(fir, from[0]), Weights::fir(fir, from[1]))
    }

    pub(crate) fn of(vertical: Weights, horizontal: Weights) -> Resample {
        Resample { vertical_transposed: vertical.transposed(), horizontal_transposed: horizontal.transposed(), vertical, horizontal }
    }

    /// `[H, W]` of the input.
    pub fn from(&self) -> [usize; 2] {
        [self.vertical.inputs(), self.horizontal.inputs()]
    }

    /// `[H', W']` of the output.
    pub fn to(&self) -> [usize; 2] {
        [self.vertical.outputs(), self.horizontal.outputs()]
    }
}
