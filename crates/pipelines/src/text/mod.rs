//! Application *text*: one filmed scene with writing becomes labelled images with other words, cameras and weather (Cui et al. 2024).
//!
//! [`make_scenes`] photographs generated scenes with exact ground truth; [`lettering`] sets and draws writing.

pub mod annotate;
pub mod camera;
pub mod detectors;
pub mod edit;
pub mod field;
mod fnv;
pub mod label;
pub mod lettering;
pub mod make_scenes;
pub mod placed;
pub mod pose_clusters;
pub mod quickstart;
pub mod regions;
pub mod report;
pub mod retouch;
pub mod stages;
pub mod study;
pub mod styling;
pub mod surface;
pub mod synth;
pub mod truth;
pub mod viewing;
#[cfg(test)]
mod whole_tests;
mod words;
