//! `--mask` and `--mask-meaning`.

use super::process::usage;
use clap::Args;
use diorama_data::masks::{self, MaskOptions, MaskUse};
use diorama_pipelines::Result;

/// Options of commands that read a capture with masks.
#[derive(Args, Clone, Debug)]
pub struct MaskFlags {
    /// Masks beside the photographs: use (black is left out), invert or ignore [default: use]
    #[arg(long, value_name = "use|invert|ignore")]
    pub mask: Option<String>,
    /// Meaning of masked-out pixels: object (empty space), unknown (anything), or auto, chosen from what the masks cover [default: auto]
    #[arg(long, value_name = "auto|object|unknown")]
    pub mask_meaning: Option<String>,
}

impl MaskFlags {
    /// The options' values.
    ///
    /// # Errors
    /// If a value is unknown.
    pub fn options(&self) -> Result<MaskOptions> {
        Ok(MaskOptions {
            usage: self.mask.as_deref().map_or(Ok(MaskUse::Use), str::parse).map_err(usage)?,
            meaning: self.mask_meaning.as_deref().map_or(Ok(None), masks::parse_meaning).map_err(usage)?,
        })
    }
}
