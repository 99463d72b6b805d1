//! Packed prefix sums: exclusive sums of counts, and sums of values within each ray.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;
