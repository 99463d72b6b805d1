//! The applications: each a recipe over the rooms below.

pub mod application;
pub mod bench;
pub mod error;
pub mod object;
pub mod run;

pub use application::Application;
pub use error::{PipelineError, Result};
