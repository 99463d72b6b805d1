//! Values of an image at the points of a grid, whose coordinates −1 and 1 are the image's borders (Jaderberg et al. 2015).

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// How a value between pixels is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    Bilinear,
    /// The next pixel, halves to the even one; the grid gets no gradient.
    Nearest,
}

/// What lies outside of the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outside {
    Zeros,
    /// The next pixel of the border.
    Border,
}

/// Sampling of x `[N, C, H, W]` at a grid `[N, H', W', 2]` of (x, y), which gives `[N, C, H', W']`.
#[derive(Clone, Copy, Debug)]
pub struct GridSample {
    pub mode: Mode,
    pub outside: Outside,
    /// Whether −1 and 1 are the centers of the outermost pixels, or their outer edges.
    pub align_corners: bool,
    pub images: usize,
    pub channels: usize,
    /// `[H, W]`
    pub from: [usize; 2],
    /// `H' W'`
    pub points: usize,
}
