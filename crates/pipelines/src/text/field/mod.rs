//! The field of a scene with writing, and the class of each of its points (Cui et al. 2024, section 3.1).
//!
//! First density and color are learned, as instant-ngp's with appearance codes, with the stochastic structural loss
//! ([`diorama_kernels::ops::s3im`]), distortion and entropy of opacity. Then they stay, and a head learns classes: the background and one for
//! each text region. It reads the density's features and triangle waves of the position, and learns from the labelled photographs and from
//! labels that depth carries to the others ([`label_maps`]).

pub mod config;
mod distances;
pub mod label_maps;
mod losses;
pub mod model;
pub mod recipe;
pub mod scores;
#[cfg(test)]
mod tests;
mod trainer;
