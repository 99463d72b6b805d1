//! Reads and writes every file: captures, images, videos, meshes, point clouds, checkpoints, logs. Knows nothing about training.
//!
//! - [`import::import`] reads a capture (COLMAP, `transforms.json`, the Blender set, LLFF, or a zip of one) into a
//!   [`Capture`](diorama_geom::Capture); [`masks`] and [`sparse`] add masks and points.
//! - [`pixel_store::PixelStore`] decodes the photographs of a capture within a memory budget; [`photo`] reads and writes single images.
//! - [`glb`], [`mesh_text`] (OBJ, PLY, STL), [`usdz`], [`collada`] and [`point_cloud`] (LAS, E57) write meshes and points.
//! - [`model_file`] reads models (glTF, OBJ), [`gltf`] also writes them; [`environment`] and [`sh_text`] hold light.
//! - [`film`] writes MP4 and GIF, [`depth`] sequences of depth maps, [`plot`] charts.
//! - [`checkpoint`] saves named arrays atomically; [`weights`] reads safetensors and PyTorch's `.pth`, [`tetrahedra_npz`]
//!   tetrahedral grids.
//!
//! Every failure is a [`DataError`]: one line that names the file and what to do. Files are written through [`atomic`], so they appear
//! complete or not at all.
//!
//! ```
//! use diorama_data::import::{ImportOptions, import};
//! use diorama_data::{photo, transforms_json};
//! use diorama_geom::capture::{Frame, SceneBox};
//! use diorama_geom::glam::DVec3;
//! use diorama_geom::{Camera, Capture, ImageU8, Pose};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let scratch = tempfile::tempdir()?;
//! # let folder = scratch.path().to_path_buf();
//! // Four photographs around the origin, written with their poses into `folder`.
//! let image = ImageU8 { width: 32, height: 24, channels: 3, data: vec![128; 32 * 24 * 3] };
//! let mut frames = Vec::new();
//! for (i, eye) in [DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y].into_iter().enumerate() {
//!     let file = folder.join(format!("{i}.png"));
//!     photo::save_png(&file, &image)?;
//!     let pose = Pose::look_at(3.0 * eye, DVec3::ZERO, DVec3::Z);
//!     frames.push(Frame::new(format!("{i}"), file, Camera::pinhole(32, 24, 0.8), pose));
//! }
//! let scene = SceneBox { center: DVec3::ZERO, half: 1.0, aabb_scale: 1 };
//! transforms_json::write(&folder.join("transforms.json"), &folder, &Capture::new(frames, scene), None)?;
//!
//! let capture = import(&folder, &ImportOptions::default())?;
//! assert_eq!(capture.frames.len(), 4);
//!
//! // Errors name the file and what to do.
//! let error = import(&folder.join("missing"), &ImportOptions::default()).unwrap_err();
//! assert!(error.is_input() && error.to_string().contains("missing: does not exist; give a folder"));
//! # Ok(())
//! # }
//! ```
#![allow(unsafe_code)] // byte views of numbers in `checkpoint`

pub mod archive;
pub mod atomic;
pub mod camera_path_json;
pub mod checkpoint;
pub mod collada;
pub mod colmap;
mod colmap_model;
pub mod depth;
pub mod environment;
pub mod error;
pub mod film;
pub mod gif;
pub mod glb;
pub mod gltf;
pub mod import;
pub mod imported;
pub mod jpeg;
pub mod json;
pub mod llff;
mod loaded_model;
pub mod lock;
pub mod masks;
pub mod memory;
pub mod mesh_text;
pub mod model_file;
pub mod mp4;
pub mod nerf_osr;
pub mod npy;
pub mod obj;
pub mod photo;
pub mod photo_check;
pub mod photo_import;
pub mod pickle;
pub mod pixel_store;
pub mod plot;
pub mod point_cloud;
pub mod process;
pub mod sessions;
pub mod sh_text;
pub mod sharpness;
pub mod sparse;
pub mod sparse_ply;
pub mod splat_ply;
pub mod split;
pub mod tar;
pub mod tetrahedra_npz;
pub mod text_labels;
pub mod text_set;
pub mod tfevents;
pub mod transforms_json;
pub mod usdz;
pub mod video;
pub mod weights;

pub use error::{DataError, Result};
