//! Features at the corners of the occupied voxels of a sparse world (GANcraft, section 3.1): each voxel
//! names eight rows of a feature table, and a point takes their trilinear mix.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Which rows the samples mix. Corner `c` of a voxel is its lowest corner plus bit `k` of `c` along axis `k`.
#[derive(Clone, Copy, Debug)]
pub struct Corners<'a> {
    /// Rows of each voxel's corners, `[voxels, 8]`.
    pub rows: &'a [u32],
    /// Voxel of each sample, `[S]`.
    pub voxel: &'a [u32],
}
