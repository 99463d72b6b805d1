//! Attributes of vertices at pixels, `u a + v b + (1 − u − v) c`, and their screen derivatives (Laine et al. 2020).

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Interpolation of attributes `[V, A]`, or `[N, V, A]` of their own for each image, at the pixels of a raster, which gives
/// `[N, H, W, A]`.
///
/// Triangles name the attributes of their corners; they may differ from the triangles of positions, whose order they share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Interpolate {
    /// N
    pub images: usize,
    /// `H · W`
    pub pixels: usize,
    /// V
    pub vertices: usize,
    /// A
    pub attributes: usize,
    /// Whether every image has attributes of its own.
    pub per_image: bool,
}
