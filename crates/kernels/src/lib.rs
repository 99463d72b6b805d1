//! Ops of radiance fields with an f64 reference and a CPU implementation each, and the devices they
//! run on. Every op is a folder: `mod.rs` contract, `reference.rs` plain loops in f64 forward and
//! backward, `cpu.rs`, `tests.rs`; with a GPU `gpu.rs`, and `cases.rs` that tests and `bench check` share.
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
mod amx_chain;
mod api;
#[cfg(feature = "gpu")]
pub mod check;
pub mod device;
pub mod gemm;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod math;
pub mod ops;
pub mod probe;
pub mod simd;
mod sums;
pub mod tasks;
pub mod tile;
mod vector;
