//! Blends colors across silhouettes between pixels, through which positions get the gradient of visibility (Laine et al. 2020, "Modular
//! Primitives for High-Performance Differentiable Rendering").
//!
//! Of two pixels side by side that show different triangles, the nearer surface may end between their centers: at a silhouette, an edge that
//! has no other triangle, or one on the same side in the picture. If the edge crosses the segment between the centers at distance `d`
//! from the nearer one, a share `|½ − d|` of a neighbor's color covers a pixel:
//! `c_near += (½ − d)(c_far − c_near)` for `d < ½`, else `c_far += (d − ½)(c_near − c_far)`. Edges that are closer to vertical than to
//! horizontal blend pixels of one row, the others pixels of one column, so that a pixel's coverage counts once.
//!
//! The paper looks at edges of the visible triangle alone, and misses silhouettes of fine meshes, whose last triangles hold no pixel's
//! center. Here the surface can be followed along the segment, from triangle to triangle ([`Antialias::follow`]).

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;
mod topology;

pub use topology::Topology;

/// Antialiasing of colors `[N, H, W, C]` by positions `[N, V, 4]` in clip space.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Antialias {
    /// N
    pub images: usize,
    /// V, of each image.
    pub vertices: usize,
    /// `[H, W]`
    pub size: [usize; 2],
    /// C
    pub channels: usize,
    /// Triangles beyond the visible one that are searched for the silhouette; 0 is the paper's method.
    pub follow: usize,
}

/// A silhouette's edge between the centers of two pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crossing {
    /// Pixel of the triangle that the edge belongs to, and the one beside it, among those of all images.
    pub near: u32,
    pub far: u32,
    /// Distance of the crossing from the nearer one, in 0..=1 pixels.
    pub distance: f32,
    /// Vertices of the edge.
    pub edge: [u32; 2],
}

/// What [`rasterize`](crate::ops::rasterize) gave: ids and depths, `[N, H, W]`.
#[derive(Clone, Copy, Debug)]
pub struct Visible<'a> {
    pub ids: &'a [u32],
    pub depth: &'a [f32],
}
