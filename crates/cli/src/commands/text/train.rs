//! `diorama text train`

use crate::commands::process::{INTERRUPT, discard, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::Progress;
use clap::Args;
use diorama_pipelines::run::{RunFolder, config};
use diorama_pipelines::text::field::config::{Config, Preset};
use diorama_pipelines::text::field::recipe;
use diorama_pipelines::{PipelineError, Result};
use std::path::{Path, PathBuf};

/// Train the field of a scene with writing, then the classes of its text regions
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text train data/signs/room-000 --preset ci -o runs/room\n  diorama text train --resume -o runs/room\n  diorama text eval runs/room"
)]
pub struct Train {
    /// Folder of the capture, with labels.jsonl beside its photographs
    data: Option<PathBuf>,
    /// ci, fast or gpu
    #[arg(long, default_value = "fast")]
    preset: String,
    /// Leave out the structural loss
    #[arg(long)]
    no_s3im: bool,
    /// Leave out the distortion loss
    #[arg(long)]
    no_dist: bool,
    /// Leave out the encoded position that classes are learned from
    #[arg(long)]
    no_pe: bool,
    /// auto, cpu, or a GPU
    #[arg(long)]
    device: Option<String>,
    /// Run folder
    #[arg(short, long, default_value = "runs/text")]
    out: PathBuf,
    /// Steps of the whole run, both stages
    #[arg(long)]
    steps: Option<u64>,
    /// Seconds of the whole run
    #[arg(long)]
    seconds: Option<f64>,
    #[arg(long)]
    seed: Option<u64>,
    /// KEY=VALUE of the configuration; may be repeated
    #[arg(long)]
    set: Vec<String>,
    /// Go on from the last checkpoint
    #[arg(long)]
    resume: bool,
    /// Replace an earlier run
    #[arg(long)]
    force: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

/// Checks values that a resumed run keeps.
///
/// # Errors
/// With the keys that differ.
fn unchanged(run: &Path, before: &[(String, String)], now: &[(String, String)]) -> Result<()> {
    let is_kept = |key: &str| key == "seed" || ["data.", "field.", "labels."].iter().any(|part| key.starts_with(part));
    let differing: Vec<&str> = before.iter().zip(now).filter(|(a, b)| a != b && is_kept(&a.0)).map(|(a, _)| &a.0[..]).collect();
    if differing.is_empty() {
        return Ok(());
    }
    let (run, differing) = (run.display(), differing.join(", "));
    let what = format!("--resume: {run} was begun with other {differing}; leave them out, or begin a new run with another --out");
    Err(PipelineError::Usage(what))
}

impl Verb for Train {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let (mut folder, mut config) = match (self.resume, &self.data) {
            (true, None) => {
                let (folder, description) = RunFolder::open(&self.out)?;
                (Some(folder), description.config::<Config>()?)
            }
            (true, Some(_)) => return Err(PipelineError::Usage("--resume: the run knows its capture; leave out the folder".into())),
            (false, None) => return Err(PipelineError::Usage("give the folder of a capture, or --resume".into())),
            (false, Some(data)) => (None, Config::new(Preset::named(&self.preset)?, data.clone())),
        };
        if self.resume && (self.no_s3im || self.no_dist || self.no_pe) {
            return Err(PipelineError::Usage("--resume: the run knows its losses; leave out --no-s3im, --no-dist and --no-pe".into()));
        }
        let before = config::values(&config);
        let off = [(self.no_s3im, "loss.s3im"), (self.no_dist, "loss.distortion"), (self.no_pe, "labels.waves")];
        off.into_iter().filter(|(off, _)| *off).try_for_each(|(_, key)| config.set(key, "0"))?;
        self.steps.iter().for_each(|s| config.run.steps = *s);
        self.seconds.iter().for_each(|s| config.run.seconds = *s);
        self.seed.iter().for_each(|s| config.seed = *s);
        self.device.iter().for_each(|d| config.device.clone_from(d));
        config::set_all(&mut config, &self.set)?;
        if self.resume {
            unchanged(&self.out, &before, &config::values(&config))?;
        }
        // Nothing is written before the request is known to be sound.
        if !self.resume {
            recipe::check(&config)?;
        }
        let existed = self.out.exists();
        let mut folder = folder.take().map_or_else(|| RunFolder::create(&self.out, self.force), Ok)?;
        watch_interrupts();
        let mut progress = Progress::new();
        let trained = recipe::train(&config, &mut folder, self.resume, &INTERRUPT, &mut |e| progress.event(e));
        if trained.is_err() && !existed && !folder.checkpoints().exists() {
            // A run that never started leaves nothing behind.
            drop(folder);
            discard(&self.out);
        }
        let s = &trained?.summary;
        if self.json {
            println!(
                "{}",
                serde_json::json!({ "run": self.out, "steps": s.step, "seconds": s.seconds, "loss": s.loss, "interrupted": s.interrupted })
            );
        } else {
            println!("{} steps in {:.0} s, loss {:.5}", s.step, s.seconds, s.loss);
            println!("{}", self.out.display());
        }
        Ok(if s.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }
}
