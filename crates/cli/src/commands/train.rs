//! `diorama train`

use super::mask_flags::MaskFlags;
use super::process::{INTERRUPT, discard, usage, use_threads, watch_interrupts};
use super::view::ListenFlags;
use super::{Outcome, Verb};
use crate::terminal::Progress;
use clap::Args;
use diorama_data::DataError;
use diorama_engine::train::Summary;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::memory;
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::recipe::{self, Trained};
use diorama_pipelines::object::run_folder::read_config;
use diorama_pipelines::object::viewing::{self, RunView};
use diorama_pipelines::run::RunFolder;
use diorama_pipelines::run::config::key_and_value;
use diorama_pipelines::{Application, PipelineError, Result};
use diorama_viewer::Server;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Train a field on photographs with poses
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama train capture/ -o runs/chair --seconds 120\n  diorama train lego/ -o runs/lego --method mlp --downscale 8 --background white\n  diorama train capture/ -o runs/chair --resume"
)]
pub struct Train {
    /// Folder with photographs and transforms.json, transforms_train.json, a COLMAP model or poses_bounds.npy
    data: Option<PathBuf>,
    /// With --resume: where the photographs are now, if they moved
    #[arg(long = "data", value_name = "FOLDER", requires = "resume", conflicts_with = "data")]
    moved: Option<PathBuf>,
    /// Folder of the run
    #[arg(short, long)]
    out: PathBuf,
    /// ngp, nerf, mlp or baseline [default: ngp]
    #[arg(long)]
    method: Option<String>,
    /// transforms, blender, colmap or llff, if the folder contains several
    #[arg(long)]
    format: Option<String>,
    /// Reduce the photographs by this factor
    #[arg(long)]
    downscale: Option<u32>,
    /// Stop after N steps
    #[arg(long)]
    steps: Option<u64>,
    /// Stop after S seconds of training
    #[arg(long, allow_negative_numbers = true)]
    seconds: Option<f64>,
    /// every:N, A:B:C (percent), file or all
    #[arg(long)]
    split: Option<String>,
    #[command(flatten)]
    masks: MaskFlags,
    /// auto, white, black, random or learned
    #[arg(long)]
    background: Option<String>,
    /// auto, cpu, cuda, vulkan, metal or webgpu; auto is the best GPU that the build supports, else the CPU
    #[arg(long)]
    device: Option<String>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Seed of all random numbers
    #[arg(long)]
    seed: Option<u64>,
    /// Leave out photographs that cannot be decoded, for example because they are truncated, and list them
    #[arg(long)]
    skip_broken: bool,
    /// report: reduce each photograph so that its shortest side has 100 pixels
    #[arg(long, conflicts_with = "downscale")]
    preset: Option<String>,
    /// Set a configuration value, for example loss.distortion=0.01; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Read the configuration from a config.toml
    #[arg(long)]
    config: Option<PathBuf>,
    /// Show the run in the browser while it trains
    #[arg(long)]
    view: bool,
    #[command(flatten)]
    listen: ListenFlags,
    /// Continue from the last checkpoint
    #[arg(long)]
    resume: bool,
    /// Replace the content of the run folder
    #[arg(long)]
    force: bool,
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
        // Runs of other applications are started and resumed by the application's own command.
        match if self.resume { Application::of_run(&self.out)? } else { Application::Object } {
            Application::Object => self.object(),
            of @ Application::Relight => Err(of.refuse(&self.out, "diorama relight train --resume")),
            of @ Application::RelightObject => Err(of.refuse(&self.out, "diorama relight object --resume")),
            of @ Application::Text => Err(of.refuse(&self.out, "diorama text train --resume")),
            of @ Application::Detector => Err(of.refuse(&self.out, "diorama text train-detector --resume")),
        }
    }
}

impl Train {
    /// Trains a run of the object application.
    fn object(&self) -> Result<Outcome> {
        let mut config = configuration(self)?;
        if !self.resume {
            // The capture is read before anything is written.
            memory::check_training(&config, &recipe::load_capture(&config)?)?;
        }
        let device = recipe::device(&config)?;
        let existed = self.out.exists();
        let opened = if self.resume { Some(RunFolder::open(&self.out)?.0) } else { None };
        if let (Some(folder), Some(data)) = (&opened, &self.moved) {
            config.data.path = folder.move_capture::<Config>(data)?.data.path;
        }
        // The port is opened before the run folder is created.
        let viewing = if self.view { Some(watch(self, &config, opened.as_ref())?) } else { None };
        let mut folder = opened.map_or_else(|| RunFolder::create(&self.out, self.force), Ok)?;
        watch_interrupts();
        let mut progress = Progress::new();
        eprintln!("device: {device}");
        let viewing = viewing.map(|(view, server)| (view, std::thread::spawn(move || server.run(&INTERRUPT))));
        let view = viewing.as_ref().map(|v| &*v.0);
        let trained = recipe::train(&config, &mut folder, self.resume, view, &INTERRUPT, &mut |e| progress.event(e));
        if trained.is_err() && !existed && !folder.checkpoints().exists() {
            // A run that never started leaves nothing behind, and earlier files stay.
            drop(folder);
            discard(&self.out);
        }
        let trained = trained?;
        if self.json {
            println!("{}", self.results(&trained));
        } else {
            self.print(&trained);
        }
        if let Some((_, server)) = viewing {
            eprintln!("the viewer keeps running until Ctrl-C");
            let _ = server.join();
        }
        Ok(if trained.summary.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }

    fn results(&self, trained: &Trained) -> serde_json::Value {
        let Trained { model, summary, device } = trained;
        let seconds = summary.seconds.max(1e-9);
        let (rays, samples) = (model.rays, model.samples);
        serde_json::json!({
            "run": self.out,
            "method": model.config.method,
            "device": device,
            "steps": summary.step,
            "seconds": summary.seconds,
            "rays": rays,
            "samples": samples,
            "rays_per_s": rays as f64 / seconds,
            "samples_per_s": samples as f64 / seconds,
            "loss": finite(summary.loss),
            "psnr_train": summary.scalars.get("psnr").and_then(finite),
            "psnr_held_out": held_out(summary).and_then(finite),
        })
    }

    fn print(&self, trained: &Trained) {
        let summary = &trained.summary;
        let Some(psnr) = summary.scalars.get("psnr").and_then(finite) else { return };
        println!(
            "{}: {} steps in {:.1} s, {:.0} rays/s, psnr {:.2} dB on training rays{}",
            self.out.display(),
            summary.step,
            summary.seconds,
            trained.model.rays as f64 / summary.seconds.max(1e-9),
            psnr,
            held_out(summary).map_or(String::new(), |p| format!(", {p:.2} dB on held-out pixels"))
        );
        println!("next: diorama eval {}", self.out.display());
    }
}

/// The view source of a run in training, and a bound server that does not serve yet.
fn watch(a: &Train, config: &Config, resumed: Option<&RunFolder>) -> Result<(Arc<RunView>, Server)> {
    let capture = resumed.map_or_else(|| recipe::load_capture(config), RunFolder::capture)?;
    let view = viewing::open(&a.out, ObjectModel::new(config.clone(), capture, false)?, true)?;
    let server = a.listen.bind(view.clone())?;
    eprintln!("view: {}", server.address());
    Ok((view, server))
}

/// PSNR of held-out pixels.
fn held_out(summary: &Summary) -> Option<f64> {
    summary.scores.as_ref().and_then(|s| s.get("psnr"))
}

fn finite(v: f64) -> Option<f64> {
    v.is_finite().then_some(v)
}

/// The run's configuration: defaults, then a file, then options. A resumed run keeps its own, except for the budget.
fn configuration(a: &Train) -> Result<Config> {
    let mut c = if a.resume { resumed(a)? } else { begun(a)? };
    let before = a.resume.then(|| c.clone());
    let mut set = |key: &str, value: Option<String>| value.map_or(Ok(()), |v| c.set(key, &v));
    // A method given in addition to a file keeps the file's other values.
    set("method", a.method.clone())?;
    set("data.format", a.format.clone())?;
    set("data.downscale", a.downscale.map(|v| v.to_string()))?;
    set("data.split", a.split.clone())?;
    set("data.mask", a.masks.mask.clone())?;
    set("data.mask_meaning", a.masks.mask_meaning.clone())?;
    set("background", a.background.clone())?;
    set("device", a.device.clone())?;
    set("seed", a.seed.map(|v| v.to_string()))?;
    set("data.skip_broken", (a.skip_broken && !a.resume).then(|| "true".into()))?;
    set_budget(a, &mut c)?;
    for o in &a.overrides {
        let (key, value) = key_and_value(o)?;
        // Values that the run has determined stay.
        if !(a.resume && is_settled_later(key, value)) {
            c.set(key, value)?;
        }
    }
    if let Some(p) = &a.preset {
        if p != "report" {
            return Err(usage(format!("preset {p}: the only preset is report")));
        }
        (c.data.shortest_side, c.data.downscale) = (100, 1);
    }
    if let Some(before) = before {
        same(a, &before, &c)?;
    }
    c.check()?;
    Ok(c)
}

/// The configuration of the resumed run.
fn resumed(a: &Train) -> Result<Config> {
    let c = read_config(&a.out)?;
    if let Some(d) = &a.data
        && std::path::absolute(d).ok() != std::path::absolute(&c.data.path).ok()
    {
        return Err(PipelineError::Usage(format!(
            "--resume: {} was trained on {}, not on {}; if the photographs moved, give their folder as --data FOLDER instead",
            a.out.display(),
            c.data.path.display(),
            d.display()
        )));
    }
    Ok(c)
}

/// The defaults of a method, or a file.
fn begun(a: &Train) -> Result<Config> {
    let data = a.data.clone().ok_or_else(|| PipelineError::Usage("train: give the folder of photographs".into()))?;
    let method: Method = a.method.as_deref().unwrap_or("ngp").parse().map_err(|e| usage(format!("method {e}")))?;
    let Some(file) = &a.config else { return Ok(Config::new(method, data)) };
    let mut c = read_file(file)?;
    c.data.path = data;
    Ok(c)
}

/// The configuration file of `--config`.
fn read_file(file: &Path) -> Result<Config> {
    let text = std::fs::read_to_string(file).map_err(DataError::io(file, "read"))?;
    Config::from_toml(&text).map_err(|e| DataError::input(file, e).into())
}

/// Steps and seconds: a budget in one of them replaces a default in the other.
fn set_budget(a: &Train, c: &mut Config) -> Result<()> {
    if let Some(s) = a.seconds {
        if !(s.is_finite() && s > 0.0) {
            return Err(usage(format!("seconds {s}: must be greater than 0")));
        }
        c.run.seconds = s;
        if a.steps.is_none() {
            c.run.steps = 0;
        }
    }
    if let Some(n) = a.steps {
        if n == 0 {
            return Err(usage("steps 0: must be at least 1".into()));
        }
        c.run.steps = n;
        if a.seconds.is_none() {
            c.run.seconds = 0.0;
        }
    }
    Ok(())
}

/// Error for a value that a resumed run cannot accept.
fn changed(flag: &str, run: &str, requested: &str) -> Result<()> {
    let what = format!("{flag} cannot change on --resume: the run has {run}, not {requested}; start a new run with another --out");
    Err(PipelineError::Usage(what))
}

/// Checks values that a resumed run keeps: the same value may be given again; for another, the error names both.
fn same(a: &Train, before: &Config, now: &Config) -> Result<()> {
    let (run, requested) = (before.values(), now.values());
    let kept = |key: &str| key == "method" || key == "background" || key == "seed" || key.starts_with("field.") || key.starts_with("data.");
    for ((key, run), (_, requested)) in run.iter().zip(&requested).filter(|((key, run), (_, requested))| kept(key) && run != requested) {
        let flag = FLAGS.iter().find(|f| f.1 == key).map_or(&key[..], |f| f.0);
        // The pixels of a run may be stored more sparsely than before.
        if key != "data.memory_budget" {
            return changed(flag, run, requested);
        }
    }
    same_file(a, before)
}

/// The same check for the file of `--config`, if there is one.
fn same_file(a: &Train, before: &Config) -> Result<()> {
    let Some(file) = &a.config else { return Ok(()) };
    let (run, given) = (before.values(), read_file(file)?.values());
    // Options of the same command take precedence over the file, as when the run was started.
    let flagged = |key: &str| {
        let set = a.overrides.iter().any(|o| o.split('=').next().is_some_and(|k| k.trim() == key));
        set || FLAGS.iter().any(|f| f.1 == key && is_given(a, f.0)) || key.starts_with("run.") || ["device", "data.path"].contains(&key)
    };
    match run.iter().zip(&given).find(|((key, run), (_, given))| run != given && !flagged(key) && !is_settled_later(key, given)) {
        Some(((key, run), (_, given))) => changed(&format!("--config {}: {key}", file.display()), run, given),
        None => Ok(()),
    }
}

/// Whether a value is determined from the photographs; the run then keeps the result.
fn is_settled_later(key: &str, value: &str) -> bool {
    match key {
        "data.white" | "sampling.near" => value.parse::<f64>() == Ok(0.0),
        "field.appearance" | "loss.depth_from" => value.trim_matches('"') == "auto",
        _ => false,
    }
}

/// Options and the keys that they set.
const FLAGS: [(&str, &str); 10] = [
    ("--method", "method"),
    ("--downscale", "data.downscale"),
    ("--preset report", "data.shortest_side"),
    ("--split", "data.split"),
    ("--background", "background"),
    ("--seed", "seed"),
    ("--format", "data.format"),
    ("--mask", "data.mask"),
    ("--mask-meaning", "data.mask_meaning"),
    ("--skip-broken", "data.skip_broken"),
];

fn is_given(a: &Train, flag: &str) -> bool {
    match flag {
        "--method" => a.method.is_some(),
        "--downscale" => a.downscale.is_some(),
        "--preset report" => a.preset.is_some(),
        "--split" => a.split.is_some(),
        "--background" => a.background.is_some(),
        "--seed" => a.seed.is_some(),
        "--mask" => a.masks.mask.is_some(),
        "--mask-meaning" => a.masks.mask_meaning.is_some(),
        "--skip-broken" => a.skip_broken,
        _ => a.format.is_some(),
    }
}
