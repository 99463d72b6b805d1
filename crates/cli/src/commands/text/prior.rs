//! `diorama text prior`

use crate::commands::process::usage;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_data::text_labels::{self, Format, Known, LabelledImage};
use diorama_data::{DataError, photo};
use diorama_pipelines::text::synth::prior::Prior;
use diorama_pipelines::{PipelineError, Result};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Measure where text is in labelled images and how large, for the cameras of a data set
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Example:\n  diorama text prior --images icdar/images --labels icdar/gt --format icdar15 -o prior.json\n  diorama text synth runs/room --prior prior.json"
)]
pub struct PriorCommand {
    /// Folder of the images
    #[arg(long)]
    images: PathBuf,
    /// Folder or file of their labels
    #[arg(long)]
    labels: PathBuf,
    /// labelme, ppocr, icdar13, icdar15 or mlt17
    #[arg(long)]
    format: String,
    #[arg(short, long, default_value = "prior.json")]
    out: PathBuf,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

/// Labels of a folder of images, and the images' sizes by name.
///
/// # Errors
/// When the format is none, or images or labels cannot be read.
pub fn labelled(folder: &Path, labels: &Path, format: &str) -> Result<(Vec<LabelledImage>, HashMap<String, (u32, u32)>)> {
    let names = || Format::ALL.map(Format::name).join(", ");
    let format = Format::named(format).ok_or_else(|| usage(format!("format {format:?}: expected {}", names())))?;
    let mut known = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(DataError::io(folder, "read"))? {
        let path = entry.map_err(DataError::io(folder, "read"))?.path();
        let is_image = path.extension().is_some_and(|e| ["png", "jpg", "jpeg"].iter().any(|k| e.eq_ignore_ascii_case(k)));
        if is_image {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            known.push(Known { path: name, size: photo::size(&path)? });
        }
    }
    if known.is_empty() {
        return Err(PipelineError::Usage(format!("{}: holds no PNG or JPEG images", folder.display())));
    }
    known.sort_by(|a, b| a.path.cmp(&b.path));
    let images = text_labels::import(format, labels, &known)?;
    Ok((images, known.into_iter().map(|k| (k.path, k.size)).collect()))
}

impl Verb for PriorCommand {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        let (images, sizes) = labelled(&self.images, &self.labels, &self.format)?;
        let prior = Prior::of(&images, &sizes);
        if prior.regions == 0 {
            return Err(PipelineError::Usage(format!("{}: all regions are to be ignored", self.labels.display())));
        }
        prior.save(&self.out)?;
        let at = |share: f64| 100.0 * prior.areas[((prior.areas.len() - 1) as f64 * share) as usize];
        if self.json {
            println!("{}", serde_json::json!({ "regions": prior.regions, "images": images.len(), "prior": self.out }));
        } else {
            println!("{} regions of {} images", prior.regions, images.len());
            println!("area            {:.2} % of the image, nine of ten from {:.2} to {:.2} %", at(0.5), at(0.05), at(0.95));
            println!("{}", self.out.display());
        }
        Ok(Outcome::Done)
    }
}
