//! Renderers: volume rendering of fields, and Gaussian splats.

pub mod accelerator;
mod blocks;
pub mod layers;
pub mod quality;
pub mod splat;
pub mod supervised;
pub mod traced;
pub mod view;
pub mod volume;
