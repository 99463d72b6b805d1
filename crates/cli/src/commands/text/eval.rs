//! `diorama text eval`

use crate::commands::process::{note, use_threads};
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_data::{DataError, photo};
use diorama_pipelines::Result;
use diorama_pipelines::text::field::{recipe, scores};
use std::path::{Path, PathBuf};

/// Score the held-out photographs of a text run: colors, and classes where they are known
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama text eval runs/text -o views")]
pub struct Eval {
    /// Folder of the run
    run: PathBuf,
    /// Folder for a picture of each view: photograph, rendered view, classes, known classes [default: RUN/eval]
    #[arg(short, long)]
    out: Option<PathBuf>,
    /// Where the photographs are now
    #[arg(long)]
    data: Option<PathBuf>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Eval {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let (model, notes) = recipe::load(&self.run, self.data.as_deref())?;
        notes.iter().for_each(|n| note(n));
        let out = self.out.clone().unwrap_or_else(|| self.run.join("eval"));
        std::fs::create_dir_all(&out).map_err(DataError::io(&out, "create"))?;
        let look = &mut |name: &str, sheet: &_| {
            let stem = Path::new(name).file_stem().unwrap_or_default().to_string_lossy();
            Ok(photo::save_png(&out.join(format!("{stem}.png")), sheet)?)
        };
        let s = scores::evaluate(&model, look)?;
        if self.json {
            println!("{}", serde_json::to_string(&s).expect("plain values"));
        } else {
            println!("{} held-out views  PSNR {:.2} dB  SSIM {:.3}", s.views, s.psnr, s.ssim);
            match s.miou {
                Some(miou) => println!("classes         mIoU {miou:.3}"),
                None => println!("classes         none are known of the held-out views"),
            }
            if let Some(error) = s.depth_error {
                println!("depth           median error {:.1} %", 100.0 * error);
            }
            println!("{}", out.display());
        }
        Ok(Outcome::Done)
    }
}
