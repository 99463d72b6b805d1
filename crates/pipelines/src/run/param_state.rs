//! Parameters and other numbers of a model in checkpoints.

use crate::error::{PipelineError, Result};
use diorama_data::checkpoint::{Checkpoint, Entry};
use diorama_engine::params::{ParamSet, RestoreError};
use std::path::Path;

/// Values and moments of all groups, as checkpoints hold them.
pub fn entries(params: ParamSet<'_>) -> Vec<Entry<'_>> {
    params.into_arrays().into_iter().map(|(name, data)| entry(name, data)).collect()
}

/// Numbers that stand in a row.
pub fn entry(name: impl Into<String>, data: &[f32]) -> Entry<'_> {
    Entry { name: name.into(), shape: vec![data.len()], data }
}

/// Takes groups from a checkpoint that was read from `file`.
///
/// # Errors
/// When the checkpoint has not what the groups need.
pub fn restore(params: &mut ParamSet, from: &mut Checkpoint, file: &Path) -> Result<()> {
    params.restore(&mut |name| from.take(name)).map_err(|e| misfit(&e, file))
}

/// Takes numbers of a name from a checkpoint that was read from `file`, as many as there are in `into`.
///
/// # Errors
/// When they are missing or not as many.
pub fn take(into: &mut Vec<f32>, name: &str, from: &mut Checkpoint, file: &Path) -> Result<()> {
    let values = from.take(name).ok_or_else(|| misfit(&RestoreError::Missing(name.into()), file))?;
    if values.len() != into.len() {
        return Err(misfit(&RestoreError::Length { name: name.into(), got: values.len(), wanted: into.len() }, file));
    }
    *into = values;
    Ok(())
}

fn misfit(e: &RestoreError, file: &Path) -> PipelineError {
    PipelineError::Usage(format!("{}: {e}", file.display()))
}
