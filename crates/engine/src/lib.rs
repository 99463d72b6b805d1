//! Fields, samplers, renderers, metrics, optimisers and the training run. Opens no file.

pub mod background;
pub mod fields;
pub mod metrics;
#[cfg(feature = "gpu")]
pub mod on_gpu;
pub mod params;
pub mod renderers;
pub mod samplers;
pub mod stages;
pub mod step;
pub mod train;
