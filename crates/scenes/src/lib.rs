//! Procedural scenes with exact cameras and exact ground truth, rendered by a small ray caster.

pub mod ray_caster;
pub mod still_life;
