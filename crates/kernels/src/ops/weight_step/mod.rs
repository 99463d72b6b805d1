//! One optimizer step of a network's weights: SGD with momentum, Adam (Kingma and Ba 2015), AdamW (Loshchilov and Hutter 2019).
//!
//! The gradient is `g ← clamp(scale · g, ±limit)`; then
//! - SGD: `g ← g + decay · p`, `m ← μ m + g`, `p ← p − rate · m`, or with Nesterov's look-ahead `p ← p − rate · (g + μ m)`;
//! - Adam: `g ← g + decay · p`, `m ← β₁ m + (1 − β₁) g`, `v ← β₂ v + (1 − β₂) g²`, `p ← p − rate · m̂ / (√v̂ + ε)`;
//! - AdamW: `p ← (1 − rate · decay) p`, then as Adam without decay.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Rule by which a weight follows its gradient.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rule {
    Sgd {
        momentum: f32,
        nesterov: bool,
    },
    /// Weight decay is part of the gradient.
    Adam {
        beta1: f32,
        beta2: f32,
        epsilon: f32,
    },
    /// Weight decay shrinks the weight itself.
    AdamW {
        beta1: f32,
        beta2: f32,
        epsilon: f32,
    },
}

impl Rule {
    /// The usual constants.
    pub const ADAM: Rule = Rule::Adam { beta1: 0.9, beta2: 0.999, epsilon: 1e-8 };
    pub const ADAM_W: Rule = Rule::AdamW { beta1: 0.9, beta2: 0.999, epsilon: 1e-8 };
    pub const SGD: Rule = Rule::Sgd { momentum: 0.0, nesterov: false };

    /// How many moments a weight has.
    pub fn moments(&self) -> usize {
        match self {
            Rule::Sgd { momentum: 0.0, .. } => 0,
            Rule::Sgd { .. } => 1,
            Rule::Adam { .. } | Rule::AdamW { .. } => 2,
        }
    }
}

/// One step of one weight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    pub rule: Rule,
    pub rate: f32,
    pub weight_decay: f32,
    /// Number of the step, from 1.
    pub t: u64,
    /// Factor of the gradient.
    pub scale: f32,
    /// Largest magnitude of a gradient, after the factor.
    pub limit: f32,
}
