//! Distortion loss (Barron et al. 2022, mip-NeRF 360, eq. 15), which pulls a ray's weights together:
//! `Σ_ij w_i w_j |m_i − m_j| + ⅓ Σ_i w_i² δ_i` with interval midpoints `m` and lengths `δ`.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Distance `t` as a coordinate in which all of space is finite, `s = 4 t / (1 + t)`: like distance around 1, where its slope
/// is 1, and like disparity beyond. The loss of unbounded rays is taken in it, as in mip-NeRF 360's normalized distance.
#[inline(always)]
pub fn normalized_distance(t: f32) -> f32 {
    4.0 * t / (1.0 + t)
}
