//! Where rays enter and leave a box (Kay and Kajiya 1986): `[near, far]` along each unit direction,
//! clipped to `near ≥ near_plane`; an empty interval (`near = far = 0`) when the ray misses.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;
