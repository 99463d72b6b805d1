//! Density of a field and its gradient with respect to position, both of which a loss may act on: `σ = a(r)`, `∇σ = a'(r) Jᵀ g`, with
//! the density before its activation `r`, its gradient `g = ∂r/∂f` with respect to the features, and `J = ∂f/∂x`.
//!
//! The layers before the density are piecewise linear, so that `r` is, at each sample, a linear function of the features and `g` the
//! product of the layers' weights and slopes. Its backward pass is of first order and exact almost everywhere: for gradients `d_σ` and
//! `d_∇` let `δ = a' d_σ + a'' d_∇ · Jᵀ g`, the gradient of `r`, and `v = a' d_∇`. Pushing `y = δ f + J v` through the layers as they
//! act on the sample (slopes fixed, biases times `δ`) gives the inputs `y_j` of each layer, and with `u_j = ∂r/∂(layer j before its
//! activation)` the gradient of its weight is `y_jᵀ u_j`, of its bias `δ u_j`; the features have `δ g`, and a hash grid's table has `g`
//! along `v` besides. Positions get no gradient.

pub mod cpu;
pub mod reference;
mod rows;
#[cfg(test)]
mod tests;

use super::field_step::{BlockEncoding, FieldNet};
use super::fused_mlp::{Head, Layer, Source};
use super::hash_grid::HashGrid;
use super::linear::Activation;
use crate::gemm::Precision;

/// The layers of a [`FieldNet`] that its density depends on.
#[derive(Clone, Debug, PartialEq)]
pub struct DensityNet {
    /// The last is the density head's; sources are renumbered.
    layers: Vec<Layer>,
    /// First parameter of each layer.
    offsets: Vec<usize>,
    /// Rows of each layer's weight.
    fan_in: Vec<usize>,
    /// Of the density, in the last layer.
    head: Head,
    /// Numbers per encoded position.
    input: usize,
    precision: Precision,
    params_len: usize,
}

/// Why a density has no gradient that could be trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Undifferentiable {
    /// A layer reads a code of the ray.
    ReadsCode { layer: usize, input: usize },
    /// A layer's activation is neither none nor ReLU nor leaky ReLU.
    Smooth { layer: usize, activation: Activation },
}

impl std::fmt::Display for Undifferentiable {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        match self {
            Undifferentiable::ReadsCode { layer, input } => {
                write!(f, "the density has no gradient to train: its layer {layer} reads code {input}; let it read the position alone")
            }
            Undifferentiable::Smooth { layer, activation } => {
                write!(
                    f,
                    "the density has no gradient to train: its layer {layer} has the activation {activation:?}; use Relu or LeakyRelu"
                )
            }
        }
    }
}

impl std::error::Error for Undifferentiable {}

impl DensityNet {
    /// The density's part of a network.
    ///
    /// # Errors
    /// When a layer of it reads a code, is modulated by one, or has a smooth activation.
    pub fn new(net: &FieldNet) -> Result<DensityNet, Undifferentiable> {
        let (mlp, last) = (&net.mlp, net.density.layer);
        let mut is_read = vec![false; last + 1];
        is_read[last] = true;
        for (j, layer) in mlp.layers[..=last].iter().enumerate().rev() {
            if !is_read[j] {
                continue;
            }
            if let Some(input) = layer.modulation {
                return Err(Undifferentiable::ReadsCode { layer: j, input });
            }
            if !matches!(layer.activation, Activation::None | Activation::Relu | Activation::LeakyRelu) {
                return Err(Undifferentiable::Smooth { layer: j, activation: layer.activation });
            }
            for s in &layer.inputs {
                match *s {
                    Source::Layer(i) => is_read[i] = true,
                    Source::Input(0) => {}
                    Source::Input(input) => return Err(Undifferentiable::ReadsCode { layer: j, input }),
                }
            }
        }
        let kept: Vec<usize> = (0..=last).filter(|j| is_read[*j]).collect();
        let renumbered = |s: &Source| match *s {
            Source::Layer(i) => Source::Layer(kept.partition_point(|k| *k < i)),
            input => input,
        };
        let layer = |j: &usize| Layer { inputs: mlp.layers[*j].inputs.iter().map(renumbered).collect(), ..mlp.layers[*j].clone() };
        Ok(DensityNet {
            layers: kept.iter().map(layer).collect(),
            offsets: kept.iter().map(|j| mlp.offsets[*j]).collect(),
            fan_in: kept.iter().map(|j| mlp.fan_in(*j)).collect(),
            head: Head { layer: kept.len() - 1, ..net.density },
            input: mlp.input_widths[0],
            precision: mlp.precision,
            params_len: mlp.params_len(),
        })
    }

    /// Numbers per encoded position.
    pub fn input_width(&self) -> usize {
        self.input
    }

    fn source_width(&self, s: Source) -> usize {
        match s {
            Source::Input(_) => self.input,
            Source::Layer(j) => self.layers[j].width,
        }
    }
}

/// Points at which a density is evaluated, in the encoder's coordinates.
#[derive(Clone, Copy)]
pub enum DensityPoints<'a> {
    /// Points `[N, 3]` of a hash grid with their features `[L, N, F]`.
    Hash { grid: &'a HashGrid, table: &'a [f32], points: &'a [f32], features: &'a [f32] },
    /// Points `[N, 3]` that are encoded block by block.
    Encoded { encoding: BlockEncoding, points: &'a [f32] },
}

impl DensityPoints<'_> {
    /// Number of points.
    pub fn len(&self) -> usize {
        match self {
            DensityPoints::Hash { points, .. } | DensityPoints::Encoded { points, .. } => points.len() / 3,
        }
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Gradients of a loss; an empty slice stands for zeros.
#[derive(Clone, Copy, Default)]
pub struct DensityGradients<'a> {
    /// Of the densities, `[N]`.
    pub sigma: &'a [f32],
    /// Of the densities' gradients, `[N, 3]`.
    pub gradient: &'a [f32],
}
