//! `diorama relight quickstart`

use crate::commands::process::{INTERRUPT, note, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb, stages};
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::relight::quickstart::{self, QuickstartOptions};
use std::path::PathBuf;

/// Run every step on a street and a chair that the program generates itself
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Example:\n  diorama relight quickstart -o runs/relight-quickstart\n\nAfter an interruption, the same command goes on."
)]
pub struct Quickstart {
    /// Folder for all results
    #[arg(short, long, default_value = "runs/relight-quickstart")]
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
const MARK: &str = "street";

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
        } else {
            println!(
                "street     {:.2} dB in an unseen light, albedo {:.2} dB, normals {:.1}°",
                made.unseen_light_psnr, made.albedo_psnr, made.normal_median_deg
            );
            println!("chair      {:.2} dB, in an unseen light {:.2} dB", made.object_psnr, made.object_relight_psnr);
            println!("meshes     {}, {}", made.glb.display(), made.site_glb.display());
            println!("composed   {}", made.composed.display());
            println!("report     {}", made.report.display());
        }
        Ok(Outcome::Done)
    }
}
