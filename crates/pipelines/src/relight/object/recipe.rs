//! Training recipe of the object model, to be read from top to bottom.

use super::capture::{self, ObjectCapture};
use super::config::Config;
use super::export;
use super::model::{ObjectModel, Stage};
use super::trainer::Trainer;
use crate::error::{PipelineError, Result};
use crate::run::{RunDescription, RunFolder, folder, kept_capture, training};
use diorama_data::gltf::{self, WriteOptions};
use diorama_data::{checkpoint, environment};
use diorama_engine::train::{Event, RunOptions, Summary};
use diorama_geom::Capture;
use diorama_geom::capture::Split;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Result of training.
pub struct Trained {
    pub model: ObjectModel,
    pub capture: ObjectCapture,
    pub summary: Summary,
}

/// Trains into `folder`, from the start or from its checkpoint.
///
/// # Errors
/// When the capture or a checkpoint cannot be read, or training diverges.
pub fn train(
    config: &Config,
    imported: &Capture,
    folder: &mut RunFolder,
    resume: bool,
    interrupt: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Trained> {
    imported.notes.iter().for_each(|n| events(&Event::Note(n.clone())));
    let config = &if resume { with_kept_start(config.clone(), folder.path()) } else { config.clone() };
    let photographs = capture::load(config, imported)?;
    let kept = if resume && checkpoint::exists(&folder.checkpoints()) { Some(checkpoint::load(&folder.checkpoints())?) } else { None };
    let mut model = match kept {
        Some((c, note)) => {
            note.into_iter().for_each(|n| events(&Event::Note(n)));
            ObjectModel::restored(config.clone(), &photographs, c, &checkpoint::latest(&folder.checkpoints()))?
        }
        None => ObjectModel::new(config.clone(), &photographs)?,
    };
    std::mem::take(&mut model.notes).into_iter().for_each(|n| events(&Event::Note(n)));
    if resume {
        folder.cut_metrics(model.origin.step)?;
    } else {
        folder.write_description(&model.config, imported)?;
    }
    let (origin, checkpoints) = (model.origin, folder.checkpoints());
    let mut trainer = Trainer::new(model, photographs, &checkpoints);
    let options = RunOptions {
        steps: Some(config.steps()),
        seconds: None,
        log_every: config.run.log_every,
        save_every_seconds: config.run.save_every_seconds,
        save_every_steps: None,
        evaluate_every: None,
    };
    let summary = training::train((&options, origin), &mut trainer, folder, interrupt, events)?;
    let Trainer { mut model, capture, .. } = trainer;
    model.probe.update();
    Ok(Trained { model, capture, summary })
}

/// Writes the object as GLB, and its light beside it as `NAME.probe.hdr`; returns the latter's name.
///
/// # Errors
/// When training has not reached the second stage, or a file cannot be written.
pub fn export(model: &ObjectModel, out: &Path) -> Result<PathBuf> {
    let Stage::Textured(textured) = &model.stage else {
        return Err(PipelineError::Usage("training has not reached the stage with textures; go on with --resume".into()));
    };
    let name = out.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    gltf::save(out, &export::model(textured, &model.placement, &name), WriteOptions::default())?;
    let probe = out.with_extension("probe.hdr");
    environment::save_hdr(&probe, &model.probe.environment())?;
    Ok(probe)
}

/// A trained model with its photographs, and notes.
///
/// # Errors
/// When the folder holds no run of this application, or its checkpoint is damaged.
pub fn load(run: &Path) -> Result<(ObjectModel, ObjectCapture, Vec<String>)> {
    let config = with_kept_start(RunDescription::read(run)?.config()?, run);
    let imported = kept_capture::read(run, None, &config.data.path)?;
    let (checkpoint, file, note) = folder::last_checkpoint(run)?;
    let photographs = capture::load(&config, &imported)?;
    let model = ObjectModel::restored(config, &photographs, checkpoint, &file)?;
    Ok((model, photographs, note.into_iter().collect()))
}

/// A configuration whose mesh and photographs, if the run keeps them itself, are where the run's folder is now.
fn with_kept_start(mut config: Config, run: &Path) -> Config {
    let kept = run.join(folder::START);
    let is_kept = |p: &Path| p.file_name().is_some_and(|n| n == folder::START) && !p.exists() && kept.is_dir();
    if is_kept(&config.data.path) {
        config.base_mesh = config.base_mesh.file_name().map_or(PathBuf::new(), |name| kept.join(name));
        config.data.path = kept;
    }
    config
}

/// Description of a run for `diorama info`.
///
/// # Errors
/// As [`load`].
pub fn describe(run: &Path) -> Result<serde_json::Value> {
    let (model, photographs, notes) = load(run)?;
    let faces = match &model.stage {
        Stage::Topology(m) => m.mesh().faces.len(),
        Stage::Textured(m) => m.layout.faces.len(),
    };
    Ok(serde_json::json!({
        "kind": "relight object run",
        "data": model.config.data.path,
        "steps": model.origin.step,
        "seconds": model.origin.seconds,
        "stage": model.stage.name(),
        "faces": faces,
        "training_views": photographs.indices(Split::Train).len(),
        "held_out_views": photographs.indices(Split::Test).len(),
        "notes": notes,
    }))
}
