//! Source of the viewer for runs of any application, finished or in training.

use super::metrics::{Row, curve, read_rows};
use super::viewer_files::{self, Crop, Saved};
use crate::error::Result;
use diorama_data::photo;
use diorama_engine::train::scalar::{self, SCORE_PREFIX};
use diorama_engine::train::{Event, Origin};
use diorama_geom::capture::focus_point;
use diorama_geom::glam::DVec3;
use diorama_geom::view_controls::{ViewControl, ViewLayer};
use diorama_geom::view_source::{MeasuredLength, MeshRequest, ViewChart, ViewFigure, ViewFrame, ViewLine};
use diorama_geom::view_source::{ViewRequest, ViewScene, ViewSource, ViewStatus};
use diorama_geom::{Camera, Capture, ImageU8};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::{Duration, Instant};

/// Longest side of a small photograph.
pub const THUMBNAIL: usize = 160;
/// Least time between updates of a run in training.
const REFRESH: Duration = Duration::from_secs(2);

/// Interface of an application's model to the viewer; [`RunView`] does the rest.
pub trait ViewedModel: Send + Sync + 'static {
    /// Figures that are shown, by their names in the log, and what they are called on the page.
    const FIGURES: &'static [(&'static str, &'static str)];
    /// Those of them that have a chart over the steps, in which their scores on held-out data stand beside them.
    const CHARTS: &'static [(&'static str, &'static str)];

    /// Photographs and cameras.
    fn capture(&self) -> &Capture;

    /// Step and seconds of training.
    fn origin(&self) -> Origin;

    /// Pictures that can be drawn of a view; the first is shown first.
    fn layers(&self) -> Vec<ViewLayer>;

    /// Settings of these pictures.
    fn controls(&self) -> Vec<ViewControl> {
        Vec::new()
    }

    /// Draws a layer of a view as `[H, W, 3]` sRGB.
    ///
    /// # Errors
    /// When the device that the user named has failed.
    fn view(&self, request: &ViewRequest) -> Result<ImageU8>;

    /// The place in the world that the only pixel of a view shows; none where nothing is.
    fn point(&self, one_pixel: &ViewRequest) -> Option<[f64; 3]>;

    /// Makes a mesh in the run's folder; the file, and its metres per unit of the capture.
    ///
    /// # Errors
    /// When the application makes none, or it cannot be made or written.
    fn export(&self, run: &Path, request: &MeshRequest, progress: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64)>;
}

/// A run in the viewer. While it trains, [`RunView::wants_update`] says when to [`RunView::show`] what has been learned.
pub struct RunView<M> {
    folder: PathBuf,
    model: RwLock<Arc<M>>,
    training: Mutex<Training>,
    shown: Mutex<Instant>,
    /// Whether a view was asked for since the model was last shown.
    has_viewer: AtomicBool,
    saved: Mutex<Saved>,
    behind_fog: Mutex<Vec<usize>>,
}

/// Progress and figures of training.
#[derive(Clone, Debug, Default)]
struct Training {
    step: u64,
    seconds: f64,
    progress: f64,
    is_running: bool,
    /// Last value of each figure that is shown.
    figures: Vec<(&'static str, f64)>,
}

impl Training {
    /// Takes over the figures of `shown` that a row of the log has.
    fn read(&mut self, shown: &'static [(&str, &str)], row: &Row) {
        (self.step, self.seconds) = (row.step, row.seconds);
        self.figures = shown.iter().filter_map(|(name, _)| Some((*name, row.get(name).or_else(|| self.figure(name))?))).collect();
    }

    fn figure(&self, name: &str) -> Option<f64> {
        self.figures.iter().find(|f| f.0 == name).map(|f| f.1)
    }

    fn status(&self, shown: &[(&str, &str)]) -> ViewStatus {
        let of = |(name, label): &(&str, &str)| {
            let value = self.figure(name)?;
            Some(ViewFigure { id: name.to_string(), label: label.to_string(), value, text: scalar::text(name, value) })
        };
        let (step, seconds, progress, running) = (self.step, self.seconds, self.progress, self.is_running);
        ViewStatus { step, seconds, progress, running, figures: shown.iter().filter_map(of).collect() }
    }
}

impl<M: ViewedModel> RunView<M> {
    /// A run whose model is `model`; `running` says whether it trains.
    ///
    /// # Errors
    /// When what was saved in the viewer before cannot be read.
    pub fn new(folder: &Path, model: M, running: bool) -> Result<Arc<Self>> {
        let mut training = Training::default();
        if !running {
            read_rows(folder).iter().for_each(|row| training.read(M::FIGURES, row));
            // Nothing is being done per second.
            training.figures.retain(|(name, _)| scalar::unit(name) != "/s");
        }
        let Origin { step, seconds } = model.origin();
        Ok(Arc::new(RunView {
            saved: Mutex::new(Saved::read(folder, &model.capture().world_from_capture)?),
            behind_fog: Mutex::default(),
            folder: folder.to_path_buf(),
            model: RwLock::new(Arc::new(model)),
            training: Mutex::new(Training { step, seconds, is_running: running, ..training }),
            shown: Mutex::new(Instant::now()),
            has_viewer: AtomicBool::new(true),
        }))
    }

    /// The model that is shown.
    pub fn model(&self) -> Arc<M> {
        self.model.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Whether somebody looked since the model was last shown, and that was long enough ago.
    pub fn wants_update(&self) -> bool {
        self.has_viewer.load(Ordering::Relaxed) && lock(&self.shown).elapsed() >= REFRESH
    }

    /// Shows a newer model.
    pub fn show(&self, model: M) {
        *self.model.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(model);
        *lock(&self.shown) = Instant::now();
        self.has_viewer.store(false, Ordering::Relaxed);
    }

    /// Takes over the figures of an event of training.
    pub fn update(&self, event: &Event) {
        let mut t = lock(&self.training);
        Row::of(event).iter().for_each(|row| t.read(M::FIGURES, row));
        match event {
            Event::Progress { progress, .. } => (t.progress, t.is_running) = (*progress, true),
            Event::Finished { step, .. } => (t.step, t.is_running) = (*step, false),
            _ => {}
        }
    }

    /// The last value of one of the figures that are shown.
    pub fn figure(&self, name: &str) -> Option<f64> {
        lock(&self.training).figure(name)
    }

    /// Marks frames as behind fog, and no others.
    pub fn mark_behind_fog(&self, frames: Vec<usize>) {
        *lock(&self.behind_fog) = frames;
    }
}

fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

fn in_words<T>(r: Result<T>) -> std::result::Result<T, String> {
    r.map_err(|e| e.to_string())
}

impl<M: ViewedModel> ViewSource for RunView<M> {
    fn scene(&self) -> ViewScene {
        let m = self.model();
        let capture = m.capture();
        let frames: Vec<ViewFrame> = capture.frames.iter().map(ViewFrame::from).collect();
        let poses: Vec<_> = frames.iter().map(|f| f.world_from_camera).collect();
        let (focus, distance) = focus_point(&poses);
        let s = capture.scene;
        let corner = |sign: f64| (s.center + DVec3::splat(sign * s.half * s.aabb_scale as f64)).to_array();
        let Saved { crop, measured, path } = lock(&self.saved).clone();
        ViewScene {
            name: self.folder.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            frames,
            layers: m.layers(),
            controls: m.controls(),
            note: String::new(),
            is_run: true,
            focus: focus.to_array(),
            distance,
            world_from_capture: capture.world_from_capture,
            bounds: (corner(-1.0), corner(1.0)),
            crop,
            measured,
            path,
        }
    }

    fn status(&self) -> ViewStatus {
        lock(&self.training).status(M::FIGURES)
    }

    fn charts(&self) -> Vec<ViewChart> {
        let rows = read_rows(&self.folder);
        let chart = |(name, label): &(&str, &str)| {
            let line = |figure: String, label: &str, held_out| {
                let points = curve(&rows, &figure);
                ViewLine { figure, label: label.into(), held_out, points }
            };
            let lines = vec![line(name.to_string(), "training", false), line(format!("{SCORE_PREFIX}{name}"), "held out", true)];
            ViewChart { label: label.to_string(), unit: scalar::unit(name).into(), lines }
        };
        M::CHARTS.iter().map(chart).collect()
    }

    fn behind_fog(&self) -> Vec<usize> {
        lock(&self.behind_fog).clone()
    }

    fn view(&self, r: &ViewRequest) -> std::result::Result<ImageU8, String> {
        self.has_viewer.store(true, Ordering::Relaxed);
        in_words(self.model().view(r))
    }

    fn point(&self, r: &ViewRequest, x_px: f64, y_px: f64) -> Option<[f64; 3]> {
        // A picture of that one pixel.
        let camera = Camera { width: 1, height: 1, cx: r.camera.cx - x_px + 0.5, cy: r.camera.cy - y_px + 0.5, ..r.camera };
        self.model().point(&ViewRequest { camera, ..r.clone() })
    }

    fn thumbnail(&self, frame: usize) -> std::result::Result<ImageU8, String> {
        let m = self.model();
        let f = m.capture().frames.get(frame).ok_or_else(|| format!("there is no photograph {frame}"))?;
        photo::load_small(&f.image, THUMBNAIL).map_err(|e| e.to_string())
    }

    fn save_crop(&self, crop: Option<Crop>) -> std::result::Result<(), String> {
        in_words(viewer_files::save_crop(&self.folder, crop))?;
        lock(&self.saved).crop = crop;
        Ok(())
    }

    fn save_measured(&self, measured: Option<MeasuredLength>) -> std::result::Result<(), String> {
        in_words(viewer_files::save_measured(&self.folder, measured, &self.model().capture().world_from_capture))?;
        lock(&self.saved).measured = measured;
        Ok(())
    }

    fn save_path(&self, json: &str) -> std::result::Result<PathBuf, String> {
        let file = in_words(viewer_files::save_path(&self.folder, json, &self.model().capture().world_from_capture))?;
        lock(&self.saved).path = Some(json.to_string());
        Ok(file)
    }

    fn open_path(&self, json: &str) -> std::result::Result<String, String> {
        in_words(viewer_files::path_in_world(&self.folder, json, &self.model().capture().world_from_capture))
    }

    fn export(&self, r: &MeshRequest, progress: &mut dyn FnMut(&str, usize, usize)) -> std::result::Result<(PathBuf, f64), String> {
        in_words(self.model().export(&self.folder, r, progress))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_engine::train::{Scalar, Scalars, Scores};
    use diorama_geom::Similarity;
    use diorama_geom::capture::SceneBox;

    /// A model of an application that does not exist: it learns to read.
    struct Reader(Capture);

    impl ViewedModel for Reader {
        const FIGURES: &'static [(&'static str, &'static str)] =
            &[("accuracy", "Accuracy"), ("val_accuracy", "Held out"), ("words_per_s", "Words")];
        const CHARTS: &'static [(&'static str, &'static str)] = &[("accuracy", "Accuracy")];

        fn capture(&self) -> &Capture {
            &self.0
        }
        fn origin(&self) -> Origin {
            Origin { step: 7, seconds: 3.0 }
        }
        fn layers(&self) -> Vec<ViewLayer> {
            vec![ViewLayer::new("letters", "Letters")]
        }
        fn view(&self, _: &ViewRequest) -> Result<ImageU8> {
            Err(crate::PipelineError::Device("unplugged".into()))
        }
        fn point(&self, r: &ViewRequest) -> Option<[f64; 3]> {
            Some(r.camera.direction(0.5, 0.5).to_array())
        }
        fn export(&self, run: &Path, r: &MeshRequest, _: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64)> {
            Ok((run.join(format!("letters.{}", r.format)), 2.0))
        }
    }

    fn reader() -> Reader {
        Reader(Capture::new(Vec::new(), SceneBox { center: DVec3::ZERO, half: 1.0, aabb_scale: 2 }))
    }

    #[test]
    fn figures_that_only_one_application_has_are_shown() {
        let dir = tempfile::tempdir().unwrap();
        let view = RunView::new(dir.path(), reader(), true).unwrap();
        assert!(view.status().figures.is_empty() && view.status().running);
        let scalars = || Scalars::from([Scalar::new("accuracy", 0.5), Scalar::rate("words_per_s", 90.0), Scalar::new("hidden", 1.0)]);
        let events = [
            Event::Progress { step: 8, seconds: 4.0, progress: 0.25, loss: 1.0, scalars: scalars() },
            Event::Evaluated { step: 8, seconds: 4.0, scores: Scores::from([Scalar::new("accuracy", 0.25)]) },
        ];
        events.iter().for_each(|e| view.update(e));
        let shown = |s: ViewStatus| s.figures.into_iter().map(|f| (f.label, f.text)).collect::<Vec<_>>();
        let status = view.status();
        assert_eq!((status.step, status.progress), (8, 0.25));
        let wanted = [("Accuracy", "0.5000"), ("Held out", "0.2500"), ("Words", "90.00/s")].map(|(l, t)| (l.to_string(), t.to_string()));
        assert_eq!(shown(status), wanted);
        // A finished run has them from its log, and does nothing per second.
        let log: String = events.iter().map(|e| Row::of(e).unwrap().line()).collect();
        std::fs::write(dir.path().join(super::super::metrics::NAME), log).unwrap();
        let finished = RunView::new(dir.path(), reader(), false).unwrap();
        assert_eq!((shown(finished.status()), finished.status().step), (wanted[..2].to_vec(), 7));
        let chart = finished.charts().remove(0);
        let lines: Vec<_> = chart.lines.iter().map(|l| (&l.figure[..], l.held_out, l.points.clone())).collect();
        assert_eq!(lines, [("accuracy", false, vec![(8, 0.5)]), ("val_accuracy", true, vec![(8, 0.25)])]);
    }

    #[test]
    fn a_newer_model_is_wanted_when_somebody_looks() {
        let dir = tempfile::tempdir().unwrap();
        let view = RunView::new(dir.path(), reader(), true).unwrap();
        *lock(&view.shown) -= REFRESH;
        assert!(view.wants_update());
        view.show(reader());
        *lock(&view.shown) -= REFRESH;
        assert!(!view.wants_update(), "nobody asked for a view of the last one");
        let s = view.scene();
        let camera = Camera::pinhole(8, 6, 0.8);
        let values = diorama_geom::view_controls::ControlValues::default();
        let world_from_camera = diorama_geom::Pose::look_at(DVec3::X, DVec3::ZERO, DVec3::Z);
        let request = ViewRequest { camera, world_from_camera, layer: s.layers[0].id.clone(), values, clip: None };
        assert!(ViewSource::view(&*view, &request).unwrap_err().contains("unplugged"));
        assert!(view.wants_update());
        let seen = ViewSource::point(&*view, &request, 6.5, 1.5).unwrap();
        let along = camera.direction(6.5, 1.5).to_array();
        assert!(seen.iter().zip(along).all(|(a, b)| (a - b).abs() < 1e-12), "{seen:?} {along:?}");
        assert_eq!(s.world_from_capture, Similarity::IDENTITY);
    }
}
