//! Elementwise non-linearities of networks. Backward recomputes the slope from the op's input.

pub mod cpu;
pub(crate) mod functions;
pub mod reference;
#[cfg(test)]
pub(crate) mod tests;

/// `y = f(x)`, element by element.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Activation {
    #[default]
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

impl Activation {
    /// Whether the slope needs the function's input; else the output tells it, too.
    pub fn needs_input(self) -> bool {
        match self {
            Activation::None | Activation::Relu | Activation::Sigmoid | Activation::Tanh => false,
            Activation::LeakyRelu(slope) => slope < 0.0,
            Activation::Softplus | Activation::Silu | Activation::Gelu | Activation::GeluTanh => true,
        }
    }
}
