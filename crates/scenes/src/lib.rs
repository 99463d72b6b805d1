//! Procedural scenes with exact cameras and exact ground truth, rendered by a small ray caster.
//!
//! [`still_life`] is the capture of `diorama quickstart`; [`ray_caster`] has the shapes, textures and the renderer for scenes of your own.
//!
//! ```
//! use diorama_scenes::still_life;
//!
//! // Eight photographs of 32 × 32 pixels, with their cameras and poses.
//! let photos = still_life::photographs(8, 32);
//! assert_eq!((photos.len(), photos[0].image.width, photos[0].image.channels), (8, 32, 4));
//! // The object is in the center of the image, the corners are transparent.
//! assert_eq!((photos[0].image.pixel(16, 16)[3], photos[0].image.pixel(0, 0)[3]), (255, 0));
//! ```

mod assembly;
pub mod chair;
pub mod ray_caster;
pub mod still_life;
pub mod still_life_model;
pub mod street;
mod surface;
mod textures;
