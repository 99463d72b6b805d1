//! The applications: each a recipe over the rooms below.

pub mod bench;
pub mod error;
pub mod object;

pub use error::{PipelineError, Result};
