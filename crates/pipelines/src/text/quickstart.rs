//! Everything at once on a scene that the project generates: photographs, field, regions, edits, a data set, and detectors that it trains.

mod page;

use super::detectors::config::Kind;
use super::edit;
use super::field::config::{Config, Preset};
use super::field::{recipe, scores};
use super::label::accuracy::Accuracy;
use super::make_scenes::{self, FontSource, SceneOptions};
use super::report::{self, Contents, Failures, FieldQuality, Judging, LabelledSet};
use super::stages;
use super::styling::MaskMode;
use super::synth::dataset::{self, Synthesized};
use super::synth::plan::{Scenes, Shard, SynthOptions};
use super::synth::sampling::Sampling;
use crate::error::Result;
use crate::run::stages::Listeners;
use diorama_data::text_set::SetFormat;
use diorama_data::{DataError, atomic, photo};
use diorama_engine::train::Event;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Size of the images, and how many are kept for judging.
const SIZE: (u32, u32) = (160, 120);
const JUDGED: usize = 60;
/// Side of the windows that detectors are trained on.
const CROP: usize = 128;

/// How much is generated and trained.
#[derive(Clone, Debug)]
pub struct QuickstartOptions {
    pub steps: Option<u64>,
    pub words: usize,
    pub images: usize,
    /// Seconds of training of each detector.
    pub detector_seconds: f64,
}

impl Default for QuickstartOptions {
    /// Less than a quarter of an hour on two cores.
    fn default() -> Self {
        QuickstartOptions { steps: None, words: 8, images: 500, detector_seconds: 180.0 }
    }
}

/// Figures, and where everything is.
#[derive(Clone, Debug, Serialize)]
pub struct Made {
    pub psnr: f64,
    pub ssim: f64,
    pub miou: Option<f64>,
    pub corner_error_px: Option<f64>,
    pub pose_error_deg: Option<f64>,
    pub images: usize,
    pub images_per_s: f64,
    /// Labels of new words that were compared with their glyphs, and those more than 2 pixels off.
    pub compared: usize,
    pub misfits: usize,
    /// F by instance on images of the same scene that no detector was trained on.
    pub f_db: f64,
    pub f_east: f64,
    pub dataset: PathBuf,
    pub report: PathBuf,
    pub notes: Vec<String>,
}

/// Generates, trains, labels, edits, draws, trains detectors and reports into `out`; none when stopped. What is done already is kept: the same
/// command goes on after an interruption.
///
/// # Errors
/// When a stage fails, or the folder cannot be written.
pub fn quickstart(out: &Path, o: &QuickstartOptions, stop: &AtomicBool, listeners: Listeners) -> Result<Option<Made>> {
    std::fs::create_dir_all(out).map_err(DataError::io(out, "create"))?;
    let Listeners { stage, share, events } = listeners;
    let mut q = Quickstart { out, o, stop, notes: Vec::new(), share, events };
    stage("photographing a room with two signs");
    let Some(scene) = q.scene()? else { return Ok(None) };
    stage("training its field, and the classes of its signs");
    if !q.field(&scene)? {
        return Ok(None);
    }
    stage("finding the signs in space");
    let Some((field, accuracy)) = q.label()? else { return Ok(None) };
    stage("writing other words on them");
    if !q.edit()? {
        return Ok(None);
    }
    stage("drawing labelled images");
    let Some(made) = q.synthesize()? else { return Ok(None) };
    stage("training a DB detector");
    let Some(db) = q.detector(Kind::Db)? else { return Ok(None) };
    stage("training an EAST detector");
    let Some(east) = q.detector(Kind::East)? else { return Ok(None) };
    let f = |d: &Failures| d.judged.evaluation.instance.f;
    let made = Made {
        psnr: field.psnr,
        ssim: field.ssim,
        miou: field.miou,
        corner_error_px: accuracy.corner_error_px,
        pose_error_deg: accuracy.pose_error_deg,
        images: made.images,
        images_per_s: made.images_per_s,
        compared: made.compared,
        misfits: made.misfits,
        f_db: f(&db),
        f_east: f(&east),
        dataset: out.join("dataset"),
        report: out.join("report.html"),
        notes: q.notes,
    };
    let contents = Contents {
        sets: vec![LabelledSet::read(&made.dataset)?],
        real: None,
        detectors: vec![db, east],
        fields: vec![FieldQuality { run: out.join("field").display().to_string(), scores: field }],
    };
    let page = report::page::html("diorama text quickstart", &page::head(&made), &contents, page::FOOT)?;
    atomic::write(&made.report, page.as_bytes())?;
    Ok(Some(made))
}

struct Quickstart<'a> {
    out: &'a Path,
    o: &'a QuickstartOptions,
    stop: &'a AtomicBool,
    notes: Vec<String>,
    share: &'a mut dyn FnMut(f64),
    events: &'a mut dyn FnMut(&Event),
}

impl Quickstart<'_> {
    fn run(&self) -> PathBuf {
        self.out.join("field")
    }

    /// The scene's folder.
    fn scene(&mut self) -> Result<Option<PathBuf>> {
        let options = SceneOptions { fonts: FontSource::Shipped, ..SceneOptions::named("ci")? };
        let folder = self.out.join("scenes");
        let made = make_scenes::generate(&folder, &options, false, self.stop, self.share)?;
        Ok((!made.interrupted).then(|| folder.join(&made.scenes[0])))
    }

    /// Trains the field, or goes on with it; false after an interrupt.
    fn field(&mut self, scene: &Path) -> Result<bool> {
        let (run, mut config) = (self.run(), Config::new(Preset::Ci, scene.to_path_buf()));
        config.device = "cpu".into();
        self.o.steps.iter().for_each(|s| config.run.steps = *s);
        stages::field(&run, &config, self.stop, self.events)
    }

    /// Scores the field and labels all photographs.
    fn label(&mut self) -> Result<Option<(scores::Scores, Accuracy)>> {
        let (model, _) = recipe::load(&self.run(), None)?;
        let views = self.out.join("views");
        std::fs::create_dir_all(&views).map_err(DataError::io(&views, "create"))?;
        let look = &mut |name: &str, sheet: &_| {
            let stem = Path::new(name).file_stem().unwrap_or_default().to_string_lossy();
            Ok(photo::save_png(&views.join(format!("{stem}.png")), sheet)?)
        };
        let field = scores::evaluate(&model, look)?;
        let done = stages::labels(&self.run(), self.out.join("labels"), self.stop, self.share)?;
        self.notes.extend(done.notes);
        Ok((!done.interrupted).then_some((field, done.accuracy.unwrap_or_default())))
    }

    fn edit(&mut self) -> Result<bool> {
        if edit::Edit::names(&self.run())?.is_empty() {
            let done = stages::words(&self.run(), (self.o.words, 0), self.stop, self.share)?;
            self.notes.extend(done.notes);
            return Ok(!done.interrupted);
        }
        Ok(true)
    }

    /// The data set, and one to judge detectors on.
    fn synthesize(&mut self) -> Result<Option<Synthesized>> {
        let scenes = Scenes::read(&self.run())?;
        let mut first = None;
        for (name, count, seed) in [("dataset", self.o.images, 0), ("judged", JUDGED, 1)] {
            let options = SynthOptions {
                count,
                size: SIZE,
                sampling: Sampling::Balanced,
                clusters: 16,
                only: Vec::new(),
                prior: None,
                formats: vec![SetFormat::Icdar15, SetFormat::Ppocr, SetFormat::Mmocr, SetFormat::Coco],
                seed,
                styles: Vec::new(),
                mask: MaskMode::default(),
            };
            let share = &mut *self.share;
            let made =
                dataset::synthesize(&self.out.join(name), (&scenes, &options, Shard::WHOLE), false, self.stop, &mut |s, _| share(s))?;
            if made.interrupted {
                return Ok(None);
            }
            self.notes.extend(made.notes.iter().filter(|_| first.is_none()).cloned());
            first.get_or_insert(made);
        }
        Ok(first)
    }

    /// Trains a detector and judges it.
    fn detector(&mut self, kind: Kind) -> Result<Option<Failures>> {
        let run = self.out.join(kind.name());
        let mut config = stages::quick_detector(kind, self.out.join("dataset"), CROP);
        (config.run.steps, config.run.seconds) = (0, self.o.detector_seconds);
        let Some(trained) = stages::detector(&run, &config, self.stop, self.events)? else { return Ok(None) };
        let [dataset, judged] = ["dataset", "judged"].map(|name| self.out.join(name));
        let seed = report::unused_seed(&[&dataset, &judged])?;
        let detector = (&trained.detector, &config);
        let judging = Judging { detector, name: &run.display().to_string(), set: &judged, runs: &[self.run()], seed };
        judging.judge(self.stop, &mut *self.share)
    }
}
