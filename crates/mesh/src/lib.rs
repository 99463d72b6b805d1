//! From a field to a mesh: extraction in bounded blocks, cleaning, simplification, colours, textures.

pub mod atlas;
pub mod bake;
pub mod clean;
pub mod color;
pub mod extract;
pub mod simplify;
