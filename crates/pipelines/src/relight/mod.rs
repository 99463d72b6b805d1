//! Light that can be changed: models with materials composed into scenes and rendered under other skies.
//!
//! [`scene_file`] describes a composition, [`scenario`] writes one, [`compose`] renders it, [`export_blender`] writes it for Blender, [`turntable`] renders a model from all sides. [`light`] reads environment
//! maps, skies and spherical harmonics, [`picture`] refines a picture in passes that can be interrupted. [`outdoor`] is the scene model,
//! [`synth`] generates a benchmark for it, [`truth`] its exact layers.

pub mod compose;
pub mod export_blender;
pub mod light;
pub mod outdoor;
pub mod picture;
pub mod scenario;
pub mod scene_file;
pub mod synth;
pub mod truth;
pub mod turntable;
