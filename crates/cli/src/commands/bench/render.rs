//! `diorama bench render`

use crate::commands::process::{note, use_threads};
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::bench;
use diorama_pipelines::object::{device, run_folder};
use std::path::PathBuf;

/// Measure frames per second of a run's held-out views, and the error of the fast quality
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama bench render runs/chair --json")]
pub struct Render {
    /// Folder of the run
    run: PathBuf,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    device: String,
    /// Runs per view; the median is reported
    #[arg(long, default_value_t = 5)]
    repeats: usize,
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
        let (mut model, notes) = run_folder::load_model(&self.run)?;
        let device = device::accelerate(&mut model, &self.device, Box::new(note))?;
        notes.iter().for_each(|n| eprintln!("note: {n}"));
        let report = bench::render::run(&model, self.repeats, device)?;
        if self.json {
            println!("{}", serde_json::json!(report));
            return Ok(Outcome::Done);
        }
        println!("{} views of {} x {} on {}", report.views, report.width, report.height, report.device);
        for (name, q) in [("exhaustive", report.exhaustive), ("full", report.full), ("fast", report.fast)] {
            let times = q.frames_per_s / report.exhaustive.frames_per_s;
            println!(
                "{name:<10} {:6.2} frames/s ({times:.2} x), {:.3} dB, {:.1} dB against exhaustive",
                q.frames_per_s, q.psnr, q.psnr_against_exhaustive
            );
        }
        Ok(Outcome::Done)
    }
}
