//! `diorama bench train`

use crate::commands::process::use_threads;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::bench;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::run::config::set_all;
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;

/// Show how long each stage of a training step takes; writes nothing
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama bench train capture/ --downscale 4 --steps 200")]
pub struct Train {
    /// Folder of the capture
    data: PathBuf,
    /// ngp, nerf, mlp or baseline
    #[arg(long, default_value = "ngp")]
    method: String,
    /// Reduce the photographs by this factor
    #[arg(long, default_value_t = 1)]
    downscale: u32,
    /// every:N, A:B:C (percent), file or all
    #[arg(long, default_value = "file")]
    split: String,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    device: String,
    /// Steps before the measured steps
    #[arg(long, default_value_t = 300)]
    warmup: u64,
    /// Number of measured steps
    #[arg(long, default_value_t = 200)]
    steps: u64,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Set a configuration value; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Train {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let method: Method = self.method.parse().map_err(|e| PipelineError::Usage(format!("--method {e}")))?;
        let mut c = Config::new(method, self.data.clone());
        c.data.downscale = self.downscale;
        c.data.split = self.split.clone();
        c.set("device", &self.device)?;
        set_all(&mut c, &self.overrides)?;
        c.check()?;
        let r = bench::train::run(&c, self.warmup, self.steps.max(1))?;
        if self.json {
            println!("{}", serde_json::json!(r));
            return Ok(Outcome::Done);
        }
        for s in &r.stages {
            println!("{:<12} {:>8.2} ms/step {:>6.1} %", s.stage, s.ms, 100.0 * s.share);
        }
        let with = if r.device == "cpu" { format!("{} thread(s), {}", r.threads, r.simd) } else { r.device };
        println!("{} steps in {:.1} s on {with}", r.steps, r.seconds);
        println!(
            "{:.0} rays/s; per ray {:.1} samples marched, {:.1} trained; {:.0} samples/s trained",
            r.rays_per_s, r.marched_per_ray, r.trained_per_ray, r.trained_per_s
        );
        if let Some(o) = r.occupied {
            println!("{:.1} % of the occupancy grid's cells are occupied", 100.0 * o);
        }
        Ok(Outcome::Done)
    }
}
