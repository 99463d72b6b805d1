//! `diorama relight turntable`

use super::light_flags::LightFlags;
use crate::commands::process::{INTERRUPT, note, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_pipelines::relight::path_tracer::PathTracer;
use diorama_pipelines::relight::turntable::{self, TurntableOptions};
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;
use std::time::Instant;

/// Render a model from all sides under one light
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama relight turntable chair.glb --light dusk.hdr --frames 36 -o turn/\n  diorama relight turntable chair.glb --light sky:8,200 --background -o turn.mp4"
)]
pub struct Turntable {
    /// Model (.glb, .gltf or .obj)
    model: PathBuf,
    #[command(flatten)]
    light: LightFlags,
    #[arg(long, default_value_t = 36)]
    frames: usize,
    /// WIDTHxHEIGHT
    #[arg(long, default_value = "512x512")]
    size: String,
    /// Samples per pixel
    #[arg(long, default_value_t = 64)]
    spp: u32,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    device: String,
    /// Height of the camera above the model's center in degrees
    #[arg(long, default_value_t = 20.0, allow_hyphen_values = true)]
    elevation: f64,
    /// Horizontal field of view in degrees
    #[arg(long, default_value_t = 35.0)]
    fov: f64,
    /// off or atrous
    #[arg(long, default_value = "atrous")]
    denoise: String,
    /// Show the light behind the model
    #[arg(long)]
    background: bool,
    /// Turn the model under a light that stays, in place of the camera
    #[arg(long)]
    turn_model: bool,
    /// Stops by which frames are brightened [default: such that the brightest twentieth of the first frame is nearly white]
    #[arg(long, allow_hyphen_values = true)]
    exposure: Option<f64>,
    /// Folder for PNG files, or a video (.mp4, .gif)
    #[arg(short, long, default_value = "turntable")]
    out: PathBuf,
    /// Replace frames that are there; else they are kept, and the others rendered
    #[arg(long)]
    force: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Turntable {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let options = self.options()?;
        watch_interrupts();
        let mut tracer = PathTracer::open(&self.device, Box::new(note))?;
        let (start, mut shown) = (Instant::now(), ShareShown::new());
        let made = turntable::render(&self.model, &options, &mut tracer, self.force, &INTERRUPT, &mut |s| shown.show(s, "turntable"))?;
        shown.finish();
        made.notes.iter().for_each(|n| note(n));
        if made.interrupted {
            eprintln!("interrupted after {} frames", made.frames);
        }
        if self.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
        } else {
            println!("{} frames of {} triangles in {:.1} s ({})", made.frames, made.triangles, start.elapsed().as_secs_f64(), made.device);
            println!("exposure   {:+.2} stops", made.exposure);
            println!("{}", made.out.display());
        }
        Ok(if made.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }
}

impl Turntable {
    fn options(&self) -> Result<TurntableOptions> {
        let refuse = |text: &str| Err(PipelineError::Usage(text.into()));
        if self.frames == 0 || self.spp == 0 {
            return refuse("--frames and --spp: must be at least 1");
        }
        let is_between = |v: f64, low: f64, high: f64| v > low && v < high;
        if !is_between(self.fov, 0.0, 179.0) || !is_between(self.elevation, -90.0, 90.0) {
            return refuse("--fov: must lie between 0 and 179 degrees; --elevation: between -90 and 90");
        }
        let denoise = match self.denoise.as_str() {
            "off" => false,
            "atrous" => true,
            _ => return refuse("--denoise: expected off or atrous"),
        };
        Ok(TurntableOptions {
            light: self.light.options()?,
            frames: self.frames,
            size: crate::commands::render::parse_size(&self.size)?,
            samples: self.spp,
            elevation: self.elevation.to_radians(),
            fov: self.fov.to_radians(),
            denoise,
            background: self.background,
            turn_model: self.turn_model,
            exposure: self.exposure,
            out: self.out.clone(),
        })
    }
}
