//! Object model: photographs of an object with opacity → a mesh with textures of base color, roughness, metalness and normals, and the light
//! that it stood in.
//!
//! Munkberg et al. 2022, "Extracting Triangular 3D Models, Materials, and Lighting From Images", from their equations: [`topology`] finds a
//! surface on a tetrahedral grid with a material by position, [`textured`] refines it as a mesh with textures; both are drawn by [`raster`],
//! lit by [`probe`], and compared by [`loss`]. Shapes begin with the hull of the masks ([`hull`])
//! without what photographs do not agree on ([`carving`]).
//! A third stage (`traced`, on request) traces shadows and light between surfaces, and tells light from base color.
//!
//! Adam does not depend on the scale of gradients, so the factors of gradients that others give (64 for light, ⅛ for hash tables) are left out.

pub mod albedo_entropy;
pub mod capture;
pub mod carving;
pub mod config;
mod export;
mod gloss;
pub mod hull;
pub mod loss;
pub mod material;
mod memory;
mod metal;
pub mod model;
mod pixel_means;
pub mod placement;
pub mod probe;
pub mod raster;
pub mod recipe;
pub mod scores;
mod surroundings;
pub mod synth;
pub mod textured;
pub mod topology;
mod traced;
mod trainer;
mod transport;
pub mod truth;
