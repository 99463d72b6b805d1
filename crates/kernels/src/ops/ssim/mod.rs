//! Structural similarity (Wang et al. 2004): Gaussian window 11×11 with σ = 1.5, `C₁ = 0.01²`,
//! `C₂ = 0.03²`, windows inside the image only, mean over positions and channels.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

pub const WINDOW: usize = 11;
pub const SIGMA: f64 = 1.5;
pub const C1: f64 = 0.01 * 0.01;
pub const C2: f64 = 0.03 * 0.03;

/// The window's one-dimensional weights, which sum to 1.
pub fn gaussian() -> [f64; WINDOW] {
    let g: [f64; WINDOW] = std::array::from_fn(|i| (-((i as f64 - 5.0).powi(2)) / (2.0 * SIGMA * SIGMA)).exp());
    let sum: f64 = g.iter().sum();
    g.map(|v| v / sum)
}
