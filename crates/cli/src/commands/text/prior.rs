//! `diorama text prior`

use crate::commands::process::usage;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_data::text_labels::{self, Format, Known};
use diorama_data::{DataError, photo};
use diorama_pipelines::text::synth::prior::Prior;
use diorama_pipelines::{PipelineError, Result};
use std::collections::HashMap;
use std::path::PathBuf;

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

impl Verb for PriorCommand {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        let names = || Format::ALL.map(Format::name).join(", ");
        let format = Format::named(&self.format).ok_or_else(|| usage(format!("format {:?}: expected {}", self.format, names())))?;
        let mut known = Vec::new();
        for entry in std::fs::read_dir(&self.images).map_err(DataError::io(&self.images, "read"))? {
            let path = entry.map_err(DataError::io(&self.images, "read"))?.path();
            let is_image = path.extension().is_some_and(|e| ["png", "jpg", "jpeg"].iter().any(|k| e.eq_ignore_ascii_case(k)));
            if is_image {
                let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                known.push(Known { path: name, size: photo::size(&path)? });
            }
        }
        if known.is_empty() {
            return Err(PipelineError::Usage(format!("{}: holds no PNG or JPEG images", self.images.display())));
        }
        known.sort_by(|a, b| a.path.cmp(&b.path));
        let images = text_labels::import(format, &self.labels, &known)?;
        let sizes: HashMap<String, (u32, u32)> = known.into_iter().map(|k| (k.path, k.size)).collect();
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
