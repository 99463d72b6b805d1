//! Training of a run: what happens goes into its folder and to whoever watches.

use super::RunFolder;
use crate::error::{PipelineError, Result};
use diorama_data::checkpoint;
use diorama_engine::train::{self, Event, Origin, RunError, RunOptions, Summary, Trainee};
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Trains until the end of a run or an interrupt, logs into its folder, and draws the curves.
///
/// # Errors
/// When a step or a file fails, or training diverges.
pub fn train<T: Trainee<Error = PipelineError>>(
    (options, origin): (&RunOptions, Origin),
    trainer: &mut T,
    folder: &mut RunFolder,
    interrupt: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Summary> {
    let mut log_error = None;
    let result = train::run(options, origin, trainer, interrupt, &mut |e| {
        if let Err(e) = folder.log(e) {
            log_error.get_or_insert(e);
        }
        events(e);
    });
    if let Some(e) = log_error {
        return Err(e);
    }
    let summary = result.map_err(|e| match e {
        RunError::Failed(e) => e,
        RunError::Diverged { first, again } => PipelineError::Diverged { first, again, kept: kept(&folder.checkpoints()) },
    })?;
    folder.draw_curves()?;
    Ok(summary)
}

/// What is left of a run that diverged.
pub fn kept(checkpoints: &Path) -> String {
    if checkpoint::exists(checkpoints) {
        format!("{} is the last good checkpoint", checkpoint::latest(checkpoints).display())
    } else {
        "there was no checkpoint yet".into()
    }
}
