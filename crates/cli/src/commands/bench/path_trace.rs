//! `diorama bench path-trace`

use crate::commands::process::use_threads;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::bench::path_trace::{self, PathTraceOptions};
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;

/// Measure samples and rays per second of the path tracer
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama bench path-trace scene.toml --spp 32 --threads 2 --json")]
pub struct PathTrace {
    /// Model (.glb, .gltf, .obj) or composition (.toml) [default: a generated street]
    input: Option<PathBuf>,
    /// WIDTHxHEIGHT [default: that of the composition, else 640x360]
    #[arg(long)]
    size: Option<String>,
    /// Samples per pixel
    #[arg(long, default_value_t = 16)]
    spp: u32,
    /// Number of runs; the median is reported
    #[arg(long, default_value_t = 5)]
    repeats: usize,
    /// Save the picture of the last run as .exr, for other programs
    #[arg(long)]
    save: Option<PathBuf>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for PathTrace {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if self.spp == 0 || self.repeats == 0 {
            return Err(PipelineError::Usage("--spp and --repeats: must be at least 1".into()));
        }
        let size = self.size.as_deref().map(crate::commands::render::parse_size).transpose()?;
        let options = PathTraceOptions { size, samples: self.spp, repeats: self.repeats, save: self.save.clone() };
        let r = path_trace::run(self.input.as_deref(), &options)?;
        if self.json {
            println!("{}", serde_json::json!(r));
        } else {
            let [w, h] = r.size;
            println!("{}: {} triangles, {w} × {h} pixels, {} samples each", r.scene, r.triangles, r.spp);
            println!(
                "{:.2} M samples/s, {:.2} M rays/s ({:.2} s) on {} thread(s), {}",
                r.samples_per_s / 1e6,
                r.rays_per_s / 1e6,
                r.seconds,
                r.threads,
                r.simd
            );
        }
        Ok(Outcome::Done)
    }
}
