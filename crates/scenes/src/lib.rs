//! Procedural scenes with exact cameras and exact ground truth.
//!
//! - [`still_life`] is the capture of `diorama quickstart`; [`ray_caster`] has the shapes, textures and the renderer for scenes of your own.
//! - [`hills`] is a surface with exact distances and floaters, to measure meshing.
//! - [`street`], [`chair`] and [`still_life_model`] are triangle meshes with metallic-roughness materials, for a path tracer to light.
//! - [`signs`] are places whose boards carry writing that the caller paints.
//!
//! ```
//! use diorama_scenes::still_life;
//!
//! // Eight photographs of 32 × 32 pixels, with their cameras and poses.
//! let photos = still_life::photographs(8, 32);
//! assert_eq!((photos.len(), photos[0].image.width, photos[0].image.channels), (8, 32, 4));
//! // The object is in the center of the image, the corners are transparent.
//! assert_eq!((photos[0].image.pixel(16, 16)[3], photos[0].image.pixel(0, 0)[3]), (255, 0));
//!
//! // A street, and a photographer's way through it.
//! use diorama_scenes::street;
//! let (model, cameras) = (street::model(1), street::cameras(12, 640, 480, 1));
//! assert!(model.face_count() > 100_000 && cameras.len() == 12);
//! assert!(model.parts.iter().any(|part| part.name == "car.1.body"));
//! ```

mod assembly;
pub mod chair;
pub mod hills;
pub mod ray_caster;
pub mod signs;
pub mod still_life;
pub mod still_life_model;
pub mod street;
mod surface;
mod textures;
