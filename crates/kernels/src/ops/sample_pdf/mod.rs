//! Importance sampling of new distances from a coarse pass (NeRF, section 5.2): inverse transform of
//! the piecewise-constant density given by weights over bins. Not differentiated, as in NeRF.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Added to every weight, so that an empty ray is sampled uniformly.
pub const FLOOR: f32 = 1e-5;
