//! Unit normals of vertices: the sum over a vertex's faces of `(b − a) × (c − a)`, whose length is the double area, made unit.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Sums that are shorter count as no normal: they give +z, and no gradient.
pub const LEAST: f32 = 1e-20;
