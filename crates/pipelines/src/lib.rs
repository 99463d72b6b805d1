//! Applications of diorama: recipes that turn photographs into fields, views and meshes. Depend on this crate to train a field from a
//! program of your own:
//!
//! ```toml
//! [dependencies]
//! diorama-pipelines = { path = "diorama/crates/pipelines" } # features = ["native"] for GPUs
//! diorama-data = { path = "diorama/crates/data" }
//! diorama-engine = { path = "diorama/crates/engine" }
//! ```
//!
//! Twenty lines generate a capture, train on it and save a view:
//!
//! ```
//! use diorama_data::photo::save_png;
//! use diorama_engine::renderers::volume::Quality;
//! use diorama_pipelines::object::config::{Config, Method};
//! use diorama_pipelines::object::{quickstart, recipe};
//! use diorama_pipelines::run::RunFolder;
//! use std::sync::atomic::AtomicBool;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let out = std::env::temp_dir().join("diorama-first-field");
//! let capture = out.join("capture"); // any folder that `diorama train` reads will do
//! quickstart::write_capture(&capture, 16, 48)?;
//!
//! let mut config = Config::new(Method::Ngp, capture);
//! config.set("run.steps", "40")?;
//! config.set("field.log2_size", "14")?;
//!
//! let mut run = RunFolder::create(&out.join("run"), true)?;
//! let stop = AtomicBool::new(false); // set it to stop cleanly
//! let trained = recipe::train(&config, &mut run, false, None, &stop, &mut |event| println!("{event:?}"))?;
//!
//! let camera = trained.model.posed(0); // of the first photograph
//! let view = trained.model.tracer(Quality::Full).view(&camera, &mut |_| {});
//! save_png(&out.join("view.png"), &view.rgb.to_u8())?;
//! # std::fs::remove_dir_all(out)?;
//! # Ok(())
//! # }
//! ```
//!
//! Main types: [`Application`] lists the applications. [`object::config::Config`] is everything that an object run depends on,
//! [`run::RunFolder`] the folder that it writes, [`run::device::Device`] where its steps are carried out, [`run::viewing::RunView`] the run in
//! the viewer.
//!
//! [`object`] holds the recipe ([`object::recipe::train`]), its configuration ([`object::config::Config`]), and what follows training:
//! views ([`object::render`]), scores ([`object::evaluate`]), meshes ([`object::export`]) and point clouds ([`object::points`]).
//! [`object::run_folder::load_model`] reads a run again. [`run`] is shared by all applications. The examples of this crate show losses,
//! codes and formulas of one's own.
//!
//! The rooms below: `diorama-engine` (fields, samplers, losses, renderers), `diorama-kernels` (operators on CPU and GPU), `diorama-mesh`,
//! `diorama-data` (files), `diorama-scenes` (generated captures), `diorama-geom` (cameras, poses, images).

pub mod application;
pub mod bench;
pub mod error;
pub mod object;
pub mod relight;
pub mod run;
pub mod text;

pub use application::Application;
pub use error::{PipelineError, Result};
