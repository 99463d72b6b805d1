//! Networks that are not fields: our ops as differentiable ops on burn's tensors, layers and modules built of them, their
//! weights and their training.
//!
//! burn keeps the graph of a step and runs on GPUs; on the CPU every op that costs time is one of `diorama-kernels`.

pub mod bridge;
pub mod layers;
pub mod modules;
pub mod onnx;
pub mod ops;
pub mod param;
pub mod train;
pub mod weights;

pub use bridge::{OpError, read_values};
/// burn's tensors, for rooms that do not name burn themselves.
pub use burn::tensor::{Device, Tensor, TensorData};
pub use param::{Kind, Mode, Module, Param, Visitor};

/// Runs `work` on a thread of rayon's pool: ops that it calls start there without handing over to another thread, which each of them
/// does outside the pool (7 % of a forward pass of ViT-B/32). `work` must not wait for a thread that itself uses the pool, such as those
/// of a [`Loader`](train::Loader).
pub fn on_pool<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    rayon::scope(|_| work())
}
