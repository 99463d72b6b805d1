//! One folder per op.

pub mod adam;
pub mod composite;
pub mod distortion;
pub mod frequency;
pub mod fused_mlp;
pub mod hash_grid;
pub mod linear;
pub mod march;
pub mod ngp_field;
pub mod spherical_harmonics;
