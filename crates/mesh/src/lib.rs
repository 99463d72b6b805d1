//! From a field to a mesh: extraction in bounded blocks, cleaning, repair, simplification, colours, textures, normal maps.

pub mod atlas;
pub mod bake;
pub mod clean;
pub mod color;
pub mod extract;
pub mod normal_map;
pub mod repair;
pub mod simplify;
pub mod visibility;
