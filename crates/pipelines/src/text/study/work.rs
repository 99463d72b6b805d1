//! Stages of studies, each done once: scenes, fields, sets of images, detectors and their scores.

use super::folder::StudyFolder;
use super::table::{Judgement, Trial};
use super::{Common, FREE};
use crate::error::{PipelineError, Result};
use crate::run::device::Device;
use crate::run::stages::Listeners;
use crate::text::detectors::config::Kind;
use crate::text::detectors::{judge, recipe as detection};
use crate::text::field::config::{Config, Preset};
use crate::text::field::{recipe, scores};
use crate::text::fnv;
use crate::text::make_scenes::{self, SceneOptions};
use crate::text::stages;
use crate::text::styling::MaskMode;
use crate::text::synth::dataset;
use crate::text::synth::plan::{SceneEntry, Scenes, Shard, SynthOptions};
use crate::text::synth::prior::Prior;
use crate::text::synth::sampling::{Clustering, Draws, Sampling, sample_seed};
use crate::text::synth::scene::SynthScene;
use diorama_data::error;
use diorama_data::text_set::SetFormat;
use diorama_data::text_set::detector_set::DetectorImage;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Cameras like a photograph's that are drawn of a scene to see whether it has enough of them, and how many must be valid.
const PROBES: usize = 8;
const VALID: usize = 4;

/// A scene whose field is trained, labelled and edited.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneStage {
    pub scene: String,
    /// Of held-out photographs.
    pub psnr: f64,
    pub miou: Option<f64>,
    /// Median over labels of all photographs.
    pub corner_error_px: Option<f64>,
    /// Why no image can be drawn of it; none of the others.
    pub left_out: Option<String>,
}

/// A set of images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SetStage {
    pub set: String,
    pub images: usize,
    pub words: usize,
    /// Words that are not to be read.
    pub unreadable: usize,
    /// Images of each cluster of text poses; empty where these are unknown.
    pub clusters: Vec<usize>,
    pub notes: Vec<String>,
}

/// A detector that is trained.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct DetectorStage {
    steps: u64,
    seconds: f64,
}

/// Images that detectors are judged on.
pub struct Test {
    pub name: &'static str,
    /// Name of its scores' stage, which tells it from others.
    pub key: String,
    pub images: Vec<DetectorImage>,
}

/// A study at work.
pub struct Work<'a, 'l> {
    pub folder: StudyFolder,
    pub common: &'a Common,
    pub stop: &'a AtomicBool,
    pub listeners: Listeners<'l>,
}

impl<'a, 'l> Work<'a, 'l> {
    /// Opens the folder of a study of these options.
    ///
    /// # Errors
    /// As [`StudyFolder::begin`], and when an option cannot be.
    pub fn begin(
        (out, force): (&Path, bool),
        options: &serde_json::Value,
        common: &'a Common,
        stop: &'a AtomicBool,
        listeners: Listeners<'l>,
    ) -> Result<Work<'a, 'l>> {
        common.check()?;
        Device::open(&common.device)?;
        let folder = StudyFolder::begin(out, options, &FREE, force)?;
        Ok(Work { folder, common, stop, listeners })
    }

    /// A place in the folder.
    pub fn at(&self, place: &str) -> PathBuf {
        self.folder.path().join(place)
    }

    /// Photographs scenes into a folder; their names.
    pub fn scenes(&mut self, place: &str, options: &SceneOptions) -> Result<Option<Vec<String>>> {
        let out = self.at(place);
        (self.listeners.stage)(&format!("{place}: photographs of {} scenes", options.scenes));
        let Work { folder, stop, listeners, .. } = self;
        folder.once(place, &out, || {
            let made = make_scenes::generate(&out, options, false, stop, listeners.share)?;
            Ok((!made.interrupted).then_some(made.scenes))
        })
    }

    /// Trains, labels and edits fields of scenes; those of which no image can be drawn are left out and say why.
    pub fn fields(&mut self, place: &str, scenes: &[String]) -> Result<Option<Vec<SceneStage>>> {
        let mut out = Vec::new();
        for (k, scene) in scenes.iter().enumerate() {
            (self.listeners.stage)(&format!("{scene}: field, regions and words ({} of {})", k + 1, scenes.len()));
            let (photographs, run) = (self.at(place).join(scene), self.at("runs").join(scene));
            let Work { folder, common, stop, listeners } = self;
            let work = || field(scene, (&photographs, &run), common, stop, listeners);
            let Some(done) = folder.once(&format!("field-{scene}"), &run, work)? else { return Ok(None) };
            out.push(done);
        }
        Ok(Some(out))
    }

    /// Draws a set of images of scenes whose fields are usable, `images` of each.
    pub fn drawn(
        &mut self,
        set: &str,
        scenes: &[SceneStage],
        (sampling, images, seed): (Sampling, usize, u64),
    ) -> Result<Option<SetStage>> {
        (self.listeners.stage)(&format!("{set}: {} images of {} scenes", images * scenes.len(), scenes.len()));
        let (out, runs) = (self.set(set), self.at("runs"));
        let entry = |s: &SceneStage| SceneEntry { run: runs.join(&s.scene), name: Some(s.scene.clone()), original: false };
        let list = Scenes { scenes: scenes.iter().map(entry).collect() };
        let options = SynthOptions {
            count: images * scenes.len(),
            size: self.common.size,
            sampling,
            clusters: self.common.clusters,
            only: Vec::new(),
            prior: None,
            formats: vec![SetFormat::Icdar15],
            seed,
            styles: Vec::new(),
            mask: MaskMode::default(),
        };
        let Work { folder, stop, listeners, .. } = self;
        folder.once(&format!("set-{set}"), &out, || {
            let made = dataset::synthesize(&out, (&list, &options, Shard::WHOLE), false, stop, &mut |s, _| (listeners.share)(s))?;
            let done = SetStage {
                set: set.into(),
                images: made.images,
                words: made.words,
                unreadable: made.unreadable,
                clusters: made.clusters,
                notes: made.notes,
            };
            Ok((!made.interrupted).then_some(done))
        })
    }

    /// Folder of a set.
    pub fn set(&self, name: &str) -> PathBuf {
        self.at("sets").join(name)
    }

    /// Trains detectors of all models and seeds on sets, and judges them on tests. Sets take turns, so that a machine that slows down does so
    /// for all of them.
    pub fn trials(&mut self, sets: &[&'static str], tests: &[Test]) -> Result<Option<Vec<Trial>>> {
        let mut out = Vec::new();
        let all = (0..self.common.seeds).flat_map(|seed| self.common.models.iter().map(move |model| (seed, *model)));
        for (seed, model) in all {
            for set in sets {
                let Some(trained) = self.detector(model, set, seed)? else { return Ok(None) };
                for test in tests {
                    let Some(judgement) = self.judged(&detector_name(model, set, seed), test)? else { return Ok(None) };
                    let DetectorStage { steps, seconds } = trained;
                    out.push(Trial { model, set, seed, steps, seconds, test: test.name, judgement });
                }
            }
        }
        Ok(Some(out))
    }

    fn detector(&mut self, model: Kind, set: &str, seed: u64) -> Result<Option<DetectorStage>> {
        let name = detector_name(model, set, seed);
        (self.listeners.stage)(&format!("{name}: training"));
        let (data, run) = (self.set(set), self.at("detectors").join(&name));
        let mut config = stages::quick_detector(model, data, self.common.crop());
        config.seed = self.common.seed.wrapping_mul(1000).wrapping_add(seed);
        (config.run.steps, config.run.seconds) = (self.common.limit.steps, self.common.limit.seconds);
        let Work { folder, stop, listeners, .. } = self;
        folder.once(&format!("detector-{name}"), &run.join(detection::WEIGHTS), || {
            let trained = stages::detector(&run, &config, stop, listeners.events)?;
            Ok(trained.map(|t| DetectorStage { steps: t.summary.step, seconds: t.summary.seconds }))
        })
    }

    fn judged(&mut self, detector: &str, test: &Test) -> Result<Option<Judgement>> {
        (self.listeners.stage)(&format!("{detector}: judging on {} images ({})", test.images.len(), test.name));
        let run = self.at("detectors").join(detector);
        let Work { folder, stop, listeners, .. } = self;
        let weights = error::read(&run.join(detection::WEIGHTS), u64::MAX)?;
        folder.once(&format!("scores-{detector}-{:016x}-{}", fnv::hash(weights), test.key), &run, || {
            let (network, config) = detection::open(&run, None, None)?;
            let look = &mut |i: usize| (listeners.share)(i as f64 / test.images.len() as f64);
            Ok(judge::judge(&network, &config, &test.images, stop, look)?.map(|j| Judgement::of(&j)))
        })
    }
}

fn detector_name(model: Kind, set: &str, seed: u64) -> String {
    format!("{}-{set}-{seed}", model.name())
}

/// Those of which images can be drawn, at least one, and notes on the others.
///
/// # Errors
/// When there is none.
pub fn usable(stages: &[SceneStage]) -> Result<(Vec<SceneStage>, Vec<String>)> {
    let (usable, left_out): (Vec<SceneStage>, Vec<SceneStage>) = stages.iter().cloned().partition(|s| s.left_out.is_none());
    let note = |s: &SceneStage| format!("{} is left out: {}", s.scene, s.left_out.as_deref().unwrap_or_default());
    let notes: Vec<String> = left_out.iter().map(note).collect();
    match usable.is_empty() {
        true => Err(PipelineError::Usage(format!(
            "images can be drawn of no scene; begin anew with more --field-steps and another --out: {}",
            notes.join("; ")
        ))),
        false => Ok((usable, notes)),
    }
}

/// Trains a field of photographs, finds and labels its regions, and writes other words on them; none after an interrupt.
fn field(
    scene: &str,
    (photographs, run): (&Path, &Path),
    common: &Common,
    stop: &AtomicBool,
    Listeners { share, events, .. }: &mut Listeners,
) -> Result<Option<SceneStage>> {
    let mut config = Config::new(Preset::Ci, photographs.to_path_buf());
    config.device.clone_from(&common.device);
    config.run.steps = common.field_steps;
    if !stages::field(run, &config, stop, events)? {
        return Ok(None);
    }
    let (model, _) = recipe::load(run, None)?;
    let scores = scores::evaluate(&model, &mut |_, _| Ok(()))?;
    let mut stage = SceneStage { scene: scene.into(), psnr: scores.psnr, miou: scores.miou, corner_error_px: None, left_out: None };
    let mut drawable = || -> Result<bool> {
        let labelled = stages::labels(run, run.join("labels"), stop, share)?;
        stage.corner_error_px = labelled.accuracy.and_then(|a| a.corner_error_px);
        if labelled.interrupted || stages::words(run, (common.words, common.seed), stop, share)?.interrupted {
            return Ok(false);
        }
        probe(scene, run, common).map(|()| true)
    };
    match drawable() {
        Ok(false) => return Ok(None),
        Ok(true) => {}
        // The field is good enough to be scored, but not to be written on.
        Err(PipelineError::Usage(why)) => stage.left_out = Some(why),
        Err(e) => return Err(e),
    }
    Ok(Some(stage))
}

/// Sees whether a scene has cameras for balanced and for random sets.
///
/// # Errors
/// When it has too few.
fn probe(name: &str, run: &Path, common: &Common) -> Result<()> {
    let mut scene = SynthScene::load(name.into(), run, &mut |_| ())?;
    scene.look();
    let clustering = Clustering::new(&[scene.members.clone()], common.clusters);
    let (prior, camera) = (Prior::default(), scene.camera(common.size));
    let draws = Draws { scene: &scene, number: 0, clustering: &clustering, prior: &prior, camera, seed: common.seed };
    let valid = (0..PROBES).filter(|k| draws.random(sample_seed(common.seed, name, *k)).is_ok()).count();
    if draws.feasible().0.is_empty() {
        return Err(PipelineError::Usage("no cluster of text poses has a valid camera".into()));
    }
    if valid < VALID {
        return Err(PipelineError::Usage(format!("only {valid} of {PROBES} cameras like those of its photographs are valid")));
    }
    Ok(())
}
