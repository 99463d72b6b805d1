//! Regions in the world from a trained run, and labels of any views of it.
//!
//! Points of each class become a surface and a rectangle ([`fitting`]), which is projected to each view ([`in_view`]) with its pose and the
//! share of it that the view shows; a data set with the views and their labels is written.

pub mod accuracy;
mod by_mask;
pub mod fitting;
pub mod homography;
pub mod in_view;
mod points;
mod stereo;

use super::field::model::TextModel;
use super::field::recipe;
use super::placed::{self, PlacedRegion};
use super::truth::Truth;
use crate::error::{PipelineError, Result};
use accuracy::{Accuracy, Collected};
use diorama_data::text_set::{self, SetFormat, SetImage, SetWord};
use diorama_data::{DataError, camera_path_json, import, photo};
use diorama_engine::renderers::volume::Quality;
use diorama_geom::capture::Split;
use diorama_geom::{Camera, ImageU8, Pose};
use diorama_kernels::ops::ray_generation::PosedCamera;
use fitting::FitOptions;
use in_view::OnSurface;
use points::ViewCache;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use stereo::Stereo;

/// Quality of all views that geometry is read from.
const QUALITY: Quality = Quality::Full;

/// Views to be labelled.
#[derive(Clone, Debug, PartialEq)]
pub enum Cameras {
    /// All photographs, those of training, or those held out.
    All,
    Training,
    HeldOut,
    /// Cameras of a `camera_path.json`, whose views are rendered.
    File(PathBuf),
}

/// How labels come to views.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Labeler {
    /// By regions in space.
    Surfaces(FitOptions),
    /// From labelled photographs to each view, without regions in space.
    Stereo,
}

/// What to label, and how.
#[derive(Clone, Debug)]
pub struct LabelOptions {
    pub labeler: Labeler,
    pub cameras: Cameras,
    pub formats: Vec<SetFormat>,
    /// Folder of the data set.
    pub out: PathBuf,
}

/// What was labelled.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Labelled {
    pub regions: usize,
    /// Regions that are on no surface.
    pub without_surface: usize,
    pub images: usize,
    pub words: usize,
    /// Words that nobody is to read.
    pub unreadable: usize,
    /// Against the truth, where the scene has one.
    pub accuracy: Option<Accuracy>,
    pub notes: Vec<String>,
    pub interrupted: bool,
}

/// A view to be labelled.
struct LabelledView {
    name: String,
    camera: Camera,
    world_from_camera: Pose,
    /// The capture's frame, and its photograph; none: it is rendered.
    frame: Option<usize>,
    photograph: Option<PathBuf>,
}

/// What labels views.
enum Carrier<'a> {
    Regions(&'a TextModel, Vec<PlacedRegion>),
    Stereo(Stereo<'a>),
}

impl Carrier<'_> {
    fn words(&self, view: &LabelledView) -> Vec<SetWord> {
        match self {
            Carrier::Regions(model, regions) => words(model, regions, view),
            Carrier::Stereo(stereo) => stereo.words(view),
        }
    }
}

/// Fits the regions of a run and writes them to its `regions.json`, unless labels are carried by stereo, and writes a labelled data set of the views.
///
/// # Errors
/// When the run has no classes yet, no region has a surface or a class, the folder is not empty, or a file cannot be read or written.
pub fn label(
    run: &Path,
    data: Option<&Path>,
    options: &LabelOptions,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(f64, &str),
) -> Result<Labelled> {
    let (model, notes) = recipe::load(run, data)?;
    let views = views(&model, &options.cameras)?;
    let mut out = Labelled { notes, ..Labelled::default() };
    let carrier = match options.labeler {
        Labeler::Surfaces(fit) => place(&model, run, fit, &mut out, stop, progress)?.map(|regions| Carrier::Regions(&model, regions)),
        Labeler::Stereo => Stereo::new(&model, stop, progress).map(Carrier::Stereo),
    };
    let Some(carrier) = carrier else {
        return Ok(Labelled { interrupted: true, ..out });
    };
    let truth = truth(&model)?;
    let mut collected = Collected::default();
    let mut images = Vec::new();
    if options.out.join(text_set::ANNOTATIONS).exists() {
        text_set::remove(&options.out, &text_set::read(&options.out)?)?;
    }
    std::fs::create_dir_all(options.out.join("images")).map_err(DataError::io(&options.out, "create"))?;
    for (k, view) in views.iter().enumerate() {
        if stop.load(Ordering::Relaxed) {
            return Ok(Labelled { interrupted: true, ..out });
        }
        progress(k as f64 / views.len() as f64, "labels");
        let words = carrier.words(view);
        if let Some(known) = truth.as_ref().and_then(|t| accuracy::view_of(t, &view.name)) {
            collected.add(known, &words);
        }
        (out.words, out.unreadable) = (out.words + words.len(), out.unreadable + words.iter().filter(|w| w.ignore).count());
        let image = set_image(view, words);
        photo::save_png(&options.out.join(&image.image), &picture(&model, view)?)?;
        images.push(image);
    }
    text_set::save(&options.out, &images)?;
    text_set::write(&options.out, &images, &options.formats)?;
    (out.images, out.accuracy) = (images.len(), collected.accuracy());
    Ok(out)
}

/// Fits the regions of a run and writes them to its `regions.json`; none after an interrupt.
fn place(
    model: &TextModel,
    run: &Path,
    fit: FitOptions,
    out: &mut Labelled,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(f64, &str),
) -> Result<Option<Vec<PlacedRegion>>> {
    if model.classes.is_none() {
        let what = "has learned no classes yet; go on with `diorama text train --resume`";
        return Err(PipelineError::Usage(format!("{}: {what}", run.display())));
    }
    let Some(regions) = regions(model, fit, stop, &mut out.notes, progress) else { return Ok(None) };
    if regions.iter().all(|r| r.rectangle.is_none()) {
        let why = out.notes.last().cloned().unwrap_or_default();
        return Err(PipelineError::Usage(format!("{}: no region has a surface; {why}", run.display())));
    }
    placed::save(run, &regions)?;
    (out.regions, out.without_surface) = (regions.len(), regions.iter().filter(|r| r.rectangle.is_none()).count());
    Ok(Some(regions))
}

/// Fits all regions; none after an interrupt.
pub fn regions(
    model: &TextModel,
    options: FitOptions,
    stop: &AtomicBool,
    notes: &mut Vec<String>,
    progress: &mut dyn FnMut(f64, &str),
) -> Option<Vec<PlacedRegion>> {
    let (mut cache, mut out) = (ViewCache::new(model), Vec::new());
    for class in 1..model.labels.count() {
        if stop.load(Ordering::Relaxed) {
            return None;
        }
        progress((class - 1) as f64 / model.labels.classes.len() as f64, "regions");
        let (region, note) = fitting::fit(model, class as u8, options, &mut cache);
        notes.extend(note);
        out.push(region);
    }
    Some(out)
}

/// Labels of a view.
fn words(model: &TextModel, regions: &[PlacedRegion], view: &LabelledView) -> Vec<SetWord> {
    let of_surfaces =
        regions.iter().filter_map(OnSurface::of).filter_map(|w| in_view::labelled(model, &w, &view.camera, &view.world_from_camera));
    let mut out: Vec<SetWord> = of_surfaces.collect();
    if regions.iter().any(|r| r.rectangle.is_none()) {
        let camera = posed(model, view);
        if let Some(shares) = model.shares(&camera, &mut |_| ()) {
            let size = [camera.camera.width as usize, camera.camera.height as usize];
            out.extend(by_mask::words(model, regions, (&shares, size), &view.camera));
        }
    }
    out
}

/// The camera of a view in model space.
fn posed(model: &TextModel, view: &LabelledView) -> PosedCamera {
    PosedCamera { camera: view.camera, pose: model.model_from_world.pose(&view.world_from_camera) }
}

/// The photograph of a view, or its rendering.
fn picture(model: &TextModel, view: &LabelledView) -> Result<ImageU8> {
    match &view.photograph {
        Some(file) => Ok(photo::load(file)?),
        None => Ok(model.tracer(QUALITY).view(&posed(model, view), &mut |_| ()).rgb.to_u8()),
    }
}

/// The truth of the scene of a run, if it is a generated one.
pub fn truth(model: &TextModel) -> Result<Option<Truth>> {
    let root = import::root(&model.config.data.path)?;
    super::truth::file(&root, "truth.json").exists().then(|| Truth::read(&root)).transpose()
}

fn views(model: &TextModel, cameras: &Cameras) -> Result<Vec<LabelledView>> {
    let frames: Vec<usize> = match cameras {
        Cameras::All => (0..model.capture.frames.len()).collect(),
        Cameras::Training => model.train.clone(),
        Cameras::HeldOut => model.capture.indices(Split::Test),
        Cameras::File(file) => {
            let path = camera_path_json::read(file, &model.capture.world_from_capture)?;
            let view = |(k, v): (usize, &diorama_geom::camera_path::PathView)| LabelledView {
                name: format!("{k:06}"),
                camera: v.camera,
                world_from_camera: v.world_from_camera,
                frame: None,
                photograph: None,
            };
            return Ok(path.views.iter().enumerate().map(view).collect());
        }
    };
    if frames.is_empty() {
        let path = model.config.data.path.display();
        return Err(PipelineError::Usage(format!("{path}: no photograph is held out; choose other --cameras")));
    }
    let view = |i: &usize| {
        let f = &model.capture.frames[*i];
        let name = Path::new(&f.name).file_stem().unwrap_or_default().to_string_lossy().into_owned();
        LabelledView { name, camera: f.camera, world_from_camera: f.world_from_camera, frame: Some(*i), photograph: Some(f.image.clone()) }
    };
    Ok(frames.iter().map(view).collect())
}

/// The record of a view.
fn set_image(view: &LabelledView, words: Vec<SetWord>) -> SetImage {
    let (c, pose) = (&view.camera, &view.world_from_camera);
    let (r, t) = (&pose.rotation, pose.translation);
    SetImage {
        image: format!("images/{}.png", view.name),
        width: c.width,
        height: c.height,
        intrinsic: [c.fx, c.fy, c.cx, c.cy],
        world_from_camera: std::array::from_fn(|k| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]]),
        scene: String::new(),
        style: None,
        seed: None,
        words,
    }
}
