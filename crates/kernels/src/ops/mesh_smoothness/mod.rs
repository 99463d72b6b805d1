//! Smoothness of a triangle mesh that is moved but not reconnected.
//!
//! - Relative uniform Laplacian (Hasselgren et al. 2021; nvdiffrec's second stage): `mean |δ_i(v) − δ_i(v⁰)|²` over vertices and axes, where
//!   `δ_i(v) = mean_{j ∈ N(i)} v_j − v_i`. It is zero for the initial mesh `v⁰` and for all its translations.
//! - Normal consistency: `mean ρ(1 − cos θ)` over the edges with two faces, where θ is the angle between their normals, and
//!   `ρ(b) = b / (1 + b / c)` lets creases with `b` far beyond `c` be; `c = ∞` counts them all.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;
mod topology;

pub use topology::MeshTopology;

/// Smallest double area by which normals are divided.
pub const MIN_AREA: f32 = 1e-20;
