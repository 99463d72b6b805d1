//! Events of a run, which the terminal, the log and the viewer listen to.

use super::scalar::{Scalars, Scores};

/// What one step came to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    /// What the step minimized. One that is not finite takes the run back (see [`super::Trainee::recover`]).
    pub loss: f64,
    /// Whatever else is worth a line in the log.
    pub scalars: Scalars,
}

/// Something that happened in a run.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The run begins or goes on at `step`.
    Started {
        step: u64,
        steps: Option<u64>,
        seconds: Option<f64>,
    },
    /// Mean loss and figures of the steps since the last such event.
    Progress {
        step: u64,
        seconds: f64,
        /// Share of the budget that is spent, 0 to 1.
        progress: f64,
        loss: f64,
        scalars: Scalars,
    },
    /// What was learned was scored on held-out data.
    Evaluated {
        step: u64,
        seconds: f64,
        scores: Scores,
    },
    Saved {
        step: u64,
    },
    /// What went wrong at `step`; the run goes on from `to_step`.
    Recovered {
        step: u64,
        to_step: u64,
        why: String,
    },
    Note(String),
    Finished {
        step: u64,
        seconds: f64,
        interrupted: bool,
    },
}
