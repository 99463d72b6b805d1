//! `diorama train`

use super::{INTERRUPT, Outcome, use_threads, watch_interrupts};
use crate::arguments::TrainArgs;
use crate::terminal::Progress;
use diorama_data::DataError;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::recipe;
use diorama_pipelines::object::run_folder::{RunFolder, read_config};
use diorama_pipelines::object::viewing::RunView;
use diorama_pipelines::{PipelineError, Result};
use std::sync::Arc;

pub fn run(a: &TrainArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let config = configuration(a)?;
    if !a.resume {
        // Read the capture before anything is written.
        recipe::load_capture(&config)?;
    }
    let device = recipe::device(&config)?;
    let existed = a.out.exists();
    let mut folder = if a.resume { RunFolder::open(&a.out)?.0 } else { RunFolder::create(&a.out, a.force)? };
    watch_interrupts();
    let mut progress = Progress::new();
    eprintln!("device: {device}");
    let viewing = if a.view { Some(watch(a, &config)?) } else { None };
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
    });
    if a.json {
        println!("{object}");
    } else {
        println!(
            "{}: {} steps in {:.1} s, {:.0} rays/s, psnr {:.2} dB on training rays",
            a.out.display(),
            summary.step,
            summary.seconds,
            summary.rays as f64 / seconds,
            summary.psnr
        );
        println!("next: diorama eval {}", a.out.display());
    }
    if let Some((_, server)) = viewing {
        eprintln!("the viewer goes on until Ctrl-C");
        let _ = server.join();
    }
    Ok(if summary.interrupted { Outcome::Interrupted } else { Outcome::Done })
}

/// Serves the run while it trains.
fn watch(a: &TrainArgs, config: &Config) -> Result<(Arc<RunView>, std::thread::JoinHandle<()>)> {
    let model = ObjectModel::new(config.clone(), recipe::load_capture(config)?, false)?;
    let view = RunView::new(&a.out, model, true);
    let server = super::view::listen(&a.listen, view.clone())?;
    eprintln!("view: {}", server.address());
    Ok((view, std::thread::spawn(move || server.run(&INTERRUPT))))
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
                "--resume: {} was trained on {}, not on {}",
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
    if a.resume {
        let fixed = [
            ("--method", a.method.is_some()),
            ("--downscale", a.downscale.is_some()),
            ("--split", a.split.is_some()),
            ("--background", a.background.is_some()),
            ("--seed", a.seed.is_some()),
            ("--format", a.format.is_some()),
            ("--config", a.config.is_some()),
            ("--preset", a.preset.is_some()),
            ("--skip-broken", a.skip_broken && !c.data.skip_broken),
        ];
        if let Some((flag, _)) = fixed.iter().find(|f| f.1) {
            return Err(PipelineError::Usage(format!("{flag} cannot change on --resume; start a new run with another --out")));
        }
    }
    let mut set = |key: &str, value: Option<String>| value.map_or(Ok(()), |v| c.set(key, &v));
    // A method that was named on top of a file keeps the file's other values.
    set("method", a.method.clone().filter(|_| !a.resume))?;
    set("data.format", a.format.clone())?;
    set("data.downscale", a.downscale.map(|v| v.to_string()))?;
    set("data.split", a.split.clone())?;
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
        c.set(key.trim(), value.trim())?;
    }
    if let Some(p) = &a.preset {
        if p != "report" {
            return Err(PipelineError::Usage(format!("--preset {p}: the only preset is report")));
        }
        let capture = recipe::load_capture(&c)?;
        let side = capture.frames.iter().map(|f| f.camera.width.min(f.camera.height)).min().unwrap_or(100);
        c.data.downscale = (side / 100).max(1);
    }
    c.check()?;
    Ok(c)
}
