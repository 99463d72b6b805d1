//! The standard field in one pass: encoded positions → networks → compositing → loss, and back, block
//! by block, so that activations never leave the cache. It serves every field made of an
//! encoding and a [`Mlp`]: instant-ngp's hash grid (features computed beforehand, level by level), and
//! NeRF's frequency encoding (computed inside the block).
//!
//! It takes gradients for colour, depth, opacity and each weight through [`RayLoss`], and returns those
//! of the parameters, the encoded or raw positions, per-ray codes and background, so that appearance
//! embeddings, distortion loss and camera refinement stay on this path. Its reference is the
//! composition of the others'.

mod disjoint;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod infer;
pub mod reference;
pub mod step;
#[cfg(test)]
mod tests;

use super::frequency::Frequency;
use super::fused_mlp::Mlp;
use super::linear::Activation;

pub use step::{StepBuffers, StepInput, StepOutput, run};

/// A network that maps an encoded position and per-ray codes to density and colour.
///
/// The network's input 0 is the encoded position; input `1 + i` is per-ray code `i`.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldNet {
    pub mlp: Mlp,
    pub sigma: Head,
    pub rgb: Head,
}

/// Where an output stands in the network: layer, first channel, activation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Head {
    pub layer: usize,
    pub channel: usize,
    pub activation: Activation,
    /// Added before the activation.
    pub shift: f32,
}

/// How positions reach the network.
pub enum Positions<'a> {
    /// Level-major features `[L, S, F]` of a hash grid; replaced by their gradients in a backward pass.
    Features { data: &'a mut [f32], levels: usize, width: usize },
    /// Positions `[S, 3]`, encoded in the block. Gradients `[S, 3]` are written where asked for.
    Encoded { encoding: Frequency, points: &'a [f32], d_points: Option<&'a mut [f32]> },
}

/// A code shared by all samples of a ray, for example encoded direction or appearance embedding.
pub struct RayCode<'a> {
    /// `[R, K]`
    pub values: &'a [f32],
    pub width: usize,
    /// `[R, K]`, overwritten in a backward pass.
    pub gradient: Option<&'a mut [f32]>,
}

/// What a ray came to.
#[derive(Clone, Copy, Debug)]
pub struct RayOutput<'a> {
    /// With the background behind it.
    pub rgb: [f32; 3],
    pub opacity: f32,
    /// `Σ w t`
    pub depth: f32,
    pub weights: &'a [f32],
    /// First sample of the ray in the packed arrays.
    pub first: usize,
}

/// Gradients of the loss for one ray; all zero on entry.
#[derive(Debug)]
pub struct RayGradient<'a> {
    pub rgb: [f32; 3],
    pub opacity: f32,
    pub depth: f32,
    pub weights: &'a mut [f32],
}

/// A loss that is a sum over rays.
pub trait RayLoss: Sync {
    /// The loss of ray `r`; fills in its gradient.
    fn ray(&self, r: usize, out: &RayOutput, gradient: &mut RayGradient) -> f64;
}
