//! Photographs to a radiance field, novel views and a mesh.

pub mod compare;
pub mod config;
pub mod depth_error;
pub mod device;
pub mod diagnose;
pub mod evaluate;
pub mod export;
mod exposure_spread;
pub(crate) mod extent;
pub mod fog;
pub mod held_out;
mod loading;
pub mod memory;
pub mod model;
mod nearest;
mod observations;
pub mod points;
pub mod prepare;
pub mod quickstart;
pub mod recipe;
pub mod render;
pub mod report;
pub mod run_folder;
pub mod seen_by;
mod texture;
pub mod viewing;
pub mod viewing_points;
