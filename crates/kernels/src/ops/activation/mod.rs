//! Elementwise non-linearities of networks. Backward recomputes the slope from the op's input.

pub mod cpu;
pub(crate) mod functions;
pub mod reference;
#[cfg(test)]
mod tests;

/// `y = f(x)`, element by element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Activation {
    None,
    /// `max(x, 0)`
    Relu,
    /// `x` above 0, `slope · x` below.
    LeakyRelu(f32),
    /// `ln(1 + eˣ)`
    Softplus,
    /// `1 / (1 + e⁻ˣ)`
    Sigmoid,
    Tanh,
    /// `x · sigmoid(x)` (Elfwing et al. 2018).
    Silu,
    /// `x Φ(x)` with the normal distribution's `Φ` (Hendrycks and Gimpel 2016).
    Gelu,
    /// [`Activation::Gelu`] with `Φ(x) ≈ (1 + tanh(√(2/π) (x + 0.044715 x³))) / 2`.
    GeluTanh,
}
