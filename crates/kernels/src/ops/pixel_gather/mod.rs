//! Colours of chosen pixels: bytes of packed RGBA frames to floats in [0, 1], alpha straight.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;
