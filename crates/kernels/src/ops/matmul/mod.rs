//! Batched matrix products, `C = A B (+ C)`, of operands that may be transposed: attention, linear layers and their gradients.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::gemm::Precision;

/// Shapes of a batch of products.
///
/// # Shapes
/// a `[batch, m, k]`, or `[batch, k, m]` where transposed; b `[batch, k, n]`, or `[batch, n, k]` where transposed; c `[batch, m, n]`.
/// All row-major.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Matmul {
    pub batch: usize,
    pub m: usize,
    pub n: usize,
    pub k: usize,
    pub a_transposed: bool,
    pub b_transposed: bool,
    /// Whether products are added to `c`; else they overwrite it.
    pub accumulate: bool,
    /// Arithmetic of the factors; sums are f32.
    pub precision: Precision,
}

impl Matmul {
    /// `[m, k] · [k, n]`, none transposed.
    pub fn new(m: usize, n: usize, k: usize) -> Self {
        Matmul { batch: 1, m, n, k, a_transposed: false, b_transposed: false, accumulate: false, precision: Precision::F32 }
    }

    /// The product that gives A's gradient from C's and B: as `matmul(d_c, b)`, or `matmul(b, d_c)` where A is transposed.
    pub fn gradient_a(&self) -> Matmul {
        let (m, n, k) = (self.m, self.n, self.k);
        if self.a_transposed {
            return Matmul { m: k, n: m, k: n, a_transposed: self.b_transposed, b_transposed: true, accumulate: false, ..*self };
        }
        Matmul { m, n: k, k: n, a_transposed: false, b_transposed: !self.b_transposed, accumulate: false, ..*self }
    }

    /// The product that gives B's gradient from A and C's: as `matmul(a, d_c)`, or `matmul(d_c, a)` where B is transposed.
    pub fn gradient_b(&self) -> Matmul {
        let (m, n, k) = (self.m, self.n, self.k);
        if self.b_transposed {
            return Matmul { m: n, n: k, k: m, a_transposed: true, b_transposed: self.a_transposed, accumulate: false, ..*self };
        }
        Matmul { m: k, n, k: m, a_transposed: !self.a_transposed, b_transposed: false, accumulate: false, ..*self }
    }
}
