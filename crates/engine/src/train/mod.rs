//! The loop of a run: steps, a log, checkpoints, evaluations, and events about all of them.

mod event;
mod run;
pub mod scalar;

pub use event::{Event, StepReport};
pub use run::{Origin, RunError, RunOptions, Summary, Trainee, run};
pub use scalar::{Scalar, Scalars, Scores};
