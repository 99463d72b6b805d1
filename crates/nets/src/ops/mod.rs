//! Layers as functions of burn's tensors. Beneath them run our ops on the CPU; images are `[batch, channels, height, width]`.
//!
//! A tensor that several layers read goes through [`fork`] first, so that its gradients are summed by our kernels in the pool's
//! memory instead of burn's.

mod attention;
mod by_burn;
#[cfg(feature = "gpu")]
pub mod check;
mod conv;
mod conv_transpose;
mod elementwise;
mod embedding;
mod join;
mod linear;
mod loss;
mod norm;
mod sample;
#[cfg(test)]
mod tests;

pub use crate::bridge::work::flops;
pub use attention::attention;
pub use conv::{Conv, conv2d};
pub use conv_transpose::conv_transpose2d;
pub use diorama_kernels::ops::activation::Activation;
pub use diorama_kernels::ops::grid_sample::{Mode as GridMode, Outside};
pub use diorama_kernels::ops::mean_error::Error;
pub use diorama_kernels::ops::pool::Pool;
pub use diorama_kernels::ops::resample::Filter;
pub use elementwise::{activation, add, add_relu, fork, modulate};
pub use embedding::embedding;
pub use join::{concat_channels, heads, merge_heads, split_heads, to_tokens, with_class_token};
pub use linear::linear;
pub use loss::{cross_entropy, log_softmax, mean_error, softmax};
pub use norm::{BatchStatistics, NormSettings, batch_norm, group_norm, layer_norm};
pub use sample::{GridSettings, average_pool, global_average_pool, grid_sample, max_pool, pixel_shuffle, resize};
