//! Shared types: transforms, cameras, rays, boxes, colors, images, meshes and captures, and the small traits that connect the other crates.
//!
//! The world is right-handed with z up. Cameras have x right, y down, z forward; pixel centers are at +0.5. Angles are in radians.
//!
//! - [`Pose`] is the rigid transform `world_from_camera`, [`Similarity`] adds a scale.
//! - [`Camera`] holds intrinsics and a [`Lens`]; [`camera_path`] makes orbits, spirals and interpolated paths.
//! - [`Capture`] is a set of [`Frame`]s (photographs with cameras and poses) and a [`SceneBox`].
//! - [`Image`] and [`ImageU8`] are row-major pixels, [`Mesh`] is an indexed triangle mesh.
//! - [`field_query::FieldQuery`] gives density and color at points; [`view_source::ViewSource`] is what a viewer can show.
//!
//! ```
//! use diorama_geom::glam::{DVec2, DVec3};
//! use diorama_geom::{Aabb, Camera, Pose, Ray};
//!
//! // A camera at (4, 0, 1) looks at the origin; z is up.
//! let camera = Camera::pinhole(640, 480, 60f64.to_radians());
//! let eye = DVec3::new(4.0, 0.0, 1.0);
//! let world_from_camera = Pose::look_at(eye, DVec3::ZERO, DVec3::Z);
//!
//! // The origin appears in the center of the image.
//! let px = camera.project(world_from_camera.inverse().point(DVec3::ZERO)).unwrap();
//! assert!((px - DVec2::new(320.0, 240.0)).length() < 1e-9);
//!
//! // The ray through this pixel enters the cube [-1, 1]³ after 3 / cos(elevation) units.
//! let ray = Ray { origin: eye, direction: world_from_camera.rotation * camera.direction(px.x, px.y) };
//! let (enter, leave) = Aabb::cube(DVec3::ZERO, 1.0).intersect(&ray).unwrap();
//! assert!((enter - 0.75 * eye.length()).abs() < 1e-9 && leave > enter);
//! ```

pub mod camera;
pub mod camera_path;
pub mod capture;
pub mod color;
pub mod contraction;
pub mod daylight;
pub mod environment;
pub mod field_query;
pub mod image;
pub mod mesh;
pub mod model;
pub mod named_array;
pub mod oriented_box;
pub mod ray;
pub mod rng;
pub mod sh_light;
pub mod sky;
pub mod splats;
pub mod tetrahedra;
pub mod transform;
pub mod view_controls;
pub mod view_source;

pub use camera::{Camera, Lens, Reduction};
pub use capture::{Capture, Frame, SceneBox, SparsePoint};
pub use glam;
pub use image::{Image, ImageU8, PixelFormat};
pub use mesh::Mesh;
pub use model::Model;
pub use named_array::NamedArray;
pub use oriented_box::OrientedBox;
pub use ray::{Aabb, Ray};
pub use tetrahedra::Tetrahedra;
pub use transform::{Pose, Similarity};
