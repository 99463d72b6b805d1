//! A page about data sets of images with writing, what detectors miss in them, and how well fields draw views: one HTML file.
//!
//! `gathered` counts, `failures` judges detectors, `charts` draws, `page` puts all together.

mod charts;
mod failures;
mod gathered;
pub mod page;
mod pictures;
mod svg;
#[cfg(test)]
mod tests;

use super::detectors::recipe as detection;
use super::field::recipe;
use super::field::scores::{self, Scores};
use crate::error::Result;
use crate::run::perceptual;
use diorama_data::text_labels::LabelledImage;
use diorama_data::text_set::{self, SetImage};
use diorama_data::{DataError, atomic};
use diorama_engine::metrics::lpips::Lpips;
pub use failures::{Failures, Judging, unused_seed};
pub use gathered::Gathered;
use serde_json::{Value, json};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Labels of photographs that data sets are compared with.
#[derive(Clone, Debug, PartialEq)]
pub struct RealLabels {
    pub name: String,
    pub images: Vec<LabelledImage>,
    /// Width and height by the images' names.
    pub sizes: HashMap<String, (u32, u32)>,
}

/// What a report is about.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReportOptions {
    /// Folders with `annotations.jsonl`.
    pub sets: Vec<PathBuf>,
    /// Runs or files of detectors; each is judged on each data set.
    pub detectors: Vec<PathBuf>,
    /// Runs of fields.
    pub runs: Vec<PathBuf>,
    /// Weights of LPIPS; none: it is left out.
    pub lpips: Vec<PathBuf>,
    pub real: Option<RealLabels>,
}

/// A data set.
#[derive(Clone, Debug)]
pub struct LabelledSet {
    pub folder: PathBuf,
    pub images: Vec<SetImage>,
    pub figures: Gathered,
}

/// A field and its scores.
#[derive(Clone, Debug)]
pub struct FieldQuality {
    pub run: String,
    pub scores: Scores,
}

/// What a page shows.
#[derive(Clone, Debug, Default)]
pub struct Contents {
    pub sets: Vec<LabelledSet>,
    pub real: Option<Gathered>,
    pub detectors: Vec<Failures>,
    pub fields: Vec<FieldQuality>,
}

impl LabelledSet {
    /// Reads a data set and counts.
    ///
    /// # Errors
    /// When the folder holds no annotations, or wrong ones.
    pub fn read(folder: &Path) -> Result<LabelledSet> {
        let images = text_set::read(folder)?;
        let figures = Gathered::of_set(&folder.display().to_string(), &images);
        Ok(LabelledSet { folder: folder.to_path_buf(), images, figures })
    }
}

impl FieldQuality {
    /// Mean LPIPS of the views; none where it was not asked for.
    pub fn lpips(&self) -> Option<f64> {
        let all: Vec<f64> = self.scores.per_view.iter().filter_map(|v| v.lpips).collect();
        (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
    }
}

impl Contents {
    /// The page's figures for scripts.
    pub fn summary(&self) -> Value {
        let labels = |g: &Gathered| {
            let clusters: Vec<Value> = g.clusters.iter().map(|c| json!({ "cluster": c.number, "words": c.words })).collect();
            json!({ "name": g.name, "images": g.images, "words": g.words, "unreadable": g.unreadable, "clusters": clusters })
        };
        let detector = |f: &Failures| {
            let s = f.judged.evaluation.instance;
            json!({ "weights": f.detector, "data": f.set, "precision": s.precision, "recall": s.recall, "f": s.f,
                "weakest": f.weakest, "command": f.command })
        };
        let field = |f: &FieldQuality| json!({ "run": f.run, "views": f.scores.views, "psnr": f.scores.psnr, "ssim": f.scores.ssim, "lpips": f.lpips() });
        json!({
            "sets": self.sets.iter().map(|s| labels(&s.figures)).collect::<Vec<_>>(),
            "real": self.real.as_ref().map(labels),
            "detectors": self.detectors.iter().map(detector).collect::<Vec<_>>(),
            "fields": self.fields.iter().map(field).collect::<Vec<_>>(),
        })
    }
}

/// Gathers what a report shows and writes the page; none after an interrupt. `progress` sees the share that is done and the work in hand.
///
/// # Errors
/// When a data set, a detector or a run cannot be read, or the page cannot be written.
pub fn report(out: &Path, o: &ReportOptions, stop: &AtomicBool, progress: &mut dyn FnMut(f64, &str)) -> Result<Option<Contents>> {
    if let Some(folder) = out.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(DataError::io(folder, "create"))?;
    }
    let mut contents = Contents {
        sets: o.sets.iter().map(|s| LabelledSet::read(s)).collect::<Result<_>>()?,
        real: o.real.as_ref().map(|r| Gathered::of_labels(&r.name, &r.images, &r.sizes)),
        ..Contents::default()
    };
    let lpips = if o.lpips.is_empty() { None } else { Some(perceptual::load_lpips(&o.lpips)?) };
    let jobs = (o.detectors.len() * o.sets.len() + o.runs.len()).max(1) as f64;
    let folders: Vec<&Path> = o.sets.iter().map(PathBuf::as_path).collect();
    let seed = unused_seed(&folders)?;
    // What cannot be read is told before any work begins.
    let opened = o.detectors.iter().map(|d| detection::open(d, None, None)).collect::<Result<Vec<_>>>()?;
    o.runs.iter().try_for_each(|run| recipe::load(run, None).map(|_| ()))?;
    for (k, ((detector, config), weights)) in opened.iter().zip(&o.detectors).enumerate() {
        let name = weights.display().to_string();
        for (i, set) in folders.iter().enumerate() {
            let done = (k * folders.len() + i) as f64;
            let judging = Judging { detector: (detector, config), name: &name, set, runs: &o.runs, seed };
            let Some(found) = judging.judge(stop, &mut |s| progress((done + s) / jobs, "detecting"))? else { return Ok(None) };
            contents.detectors.push(found);
        }
    }
    for (k, run) in o.runs.iter().enumerate() {
        if stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
        progress(((o.detectors.len() * folders.len() + k) as f64) / jobs, "held-out views");
        contents.fields.push(field(run, lpips.as_ref())?);
    }
    let page = page::html("diorama text report", "<h1>diorama text report</h1>\n", &contents, "")?;
    atomic::write(out, page.as_bytes())?;
    Ok(Some(contents))
}

/// A run's field and the scores of its held-out views.
fn field(run: &Path, lpips: Option<&Lpips>) -> Result<FieldQuality> {
    let (model, _) = recipe::load(run, None)?;
    let scores = scores::evaluate_with(&model, lpips, &mut |_, _| Ok(()))?;
    Ok(FieldQuality { run: run.display().to_string(), scores })
}
