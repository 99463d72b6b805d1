//! From fields to images.

pub mod volume;
