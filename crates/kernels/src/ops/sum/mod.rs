//! `y = act(a + b)` elementwise, where act is nothing or a ReLU: how residual branches meet; and sums of gradients.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;
