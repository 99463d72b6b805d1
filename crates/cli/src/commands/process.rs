//! Process-wide settings of commands: interrupts, threads, notes.

use diorama_pipelines::{PipelineError, Result};
use std::sync::atomic::{AtomicBool, Ordering};

/// Set by the first Ctrl-C; the second ends the program at once.
pub static INTERRUPT: AtomicBool = AtomicBool::new(false);

/// Makes Ctrl-C end long work cleanly.
pub fn watch_interrupts() {
    // A handler may exist already when commands call commands.
    let _ = ctrlc::set_handler(|| {
        if INTERRUPT.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("stopping after this step; press Ctrl-C again to stop at once");
    });
}

/// Limits the threads of all kernels.
///
/// # Errors
/// If the number is zero.
pub fn use_threads(threads: Option<usize>) -> Result<()> {
    if threads == Some(0) {
        return Err(PipelineError::Usage("--threads 0: must be at least 1".into()));
    }
    if let Some(n) = threads {
        let _ = rayon::ThreadPoolBuilder::new().num_threads(n).build_global();
    }
    Ok(())
}

/// Prints a note for the user.
pub fn note(text: &str) {
    eprintln!("note: {text}");
}

/// Removes the folder of a run that did not start, and says so where it cannot.
pub fn discard(run: &std::path::Path) {
    if let Err(e) = std::fs::remove_dir_all(run) {
        note(&format!("{}: cannot remove the run that did not start: {e}", run.display()));
    }
}

/// Error for an option's value; `text` begins with the option's name.
pub fn usage(text: String) -> PipelineError {
    PipelineError::Usage(format!("--{text}"))
}
