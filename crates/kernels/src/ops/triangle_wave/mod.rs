//! Triangle-wave encoding (tiny-cuda-nn): a continuous, piecewise linear wave in place of sines,
//! `y_k = 2 |((2ᵏ x + k/2) mod 2) − 1| − 1` for band `k`, the first of which is 0, with the mathematical (non-negative) modulus.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;
