//! The perceptual distance LPIPS with weights of the user's.

use crate::error::{PipelineError, Result};
use diorama_data::weights;
use diorama_engine::metrics::lpips::{self, Lpips};
use std::path::PathBuf;

/// Reads the network and the heads of LPIPS, which may be one file or several.
///
/// # Errors
/// When a file is malformed, or the network or the heads are missing.
pub fn load_lpips(files: &[PathBuf]) -> Result<Lpips> {
    let mut tensors = Vec::new();
    for file in files {
        tensors.extend(weights::read(file, &lpips::is_wanted)?.into_iter().map(|t| (t.name, t.shape, t.values)));
    }
    let names: Vec<String> = files.iter().map(|f| f.display().to_string()).collect();
    Lpips::new(tensors).map_err(|e| PipelineError::Usage(format!("{}: {e}", names.join(","))))
}
