//! Every byte to or from disk: captures, images, video, meshes, checkpoints, logs. Knows no training.
#![allow(unsafe_code)] // the bytes of numbers in `checkpoint`

pub mod archive;
pub mod atomic;
pub mod camera_path_json;
pub mod checkpoint;
pub mod collada;
pub mod colmap;
mod colmap_model;
pub mod depth;
pub mod error;
pub mod film;
pub mod gif;
pub mod glb;
pub mod import;
pub mod imported;
pub mod jpeg;
pub mod json;
pub mod llff;
pub mod lock;
pub mod masks;
pub mod memory;
pub mod mesh_text;
pub mod mp4;
pub mod photo;
pub mod photo_check;
pub mod photo_import;
pub mod pickle;
pub mod pixel_store;
pub mod plot;
pub mod point_cloud;
pub mod process;
pub mod sparse;
pub mod sparse_ply;
pub mod splat_ply;
pub mod split;
pub mod tfevents;
pub mod transforms_json;
pub mod usdz;
pub mod video;
pub mod weights;

pub use error::{DataError, Result};
