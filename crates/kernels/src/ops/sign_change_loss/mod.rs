//! Regularizer against interior floaters of a signed distance (Munkberg et al. 2022, nvdiffrec, Eq. 6): the mean over the edges that the
//! surface cuts of `H(σ(s_i), [s_j > 0]) + H(σ(s_j), [s_i > 0])`, where `H(σ(x), y) = max(x, 0) − x y + ln(1 + e^−|x|)` is binary cross
//! entropy and `∂H/∂x = σ(x) − y`. No cut edges give zero.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;
