//! Stages that follow each other without further questions: the field of a scene, labels of its photographs, words on its signs, detectors.

use super::detectors::config::{Backbone, Config as DetectorConfig, Kind};
use super::detectors::recipe as detection;
use super::edit::{self, Change, EditOptions, Edited, drawing::Blend, ground::Eraser};
use super::field::config::Config;
use super::field::recipe;
use super::label::fitting::FitOptions;
use super::label::{self, Cameras, LabelOptions, Labeler, Labelled};
use crate::error::Result;
use crate::run::{RunFolder, folder};
use diorama_data::text_set::SetFormat;
use diorama_engine::train::Event;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Rate of detectors that have few steps.
const RATE: f32 = 0.003;

/// The run of a folder, and whether it goes on from a checkpoint.
fn begun(run: &Path) -> Result<(RunFolder, bool)> {
    let resume = folder::checkpoints(run).exists();
    Ok((if resume { RunFolder::open(run)?.0 } else { RunFolder::create(run, true)? }, resume))
}

/// Trains a field into the folder of a run, or goes on with it; false after an interrupt.
///
/// # Errors
/// As [`recipe::train`].
pub fn field(run: &Path, config: &Config, stop: &AtomicBool, events: &mut dyn FnMut(&Event)) -> Result<bool> {
    let (mut run, resume) = begun(run)?;
    Ok(!recipe::train(config, &mut run, resume, stop, events)?.summary.interrupted)
}

/// Finds the regions of a run in space and labels all of its photographs in a folder.
///
/// # Errors
/// As [`label::label`].
pub fn labels(run: &Path, out: PathBuf, stop: &AtomicBool, share: &mut dyn FnMut(f64)) -> Result<Labelled> {
    let labeler = Labeler::Surfaces(FitOptions::default());
    let options = LabelOptions { labeler, cameras: Cameras::All, formats: vec![SetFormat::Icdar15], out };
    label::label(run, None, &options, stop, &mut |s, _| share(s))
}

/// Writes so many other words on each region of a run.
///
/// # Errors
/// As [`edit::edit`].
pub fn words(run: &Path, (words, seed): (usize, u64), stop: &AtomicBool, share: &mut dyn FnMut(f64)) -> Result<Edited> {
    let options = EditOptions {
        regions: Vec::new(),
        change: Change::Words(words),
        font: None,
        eraser: Eraser::PatchMatch,
        blend: Blend::Alpha,
        color: None,
        seed,
    };
    edit::edit(run, None, &options, stop, &mut |s, _| share(s))
}

/// Configuration of a small detector that learns in minutes, from windows of `crop` pixels. Its length is to be set.
pub fn quick_detector(kind: Kind, data: PathBuf, crop: usize) -> DetectorConfig {
    let mut config = DetectorConfig::new(kind, Backbone::Tiny, data);
    config.batch.crop = crop;
    // In so few steps, Adam learns what the published rules have not begun to.
    (config.optim.rule, config.optim.rate) = ("adam".into(), RATE);
    config.decode.db.unclip = 0.0;
    config
}

/// Trains a detector into the folder of a run, or goes on with it; none after an interrupt.
///
/// # Errors
/// As [`detection::train`].
pub fn detector(
    run: &Path,
    config: &DetectorConfig,
    stop: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Option<detection::Trained>> {
    let (mut run, resume) = begun(run)?;
    let trained = detection::train(config, &mut run, (resume, None), stop, events)?;
    Ok((!trained.summary.interrupted).then_some(trained))
}
