//! Loading of the capture that a configuration names.

use super::config::Config;
use crate::error::{PipelineError, Result};
use diorama_data::import::{self, ImportOptions};
use diorama_data::photo_check;
use diorama_geom::Capture;

/// Reads the capture that a configuration names.
pub fn load_capture(config: &Config) -> Result<Capture> {
    let split = config.data.split.parse().map_err(PipelineError::Usage)?;
    let format = match &config.data.format[..] {
        "" => None,
        f => Some(f.parse().map_err(PipelineError::Usage)?),
    };
    let options = ImportOptions {
        format,
        split,
        seed: config.seed,
        masks: config.data.masks()?,
        skip_broken: config.data.skip_broken,
        ..ImportOptions::default()
    };
    let mut capture = import::import(&config.data.path, &options)?;
    if config.data.skip_broken {
        photo_check::leave_out_broken(&mut capture)?;
    }
    Ok(capture)
}
