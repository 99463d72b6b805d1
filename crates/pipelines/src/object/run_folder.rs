//! The object application's part of a run folder: its configuration, its summary, and the trained model.

use super::config::Config;
use super::loading;
use super::model::ObjectModel;
use crate::error::Result;
use crate::run::{RunDescription, RunFolder, folder, kept_capture, summary};
use diorama_geom::Capture;
use diorama_geom::capture::Split;
use std::path::{Path, PathBuf};

/// Reading of a run's capture together with what its data set alone has.
pub trait SparsePoints {
    /// [`RunFolder::capture`] with its sparse points; a note says so where they cannot be had.
    ///
    /// # Errors
    /// When the capture is damaged, or photographs are missing.
    fn capture_with_points(&self) -> Result<Capture>;
}

impl SparsePoints for RunFolder {
    fn capture_with_points(&self) -> Result<Capture> {
        let mut capture = self.capture()?;
        read_points(&mut capture, &self.description()?.config()?, &self.data_set()?);
        Ok(capture)
    }
}

/// The configuration of a run.
///
/// # Errors
/// When there is no run, it is of another application, or its configuration is wrong.
pub fn read_config(run: &Path) -> Result<Config> {
    RunDescription::read(run)?.config()
}

/// Results of a run, as `summary.json` keeps them.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RunSummary {
    pub steps: u64,
    pub seconds: f64,
    /// `cpu`, or what the GPU calls itself.
    pub device: String,
    /// Of training rays, and of held-out pixels when they were judged last; dB.
    pub psnr_train: Option<f64>,
    pub psnr_held_out: Option<f64>,
    /// Names of held-out views that lie far below the training views.
    #[serde(default)]
    pub behind_fog: Vec<String>,
    /// Most bytes that training had in memory, where the system tells.
    pub peak_memory_bytes: Option<u64>,
}

/// Results of a run; none before its end.
///
/// # Errors
/// When the file is malformed.
pub fn read_summary(run: &Path) -> Result<Option<RunSummary>> {
    summary::read(run)
}

/// A trained model, read from its folder.
///
/// # Errors
/// When the run, its capture or its checkpoints are damaged.
pub fn load_model(run: &Path) -> Result<(ObjectModel, Vec<String>)> {
    load_model_of(run, None)
}

/// A trained model whose photographs are in `data` now, if that is given.
///
/// # Errors
/// As [`load_model`], and when `data` lacks a photograph.
pub fn load_model_of(run: &Path, data: Option<&Path>) -> Result<(ObjectModel, Vec<String>)> {
    let config = read_config(run)?;
    let capture = kept_capture::read(run, data, &config.data.path)?;
    let (checkpoint, file, note) = folder::last_checkpoint(run)?;
    // The field's space depends on it.
    let has_alpha = checkpoint.metadata.get("has_alpha").is_some_and(|v| v == "true");
    let mut model = ObjectModel::new(config, capture, has_alpha)?;
    model.restore(checkpoint, &file)?;
    Ok((model, note.into_iter().collect()))
}

/// Description of a run for `diorama info`.
///
/// # Errors
/// As [`load_model`].
pub fn describe(run: &Path) -> Result<serde_json::Value> {
    let (model, notes) = load_model(run)?;
    let o = model.origin;
    Ok(serde_json::json!({
        "kind": "object run",
        "method": model.config.method,
        "data": model.config.data.path,
        "downscale": model.config.data.downscale,
        "steps": o.step,
        "seconds": o.seconds,
        "rays": model.rays,
        "samples": model.samples,
        "parameters": model.field.groups().iter().map(|g| g.values.len()).sum::<usize>(),
        "training_views": model.train.len(),
        "held_out_views": model.capture.indices(Split::Test).len(),
        "occupied": model.occupancy.as_ref().map(|o| o.bits().fill()),
        "notes": notes,
    }))
}

/// Reads the sparse points of a model's capture, whose photographs are in `data` now, if that is given; else a note says why not.
///
/// # Errors
/// When the run's capture is damaged.
pub fn add_points(model: &mut ObjectModel, run: &Path, data: Option<&Path>) -> Result<Vec<String>> {
    let data: PathBuf = match data {
        Some(moved) => moved.to_path_buf(),
        None => kept_capture::data_set(run, &model.config.data.path)?,
    };
    let n_notes = model.capture.notes.len();
    read_points(&mut model.capture, &model.config, &data);
    Ok(model.capture.notes.split_off(n_notes))
}

/// Reads the sparse points of a kept capture, which its run has not kept, from its data set; a note says so where they cannot be had.
fn read_points(kept: &mut Capture, config: &Config, data: &Path) {
    let mut config = config.clone();
    config.data.path = data.to_path_buf();
    kept_capture::add_points(kept, loading::load_capture(&config));
}

#[cfg(test)]
mod tests {
    use super::super::config::Method;
    use super::super::quickstart::write_capture;
    use super::*;

    #[test]
    fn points_of_another_world_are_not_used() {
        let dir = tempfile::tempdir().unwrap();
        let data = dir.path();
        write_capture(data, 4, 16).unwrap();
        let config = Config::new(Method::Ngp, data.into());
        let mut kept = loading::load_capture(&config).unwrap();
        read_points(&mut kept, &config, data);
        assert_eq!(kept.notes, Vec::<String>::new(), "the same capture");
        kept.frames[1].world_from_camera.translation.x += 0.1;
        read_points(&mut kept, &config, data);
        assert!(kept.notes[0].contains("has changed"), "{:?}", kept.notes);
        std::fs::remove_file(data.join("transforms.json")).unwrap();
        read_points(&mut kept, &config, data);
        assert!(kept.notes[1].contains("cannot be read again"), "{:?}", kept.notes);
    }
}
