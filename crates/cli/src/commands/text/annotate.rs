//! `diorama text annotate`

use crate::commands::process::{note, usage};
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_data::text_labels::Format;
use diorama_pipelines::Result;
use diorama_pipelines::text::annotate;
use std::path::PathBuf;

/// Import labels of writing for a capture, and check them
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama text annotate data/shop --format labelme labels/")]
pub struct Annotate {
    /// Folder of the capture
    capture: PathBuf,
    /// File or folder of the labels
    labels: PathBuf,
    /// labelme, ppocr, icdar13, icdar15 or mlt17
    #[arg(long)]
    format: String,
    /// Replace earlier labels
    #[arg(long)]
    force: bool,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Annotate {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        let format = Format::named(&self.format).ok_or_else(|| {
            let names: Vec<&str> = Format::ALL.iter().map(|f| f.name()).collect();
            usage(format!("format {:?}: expected {}", self.format, names.join(", ")))
        })?;
        let made = annotate::annotate(&self.capture, &self.labels, format, self.force)?;
        made.notes.iter().for_each(|n| note(n));
        if self.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
        } else {
            println!("{} photographs with labels of {} regions, {} labels to be ignored", made.images, made.regions, made.ignored);
            println!("{}", made.file.display());
        }
        Ok(Outcome::Done)
    }
}
