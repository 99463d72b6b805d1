//! `diorama relight render`

use super::light_flags::LightFlags;
use crate::commands::process::{INTERRUPT, note, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_pipelines::relight::outdoor::pictures::{self, Layer, PicturesOptions};
use diorama_pipelines::relight::outdoor::recipe;
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;

/// Render views of a trained scene under its own light or a new one, and its layers
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama relight render runs/site --light dusk.hdr --rotate 40 -o out\n  diorama relight render runs/site --frame 12 --own-light --layers rgb,albedo,normal,shadow"
)]
pub struct Render {
    /// Folder of the run
    run: PathBuf,
    #[command(flatten)]
    light: LightFlags,
    /// Show each view in the light that was learned for it, instead of --light
    #[arg(long)]
    own_light: bool,
    /// Number of a photograph, from 0, or its name; may be repeated [default: all that were held out]
    #[arg(long)]
    frame: Vec<String>,
    /// rgb, albedo, normal, shadow, irradiance, depth
    #[arg(long, default_value = "rgb", value_delimiter = ',')]
    layers: Vec<String>,
    /// Rays per pixel and axis, from 1 to 16
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=16))]
    samples: u32,
    /// exr (linear) or png
    #[arg(long, default_value = "png")]
    format: String,
    /// Folder for the pictures
    #[arg(short, long, default_value = "relit")]
    out: PathBuf,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Render {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let usage = |e: String| PipelineError::Usage(format!("--layers {e}"));
        let layers: Vec<Layer> = self.layers.iter().map(|l| l.parse().map_err(usage)).collect::<Result<_>>()?;
        if !["exr", "png"].contains(&&self.format[..]) {
            return Err(PipelineError::Usage(format!("--format {:?}: expected exr or png", self.format)));
        }
        let (model, notes) = recipe::load(&self.run)?;
        notes.iter().for_each(|n| note(n));
        let light = if self.own_light { None } else { Some(self.light.options()?) };
        let options = PicturesOptions {
            light,
            frames: self.frame.clone(),
            layers,
            samples: self.samples,
            is_linear: self.format == "exr",
            out: self.out.clone(),
        };
        watch_interrupts();
        let mut shown = ShareShown::new();
        let made = pictures::render(&model, &options, &INTERRUPT, &mut |s| shown.show(s, "views"))?;
        shown.finish();
        made.notes.iter().for_each(|n| note(n));
        if self.json {
            println!("{}", serde_json::json!({ "pictures": made.pictures, "interrupted": made.interrupted }));
        } else {
            println!("{} pictures in {}", made.pictures.len(), self.out.display());
        }
        Ok(if made.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }
}
