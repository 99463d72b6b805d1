//! Scene model: photographs of one place in several lights → albedo, normals, shadow, and the light of each session.
//!
//! Rudnev et al. 2022, "NeRF for Outdoor Scene Relighting": `C = S(x, L) · A ⊙ (Lᵀ b(N))` with spherical harmonics `L` per session, on a
//! hash grid, in linear light. First, surfaces are learned together with how they look in each light; then light is told
//! apart from albedo on surfaces that stay ([`shading`]). [`recipe`] trains, [`render`] shows layers under any light, [`surface_field`] is what
//! meshing sees.

pub mod config;
mod fields;
pub mod joint;
pub mod model;
pub(super) mod normal_maps;
pub mod pictures;
pub mod recipe;
pub mod render;
pub mod scores;
pub mod shading;
#[cfg(test)]
mod shading_tests;
pub mod stepper;
pub mod sun;
pub mod sunlit;
pub mod surface_field;
mod trainer;
pub mod viewing;
pub mod visibility;
