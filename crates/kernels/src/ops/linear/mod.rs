//! A fully connected layer, `y = act(x W + b)`, of any width, with one bias for all rows or one per row.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::gemm::Precision;

/// Elementwise non-linearity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    None,
    Relu,
    Sigmoid,
    /// `ln(1 + eˣ)`
    Softplus,
    /// `eˣ`, whose gradient is taken at `min(x, 15)` (instant-ngp).
    TruncatedExp,
    /// `max(x, 0.2 x)`
    LeakyRelu,
    Tanh,
    /// `x / (1 + e⁻ˣ)` (Elfwing et al. 2018)
    Silu,
}

/// Slope of [`Activation::LeakyRelu`] below 0.
pub const LEAK: f64 = 0.2;

impl Activation {
    /// Whether the slope is a function of the output; else it needs the input.
    pub fn is_monotonic(self) -> bool {
        self != Activation::Silu
    }
}

/// What is added before the activation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BiasKind {
    None,
    /// `[N]`
    Shared,
    /// `[M, N]`
    PerRow,
}

impl BiasKind {
    /// Numbers of a bias for `m` rows of `n` outputs.
    pub fn len(self, m: usize, n: usize) -> usize {
        match self {
            BiasKind::None => 0,
            BiasKind::Shared => n,
            BiasKind::PerRow => m * n,
        }
    }
}

/// A layer on the CPU: `[rows, inputs] → [rows, outputs]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Linear {
    pub rows: usize,
    pub inputs: usize,
    pub outputs: usize,
    pub bias: BiasKind,
    pub activation: Activation,
    /// Arithmetic of inputs, weights and gradients; sums are f32.
    pub precision: Precision,
}

/// Destinations of a backward pass, overwritten; what is `None` is not computed.
#[derive(Default)]
pub struct Gradients<'a> {
    /// `[rows, inputs]`
    pub x: Option<&'a mut [f32]>,
    /// `[inputs, outputs]`
    pub w: Option<&'a mut [f32]>,
    /// As the bias.
    pub bias: Option<&'a mut [f32]>,
}

/// Shape of a layer that maps rows of `k` numbers to rows of `n`, whose rows are known elsewhere.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Dense {
    pub k: usize,
    pub n: usize,
    pub bias: BiasKind,
    pub activation: Activation,
}

impl Dense {
    pub fn without_bias(k: usize, n: usize, activation: Activation) -> Dense {
        Dense { k, n, bias: BiasKind::None, activation }
    }

    /// The layer on so many rows.
    pub fn of_rows(&self, rows: usize) -> Linear {
        Linear { rows, inputs: self.k, outputs: self.n, bias: self.bias, activation: self.activation, precision: Precision::F32 }
    }
}
