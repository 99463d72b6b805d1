//! `diorama bench mesh`

use crate::commands::process::use_threads;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::bench;
use diorama_pipelines::object::run_folder;
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;

/// Extract a surface from a run's densities, with normals, and write it to a file
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama bench mesh runs/chair --resolution 512 --save-grid grid.npy")]
pub struct Mesh {
    /// Folder of the run
    run: PathBuf,
    /// Cells along the longest side
    #[arg(long, default_value_t = 512)]
    resolution: usize,
    /// Save the densities as .npy, for other programs
    #[arg(long)]
    save_grid: Option<PathBuf>,
    /// Number of runs; the median is reported
    #[arg(long, default_value_t = 5)]
    repeats: usize,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Mesh {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if !(16..=2048).contains(&self.resolution) || self.repeats == 0 {
            return Err(PipelineError::Usage("--resolution: must be 16 to 2048; --repeats: at least 1".into()));
        }
        let (model, notes) = run_folder::load_model(&self.run)?;
        notes.iter().for_each(|n| eprintln!("note: {n}"));
        let r = bench::mesh::run(&model, self.resolution, self.save_grid.as_deref(), self.repeats)?;
        if self.json {
            println!("{}", serde_json::json!(r));
        } else {
            let [x, y, z] = r.points;
            let memory = r.peak_bytes.map_or(String::new(), |b| format!(", {:.0} MB above the densities", b as f64 / 1e6));
            println!(
                "{x} x {y} x {z} at {:.2}: {} vertices, {} faces in {:.2} s on {} thread(s){memory}",
                r.level, r.vertices, r.faces, r.seconds, r.threads
            );
        }
        Ok(Outcome::Done)
    }
}
