//! Ops of radiance fields and of networks, and the devices they run on. Every op is a folder of [`ops`]: `mod.rs` is its contract,
//! `reference.rs` its definition as plain loops in f64 (forward and backward), `cpu.rs` its CPU implementation, `gpu.rs` its kernels,
//! `cases.rs` the cases that tests and `bench check` share, `tests.rs` its tests.
//!
//! Ops work on slices, whose shapes they document and check. For example, two samples on a ray, composited by the CPU and by the reference:
//!
//! ```
//! use diorama_kernels::ops::composite::{Packed, cpu, reference};
//!
//! let samples = Packed { offsets: &[0, 2], t: &[1.0, 2.0], dt: &[0.5, 0.5] };
//! let (sigma, color, background) = ([0.4, 8.0], [0.2, 0.4, 0.6, 0.9, 0.1, 0.3], [1.0; 3]);
//! let fast = cpu::forward(&samples, &sigma, &color, 3, &background);
//!
//! let wide = |v: &[f32]| v.iter().map(|v| *v as f64).collect::<Vec<f64>>();
//! let exact = reference::forward(&samples, &wide(&sigma), &wide(&color), 3, &wide(&background));
//! for (a, b) in fast.color.iter().zip(&exact.color) {
//!     assert!((*a as f64 - b).abs() < 1e-6);
//! }
//! ```
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
mod partials;
pub mod probe;
pub mod simd;
mod sums;
pub mod tasks;
pub mod tile;
mod vector;
