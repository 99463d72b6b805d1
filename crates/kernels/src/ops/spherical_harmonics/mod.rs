//! Real spherical harmonics of a unit direction, `degree²` values (degree 1 to 4), with the
//! Condon–Shortley phase, order `l² + l + m` (Sloan 2013).

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;
