//! Batched matrix products, `C = A B (+ C)`, with optionally transposed operands, for attention, linear layers and their gradients.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::gemm::Precision;

/// Description of a batch of matrix products.
///
/// # Shapes
/// a `[batch, m, k]`, or `[batch, k, m]` if transposed; b `[batch, k, n]`, or `[batch, n, k]` if transposed; c `[batch, m, n]`.
/// All row-major.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Matmul {
    pub batch: usize,
    pub m: usize,
    pub n: usize,
    pub k: usize,
    pub a_transposed: bool,
    pub b_transposed: bool,
    /// Whether products are added to `c` instead of overwriting it.
    pub accumulate: bool,
    /// Precision of the factors; sums are f32.
    pub precision: Precision,
}

impl Matmul {
    /// One product `[m, k] · [k, n]` in f32, without transposes, that overwrites `c`.
    pub fn new(m: usize, n: usize, k: usize) -> Self {
        Matmul { batch: 1, m, n, k, a_transposed: false, b_transposed: false, accumulate: false, precision: Precision::F32 }
    }

    /// The product that gives the gradient of A: of (d_c, b), or of (b, d_c) if A is transposed.
    pub fn gradient_a(&self) -> Matmul {
        let (m, n, k) = (self.m, self.n, self.k);
        if self.a_transposed {
            return Matmul { m: k, n: m, k: n, a_transposed: self.b_transposed, b_transposed: true, accumulate: false, ..*self };
        }
        Matmul { m, n: k, k: n, a_transposed: false, b_transposed: !self.b_transposed, accumulate: false, ..*self }
    }

    /// The product that gives the gradient of B: of (a, d_c), or of (d_c, a) if B is transposed.
    pub fn gradient_b(&self) -> Matmul {
        let (m, n, k) = (self.m, self.n, self.k);
        if self.b_transposed {
            return Matmul { m: n, n: k, k: m, a_transposed: true, b_transposed: self.a_transposed, accumulate: false, ..*self };
        }
        Matmul { m: k, n, k: m, a_transposed: !self.a_transposed, b_transposed: false, accumulate: false, ..*self }
    }
}
