//! Training of networks: gradients by parameter, optimizers, schedules, averages, loading and augmentation of data.
//!
//! One step: `loss.backward()` → [`Gradients::take`] → clipping → [`Optimizer::step`]. What a run needs to go on bit by bit is in
//! [`Optimizer::state`], [`Ema::state`] and the network's [`crate::param::arrays`].

pub mod augment;
mod ema;
mod gradients;
pub mod loader;
mod on_device;
mod optimizer;
mod schedule;
mod stack;
#[cfg(test)]
mod tests;

pub use ema::Ema;
pub use gradients::Gradients;
pub use loader::{Loader, LoaderSettings, SampleKey};
pub use optimizer::{Group, Optimizer, Rule, StateError};
pub use schedule::{Schedule, Shape};
pub use stack::stack;
