//! `y = act(a + b)` elementwise, where act is nothing or a ReLU: the sum of residual branches, and of gradients.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;
