//! Networks that are not fields: our ops as differentiable ops on burn's tensors, layers and modules built of them, their
//! weights and their training.
//!
//! burn keeps the graph of a step and runs on GPUs; on the CPU every op that costs time is one of `diorama-kernels`.

pub mod bridge;

pub use bridge::{OpError, read_values};
