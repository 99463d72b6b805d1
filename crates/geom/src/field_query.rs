//! Queries of a radiance field, for crates that do not know how it is computed, such as meshing.

/// A radiance field that can be evaluated at points of the world.
pub trait FieldQuery: Sync {
    /// Density in inverse world units at `points` `[N, 3]`, written to `sigma` `[N]`.
    fn density(&self, points_in_world: &[[f32; 3]], sigma: &mut [f32]);

    /// sRGB color seen at `points` `[N, 3]` along unit `directions` `[N, 3]`, written to `rgb` `[N, 3]`.
    fn color(&self, points_in_world: &[[f32; 3]], directions: &[[f32; 3]], rgb_srgb: &mut [[f32; 3]]);
}

/// Images of frames, decoded on first use.
pub trait ImageSource: Send + Sync {
    /// The pixels of frame `index`, or a one-line error that names the file.
    fn load(&self, index: usize) -> Result<crate::ImageU8, String>;
}
