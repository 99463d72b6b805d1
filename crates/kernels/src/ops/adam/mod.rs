//! Adam (Kingma and Ba 2015) on plain buffers, dense or on touched lines only.
//!
//! `m ← β₁ m + (1 − β₁) g`, `v ← β₂ v + (1 − β₂) g²`, `p ← p − rate · m̂ / (√v̂ + ε)` with
//! `m̂ = m / (1 − β₁ᵗ)`, `v̂ = v / (1 − β₂ᵗ)`. The sparse form leaves elements with `g = 0` alone,
//! moments included (as instant-ngp does for its table), and clears the gradients it has used.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Rates of one parameter group.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adam {
    pub rate: f32,
    pub beta1: f32,
    pub beta2: f32,
    pub epsilon: f32,
    /// L2 penalty added to the gradient; the sparse form adds it to elements that have one.
    pub weight_decay: f32,
}

impl Default for Adam {
    fn default() -> Self {
        Adam { rate: 1e-2, beta1: 0.9, beta2: 0.99, epsilon: 1e-15, weight_decay: 0.0 }
    }
}
