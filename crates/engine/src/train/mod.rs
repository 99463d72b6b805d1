//! The training run: a loop around a step, which emits events, saves, stops and recovers.

mod event;
mod run;

pub use event::{Event, StepReport};
pub use run::{HeldOut, Origin, RunError, RunOptions, Summary, Trainee, run};
