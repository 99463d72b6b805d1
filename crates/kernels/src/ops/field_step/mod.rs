//! Training step of the standard field in one pass: encoded positions → networks → compositing → loss → gradients, block
//! by block, so that activations never leave the cache. It serves every field made of an
//! encoding and a [`Mlp`]: instant-ngp's hash grid (features computed beforehand, level by level), and
//! NeRF's frequency encoding (computed inside the block).
//!
//! It takes gradients for composited outputs, depth, opacity and each weight through [`RayLoss`], and returns those
//! of the parameters, the encoded or raw positions, per-ray codes and background, so that appearance
//! embeddings, distortion loss and camera refinement stay on this path. A loss that sees all rays at once is a
//! [`BatchLoss`]; gradients that come from elsewhere, for example from an image network, are [`InjectedGradients`].
//! The reference is the composition of the others'.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
mod disjoint;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod infer;
pub mod reference;
mod shares;
pub mod step;
#[cfg(test)]
mod tests;

use super::frequency::{self, Frequency};
use super::fused_mlp::{Head, Mlp};
use super::triangle_wave;

pub use step::{Beside, Extras, StepBuffers, StepInput, StepOutput, run};

/// A network that maps an encoded position and per-ray codes to a density and to what is composited with it.
///
/// The network's input 0 is the encoded position; input `1 + i` is per-ray code `i`; a second encoding of the position ([`Beside`]) comes last.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldNet {
    pub mlp: Mlp,
    pub density: Head,
    /// Color first, where the field has one. Composited side by side, `C` channels in all.
    pub outputs: Vec<Output>,
}

/// Some channels that a field composites, for example color, labels or a feature vector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Output {
    pub head: Head,
    pub channels: usize,
    /// Whether a softmax over the channels makes them shares; the head then has no activation.
    pub are_shares: bool,
}

impl FieldNet {
    /// A network with a density and a color of three channels.
    pub fn of_color(mlp: Mlp, density: Head, color: Head) -> FieldNet {
        FieldNet { mlp, density, outputs: vec![Output { head: color, channels: 3, are_shares: false }] }
    }

    /// Head of the color.
    ///
    /// # Panics
    /// When the field has none.
    pub fn color(&self) -> &Head {
        &self.outputs.first().filter(|o| o.channels == 3).expect("a field with a color").head
    }

    /// Head of the color, mutable.
    ///
    /// # Panics
    /// When the field has none.
    pub fn color_mut(&mut self) -> &mut Head {
        &mut self.outputs.first_mut().filter(|o| o.channels == 3).expect("a field with a color").head
    }

    /// Channels of all outputs, `C`.
    pub fn channels(&self) -> usize {
        self.outputs.iter().map(|o| o.channels).sum()
    }

    /// The density and the outputs: head and channels of each.
    pub fn heads(&self) -> impl Iterator<Item = (Head, usize)> + '_ {
        [(self.density, 1)].into_iter().chain(self.outputs.iter().map(|o| (o.head, o.channels)))
    }
}

/// How positions reach the network.
pub enum Positions<'a> {
    /// Level-major features `[L, S, F]` of a hash grid; in a backward pass they are replaced by their gradients if those are `wanted`.
    Features { data: &'a mut [f32], levels: usize, width: usize, wanted: bool },
    /// Positions `[S, D]`, encoded in the block; in space, `D` is 3. Gradients `[S, D]` are written where asked for.
    Encoded { encoding: BlockEncoding, points: &'a [f32], d_points: Option<&'a mut [f32]> },
}

/// An encoding without parameters, which is computed inside the block.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BlockEncoding {
    Frequency(Frequency),
    TriangleWave { bands: usize },
}

impl BlockEncoding {
    /// Coordinates of a position.
    pub fn dims(&self) -> usize {
        match self {
            BlockEncoding::Frequency(f) => f.dims,
            BlockEncoding::TriangleWave { .. } => 3,
        }
    }

    /// Numbers per position.
    pub fn output_dims(&self) -> usize {
        match self {
            BlockEncoding::Frequency(f) => f.output_dims(),
            BlockEncoding::TriangleWave { bands } => 3 * bands,
        }
    }

    /// Points `[N, D]` to rows `[N, output_dims]`.
    pub fn forward(&self, points: &[f32], out: &mut [f32]) {
        match self {
            BlockEncoding::Frequency(f) => frequency::cpu::forward(f, points, out),
            BlockEncoding::TriangleWave { bands } => triangle_wave::cpu::forward(3, *bands, points, out),
        }
    }

    /// Derivatives `[N, output_dims]` along `v` `[N, D]`, overwritten.
    pub fn tangent(&self, points: &[f32], v: &[f32], out: &mut [f32]) {
        match self {
            BlockEncoding::Frequency(f) => frequency::cpu::tangent(f, points, v, out),
            BlockEncoding::TriangleWave { bands } => triangle_wave::cpu::tangent(3, *bands, points, v, out),
        }
    }

    /// Gradient of the points, overwritten.
    pub fn backward(&self, points: &[f32], d: &[f32], d_points: &mut [f32]) {
        match self {
            BlockEncoding::Frequency(f) => frequency::cpu::backward(f, points, d, d_points),
            BlockEncoding::TriangleWave { bands } => triangle_wave::cpu::backward(3, *bands, points, d, d_points),
        }
    }
}

/// A code shared by all samples of a ray, for example encoded direction or appearance embedding.
pub struct RayCode<'a> {
    /// `[R, K]`
    pub values: &'a [f32],
    pub width: usize,
    /// `[R, K]`, overwritten in a backward pass.
    pub gradient: Option<&'a mut [f32]>,
}

/// The composited outputs of a ray.
#[derive(Clone, Copy, Debug)]
pub struct RayOutput<'a> {
    /// With the background behind them, `[C]`.
    pub values: &'a [f32],
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
    /// `[C]`
    pub values: &'a mut [f32],
    pub opacity: f32,
    pub depth: f32,
    pub weights: &'a mut [f32],
}

/// A loss that is a sum over rays.
pub trait RayLoss: Sync {
    /// The loss of ray `r`; fills in its gradient.
    fn ray(&self, r: usize, out: &RayOutput, gradient: &mut RayGradient) -> f64;
}

/// The composited outputs of a batch of rays.
#[derive(Clone, Copy, Debug)]
pub struct RayOutputs<'a> {
    /// `[R, C]`, background included.
    pub values: &'a [f32],
    /// `[R]`
    pub opacity: &'a [f32],
    /// `Σ w t`, `[R]`
    pub depth: &'a [f32],
}

/// Gradients of a loss for a batch of rays.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RayGradients {
    /// `[R, C]`
    pub values: Vec<f32>,
    /// `[R]`
    pub opacity: Vec<f32>,
    /// `[R]`
    pub depth: Vec<f32>,
}

impl RayGradients {
    /// Zeros for `rays` rays of `channels` channels.
    pub fn clear(&mut self, rays: usize, channels: usize) {
        for (v, n) in [(&mut self.values, rays * channels), (&mut self.opacity, rays), (&mut self.depth, rays)] {
            v.clear();
            v.resize(n, 0.0);
        }
    }
}

/// A loss that is a function of all rays of a batch together, for example of the structure of patches. A sum over rays is a
/// [`RayLoss`], which needs no second evaluation of the network.
pub trait BatchLoss: Sync {
    /// The loss; fills in its gradients, which are zero on entry.
    fn batch(&self, out: &RayOutputs, gradients: &mut RayGradients) -> f64;

    /// Weight of the distortion loss besides, whose mean over the rays is added.
    fn distortion(&self) -> f32 {
        0.0
    }
}

/// A loss of value 0 whose gradients were computed elsewhere.
#[derive(Clone, Copy, Debug)]
pub struct InjectedGradients<'a>(pub &'a RayGradients);

impl RayLoss for InjectedGradients<'_> {
    fn ray(&self, r: usize, out: &RayOutput, gradient: &mut RayGradient) -> f64 {
        let c = out.values.len();
        gradient.values.copy_from_slice(&self.0.values[r * c..(r + 1) * c]);
        (gradient.opacity, gradient.depth) = (self.0.opacity[r], self.0.depth[r]);
        0.0
    }
}
