//! From fields to images.

pub mod splat;
pub mod volume;
