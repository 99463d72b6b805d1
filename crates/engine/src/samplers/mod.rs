//! Sampling: pixels and their rays, and the placement of samples on rays.

pub mod occupancy;
pub mod pixels;
pub mod placement;
pub mod stereo;

use diorama_kernels::ops::photometric_loss::Targets;

/// A batch of rays in model space with what they are to match.
#[derive(Clone, Debug, Default)]
pub struct RayBatch {
    /// Training image of each ray, `[R]`.
    pub images: Vec<u32>,
    /// Pixel coordinates, `[R, 2]`.
    pub pixels: Vec<f32>,
    /// `[R, 3]`
    pub origins: Vec<f32>,
    /// Unit length, `[R, 3]`.
    pub dirs: Vec<f32>,
    /// `[R, 2]`
    pub near_far: Vec<f32>,
    /// `[R]`
    pub jitter: Vec<f32>,
    /// Straight RGBA, `[R, 4]`.
    pub target: Vec<f32>,
    /// Distance of the surface along the ray where it is known, else 0, `[R]`.
    pub distance: Vec<f32>,
    /// Whether a ray has a pixel to be compared with, `[R]`.
    pub counts: Vec<bool>,
}

impl RayBatch {
    pub fn len(&self) -> usize {
        self.images.len()
    }

    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }

    /// What the rays are compared with, over a background `[R, 3]`.
    pub fn targets<'a>(&'a self, background: &'a [f32]) -> Targets<'a> {
        Targets { rgba: &self.target, background, counts: &self.counts, distance: &self.distance }
    }

    /// Makes room for `n` rays.
    pub fn resize(&mut self, n: usize) {
        self.images.resize(n, 0);
        self.jitter.resize(n, 0.0);
        self.distance.resize(n, 0.0);
        self.counts.resize(n, true);
        for (v, c) in [(&mut self.pixels, 2), (&mut self.origins, 3), (&mut self.dirs, 3), (&mut self.near_far, 2), (&mut self.target, 4)] {
            v.resize(n * c, 0.0);
        }
    }
}
