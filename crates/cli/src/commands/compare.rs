//! `diorama compare`

use super::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::object::compare;
use diorama_pipelines::object::memory::size;
use diorama_pipelines::{Application, Result};
use std::path::PathBuf;

/// Compare runs side by side: curves, held-out images, cost
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama compare runs/a runs/b -o runs/compare")]
pub struct Compare {
    /// Folders of runs
    #[arg(required = true)]
    runs: Vec<PathBuf>,
    /// Where the photographs of all runs are now, if they moved
    #[arg(long, value_name = "FOLDER")]
    data: Option<PathBuf>,
    /// Folder for curves.svg, curves.png, views.png and compare.json
    #[arg(short, long, default_value = "runs/compare")]
    out: PathBuf,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Compare {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        for run in &self.runs {
            match Application::of_run(run)? {
                Application::Object => {}
                of @ Application::Relight => return Err(of.refuse(run, "diorama relight eval")),
                of @ Application::RelightObject => return Err(of.refuse(run, "diorama relight eval")),
                of @ Application::Text => return Err(of.refuse(run, "diorama text eval")),
                of @ Application::Detector => return Err(of.refuse(run, "diorama text eval-detector --weights")),
            }
        }
        self.objects()
    }
}

impl Compare {
    /// Compares runs of the object application.
    fn objects(&self) -> Result<Outcome> {
        let table = compare::compare(&self.runs, self.data.as_deref(), &self.out, &mut |n| eprintln!("{n}"))?;
        if self.json {
            println!("{}", serde_json::to_string(&table).expect("plain values"));
            return Ok(Outcome::Done);
        }
        println!(
            "{:<24} {:<9} {:>8} {:>9} {:>11} {:>11} {:>7} {:>7} {:>8} {:>10}",
            "run", "method", "steps", "seconds", "rays", "parameters", "psnr", "ssim", "mse", "memory"
        );
        for c in &table {
            let run = c.run.display().to_string();
            println!(
                "{run:<24} {:<9} {:>8} {:>9.1} {:>11} {:>11} {:>7.2} {:>7.4} {:>8.5} {:>10}",
                c.method,
                c.steps,
                c.seconds,
                c.rays,
                c.parameters,
                c.psnr,
                c.ssim,
                c.mse,
                c.peak_memory_bytes.map_or("unknown".into(), size)
            );
        }
        println!("{}", self.out.display());
        Ok(Outcome::Done)
    }
}
