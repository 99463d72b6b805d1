//! `diorama bench raster`

use crate::commands::process::use_threads;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::bench::raster;
use diorama_pipelines::{PipelineError, Result};

/// Measure pixels per second of rasterization, interpolation and texture
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama bench raster --threads 2 --json")]
pub struct RasterBench {
    /// Edge of the square picture in pixels
    #[arg(long, default_value_t = 512)]
    size: usize,
    /// Number of runs; medians are reported
    #[arg(long, default_value_t = 21)]
    repeats: usize,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for RasterBench {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if !(16..=4096).contains(&self.size) || self.repeats == 0 {
            return Err(PipelineError::Usage("--size: must be 16 to 4096; --repeats: at least 1".into()));
        }
        let r = raster::run(self.size, self.repeats);
        if self.json {
            println!("{}", serde_json::json!(r));
        } else {
            println!("{0} × {0} pixels, {1} triangles, {2} thread(s), {3}", self.size, r.triangles, r.threads, r.simd);
            println!(
                "bilinear   {:6.1} M pixels/s: rasterize {:.2} ms, interpolate {:.2} ms, texture {:.2} ms",
                r.pixels_per_s / 1e6,
                r.rasterize_ms,
                r.interpolate_ms,
                r.texture_ms
            );
            println!("trilinear  {:6.1} M pixels/s, with screen derivatives", r.trilinear_pixels_per_s / 1e6);
        }
        Ok(Outcome::Done)
    }
}
