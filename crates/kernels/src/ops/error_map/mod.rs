//! Mean error of the parts of training images, by which pixels are drawn (instant-ngp, error-driven sampling). Each image has [`CELLS`]²
//! cells. A ray mixes its squared error into its cell, `e ← 0.9 e + 0.1 error`, and a cell is drawn with a probability proportional to `√e`.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Cells per side of an image.
pub const CELLS: usize = 16;

/// Share of its error that a cell keeps per ray.
pub(crate) const KEPT: f32 = 0.9;

/// Errors of all images' cells, and the distribution of draws.
#[derive(Clone, Debug)]
pub struct ErrorMap {
    /// `[images, CELLS, CELLS]`
    pub errors: Vec<f32>,
    /// The errors that draws go by: a copy as of the last refresh.
    pub drawn: Vec<f32>,
    /// Sums of the roots of `drawn` up to each cell.
    cdf: Vec<f32>,
}

/// Cell of a point of an image, given in shares of its width and height.
pub(crate) fn cell_at(image: usize, u: f32, v: f32) -> usize {
    let cell = |t: f32| ((t * CELLS as f32) as usize).min(CELLS - 1);
    (image * CELLS + cell(v)) * CELLS + cell(u)
}
