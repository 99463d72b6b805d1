//! A run as the viewer sees it: finished, or while it trains.

use super::export::{self, ExportOptions, Size};
use super::held_out;
use super::model::ObjectModel;
use super::render::{self, Layer};
use super::run_folder::{RunSummary, read_summary};
use crate::error::{PipelineError, Result};
use crate::run::metrics::{Row, curve, read_rows};
use diorama_data::camera_path_json;
use diorama_data::{DataError, atomic, photo};
use diorama_engine::renderers::volume::Quality;
use diorama_engine::train::{Event, Origin, scalar};
use diorama_geom::capture::focus_point;
use diorama_geom::glam::DVec3;
use diorama_geom::view_controls::ViewLayer;
use diorama_geom::view_source::{MeasuredLength, MeshRequest, ViewChart, ViewFigure, ViewFrame, ViewLine};
use diorama_geom::view_source::{ViewRequest, ViewScene, ViewSource, ViewStatus};
use diorama_geom::{Camera, ImageU8, Similarity};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::{Duration, Instant};

/// Longest side of a small photograph.
const THUMBNAIL: usize = 160;
/// How often a run in training is looked at, at most.
const REFRESH: Duration = Duration::from_secs(2);

/// Figures that the viewer shows, by the names that the log has, and what they are called there.
const FIGURES: [(&str, &str); 4] = [("loss", "Loss"), (PSNR, "PSNR"), (HELD_OUT_PSNR, "Held out"), ("rays_per_s", "Rays")];
const PSNR: &str = "psnr";
const HELD_OUT_PSNR: &str = "val_psnr";

/// Lowest and highest corner in the world.
pub type Crop = ([f32; 3], [f32; 3]);

/// A box that was drawn in the viewer, as `crop.json` in the run folder keeps it.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CropFile {
    /// Corners in the world: z up, as in the viewer.
    min: [f32; 3],
    max: [f32; 3],
}

/// The crop box of a run, if one was saved.
///
/// # Errors
/// When the file is malformed.
pub fn read_crop(run: &Path) -> Result<Option<Crop>> {
    let file = run.join("crop.json");
    if !file.exists() {
        return Ok(None);
    }
    let text = diorama_data::error::read(&file, 1 << 16)?;
    let wrong =
        |e: String| PipelineError::from(DataError::input(&file, format!("{e}; save the box in the viewer again or remove the file")));
    let c: CropFile = serde_json::from_slice(&text).map_err(|e| wrong(e.to_string()))?;
    if (0..3).any(|k| c.min[k] >= c.max[k] || !c.min[k].is_finite() || !c.max[k].is_finite()) {
        return Err(wrong("min: must lie below max".into()));
    }
    Ok(Some((c.min, c.max)))
}

/// A length that was measured in the viewer, as `scale.json` in the run folder keeps it.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ScaleFile {
    /// Two points in the capture's frame.
    points: [[f64; 3]; 2],
    metres: f64,
}

/// The size that was measured in the viewer, if one was saved.
///
/// # Errors
/// When the file is malformed.
pub fn read_scale(run: &Path) -> Result<Option<Size>> {
    let file = run.join("scale.json");
    if !file.exists() {
        return Ok(None);
    }
    let text = diorama_data::error::read(&file, 1 << 16)?;
    let wrong = |e: String| PipelineError::from(DataError::input(&file, format!("{e}; measure in the viewer again or remove the file")));
    let ScaleFile { points, metres } = serde_json::from_slice(&text).map_err(|e| wrong(e.to_string()))?;
    if points[0] == points[1] || points.iter().flatten().any(|v| !v.is_finite()) || !(metres > 0.0 && metres.is_finite()) {
        return Err(wrong("needs two points that differ and metres above 0".into()));
    }
    Ok(Some(Size::Measured { points, metres }))
}

/// A run that is looked at. While it trains, [`RunView::wants`] says when to [`RunView::show`] what has been learned.
pub struct RunView {
    folder: PathBuf,
    model: RwLock<Arc<ObjectModel>>,
    training: Mutex<Training>,
    shown: Mutex<Instant>,
    /// Whether anybody has looked since the model was last shown.
    looked: AtomicBool,
    saved: Mutex<Saved>,
    /// Held-out frames behind fog.
    behind_fog: Mutex<Vec<usize>>,
}

/// How far training is.
#[derive(Clone, Debug, Default)]
struct Training {
    step: u64,
    seconds: f64,
    progress: f64,
    is_running: bool,
    /// Last value of each of [`FIGURES`].
    figures: Vec<(&'static str, f64)>,
}

impl Training {
    /// Takes over the figures that a row of the log has.
    fn read(&mut self, row: &Row) {
        (self.step, self.seconds) = (row.step, row.seconds);
        self.figures = FIGURES.iter().filter_map(|(name, _)| Some((*name, row.get(name).or_else(|| self.figure(name))?))).collect();
    }

    fn figure(&self, name: &str) -> Option<f64> {
        self.figures.iter().find(|f| f.0 == name).map(|f| f.1)
    }

    fn status(&self) -> ViewStatus {
        let of = |(name, label): &(&str, &str)| {
            let value = self.figure(name)?;
            Some(ViewFigure { id: name.to_string(), label: label.to_string(), value, text: scalar::text(name, value) })
        };
        let (step, seconds, progress, running) = (self.step, self.seconds, self.progress, self.is_running);
        ViewStatus { step, seconds, progress, running, figures: FIGURES.iter().filter_map(of).collect() }
    }
}

/// What was saved in the viewer: in the world, as the page has it.
#[derive(Clone, Default)]
struct Saved {
    crop: Option<Crop>,
    measured: Option<MeasuredLength>,
    path: Option<String>,
}

impl Saved {
    fn read(run: &Path, world_from_capture: &Similarity) -> Result<Saved> {
        let measured = match read_scale(run)? {
            Some(Size::Measured { points, metres }) => {
                Some(MeasuredLength { points: points.map(|p| world_from_capture.point(DVec3::from_array(p)).to_array()), metres })
            }
            _ => None,
        };
        Ok(Saved { crop: read_crop(run)?, measured, path: read_path(run, world_from_capture)? })
    }
}

/// The camera path of a run with its cameras in the world, if one was saved.
///
/// # Errors
/// When the file is malformed.
fn read_path(run: &Path, world_from_capture: &Similarity) -> Result<Option<String>> {
    let file = run.join("camera_path.json");
    if !file.exists() {
        return Ok(None);
    }
    let wrong = |e: String| DataError::input(&file, format!("{e}; save the path in the viewer again or remove the file"));
    let bytes = diorama_data::error::read(&file, 1 << 26)?;
    let text = String::from_utf8(bytes).map_err(|_| wrong("is not UTF-8 text".into()))?;
    let path = camera_path_json::read(&file, world_from_capture).and_then(|_| camera_path_json::moved(&text, &file, world_from_capture));
    path.map(Some).map_err(|e| match e {
        DataError::Input { message, .. } => wrong(message).into(),
        e => e.into(),
    })
}

impl RunView {
    /// # Errors
    /// When what was saved in the viewer before cannot be read.
    pub fn new(folder: &Path, model: ObjectModel, running: bool) -> Result<Arc<RunView>> {
        let RunSummary { behind_fog: names, .. } = read_summary(folder)?.unwrap_or_default();
        let mut training = Training::default();
        if !running {
            read_rows(folder).iter().for_each(|row| training.read(row));
            training.figures.retain(|f| f.0 != "rays_per_s");
        }
        let Origin { step, seconds } = model.origin;
        let training = Training { step, seconds, is_running: running, ..training };
        let behind_fog = (0..model.capture.frames.len()).filter(|i| names.contains(&model.capture.frames[*i].name)).collect();
        Ok(Arc::new(RunView {
            saved: Mutex::new(Saved::read(folder, &model.capture.world_from_capture)?),
            behind_fog: Mutex::new(behind_fog),
            folder: folder.to_path_buf(),
            model: RwLock::new(Arc::new(model)),
            training: Mutex::new(training),
            shown: Mutex::new(Instant::now()),
            looked: AtomicBool::new(true),
        }))
    }

    /// # Errors
    /// When the device that the user named has failed.
    pub fn check_device(&self) -> Result<()> {
        self.model().check_device()
    }

    /// What was saved, to be changed.
    fn saved(&self) -> std::sync::MutexGuard<'_, Saved> {
        self.saved.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn model(&self) -> Arc<ObjectModel> {
        self.model.read().expect("no panic while the model is exchanged").clone()
    }

    /// Whether a newer model would be looked at.
    pub fn wants(&self) -> bool {
        self.looked.load(Ordering::Relaxed) && self.shown.lock().is_ok_and(|s| s.elapsed() >= REFRESH)
    }

    pub fn show(&self, model: ObjectModel) {
        *self.model.write().expect("no panic while the model is read") = Arc::new(model);
        if let Ok(mut s) = self.shown.lock() {
            *s = Instant::now();
        }
        self.looked.store(false, Ordering::Relaxed);
    }

    /// Takes note of what training tells.
    pub fn hear(&self, event: &Event) {
        let Ok(mut t) = self.training.lock() else { return };
        Row::of(event).iter().for_each(|row| t.read(row));
        match event {
            Event::Progress { progress, .. } => (t.progress, t.is_running) = (*progress, true),
            Event::Finished { step, .. } => (t.step, t.is_running) = (*step, false),
            _ => {}
        }
    }

    /// Marks the held-out views behind fog, of those that were judged just now, each named by its frame.
    pub fn show_fog(&self, judged: &[(usize, f64)]) {
        let training = self.training.lock().ok().and_then(|t| t.figure(PSNR));
        if let (Some(training), Ok(mut fog)) = (training, self.behind_fog.lock()) {
            *fog = held_out::far_below(judged, training);
        }
    }

    fn tell<T>(r: Result<T>) -> std::result::Result<T, String> {
        r.map_err(|e| e.to_string())
    }
}

/// The pictures that [`render::picture`] draws, by the names that [`Layer`] is read from.
fn layers() -> Vec<ViewLayer> {
    let dark_to_light = [[0; 3], [255; 3]];
    vec![
        ViewLayer::new("rgb", "Color"),
        ViewLayer::new("depth", "Depth").with_scale(&[[255; 3], [26; 3]], "near", "far", ""),
        ViewLayer::new("normal", "Normals").with_classes(&[("x", [255, 128, 128]), ("y", [128, 255, 128]), ("z", [128, 128, 255])]),
        ViewLayer::new("opacity", "Opacity").with_scale(&dark_to_light, "0", "1", ""),
        ViewLayer::new("occupancy", "Occupancy").with_scale(&dark_to_light, "empty", "most cells", ""),
    ]
}

impl ViewSource for RunView {
    fn scene(&self) -> ViewScene {
        let m = self.model();
        let frames: Vec<ViewFrame> = m.capture.frames.iter().map(ViewFrame::from).collect();
        let poses: Vec<_> = frames.iter().map(|f| f.world_from_camera).collect();
        let (focus, distance) = focus_point(&poses);
        let s = m.capture.scene;
        let corner = |sign: f64| (s.center + DVec3::splat(sign * s.half * s.aabb_scale as f64)).to_array();
        let Saved { crop, measured, path } = self.saved().clone();
        ViewScene {
            name: self.folder.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            frames,
            layers: layers(),
            controls: Vec::new(),
            note: String::new(),
            is_run: true,
            focus: focus.to_array(),
            distance,
            world_from_capture: m.capture.world_from_capture,
            bounds: (corner(-1.0), corner(1.0)),
            crop,
            measured,
            path,
        }
    }

    fn status(&self) -> ViewStatus {
        self.training.lock().map(|t| t.status()).unwrap_or_default()
    }

    fn charts(&self) -> Vec<ViewChart> {
        let rows = read_rows(&self.folder);
        let line = |(figure, label): (&str, &str)| {
            let (figure, points) = (figure.to_string(), curve(&rows, figure));
            ViewLine { held_out: figure == HELD_OUT_PSNR, figure, label: label.into(), points }
        };
        let lines = [(PSNR, "training"), (HELD_OUT_PSNR, "held out")].map(line).into();
        vec![ViewChart { label: "PSNR".into(), unit: "dB".into(), lines }]
    }

    fn behind_fog(&self) -> Vec<usize> {
        self.behind_fog.lock().map(|f| f.clone()).unwrap_or_default()
    }

    fn view(&self, r: &ViewRequest) -> std::result::Result<ImageU8, String> {
        self.looked.store(true, Ordering::Relaxed);
        let m = self.model();
        let posed = m.to_model(r.camera, &r.world_from_camera);
        let layer = r.layer.parse::<Layer>()?;
        let picture = render::picture(&m, &posed, layer, r.clip, Quality::Fast);
        Self::tell(m.check_device().map(|()| picture))
    }

    fn point(&self, r: &ViewRequest, x_px: f64, y_px: f64) -> Option<[f64; 3]> {
        let m = self.model();
        // A picture of that one pixel.
        let one = Camera { width: 1, height: 1, cx: r.camera.cx - x_px + 0.5, cy: r.camera.cy - y_px + 0.5, ..r.camera };
        let posed = m.to_model(one, &r.world_from_camera);
        let distance = render::depth_of_pixel(&m, &posed, r.clip)?;
        let along = posed.camera.direction(0.5, 0.5);
        Some(m.model_from_world.inverse().point(posed.pose.point(along * distance as f64)).to_array())
    }

    fn save_measured(&self, measured: Option<MeasuredLength>) -> std::result::Result<(), String> {
        let file = self.folder.join("scale.json");
        match measured {
            Some(MeasuredLength { points, metres }) => {
                let capture_from_world = self.model().capture.world_from_capture.inverse();
                let points = points.map(|p| capture_from_world.point(DVec3::from_array(p)).to_array());
                let json = serde_json::to_vec(&ScaleFile { points, metres }).expect("plain values");
                Self::tell(atomic::write(&file, &json).map_err(PipelineError::from))?;
            }
            None if file.exists() => std::fs::remove_file(&file).map_err(|e| e.to_string())?,
            None => {}
        }
        self.saved().measured = measured;
        Ok(())
    }

    fn thumbnail(&self, frame: usize) -> std::result::Result<ImageU8, String> {
        let m = self.model();
        let f = m.capture.frames.get(frame).ok_or_else(|| format!("there is no photograph {frame}"))?;
        photo::load_small(&f.image, THUMBNAIL).map_err(|e| e.to_string())
    }

    fn save_crop(&self, crop: Option<Crop>) -> std::result::Result<(), String> {
        let file = self.folder.join("crop.json");
        match crop {
            Some((min, max)) => {
                let json = serde_json::to_vec(&CropFile { min, max }).expect("plain values");
                Self::tell(atomic::write(&file, &json).map_err(PipelineError::from))?;
            }
            None if file.exists() => std::fs::remove_file(&file).map_err(|e| e.to_string())?,
            None => {}
        }
        self.saved().crop = crop;
        Ok(())
    }

    fn save_path(&self, json: &str) -> std::result::Result<PathBuf, String> {
        let file = self.folder.join("camera_path.json");
        let capture_from_world = self.model().capture.world_from_capture.inverse();
        let moved = camera_path_json::moved(json, &file, &capture_from_world).map_err(|e| e.to_string())?;
        atomic::write(&file, moved.as_bytes()).map_err(|e| e.to_string())?;
        self.saved().path = Some(json.to_string());
        Ok(file)
    }

    fn open_path(&self, json: &str) -> std::result::Result<String, String> {
        let file = self.folder.join("camera_path.json");
        camera_path_json::moved(json, &file, &self.model().capture.world_from_capture).map_err(|e| e.to_string())
    }

    fn export(&self, r: &MeshRequest, progress: &mut dyn FnMut(&str, usize, usize)) -> std::result::Result<(PathBuf, f64), String> {
        let format = r.format.parse::<export::Format>()?;
        let out = self.folder.join(format!("mesh.{}", r.format.to_ascii_lowercase()));
        let options = ExportOptions {
            format,
            out: out.clone(),
            method: Default::default(),
            resolution: r.resolution,
            level: None,
            faces: Some(r.faces),
            texture: None,
            normal_map: false,
            watertight: false,
            size: Self::tell(read_scale(&self.folder))?.unwrap_or(Size::Unknown),
            unit_m: 1.0,
            clip: r.clip,
            floaters: 0.01,
            keep_unseen: false,
        };
        let made = Self::tell(export::export(&self.model(), &options, &mut |_| {}, progress))?;
        Ok((out, made.scale))
    }
}
