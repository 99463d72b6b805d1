//! Light that can be changed: models with materials composed into scenes and rendered under other skies.
//!
//! [`scene_file`] describes a composition, [`scenario`] writes one, [`compose`] renders it, [`export_blender`] writes it for Blender,
//! [`turntable`] renders a model from all sides. [`light`] reads environment maps, skies and spherical harmonics, [`picture`] refines a
//! picture in passes that can be interrupted, on a device of [`path_tracer`]. [`outdoor`] is the scene model, [`synth`] generates a benchmark for it, [`truth`] its exact
//! layers, [`meshing`] makes a mesh of it, [`fit_light`] finds the light of a new photograph, [`prepare`] makes data sets for it.
//! [`object`] is the object model. [`quickstart`] runs all of it on generated data.

pub mod compose;
pub mod export_blender;
pub mod fit_light;
pub mod light;
pub mod meshing;
pub mod object;
pub mod outdoor;
pub mod path_tracer;
pub mod picture;
pub mod prepare;
pub mod quickstart;
pub mod scenario;
pub mod scene_file;
pub mod synth;
pub mod truth;
pub mod turntable;
