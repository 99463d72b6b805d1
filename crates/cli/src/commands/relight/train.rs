//! `diorama relight train`

use crate::commands::process::{INTERRUPT, discard, use_threads, watch_interrupts};
use crate::commands::view::ListenFlags;
use crate::commands::{Outcome, Verb};
use crate::terminal::Progress;
use clap::Args;
use diorama_geom::Capture;
use diorama_pipelines::relight::outdoor::config::{Config, Preset};
use diorama_pipelines::relight::outdoor::model::SceneModel;
use diorama_pipelines::relight::outdoor::recipe;
use diorama_pipelines::relight::outdoor::viewing::{self, RunView};
use diorama_pipelines::run::{RunFolder, config};
use diorama_pipelines::{PipelineError, Result};
use diorama_viewer::Server;
use std::path::PathBuf;
use std::sync::Arc;

/// Train the scene model: photographs of a place in several lights to albedo, normals, shadow and light
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama relight train data/street --preset ci -o runs/street\n  diorama relight train data/street --light sun -o runs/street\n  diorama relight train --resume -o runs/street"
)]
pub struct Train {
    /// Folder of the capture
    data: Option<PathBuf>,
    /// ci, fast, or paper: the network as printed, for comparisons
    #[arg(long, default_value = "fast")]
    preset: String,
    /// sh: harmonics and a learned shadow; sun: a sun apart, whose shadows are those of the learned surfaces
    #[arg(long)]
    light: Option<String>,
    /// Run folder
    #[arg(short, long, default_value = "runs/relight")]
    out: PathBuf,
    /// Steps of the whole run
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
    /// Serve a page that shows the model while it is trained
    #[arg(long)]
    view: bool,
    #[command(flatten)]
    listen: ListenFlags,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
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
            (false, Some(data)) => {
                let preset = match self.preset.as_str() {
                    "ci" => Preset::Ci,
                    "fast" => Preset::Fast,
                    "paper" => Preset::Paper,
                    other => return Err(PipelineError::Usage(format!("--preset {other:?}: expected ci, fast or paper"))),
                };
                (None, Config::new(preset, data.clone()))
            }
        };
        self.steps.iter().for_each(|s| config.run.steps = *s);
        self.seconds.iter().for_each(|s| config.run.seconds = *s);
        self.seed.iter().for_each(|s| config.seed = *s);
        if let Some(light) = &self.light {
            if self.resume {
                return Err(PipelineError::Usage("--resume: the run knows how it takes light; leave out --light".into()));
            }
            config.set("light.model", light)?;
        }
        config::set_all(&mut config, &self.set)?;
        // Nothing is written before the request is known to be sound.
        let capture = folder.as_ref().map_or_else(|| recipe::load_capture(&config), RunFolder::capture)?;
        let existed = self.out.exists();
        // The port is opened before the run folder is created.
        let viewing = if self.view { Some(self.watch(&config, capture)?) } else { None };
        let mut folder = folder.take().map_or_else(|| RunFolder::create(&self.out, self.force), Ok)?;
        watch_interrupts();
        let mut progress = Progress::new();
        let viewing = viewing.map(|(view, server)| (view, std::thread::spawn(move || server.run(&INTERRUPT))));
        let view = viewing.as_ref().map(|v| &*v.0);
        let trained = recipe::train(&config, &mut folder, self.resume, view, &INTERRUPT, &mut |e| progress.event(e));
        if trained.is_err() && !existed && !folder.checkpoints().exists() {
            // A run that never started leaves nothing behind.
            drop(folder);
            discard(&self.out);
        }
        let trained = trained?;
        let s = &trained.summary;
        if self.json {
            println!(
                "{}",
                serde_json::json!({ "run": self.out, "steps": s.step, "seconds": s.seconds, "loss": s.loss, "interrupted": s.interrupted })
            );
        } else {
            println!("{} steps in {:.0} s, loss {:.5}", s.step, s.seconds, s.loss);
            println!("{}", self.out.display());
        }
        if let Some((_, server)) = viewing {
            eprintln!("the viewer keeps running until Ctrl-C");
            let _ = server.join();
        }
        Ok(if s.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }
}

impl Train {
    /// The view source of the run, and a bound server that does not serve yet.
    fn watch(&self, config: &Config, capture: Capture) -> Result<(Arc<RunView>, Server)> {
        let view = viewing::open(&self.out, SceneModel::new(config.clone(), capture)?, Vec::new(), true)?;
        let server = self.listen.bind(view.clone())?;
        eprintln!("view: {}", server.address());
        Ok((view, server))
    }
}
