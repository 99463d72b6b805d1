//! From fields to images.

pub mod splat;
pub mod supervised;
pub mod volume;
