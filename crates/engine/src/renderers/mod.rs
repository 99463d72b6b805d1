//! From fields to images.

mod blocks;
pub mod splat;
pub mod supervised;
pub mod volume;
