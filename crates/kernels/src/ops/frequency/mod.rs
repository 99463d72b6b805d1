//! Positional encoding (Mildenhall et al. 2020, NeRF, eq. 4):
//! `γ(x) = (x, sin(2⁰ s x), cos(2⁰ s x), …, sin(2ᴸ⁻¹ s x), cos(2ᴸ⁻¹ s x))` with `s = π` or 1, the raw
//! input optional, and a band window for coarse-to-fine training (Park et al. 2021, eq. 8).

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frequency {
    pub dims: usize,
    pub bands: usize,
    pub include_input: bool,
    /// Whether angles are multiplied by π.
    pub pi: bool,
    /// Bands admitted so far, in [0, bands]; the last one fades in by a raised cosine.
    pub window: Option<f32>,
}

impl Frequency {
    /// Numbers per encoded row.
    pub fn output_dims(&self) -> usize {
        self.dims * (2 * self.bands + self.include_input as usize)
    }

    /// Weight of band `k`: `(1 − cos(π clamp(window − k, 0, 1))) / 2`.
    pub fn band_weight(&self, k: usize) -> f64 {
        match self.window {
            None => 1.0,
            Some(a) => 0.5 * (1.0 - (std::f64::consts::PI * (a as f64 - k as f64).clamp(0.0, 1.0)).cos()),
        }
    }
}
