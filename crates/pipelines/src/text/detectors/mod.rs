//! Detectors of writing: EAST (Zhou et al. 2017) and DB (Liao et al. 2020), trained on labelled images and scored.
//!
//! [`samples`] draws windows of images, [`targets`] makes maps of outlines, the network ([`network`]) learns to predict the maps, [`boxes`]
//! reads them, and [`evaluation`] scores what was read.

pub mod boxes;
pub mod config;
pub mod det_eval;
pub mod evaluation;
pub mod judge;
pub mod network;
pub mod polygon;
pub mod recipe;
pub mod samples;
pub mod targets;
#[cfg(test)]
mod tests;
mod trainer;
