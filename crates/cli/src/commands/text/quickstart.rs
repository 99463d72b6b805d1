//! `diorama text quickstart`

use crate::commands::process::{INTERRUPT, note, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb, stages};
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::text::quickstart::{self, QuickstartOptions};
use std::path::PathBuf;

/// Run every step on a room with signs that the program generates itself
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama text quickstart -o runs/text-quickstart\n\nAfter an interruption, the same command goes on.")]
pub struct Quickstart {
    /// Folder for all results
    #[arg(short, long, default_value = "runs/text-quickstart")]
    out: PathBuf,
    /// Begin again in place of an earlier quickstart
    #[arg(long)]
    force: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

/// What marks a folder as one that a quickstart made.
const MARK: &str = "scenes";

impl Verb for Quickstart {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        stages::begin(&self.out, MARK, self.force)?;
        watch_interrupts();
        let made = stages::shown(|l| quickstart::quickstart(&self.out, &QuickstartOptions::default(), &INTERRUPT, l))?;
        let Some(made) = made else {
            eprintln!("interrupted: the same command goes on");
            return Ok(Outcome::Interrupted);
        };
        made.notes.iter().for_each(|n| note(n));
        if self.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
            return Ok(Outcome::Done);
        }
        println!("field      {:.2} dB, SSIM {:.3}, mIoU {:.3}", made.psnr, made.ssim, made.miou.unwrap_or(f64::NAN));
        let [corners, poses] = [made.corner_error_px, made.pose_error_deg].map(|v| v.unwrap_or(f64::NAN));
        println!("labels     corners {corners:.2} px, poses {poses:.1}° off");
        println!("images     {} at {:.1}/s", made.images, made.images_per_s);
        println!("           {} of {} labels of new words more than 2 px from their glyphs", made.misfits, made.compared);
        println!("detectors  F {:.1} (DB), {:.1} (EAST) on other images of the scene", 100.0 * made.f_db, 100.0 * made.f_east);
        println!("data set   {}", made.dataset.display());
        println!("report     {}", made.report.display());
        Ok(Outcome::Done)
    }
}
