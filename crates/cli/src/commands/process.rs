//! What verbs do to the process: interrupts, threads, notes.

use diorama_pipelines::{PipelineError, Result};
use std::sync::atomic::{AtomicBool, Ordering};

/// Set by the first Ctrl-C; the second ends the program at once.
pub static INTERRUPT: AtomicBool = AtomicBool::new(false);

/// Lets Ctrl-C end long work cleanly.
pub fn watch_interrupts() {
    // A handler may already be there when verbs call verbs.
    let _ = ctrlc::set_handler(|| {
        if INTERRUPT.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("stopping after this step; press Ctrl-C again to stop at once");
    });
}

/// Bounds the threads of all kernels.
///
/// # Errors
/// When there would be none.
pub fn use_threads(threads: Option<usize>) -> Result<()> {
    if threads == Some(0) {
        return Err(PipelineError::Usage("--threads 0: must be at least 1".into()));
    }
    if let Some(n) = threads {
        let _ = rayon::ThreadPoolBuilder::new().num_threads(n).build_global();
    }
    Ok(())
}

/// Tells what the user should know.
pub fn note(text: &str) {
    eprintln!("note: {text}");
}

/// What a flag's value is refused with; `text` begins with the flag's name.
pub fn usage(text: String) -> PipelineError {
    PipelineError::Usage(format!("--{text}"))
}
