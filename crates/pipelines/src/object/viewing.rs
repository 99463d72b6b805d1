//! The object application's part of viewing: its pictures, its points and its meshes. The rest is [`crate::run::viewing`]'s.

use super::export::{self, ExportOptions, Size};
use super::held_out;
use super::model::ObjectModel;
use super::render::{self, Layer};
use super::run_folder::{RunSummary, read_summary};
use crate::error::{PipelineError, Result};
use crate::run::viewer_files;
use crate::run::viewing::{RunView as AnyRunView, ViewedModel};
use diorama_engine::renderers::volume::Quality;
use diorama_engine::train::Origin;
use diorama_geom::view_controls::ViewLayer;
use diorama_geom::view_source::{MeasuredLength, MeshRequest, ViewRequest};
use diorama_geom::{Capture, ImageU8};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A run of this application in the viewer.
pub type RunView = AnyRunView<ObjectModel>;

/// Figure that views behind fog are compared with.
const PSNR: &str = "psnr";

/// Opens the view of a run; `running` says whether it trains.
///
/// # Errors
/// When what was saved in the viewer before, or the run's summary, cannot be read.
pub fn open(run: &Path, model: ObjectModel, running: bool) -> Result<Arc<RunView>> {
    let RunSummary { behind_fog, .. } = read_summary(run)?.unwrap_or_default();
    let frames = &model.capture.frames;
    let foggy = (0..frames.len()).filter(|i| behind_fog.contains(&frames[*i].name)).collect();
    let view = RunView::new(run, model, running)?;
    view.mark_behind_fog(foggy);
    Ok(view)
}

/// The size that was measured in the viewer for a run, if one was saved.
///
/// # Errors
/// When the file is malformed.
pub fn read_scale(run: &Path) -> Result<Option<Size>> {
    let size = |MeasuredLength { points, metres }| Size::Measured { points, metres };
    Ok(viewer_files::read_scale(run)?.map(size))
}

impl RunView {
    /// # Errors
    /// When the device that the user named has failed.
    pub fn check_device(&self) -> Result<()> {
        self.model().check_device()
    }

    /// Marks the held-out views behind fog, of those that were judged just now, each named by its frame.
    pub fn mark_fog(&self, judged: &[(usize, f64)]) {
        if let Some(training) = self.figure(PSNR) {
            self.mark_behind_fog(held_out::far_below(judged, training));
        }
    }
}

impl ViewedModel for ObjectModel {
    const FIGURES: &'static [(&'static str, &'static str)] =
        &[("loss", "Loss"), (PSNR, "PSNR"), ("val_psnr", "Held out"), ("rays_per_s", "Rays")];
    const CHARTS: &'static [(&'static str, &'static str)] = &[(PSNR, "PSNR")];

    fn capture(&self) -> &Capture {
        &self.capture
    }

    fn origin(&self) -> Origin {
        self.origin
    }

    /// The pictures that [`render::picture`] draws, by the names that [`Layer`] is read from.
    fn layers(&self) -> Vec<ViewLayer> {
        let dark_to_light = [[0; 3], [255; 3]];
        vec![
            ViewLayer::new("rgb", "Color"),
            ViewLayer::new("depth", "Depth").with_scale(&[[255; 3], [26; 3]], "near", "far", ""),
            ViewLayer::new("normal", "Normals").with_classes(&[("x", [255, 128, 128]), ("y", [128, 255, 128]), ("z", [128, 128, 255])]),
            ViewLayer::new("opacity", "Opacity").with_scale(&dark_to_light, "0", "1", ""),
            ViewLayer::new("occupancy", "Occupancy").with_scale(&dark_to_light, "empty", "most cells", ""),
        ]
    }

    fn view(&self, r: &ViewRequest) -> Result<ImageU8> {
        let posed = self.to_model(r.camera, &r.world_from_camera);
        let layer = r.layer.parse::<Layer>().map_err(PipelineError::Usage)?;
        let picture = render::picture(self, &posed, layer, r.clip, Quality::Fast);
        self.check_device().map(|()| picture)
    }

    fn point(&self, one_pixel: &ViewRequest) -> Option<[f64; 3]> {
        let posed = self.to_model(one_pixel.camera, &one_pixel.world_from_camera);
        let distance = render::depth_of_pixel(self, &posed, one_pixel.clip)?;
        let along = posed.camera.direction(0.5, 0.5);
        Some(self.model_from_world.inverse().point(posed.pose.point(along * distance as f64)).to_array())
    }

    fn export(&self, run: &Path, r: &MeshRequest, progress: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64)> {
        let out = run.join(format!("mesh.{}", r.format.to_ascii_lowercase()));
        let options = ExportOptions {
            format: r.format.parse::<export::Format>().map_err(PipelineError::Usage)?,
            out: out.clone(),
            method: Default::default(),
            resolution: r.resolution,
            level: None,
            faces: Some(r.faces),
            texture: None,
            normal_map: false,
            watertight: false,
            size: read_scale(run)?.unwrap_or(Size::Unknown),
            unit_m: 1.0,
            clip: r.clip,
            floaters: 0.01,
            keep_unseen: false,
        };
        let made = export::export(self, &options, &mut |_| {}, progress)?;
        Ok((out, made.scale))
    }
}
