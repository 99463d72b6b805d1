//! `diorama quickstart`

use super::process::{INTERRUPT, use_threads, watch_interrupts};
use super::{Outcome, Verb};
use crate::terminal::Progress;
use clap::Args;
use diorama_pipelines::object::quickstart;
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;

/// Run every step on a capture that the program generates itself
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama quickstart --seconds 30 -o runs/first")]
pub struct Quickstart {
    /// Folder for all results
    #[arg(short, long, default_value = "runs/quickstart")]
    out: PathBuf,
    /// Seconds of training
    #[arg(long, default_value_t = 90.0)]
    seconds: f64,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Replace an earlier quickstart
    #[arg(long)]
    force: bool,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Quickstart {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if !(self.seconds.is_finite() && self.seconds > 0.0) {
            return Err(PipelineError::Usage(format!("--seconds {}: must be greater than 0", self.seconds)));
        }
        watch_interrupts();
        // The default folder belongs to the program: a second quickstart replaces the first.
        let force = self.force || self.out == std::path::Path::new("runs/quickstart");
        let mut progress = Progress::new();
        let made =
            quickstart::quickstart(&self.out, self.seconds, force, &INTERRUPT, &mut |n| eprintln!("{n}"), &mut |e| progress.event(e))?;
        if self.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
        } else {
            println!("held-out psnr {:.2} dB, ssim {:.4} after {:.0} s of training", made.psnr, made.ssim, made.train_seconds);
            println!("report     {}", made.report.display());
            made.video.iter().for_each(|v| println!("video      {}", v.display()));
            println!("mesh       {}", made.mesh.file.display());
            println!("curves     {}", made.folder.join("curves.svg").display());
            println!("with your own photographs: diorama train FOLDER -o runs/mine");
        }
        Ok(if made.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }
}
