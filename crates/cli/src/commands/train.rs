//! `diorama train`

use super::{INTERRUPT, Outcome, use_threads, watch_interrupts};
use crate::arguments::TrainArgs;
use crate::terminal::Progress;
use diorama_data::DataError;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::run_folder::read_config;
use diorama_pipelines::object::viewing::RunView;
use diorama_pipelines::object::{memory, recipe};
use diorama_pipelines::run::RunFolder;
use diorama_pipelines::{PipelineError, Result};
use diorama_viewer::Server;
use std::sync::Arc;

pub fn run(a: &TrainArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let mut config = configuration(a)?;
    if !a.resume {
        // Read the capture before anything is written.
        memory::check_training(&config, &recipe::load_capture(&config)?)?;
    }
    let device = recipe::device(&config)?;
    let existed = a.out.exists();
    let opened = if a.resume { Some(RunFolder::open(&a.out)?.0) } else { None };
    if let (Some(folder), Some(data)) = (&opened, &a.moved) {
        config.data.path = folder.move_capture::<Config>(data)?.data.path;
    }
    // The port is asked for before there is a folder.
    let viewing = if a.view { Some(watch(a, &config, opened.as_ref())?) } else { None };
    let mut folder = opened.map_or_else(|| RunFolder::create(&a.out, a.force), Ok)?;
    watch_interrupts();
    let mut progress = Progress::new();
    eprintln!("device: {device}");
    let viewing = viewing.map(|(view, server)| (view, std::thread::spawn(move || server.run(&INTERRUPT))));
    let view = viewing.as_ref().map(|v| &*v.0);
    let result = recipe::train(&config, &mut folder, a.resume, view, &INTERRUPT, &mut |e| progress.event(e));
    let recipe::Trained { model, summary, device } = match result {
        Ok(r) => r,
        Err(e) => {
            // A run that never began leaves nothing behind, and what was there before stays.
            if !existed && !folder.checkpoints().exists() {
                drop(folder);
                let _ = std::fs::remove_dir_all(&a.out);
            }
            return Err(e);
        }
    };
    let seconds = summary.seconds.max(1e-9);
    let object = serde_json::json!({
        "run": a.out,
        "method": model.config.method,
        "device": device,
        "steps": summary.step,
        "seconds": summary.seconds,
        "rays": summary.rays,
        "samples": summary.samples,
        "rays_per_s": summary.rays as f64 / seconds,
        "samples_per_s": summary.samples as f64 / seconds,
        "loss": finite(summary.loss),
        "psnr_train": finite(summary.psnr),
        "psnr_held_out": summary.held_out.and_then(finite),
    });
    if a.json {
        println!("{object}");
    } else if summary.psnr.is_finite() {
        println!(
            "{}: {} steps in {:.1} s, {:.0} rays/s, psnr {:.2} dB on training rays{}",
            a.out.display(),
            summary.step,
            summary.seconds,
            summary.rays as f64 / seconds,
            summary.psnr,
            summary.held_out.map_or(String::new(), |p| format!(", {p:.2} dB on held-out pixels"))
        );
        println!("next: diorama eval {}", a.out.display());
    }
    if let Some((_, server)) = viewing {
        eprintln!("the viewer goes on until Ctrl-C");
        let _ = server.join();
    }
    Ok(if summary.interrupted { Outcome::Interrupted } else { Outcome::Done })
}

/// The run as the viewer sees it while it trains, and a server that is bound and does not serve yet.
fn watch(a: &TrainArgs, config: &Config, resumed: Option<&RunFolder>) -> Result<(Arc<RunView>, Server)> {
    let capture = resumed.map_or_else(|| recipe::load_capture(config), RunFolder::capture)?;
    let view = RunView::new(&a.out, ObjectModel::new(config.clone(), capture, false)?, true)?;
    let server = super::view::listen(&a.listen, view.clone())?;
    eprintln!("view: {}", server.address());
    Ok((view, server))
}

fn finite(v: f64) -> Option<f64> {
    v.is_finite().then_some(v)
}

/// The run's configuration: defaults, then a file, then flags; a resumed run keeps its own but for the budget.
fn configuration(a: &TrainArgs) -> Result<Config> {
    let mut c = if a.resume {
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
        c
    } else {
        let data = a.data.clone().ok_or_else(|| PipelineError::Usage("train: give the folder of photographs".into()))?;
        let method: Method = a.method.as_deref().unwrap_or("ngp").parse().map_err(|e| PipelineError::Usage(format!("--method {e}")))?;
        match &a.config {
            None => Config::new(method, data),
            Some(file) => {
                let text = std::fs::read_to_string(file).map_err(DataError::io(file, "read"))?;
                let mut c = Config::from_toml(&text).map_err(|e| PipelineError::from(DataError::input(file, e)))?;
                c.data.path = data;
                c
            }
        }
    };
    let before = a.resume.then(|| c.clone());
    let mut set = |key: &str, value: Option<String>| value.map_or(Ok(()), |v| c.set(key, &v));
    // A method that was named on top of a file keeps the file's other values.
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
    if let Some(s) = a.seconds {
        if !(s.is_finite() && s > 0.0) {
            return Err(PipelineError::Usage(format!("--seconds {s}: must be greater than 0")));
        }
        // A budget in seconds replaces the default number of steps.
        c.run.seconds = s;
        if a.steps.is_none() {
            c.run.steps = 0;
        }
    }
    if let Some(n) = a.steps {
        if n == 0 {
            return Err(PipelineError::Usage("--steps 0: must be at least 1".into()));
        }
        c.run.steps = n;
        if a.seconds.is_none() {
            c.run.seconds = 0.0;
        }
    }
    for o in &a.overrides {
        let (key, value) = o.split_once('=').ok_or_else(|| PipelineError::Usage(format!("--set {o}: expected KEY=VALUE")))?;
        // What a run has settled stays so.
        if !(a.resume && is_settled_later(key.trim(), value.trim())) {
            c.set(key.trim(), value.trim())?;
        }
    }
    if let Some(p) = &a.preset {
        if p != "report" {
            return Err(PipelineError::Usage(format!("--preset {p}: the only preset is report")));
        }
        (c.data.shortest_side, c.data.downscale) = (100, 1);
    }
    if let Some(before) = before {
        same(a, &before, &c)?;
    }
    c.check()?;
    Ok(c)
}

/// What a resumed run keeps: the same value may be said again, another one is named with the run's.
fn same(a: &TrainArgs, before: &Config, now: &Config) -> Result<()> {
    let changed = |flag: &str, run: &str, said: &str| {
        let what = format!("{flag} cannot change on --resume: the run has {run}, not {said}; start a new run with another --out");
        Err(PipelineError::Usage(what))
    };
    let (run, said) = (before.values(), now.values());
    let kept = |key: &str| key == "method" || key == "background" || key == "seed" || key.starts_with("field.") || key.starts_with("data.");
    for ((key, run), (_, said)) in run.iter().zip(&said).filter(|((key, run), (_, said))| kept(key) && run != said) {
        let flag = FLAGS.iter().find(|f| f.1 == key).map_or(&key[..], |f| f.0);
        // Pixels of a run may be kept more sparsely than before.
        if key != "data.memory_budget" {
            return changed(flag, run, said);
        }
    }
    let Some(file) = &a.config else { return Ok(()) };
    let text = std::fs::read_to_string(file).map_err(DataError::io(file, "read"))?;
    let given = Config::from_toml(&text).map_err(|e| PipelineError::from(DataError::input(file, e)))?.values();
    // Flags of the same command stand above the file, as they did when the run began.
    let flagged = |key: &str| {
        let set = a.overrides.iter().any(|o| o.split('=').next().is_some_and(|k| k.trim() == key));
        set || FLAGS.iter().any(|f| f.1 == key && is_given(a, f.0)) || key.starts_with("run.") || ["device", "data.path"].contains(&key)
    };
    match run.iter().zip(&given).find(|((key, run), (_, given))| run != given && !flagged(key) && !is_settled_later(key, given)) {
        Some(((key, run), (_, given))) => changed(&format!("--config {}: {key}", file.display()), run, given),
        None => Ok(()),
    }
}

/// Whether a value leaves open what the photographs say, which a run then keeps.
fn is_settled_later(key: &str, value: &str) -> bool {
    match key {
        "data.white" | "sampling.near" => value.parse::<f64>() == Ok(0.0),
        "field.appearance" | "loss.depth_from" => value.trim_matches('"') == "auto",
        _ => false,
    }
}

/// Flags and the values that they set.
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

fn is_given(a: &TrainArgs, flag: &str) -> bool {
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
