//! Training recipe of the scene model, to be read from top to bottom.

use super::config::{Config, Stage};
use super::model::SceneModel;
use super::trainer::{Given, Trainer};
use super::viewing::RunView;
use crate::error::{PipelineError, Result};
use crate::run::photographs::StoredPhotographs;
use crate::run::{RunDescription, RunFolder, folder, kept_capture, training};
use crate::run::{memory, nearest, sparse_points};
use diorama_data::import::{self, ImportOptions};
use diorama_data::pixel_store::{PixelStore, StoreOptions};
use diorama_data::{DataError, checkpoint};
use diorama_engine::samplers::pixels::{Observation, PixelSource};
use diorama_engine::samplers::stereo;
use diorama_engine::train::{Event, RunOptions, Summary};
use diorama_geom::capture::{Frame, Split};
use diorama_geom::{Capture, Reduction};
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Share of a photograph that its mask must leave.
const LEAST_COUNTING: f64 = 0.05;

/// Result of training.
pub struct Trained {
    pub model: SceneModel,
    pub summary: Summary,
}

/// Trains into `folder`, from the start or from its checkpoint; `view` shows the run in the viewer.
///
/// # Errors
/// When the capture or a checkpoint cannot be read, or training diverges.
pub fn train(
    config: &Config,
    folder: &mut RunFolder,
    resume: bool,
    view: Option<&RunView>,
    interrupt: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Trained> {
    let capture = if resume { kept(folder, config)? } else { load_capture(config)? };
    capture.notes.iter().for_each(|n| events(&Event::Note(n.clone())));
    single_light(&capture).into_iter().for_each(|n| events(&Event::Note(n)));
    check_memory(config, &capture)?;
    let photographs = load_pixels(config, &capture)?;
    let mut model = SceneModel::new(config.clone(), capture)?;
    let observations = observations(&mut model, &photographs, interrupt, events);
    if resume {
        if checkpoint::exists(&folder.checkpoints()) {
            let (c, note) = checkpoint::load(&folder.checkpoints())?;
            model.restore(c, &checkpoint::latest(&folder.checkpoints()))?;
            note.into_iter().for_each(|n| events(&Event::Note(n)));
        }
        folder.cut_metrics(model.origin.step)?;
    } else {
        folder.write_description(&model.config, &model.capture)?;
    }
    let (origin, checkpoints) = (model.origin, folder.checkpoints());
    let mut trainer = Trainer::new(model, photographs, observations, &checkpoints)?;
    trainer.view = view;
    let r = &config.run;
    let options = RunOptions {
        steps: (r.steps > 0).then_some(r.steps),
        seconds: (r.seconds > 0.0).then_some(r.seconds),
        log_every: r.log_every,
        save_every_seconds: r.save_every_seconds,
        save_every_steps: None,
        evaluate_every: None,
    };
    let summary = training::train((&options, origin), &mut trainer, folder, interrupt, &mut |e| {
        view.into_iter().for_each(|v| v.update(e));
        events(e);
    })?;
    trainer.show();
    Ok(Trained { model: trainer.model, summary })
}

/// The capture of a run that goes on, with the sparse points of its data set.
fn kept(folder: &RunFolder, config: &Config) -> Result<Capture> {
    let mut capture = folder.capture()?;
    let mut config = config.clone();
    config.data.path = folder.data_set()?;
    kept_capture::add_points(&mut capture, load_capture(&config));
    Ok(capture)
}

/// Refuses sizes that do not fit into memory.
fn check_memory(config: &Config, capture: &Capture) -> Result<()> {
    let reduction = Reduction::Times(config.data.downscale);
    let size = |f: &Frame| reduction.size((f.camera.width, f.camera.height));
    let pixels: u64 = capture.frames.iter().filter(|f| f.split == Split::Train).map(|f| size(f).0 as u64 * size(f).1 as u64).sum();
    // With their masks.
    let photographs = (5 * pixels).min(config.data.memory_budget);
    memory::require("the photographs", photographs, "use --set data.memory_budget=BYTES, or --set data.downscale=2")?;
    let f = &config.field;
    if f.is_joint() {
        return Ok(());
    }
    // Two features a row; value, gradient and two moments of each.
    let table = (f.levels as u64) << f.log2_size;
    memory::require("the field", photographs + 2 * 16 * table, &format!("use --set field.log2_size={}", f.log2_size.saturating_sub(1)))?;
    let cells = config.sampling.occupancy_resolution.pow(3) as u64;
    memory::require("the occupancy grid", photographs + 2 * 16 * table + 9 * cells, "use --set sampling.occupancy_resolution=128")
}

/// Pixels whose distance sparse points tell, or comparing photographs where these are few, and where that is left open, how near matter may be.
fn observations(model: &mut SceneModel, photographs: &StoredPhotographs, interrupt: &AtomicBool, events: &mut dyn FnMut(&Event)) -> Given {
    let (distance, mut found, mut are_sparse_points) = (model.capture.viewing_distance(), Vec::new(), false);
    if model.config.loss.depth > 0.0 {
        let reduction = Reduction::Times(model.config.data.downscale);
        // The distance of what glass mirrors is none of its own, and the sky has none.
        let is_surface = |o: &Observation| {
            let image = o.image as usize;
            let is_stored = photographs.snap(image, o.x, o.y) == (o.x, o.y);
            is_stored && !photographs.store().is_glass(image, o.x, o.y) && photographs.rgba(image, o.x, o.y)[3] > 0.5
        };
        found = sparse_points::observe(&model.capture, &model.train, reduction, model.model_from_world.scale);
        found.retain(is_surface);
        are_sparse_points = found.len() >= sparse_points::ENOUGH;
        let from = if are_sparse_points {
            "by sparse points"
        } else {
            events(&Event::Note(format!("comparing {} photographs with their neighbors to find distances", model.train.len())));
            found = stereo::observe(photographs, &model.cameras(), &model.light_of, distance, interrupt);
            found.retain(is_surface);
            "by comparing photographs"
        };
        events(&Event::Note(format!("the distance of {} pixels was found {from} (--set loss.depth=0: do not use it)", found.len())));
    }
    nearest::settle(&mut model.config.sampling.near, &mut found, distance);
    Given { pixels: found, are_sparse_points }
}

/// The capture that a configuration names.
///
/// # Errors
/// When it cannot be read.
pub fn load_capture(config: &Config) -> Result<Capture> {
    let options = ImportOptions { split: config.data.split.parse().map_err(PipelineError::Usage)?, ..ImportOptions::default() };
    let mut capture = import::import(&config.data.path, &options)?;
    // Advice on masks is for the object application, which has options for them.
    capture.notes.iter_mut().for_each(|n| n.truncate(n.find("; --mask").unwrap_or(n.len())));
    Ok(capture)
}

/// A warning where all photographs are of one light: then albedo and light cannot be told apart.
fn single_light(capture: &Capture) -> Option<String> {
    let mut sessions: Vec<Option<u32>> = capture.frames.iter().filter(|f| f.split == Split::Train).map(|f| f.session).collect();
    sessions.sort_unstable();
    sessions.dedup();
    (sessions.len() == 1).then(|| {
        "all photographs to train on are of one session: albedo and light are ambiguous; photograph at other times of day, or name sessions".into()
    })
}

fn load_pixels(config: &Config, capture: &Capture) -> Result<StoredPhotographs> {
    let frames: Vec<_> = capture.indices(Split::Train).into_iter().map(|i| &capture.frames[i]).collect();
    let reduction = Reduction::Times(config.data.downscale);
    let options = StoreOptions { reduction, budget: config.data.memory_budget, masks: capture.masks, white: 0.0 };
    let store = PixelStore::load(&frames, &options, &|| {})?;
    for (i, frame) in frames.iter().enumerate() {
        let Some(counting) = store.counting(i) else { continue };
        let share = counting.filter(|c| *c).count() as f64 / store.kept(i).max(1) as f64;
        if share < LEAST_COUNTING {
            let what = format!(
                "its mask covers {:.0} % as transient; 255 is static, 0 transient: invert the masks if they are",
                100.0 * (1.0 - share)
            );
            return Err(DataError::input(frame.mask.as_ref().unwrap_or(&frame.image), what).into());
        }
    }
    let photographs = StoredPhotographs::new(store);
    let masked = frames.iter().find_map(|f| f.mask.as_ref());
    if let Some(mask) = masked.filter(|_| !shows_surface(&photographs)) {
        let what = "this mask and all others leave nothing but glass and sky: 192 is glass, 160 sky, 255 what stays as it is";
        return Err(DataError::input(mask, what).into());
    }
    Ok(photographs)
}

/// Whether any pixel that counts shows what is neither glass nor empty space.
fn shows_surface(photographs: &StoredPhotographs) -> bool {
    (0..photographs.images()).any(|image| {
        let (w, h) = photographs.size(image);
        let shows = |x: u32, y: u32| {
            photographs.snap(image, x, y) == (x, y)
                && photographs.counts(image, x, y)
                && !photographs.store().is_glass(image, x, y)
                && photographs.rgba(image, x, y)[3] > 0.5
        };
        (0..h).any(|y| (0..w).any(|x| shows(x, y)))
    })
}

/// A trained model, and notes.
///
/// # Errors
/// When the folder holds no run of this application, its checkpoint is damaged, or it ended before light was told apart.
pub fn load(run: &Path) -> Result<(SceneModel, Vec<String>)> {
    let (model, notes) = load_of(run, None)?;
    match model.stage {
        Stage::Light => Ok((model, notes)),
        Stage::Surfaces => Err(PipelineError::Usage(format!(
            "{}: the run ended before light was told apart; go on with `diorama relight train --resume -o {0}`",
            run.display()
        ))),
    }
}

/// A model in whatever stage it is, and notes; `data` says to what folder the photographs moved.
///
/// # Errors
/// As [`load`].
pub fn load_of(run: &Path, data: Option<&Path>) -> Result<(SceneModel, Vec<String>)> {
    let config: Config = RunDescription::read(run)?.config()?;
    let capture = kept_capture::read(run, data, &config.data.path)?;
    let (checkpoint, file, note) = folder::last_checkpoint(run)?;
    let mut model = SceneModel::new(config, capture)?;
    model.restore(checkpoint, &file)?;
    Ok((model, note.into_iter().collect()))
}

/// Description of a run for `diorama info`.
///
/// # Errors
/// As [`load`].
pub fn describe(run: &Path) -> Result<serde_json::Value> {
    let (model, notes) = load_of(run, None)?;
    Ok(serde_json::json!({
        "kind": "relight run",
        "data": model.config.data.path,
        "steps": model.origin.step,
        "seconds": model.origin.seconds,
        "rays": model.rays,
        "parameters": model.field.groups().iter().map(|g| g.values.len()).sum::<usize>(),
        "training_views": model.train.len(),
        "held_out_views": model.capture.indices(Split::Test).len(),
        "lights": model.lights.values.len() / super::shading::LIGHT,
        "notes": notes,
    }))
}
