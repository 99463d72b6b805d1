//! Training recipe of the object application, to be read from top to bottom.

use super::config::Config;
use super::exposure_spread;
use super::held_out::{self, HeldOutPixels};
pub use super::loading::load_capture;
use super::memory;
use super::model::{ObjectModel, is_linear};
use super::observations;
use super::run_folder::{RunSummary, SparsePoints as _};
use super::trainer::Trainer;
use super::viewing::RunView;
use crate::error::Result;
use crate::run::RunFolder;
use crate::run::device::{Device, cpu_name};
use crate::run::nearest;
use crate::run::photographs::StoredPhotographs;
use crate::run::profile::{StageFigure, TrainReport};
use crate::run::training;
use diorama_data::checkpoint;
use diorama_data::photo_check;
use diorama_data::pixel_store::{PixelStore, StoreOptions};
use diorama_engine::samplers::pixels::Observation;
use diorama_engine::stages::Stages;
use diorama_engine::train::{Event, RunOptions, Summary, Trainee};
use diorama_geom::Capture;
use diorama_geom::capture::Split;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::ray_generation::CORRECTION;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// The device that a configuration will train on, in words.
///
/// # Errors
/// When it is not part of the build, absent, or cannot train the configuration.
pub fn device(config: &Config) -> Result<String> {
    let device = Device::open(&config.device)?;
    Ok(if device.is_gpu() { device.name() } else { cpu_name() })
}

/// Result of training.
pub struct Trained {
    pub model: ObjectModel,
    pub summary: Summary,
    /// `cpu`, or what the GPU calls itself.
    pub device: String,
}

/// Trains into `folder`, from the start or from its checkpoint.
///
/// Capture → pixels → model → loop of steps → checkpoint. `events` receives every event, `view` shows the run in the viewer.
pub fn train(
    config: &Config,
    folder: &mut RunFolder,
    resume: bool,
    view: Option<&RunView>,
    interrupt: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Trained> {
    let opened = Device::open(&config.device)?;
    opened.note().into_iter().for_each(|n| events(&Event::Note(n)));
    let capture = if resume { folder.capture_with_points()? } else { load_capture(config)? };
    for note in &capture.notes {
        events(&Event::Note(note.clone()));
    }
    let config = &resolved(config, &capture)?;
    white_note(config.data.white).into_iter().for_each(|n| events(&Event::Note(n)));
    memory::check_training(config, &capture)?.into_iter().for_each(|n| events(&Event::Note(n)));
    let (store, budget) = load_pixels(config, &capture, &opened)?;
    if let n @ 2.. = store.stride() {
        let limit = if budget < config.data.memory_budget { "what the device holds in one piece" } else { "data.memory_budget" };
        events(&Event::Note(format!("the photographs exceed {limit} ({} MiB): one pixel of each {n} x {n} is trained on", budget >> 20)));
    }
    let has_alpha = store.has_alpha;
    let mut model = ObjectModel::new(config.clone(), capture, has_alpha)?;
    let mut photographs = StoredPhotographs::new(store);
    let (observations, source) = observations::find(&mut model, &photographs, interrupt, &mut |n| events(&Event::Note(n)));
    observations::note(&model, observations.len(), source).into_iter().for_each(|n| events(&Event::Note(n)));
    let (mut model, note) = settle_exposure(model, &mut photographs, &observations)?;
    note.into_iter().for_each(|n| events(&Event::Note(n)));
    let held_out = HeldOutPixels::draw(&model)?;
    if resume {
        go_on(&mut model, folder)?.into_iter().for_each(|n| events(&Event::Note(n)));
    } else {
        folder.write_description(&model.config, &model.capture)?;
    }
    let origin = model.origin;
    let checkpoints = folder.checkpoints();
    let mut trainer = Trainer::new(model, photographs, observations, &checkpoints, opened)?;
    (trainer.view, trainer.held_out) = (view, held_out);
    let summary = training::train((&run_options(config), origin), &mut trainer, folder, interrupt, &mut |e| {
        view.into_iter().for_each(|v| v.update(e));
        events(e);
    })?;
    trainer.show()?;
    let name = |i: usize| trainer.model.capture.frames[i].name.clone();
    if resume && summary.step == origin.step {
        // What the run came to stays in its summary.
        let (steps, seconds) = (origin.step, origin.seconds);
        events(&Event::Note(format!(
            "the run has its {steps} steps and {seconds:.0} s already; --steps and --seconds are of the whole run"
        )));
        return Ok(Trained { device: trainer.device.name(), model: trainer.model, summary });
    }
    let psnr = summary.scalars.get("psnr").unwrap_or(f64::NAN);
    folder.write_summary(&RunSummary {
        steps: summary.step,
        seconds: summary.seconds,
        device: trainer.device.name(),
        psnr_train: psnr.is_finite().then_some(psnr),
        psnr_held_out: summary.scores.as_ref().and_then(|s| s.get("psnr")),
        behind_fog: held_out::far_below(&trainer.judged, psnr).into_iter().map(name).collect(),
        peak_memory_bytes: diorama_data::memory::peak_of_process(),
    })?;
    Ok(Trained { device: trainer.device.name(), model: trainer.model, summary })
}

/// Note for the user where photographs hold linear light.
fn white_note(white: f32) -> Option<String> {
    (white > 0.0).then(|| format!("the photographs hold linear light: {white} is shown as white (--set data.white={white})"))
}

/// Restores the run's last checkpoint, or leaves the model at its start; a note for the user.
fn go_on(model: &mut ObjectModel, folder: &mut RunFolder) -> Result<Option<String>> {
    let mut note = Some("the run was stopped before its first checkpoint: it begins again".into());
    if checkpoint::exists(&folder.checkpoints()) {
        let (c, of_loading) = checkpoint::load(&folder.checkpoints())?;
        model.restore(c, &checkpoint::latest(&folder.checkpoints()))?;
        note = of_loading;
    }
    folder.cut_metrics(model.origin.step)?;
    Ok(note)
}

/// Results of the first steps.
pub struct Beginning {
    /// Per step.
    pub losses: Vec<f64>,
    /// Of the cameras, where they are refined: how far their corrections went, and the mean of its gradient that the
    /// optimiser keeps.
    pub cameras: Option<[Vec<f32>; 2]>,
}

/// A capture with its training pixels, from which several runs may begin.
pub struct Loaded {
    capture: Capture,
    pixels: PixelStore,
}

impl Loaded {
    /// Reads what a configuration's `data` names.
    ///
    /// # Errors
    /// When the capture or a photograph cannot be read, or when the device cannot be opened.
    pub fn new(config: &Config) -> Result<Loaded> {
        let capture = load_capture(config)?;
        let (pixels, _) = load_pixels(&resolved(config, &capture)?, &capture, &Device::open(&config.device)?)?;
        Ok(Loaded { capture, pixels })
    }
}

/// Trains the first `steps` steps on what was loaded with the same `data` and `seed`, from cameras a little wrong where they are refined;
/// writes nothing.
///
/// # Errors
/// When the configuration makes no sense, or when the device cannot be opened or fails.
pub fn begin(config: &Config, steps: u64, loaded: &Loaded) -> Result<Beginning> {
    let mut trainer = scratch_trainer(config, true, Loaded { capture: loaded.capture.clone(), pixels: loaded.pixels.clone() })?;
    let from = trainer.model.corrections.as_ref().map(|g| g.values.clone()).unwrap_or_default();
    let losses = (0..steps).map(|step| Ok(trainer.step(step, step as f64 / steps as f64)?.loss)).collect::<Result<_>>()?;
    if trainer.model.corrections.is_some() {
        trainer.download()?;
    }
    let went = |to: &[f32]| to.iter().zip(&from).map(|(to, from)| to - from).collect();
    let cameras = trainer.model.corrections.map(|g| [went(&g.values), g.moment1]);
    Ok(Beginning { losses, cameras })
}

/// Measures the stages of a step: `warmup` steps, then `steps` measured ones; writes nothing.
pub fn profile(config: &Config, warmup: u64, steps: u64) -> Result<TrainReport> {
    let mut trainer = scratch_trainer(config, false, Loaded::new(config)?)?;
    for step in 0..warmup {
        trainer.step(step, 0.0)?;
    }
    trainer.settle()?;
    trainer.device.stages().into_iter().for_each(|s| *s = Stages::default());
    let before = (trainer.model.rays, trainer.whole, trainer.model.samples, trainer.marched);
    let begin = Instant::now();
    for step in warmup..warmup + steps {
        trainer.step(step, 0.0)?;
    }
    trainer.settle()?;
    let seconds = begin.elapsed().as_secs_f64();
    let (rays, whole) = ((trainer.model.rays - before.0) as f64, (trainer.whole - before.1) as f64);
    let (trained, marched) = ((trainer.model.samples - before.2) as f64, trainer.marched - before.3);
    let stages = trainer.device.stages().map(|s| s.seconds.clone()).unwrap_or_default();
    // A device keeps the grid.
    trainer.download()?;
    let total: f64 = stages.iter().map(|s| s.1).sum();
    Ok(TrainReport {
        threads: rayon::current_num_threads(),
        simd: diorama_kernels::simd::level().name(),
        device: trainer.device.name(),
        steps,
        seconds,
        rays_per_s: whole / seconds,
        marched_per_s: marched as f64 / seconds,
        trained_per_s: trained / seconds,
        marched_per_ray: marched as f64 / rays,
        trained_per_ray: trained / whole,
        occupied: trainer.model.occupancy.as_ref().map(|o| o.bits().fill()),
        stages: stages.iter().map(|s| StageFigure { stage: s.0, share: s.1 / total, ms: s.1 * 1e3 / steps as f64 }).collect(),
    })
}

/// How wrong cameras are made at most, in radians and lengths of the model.
const WRONG: f32 = 0.01;

/// A trainer whose run is not kept.
fn scratch_trainer(config: &Config, wrong_cameras: bool, Loaded { capture, pixels }: Loaded) -> Result<Trainer<'static>> {
    let config = &resolved(config, &capture)?;
    let device = Device::open(&config.device)?;
    let has_alpha = pixels.has_alpha;
    let mut model = ObjectModel::new(config.clone(), capture, has_alpha)?;
    let mut photographs = StoredPhotographs::new(pixels);
    let (observations, _) = observations::find(&mut model, &photographs, &AtomicBool::new(false), &mut |_| {});
    let (mut model, _) = settle_exposure(model, &mut photographs, &observations)?;
    if let (true, Some(group)) = (wrong_cameras, &mut model.corrections) {
        let rng = Rng::new(config.seed, 0);
        for (i, v) in group.values.iter_mut().enumerate() {
            let moves = config.camera.refine_focal || i % CORRECTION != 6;
            *v = if moves { WRONG * (2.0 * rng.uniform(i as u64) - 1.0) } else { 0.0 };
        }
    }
    Trainer::new(model, photographs, observations, Path::new(""), device)
}

/// Gives photographs appearance codes where their light differs, and those that wear one the mean exposure.
fn settle_exposure(
    model: ObjectModel,
    photographs: &mut StoredPhotographs,
    known: &[Observation],
) -> Result<(ObjectModel, Option<String>)> {
    let gains = exposure_spread::measure(photographs, &model, known);
    let (model, note) = exposure_spread::settle_codes(model, gains.as_deref())?;
    let Some(gains) = gains.filter(|_| model.field.codes.appearance.is_some()) else {
        return Ok((model, note));
    };
    exposure_spread::to_the_mean(&gains).into_iter().enumerate().for_each(|(i, by)| photographs.brighten(i, by));
    Ok((model, note))
}

/// The configuration with what the capture says where it leaves it open: white, and how near matter may be.
fn resolved(config: &Config, capture: &Capture) -> Result<Config> {
    let mut config = config.clone();
    if !is_linear(capture) {
        config.data.white = 0.0;
    } else if config.data.white == 0.0 {
        let train: Vec<_> = capture.frames.iter().filter(|f| f.split == Split::Train).collect();
        config.data.white = photo_check::white(&train)?;
    }
    if config.sampling.near == 0.0 {
        config.sampling.near = nearest::of_points(capture).unwrap_or(0.0);
    }
    Ok(config)
}

/// The training pixels, and the bytes that they might take.
fn load_pixels(config: &Config, capture: &Capture, device: &Device) -> Result<(PixelStore, u64)> {
    let train = capture.indices(Split::Train);
    let frames: Vec<_> = train.iter().map(|&i| &capture.frames[i]).collect();
    let budget = config.data.memory_budget.min(device.most_bytes());
    let options = StoreOptions { reduction: config.reduction(), budget, masks: capture.masks, white: config.data.white };
    Ok((PixelStore::load(&frames, &options, &|| {})?, budget))
}

fn run_options(config: &Config) -> RunOptions {
    let r = &config.run;
    let positive = |n: u64| (n > 0).then_some(n);
    RunOptions {
        steps: positive(r.steps),
        seconds: (r.seconds > 0.0).then_some(r.seconds),
        log_every: r.log_every,
        save_every_seconds: r.save_every_seconds,
        save_every_steps: positive(r.save_every_steps),
        evaluate_every: positive(r.evaluate_every),
    }
}

#[cfg(test)]
#[path = "recipe_tests.rs"]
mod tests;
