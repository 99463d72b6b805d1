//! The nouns every other room shares: transforms, cameras, rays, boxes, colour, images, meshes and
//! captures, plus the small traits that let rooms meet without knowing each other.
//!
//! World: right-handed, z up. Camera: x right, y down, z forward; pixel centres at +0.5.

pub mod camera;
pub mod camera_path;
pub mod capture;
pub mod color;
pub mod contraction;
pub mod field_query;
pub mod image;
pub mod mesh;
pub mod named_array;
pub mod oriented_box;
pub mod ray;
pub mod rng;
pub mod splats;
pub mod transform;
pub mod view_controls;
pub mod view_source;

pub use camera::{Camera, Lens, Reduction};
pub use capture::{Capture, Frame, SceneBox, SparsePoint};
pub use glam;
pub use image::{Image, ImageU8, PixelFormat};
pub use mesh::Mesh;
pub use named_array::NamedArray;
pub use oriented_box::OrientedBox;
pub use ray::{Aabb, Ray};
pub use transform::{Pose, Similarity};
