//! Removal of samples that cannot matter before the costly part of a step: those behind opaque matter (instant-ngp ends rays where
//! the transmittance falls below 1e-4) and those that hold next to nothing (nerfacc, Li et al. 2023, the alpha threshold).
//!
//! With transmittance `T`, opacity `α = 1 − e^(−σ δ)` and length `δ`, a sample stays where `T ≥ stop`, `α ≥ min(min_alpha, thin · δ)`
//! and `T α ≥ min_weight`. Samples that are left out for their opacity still take their share of the light.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Limits below which samples are left out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pruning {
    /// Samples behind which less than this share of light arrives.
    pub stop: f32,
    /// Samples of less opacity than this, unless they are denser than `thin`.
    pub min_alpha: f32,
    /// Density per inner cube from which a sample is never left out for its opacity, however short its step.
    pub thin: f32,
    /// Samples of less weight in the pixel than this.
    pub min_weight: f32,
}

/// Mark of a sample that is left out, and density of one that no light reaches.
pub const DROPPED: f32 = -1.0;
