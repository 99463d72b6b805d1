//! Events of a run, which the terminal, the log and the viewer listen to.

use super::scalar::{Scalars, Scores};

/// Result of one step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Loss of the step. If it is not finite, the run goes back ([`super::Trainee::recover`]).
    pub loss: f64,
    /// Other figures for the log, the terminal and the viewer.
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
    /// The model was scored on held-out data.
    Evaluated {
        step: u64,
        seconds: f64,
        scores: Scores,
    },
    Saved {
        step: u64,
    },
    /// The run failed at `step` because of `why` and goes on from `to_step`.
    Recovered {
        step: u64,
        to_step: u64,
        why: String,
    },
    /// Work before a step, of which a share is done, 0 to 1.
    Preparing {
        what: &'static str,
        share: f64,
    },
    Note(String),
    Finished {
        step: u64,
        seconds: f64,
        interrupted: bool,
    },
}
