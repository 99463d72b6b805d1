//! glTF 2.0 to and from a [`Model`](diorama_geom::model::Model). glTF is y up: (x, y, z) here is (x, z, −y) there.
//!
//! The container and accessors are parsed here: the crate `gltf` reads no quantized positions (KHR_mesh_quantization) and panics on them.

mod accessor;
pub(crate) mod binary;
mod data_uri;
mod document;
mod extensions;
mod material;
mod placement;
mod primitive;
mod scene;
mod schema;
mod texture;
mod write;
mod write_materials;
mod write_parts;

#[cfg(test)]
mod read_tests;
#[cfg(test)]
mod write_tests;

pub use scene::read;
pub use write::{WriteOptions, encode, save};
