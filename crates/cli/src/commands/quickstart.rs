//! `diorama quickstart`

use super::{INTERRUPT, Outcome, use_threads, watch_interrupts};
use crate::arguments::QuickstartArgs;
use crate::terminal::Progress;
use diorama_pipelines::object::quickstart;
use diorama_pipelines::{PipelineError, Result};

pub fn run(a: &QuickstartArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    if !(a.seconds.is_finite() && a.seconds > 0.0) {
        return Err(PipelineError::Usage(format!("--seconds {}: must be greater than 0", a.seconds)));
    }
    watch_interrupts();
    // The default folder is the program's own: a second quickstart replaces the first.
    let force = a.force || a.out == std::path::Path::new("runs/quickstart");
    let mut progress = Progress::new();
    let made = quickstart::quickstart(&a.out, a.seconds, force, &INTERRUPT, &mut |n| eprintln!("{n}"), &mut |e| progress.event(e))?;
    if a.json {
        println!("{}", serde_json::to_string(&made).expect("plain values"));
    } else {
        println!("held-out psnr {:.2} dB, ssim {:.4} after {:.0} s of training", made.psnr, made.ssim, made.train_seconds);
        println!("report     {}", made.report.display());
        made.video.iter().for_each(|v| println!("video      {}", v.display()));
        println!("mesh       {}", made.mesh.file.display());
        println!("curves     {}", made.folder.join("curves.svg").display());
        println!("the same with your photographs: diorama train FOLDER -o runs/mine");
    }
    Ok(if made.interrupted { Outcome::Interrupted } else { Outcome::Done })
}
