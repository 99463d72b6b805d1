//! One file per verb.

pub mod eval;
pub mod train;

use diorama_pipelines::{PipelineError, Result};
use std::sync::atomic::{AtomicBool, Ordering};

/// How a command ended, errors apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    Done,
    Interrupted,
}

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
pub fn use_threads(threads: Option<usize>) -> Result<()> {
    if threads == Some(0) {
        return Err(PipelineError::Usage("--threads 0: must be at least 1".into()));
    }
    if let Some(n) = threads {
        let _ = rayon::ThreadPoolBuilder::new().num_threads(n).build_global();
    }
    Ok(())
}
