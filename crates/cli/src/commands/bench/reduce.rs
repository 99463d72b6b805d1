//! `diorama bench reduce`

use crate::commands::count::count;
use crate::commands::process::{usage, use_threads};
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::bench::reduce;
use std::path::PathBuf;

/// Clean and reduce a generated surface of millions of faces with floaters
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama bench reduce --resolution 2400 --target 500k -o reduced/")]
pub struct Reduce {
    /// Cells along the longest side; 2000 give 20 million faces
    #[arg(long, default_value_t = 640)]
    resolution: usize,
    /// Faces that are left, such as 500k
    #[arg(long, default_value = "25k")]
    target: String,
    /// Folder for the extracted OBJ and the reduced GLB
    #[arg(short, long, default_value = "bench_reduce")]
    out: PathBuf,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Reduce {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if !(16..=4096).contains(&self.resolution) {
            return Err(usage(format!("resolution {}: must be 16 to 4096", self.resolution)));
        }
        let target = count(&self.target).filter(|n| *n > 0).ok_or_else(|| usage(format!("target {:?}: expected a number", self.target)))?;
        let r = reduce::run(self.resolution, target, &self.out)?;
        if self.json {
            println!("{}", serde_json::to_string(&r).expect("plain values"));
            return Ok(Outcome::Done);
        }
        println!(
            "{} faces in {:.1} s (sampled in {:.1} s, {} blocks), cleaned in {:.1} s, reduced to {} in {:.1} s, on {} threads",
            r.extracted_faces, r.extract_seconds, r.sample_seconds, r.sampled_blocks, r.clean_seconds, r.faces, r.reduce_seconds, r.threads
        );
        println!(
            "{} of {} floaters left, {:.4} % of the true area lost, mean distance {:.5} % of the diagonal",
            r.floaters_left,
            r.floaters,
            100.0 * r.area_lost,
            100.0 * r.mean_distance
        );
        println!(
            "OBJ before {:.1} MB, GLB after {:.2} MB (1/{:.0}), which loads in {:.2} s",
            r.obj_bytes as f64 / 1e6,
            r.glb_bytes as f64 / 1e6,
            r.obj_bytes as f64 / r.glb_bytes.max(1) as f64,
            r.glb_load_seconds
        );
        Ok(Outcome::Done)
    }
}
