//! Nearest triangle at every pixel's center, with perspective-correct barycentrics through which positions get their gradient (Laine et al.
//! 2020, "Modular Primitives for High-Performance Differentiable Rendering").
//!
//! Edge functions are those of homogeneous coordinates (Olano and Greer 1997), which need no clipping: with `M = [p₀ p₁ p₂]` for corners
//! `pᵢ = (x, y, w)` in pixels and `q = (X, Y, 1)`, the weights `β = M⁻¹ q` are all positive where the triangle covers the pixel before the
//! camera, `(u, v) = (β₀, β₁) / Σβ`, and `z/w = Σ βᵢ zᵢ` is a plane.
//!
//! # Conventions
//! - A pixel's center is `((x + 0.5), (y + 0.5))`. Row 0 is the top of the picture, and y of clip space points *down*, as in cameras here:
//!   `pixel = (clip.xy / clip.w + 1) / 2 · [W, H]`.
//! - A point is visible where `−w ≤ z ≤ w`; smaller z/w is nearer. Both sides of triangles are drawn.
//! - A point of the triangle `a b c` is `u a + v b + (1 − u − v) c`.
//! - Vertices before the camera, and not far outside of the picture, are first moved to a grid of 1/256 pixel, and keep their depth; gradients
//!   pass as if they had not been moved. What triangles of such vertices cover is computed in integers, without rounding.
//! - A center on an edge that two triangles share belongs to exactly one of them (top-left rule). Of triangles at one depth, the first wins.

mod backward;
mod bins;
pub mod cpu;
pub mod reference;
mod setup;
#[cfg(test)]
mod tests;

pub use backward::{Upstream, backward};

/// Edge of the tiles that triangles are sorted into, in pixels.
const TILE: usize = 16;

/// Steps per pixel of the grid that vertices are moved to.
const GRID: f64 = 256.0;
/// Steps from the picture's corner to the farthest vertices on the grid: 2¹⁵ pixels.
const WIDEST: f64 = 8_388_608.0;

/// Rasterization of positions `[N, V, 4]` in clip space, which gives `[N, H, W]` pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rasterize {
    /// N
    pub images: usize,
    /// V, of each image.
    pub vertices: usize,
    /// `[H, W]`
    pub size: [usize; 2],
}

impl Rasterize {
    /// Pixels of all images.
    pub fn pixels(&self) -> usize {
        self.images * self.size[0] * self.size[1]
    }

    fn check(&self, positions: usize, triangles: &[[u32; 3]]) {
        assert_eq!(positions, self.images * self.vertices * 4, "rasterize: positions");
        assert!(self.size.iter().all(|n| *n <= 1 << 15), "rasterize: size {:?}", self.size);
        check_triangles("rasterize", triangles, self.vertices);
    }
}

/// Panics when a triangle names a vertex beyond `vertices`.
pub(crate) fn check_triangles(op: &str, triangles: &[[u32; 3]], vertices: usize) {
    let most = triangles.iter().flatten().fold(None, |most, v| most.max(Some(*v)));
    assert!(most.is_none_or(|v| (v as usize) < vertices), "{op}: vertex {most:?} of {vertices}");
    assert!(triangles.len() < u32::MAX as usize, "{op}: too many triangles");
}

/// What pixels show.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Raster {
    /// Index of the triangle plus 1, or 0 for none, `[N, H, W]`.
    pub ids: Vec<u32>,
    /// Barycentrics, `[N, H, W, 2]`; 0 where there is no triangle, as in all that follows.
    pub uv: Vec<f32>,
    /// z/w, `[N, H, W]`.
    pub depth: Vec<f32>,
    /// Screen derivatives `∂u/∂X, ∂u/∂Y, ∂v/∂X, ∂v/∂Y` per pixel, `[N, H, W, 4]`; empty unless asked for.
    pub derivatives: Vec<f32>,
}
