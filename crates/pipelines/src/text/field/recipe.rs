//! Training recipe of the field, to be read from top to bottom.

use super::config::Config;
use super::distances;
use super::label_maps::Labels;
use super::model::TextModel;
use super::trainer::Trainer;
use crate::error::{PipelineError, Result};
use crate::run::device::Device;
use crate::run::photographs::StoredPhotographs;
use crate::run::{RunDescription, RunFolder, folder, kept_capture, training};
use diorama_data::checkpoint;
use diorama_data::import::{self, ImportOptions};
use diorama_data::pixel_store::{PixelStore, StoreOptions};
use diorama_engine::train::{Event, RunOptions, Summary};
use diorama_geom::capture::Split;
use diorama_geom::{Capture, Reduction};
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Result of training.
pub struct Trained {
    pub model: TextModel,
    pub summary: Summary,
}

/// Trains into `folder`, from the start or from its checkpoint.
///
/// # Errors
/// When the capture, its labels or a checkpoint cannot be read, the device fails, or training diverges.
pub fn train(
    config: &Config,
    folder: &mut RunFolder,
    resume: bool,
    interrupt: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Trained> {
    let device = Device::open(&config.device)?;
    device.note().into_iter().for_each(|n| events(&Event::Note(n)));
    let capture = if resume { folder.capture()? } else { load_capture(config)? };
    capture.notes.iter().for_each(|n| events(&Event::Note(n.clone())));
    let root = import::root(&config.data.path)?;
    let labels = Labels::read(if resume { folder.path() } else { &root }, &capture, &root)?;
    let photographs = StoredPhotographs::new(load_pixels(config, &capture, Split::Train)?);
    let mut model = TextModel::new(config.clone(), capture, labels)?;
    let note = &mut |n: String| events(&Event::Note(n));
    let observations = distances::find(&mut model, &photographs, interrupt, note);
    if resume {
        if checkpoint::exists(&folder.checkpoints()) {
            let (c, note) = checkpoint::load(&folder.checkpoints())?;
            model.restore(c, &checkpoint::latest(&folder.checkpoints()))?;
            note.into_iter().for_each(|n| events(&Event::Note(n)));
        }
        folder.cut_metrics(model.origin.step)?;
    } else {
        folder.write_description(&model.config, &model.capture)?;
        model.labels.save(folder.path())?;
    }
    let (origin, checkpoints, options) = (model.origin, folder.checkpoints(), run_options(&model.config));
    let mut trainer = Trainer::new(model, (photographs, observations), device, &checkpoints)?;
    let summary = training::train((&options, origin), &mut trainer, folder, interrupt, events)?;
    Ok(Trained { model: trainer.model, summary })
}

fn run_options(config: &Config) -> RunOptions {
    let r = &config.run;
    RunOptions {
        steps: (r.steps > 0).then_some(r.steps),
        seconds: (r.seconds > 0.0).then_some(r.seconds),
        log_every: r.log_every,
        save_every_seconds: r.save_every_seconds,
        save_every_steps: None,
        evaluate_every: None,
    }
}

/// Reads the capture and its labels, and opens the device.
///
/// # Errors
/// When one of them is wrong.
pub fn check(config: &Config) -> Result<()> {
    Device::open(&config.device)?;
    let capture = load_capture(config)?;
    let root = import::root(&config.data.path)?;
    Labels::read(&root, &capture, &root).map(|_| ())
}

/// The capture that a configuration names.
///
/// # Errors
/// When it cannot be read.
pub fn load_capture(config: &Config) -> Result<Capture> {
    let options = ImportOptions { split: config.data.split.parse().map_err(PipelineError::Usage)?, ..ImportOptions::default() };
    Ok(import::import(&config.data.path, &options)?)
}

/// Photographs of a part of the capture.
///
/// # Errors
/// When one cannot be read.
pub(super) fn load_pixels(config: &Config, capture: &Capture, of: Split) -> Result<PixelStore> {
    let frames: Vec<_> = capture.indices(of).into_iter().map(|i| &capture.frames[i]).collect();
    let reduction = Reduction::Times(config.data.downscale);
    let options = StoreOptions { reduction, budget: config.data.memory_budget, masks: capture.masks, white: 0.0 };
    Ok(PixelStore::load(&frames, &options, &|| {})?)
}

/// A trained model, and notes; `data` says to what folder the photographs moved.
///
/// # Errors
/// When the folder holds no run of this application, or its checkpoint is damaged.
pub fn load(run: &Path, data: Option<&Path>) -> Result<(TextModel, Vec<String>)> {
    let mut config: Config = RunDescription::read(run)?.config()?;
    let capture = kept_capture::read(run, data, &config.data.path)?;
    let root = match data {
        Some(data) => data.to_path_buf(),
        None => kept_capture::data_set(run, &config.data.path)?,
    };
    let labels = Labels::read(run, &capture, &import::root(&root)?)?;
    config.data.path = root;
    let (checkpoint, file, note) = folder::last_checkpoint(run)?;
    let mut model = TextModel::new(config, capture, labels)?;
    model.restore(checkpoint, &file)?;
    Ok((model, note.into_iter().collect()))
}

/// Description of a run for `diorama info`.
///
/// # Errors
/// As [`load`].
pub fn describe(run: &Path) -> Result<serde_json::Value> {
    let (model, notes) = load(run, None)?;
    Ok(serde_json::json!({
        "kind": "text run",
        "data": model.config.data.path,
        "steps": model.origin.step,
        "seconds": model.origin.seconds,
        "rays": model.rays,
        "parameters": model.field.groups().iter().map(|g| g.values.len()).sum::<usize>(),
        "training_views": model.train.len(),
        "held_out_views": model.capture.indices(Split::Test).len(),
        "regions": model.labels.classes.iter().map(|c| serde_json::json!({ "id": c.id, "text": c.transcription })).collect::<Vec<_>>(),
        "notes": notes,
    }))
}
