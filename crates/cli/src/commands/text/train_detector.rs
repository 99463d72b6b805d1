//! `diorama text train-detector`

use crate::commands::process::{INTERRUPT, discard, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::Progress;
use clap::Args;
use diorama_pipelines::run::{RunFolder, config};
use diorama_pipelines::text::detectors::config::{Backbone, Config, Kind};
use diorama_pipelines::text::detectors::recipe;
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;

/// Train a detector of writing on labelled images
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text train-detector --data ds/train --model db --backbone tiny -o runs/db\n  diorama text train-detector --resume -o runs/db\n  diorama text eval-detector --weights runs/db --data ds/test"
)]
pub struct TrainDetector {
    /// Folder with images/ and, for each image, icdar15/gt_NAME.txt
    #[arg(long, required_unless_present = "resume")]
    data: Option<PathBuf>,
    /// east or db [default: db]
    #[arg(long)]
    model: Option<String>,
    /// tiny or resnet50 [default: tiny]
    #[arg(long)]
    backbone: Option<String>,
    /// Begin with the weights of this detector, or with torchvision's of its backbone (safetensors or .pth)
    #[arg(long, conflicts_with = "resume")]
    weights: Option<PathBuf>,
    /// Run folder
    #[arg(short, long, default_value = "runs/detector")]
    out: PathBuf,
    /// Steps of the whole run
    #[arg(long)]
    steps: Option<u64>,
    /// Seconds of the whole run
    #[arg(long)]
    seconds: Option<f64>,
    /// Images per step
    #[arg(long)]
    batch: Option<usize>,
    /// Side of the windows that images are cropped to, in pixels, a multiple of 32
    #[arg(long)]
    crop: Option<usize>,
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

impl TrainDetector {
    /// The configuration of a new run, or of the run that goes on with its folder.
    fn configuration(&self) -> Result<(Option<RunFolder>, Config)> {
        let (folder, mut config) = if self.resume {
            if self.model.is_some() || self.backbone.is_some() {
                return Err(PipelineError::Usage("--resume: the run knows its network; leave out --model and --backbone".into()));
            }
            let (folder, description) = RunFolder::open(&self.out)?;
            (Some(folder), description.config::<Config>()?)
        } else {
            let model = self.model.as_deref().map_or(Ok(Kind::Db), Kind::named)?;
            let backbone = self.backbone.as_deref().map_or(Ok(Backbone::Tiny), Backbone::named)?;
            (None, Config::new(model, backbone, PathBuf::new()))
        };
        if let Some(data) = &self.data {
            // The run may go on from another folder.
            config.data.path = std::path::absolute(data).unwrap_or_else(|_| data.clone());
        }
        if self.steps.is_some() || self.seconds.is_some() {
            (config.run.steps, config.run.seconds) = (self.steps.unwrap_or(0), self.seconds.unwrap_or(0.0));
        }
        self.batch.iter().for_each(|b| config.batch.size = *b);
        self.crop.iter().for_each(|c| config.batch.crop = *c);
        self.seed.iter().for_each(|s| config.seed = *s);
        config::set_all(&mut config, &self.set)?;
        Ok((folder, config))
    }
}

impl Verb for TrainDetector {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let (folder, config) = self.configuration()?;
        // Nothing is written before the request is known to be sound.
        recipe::labelled(&config.data.path)?;
        let existed = self.out.exists();
        let mut folder = folder.map_or_else(|| RunFolder::create(&self.out, self.force), Ok)?;
        watch_interrupts();
        let mut progress = Progress::new();
        let begin = (self.resume, self.weights.as_deref());
        let trained = recipe::train(&config, &mut folder, begin, &INTERRUPT, &mut |e| progress.event(e));
        if trained.is_err() && !existed && !folder.checkpoints().exists() {
            // A run that never started leaves nothing behind.
            drop(folder);
            discard(&self.out);
        }
        let trained = trained?;
        let s = &trained.summary;
        if self.json {
            let out = serde_json::json!({
                "run": self.out,
                "weights": trained.weights,
                "steps": s.step,
                "seconds": s.seconds,
                "loss": s.loss,
                "interrupted": s.interrupted,
            });
            println!("{out}");
        } else {
            println!("{} steps in {:.0} s, loss {:.4}", s.step, s.seconds, s.loss);
            println!("{}", trained.weights.display());
        }
        Ok(if s.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }
}
