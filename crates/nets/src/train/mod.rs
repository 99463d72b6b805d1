//! Training of networks: gradients by parameter, optimizers, schedules, averages, loading and augmentation of data.
//!
//! One step: [`Loader::next_batch`] → [`stack`] → `loss.backward()` → [`Gradients::take`] → clipping → [`Optimizer::step`]. [`saved`]
//! is what a checkpoint must hold, [`resume`] goes on from it bit by bit.

pub mod augment;
mod ema;
mod gradients;
pub mod loader;
mod on_device;
mod optimizer;
mod saved;
mod schedule;
mod stack;
#[cfg(test)]
mod tests;

pub use ema::Ema;
pub use gradients::Gradients;
pub use loader::{Loader, LoaderSettings, SampleKey};
pub use optimizer::{Group, Optimizer, Rule, StateError};
pub use saved::{ResumeError, resume, saved};
pub use schedule::{Schedule, Shape};
pub use stack::stack;
