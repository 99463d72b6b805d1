//! Ops of `diorama-kernels` as differentiable ops on burn's tensors, for networks that are built with burn: on the CPU's
//! Flex backend in every build, on burn's Cube backend with the feature `gpu`.
//!
//! The program does without, so that a build of it compiles nothing of burn.

mod bridge;
#[cfg(feature = "gpu")]
pub mod check;
mod composite;
mod distortion;
mod frequency;
mod fused_mlp;
mod hash_grid;
mod linear;
#[cfg(feature = "gpu")]
mod on_gpu;
#[cfg(test)]
mod ragged_rays;
mod scan;
mod spherical_harmonics;
mod ssim;
mod triangle_wave;
mod trilinear_corner_grid;

pub use bridge::{ARITY, DeviceOp, In, Out, SliceOp, apply, apply_one, values};
pub use composite::composite;
pub use distortion::distortion;
pub use frequency::frequency;
pub use fused_mlp::fused_mlp;
pub use hash_grid::hash_grid;
pub use linear::linear;
#[cfg(feature = "gpu")]
pub use on_gpu::{Ahead, OnDevice, tensors};
pub use scan::scan;
pub use spherical_harmonics::spherical_harmonics;
pub use ssim::ssim;
pub use triangle_wave::triangle_wave;
pub use trilinear_corner_grid::trilinear_corner_grid;
