//! Runs in the viewer: colors, classes and depth from any camera, with the outlines and poses of the regions, and other writing on them.

use super::edit::Edit;
use super::edit::replacement::Overlay;
use super::field::model::TextModel;
use super::field::scores::class_color;
use super::label::in_view::{self, OnSurface};
use super::placed::{self, PlacedRegion};
use crate::error::{PipelineError, Result};
use crate::run::viewing::{RunView as AnyRunView, ViewedModel};
use diorama_data::plot;
use diorama_engine::renderers::view::View;
use diorama_engine::renderers::volume::Quality;
use diorama_engine::train::Origin;
use diorama_geom::glam::DVec3;
use diorama_geom::view_controls::{ControlInput, ViewControl, ViewLayer};
use diorama_geom::view_source::{MeshRequest, ViewRequest};
use diorama_geom::{Capture, ImageU8};
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::SystemTime;

/// A run in the viewer.
pub type RunView = AnyRunView<ViewedText>;

/// Option of a region's writing that was filmed.
const FILMED: &str = "filmed";
/// Width of lines in pixels, and length of the axes of a pose over the height of its region.
const LINE: f64 = 1.5;
const AXES: f64 = 0.6;
/// Points of each side of an outline.
const SIDE: usize = 8;
/// Colors of axes along the reading direction, up, and toward the reader.
const AXIS_COLORS: [[u8; 3]; 3] = [[235, 60, 60], [60, 200, 80], [70, 120, 245]];
/// Opacity from which a pixel has a depth, and share of a class's color in its layer.
const SURFACE: f32 = 0.5;
const TINT: f32 = 0.7;

/// A model with its regions.
pub struct ViewedText {
    model: TextModel,
    run: PathBuf,
    /// None before `diorama text label`.
    regions: Vec<PlacedRegion>,
    /// Edits that were shown, by name, with the time of their files.
    overlays: Mutex<BTreeMap<String, (SystemTime, Arc<Overlay>)>>,
}

/// Opens the view of a trained run.
///
/// # Errors
/// When its regions or what was saved in the viewer before cannot be read.
pub fn open(run: &Path, model: TextModel) -> Result<Arc<RunView>> {
    let regions = if run.join(placed::REGIONS).exists() { placed::read(run)? } else { Vec::new() };
    RunView::new(run, ViewedText { model, run: run.to_path_buf(), regions, overlays: Mutex::default() }, false)
}

impl ViewedText {
    fn posed(&self, r: &ViewRequest) -> PosedCamera {
        PosedCamera { camera: r.camera, pose: self.model.model_from_world.pose(&r.world_from_camera) }
    }

    /// Edits of a region, as options: their names and what they say; those that cannot be read say so, at every region.
    fn writing(&self, region: u32) -> Vec<(String, String)> {
        let names = match Edit::names(&self.run) {
            Ok(names) => names,
            Err(e) => return vec![("unreadable".into(), e.to_string())],
        };
        let option = |name: String| match Edit::head(&self.run, &name) {
            Ok(e) if e.region != region => None,
            Ok(e) if e.text.is_empty() => Some((name, "(erased)".to_string())),
            Ok(e) => Some((name, e.text)),
            Err(e) => Some((name, e.to_string())),
        };
        names.into_iter().filter_map(option).collect()
    }

    /// An edit, read when it is first shown and when it was made anew.
    fn overlay(&self, name: &str, region: &PlacedRegion) -> Result<Option<Arc<Overlay>>> {
        let time = Edit::time(&self.run, name)?;
        let mut known = self.overlays.lock().expect("no other thread fails with it");
        if known.get(name).is_none_or(|k| k.0 != time)
            && let Some(overlay) = Overlay::new(Edit::read(&self.run, name)?, region)
        {
            known.insert(name.to_string(), (time, Arc::new(overlay)));
        }
        Ok(known.get(name).map(|k| k.1.clone()))
    }

    /// The view with the chosen writing.
    fn draw(&self, r: &ViewRequest) -> Result<View> {
        let m = &self.model;
        let mut tracer = m.tracer(Quality::Fast);
        let corner = |c: [f32; 3]| m.model_from_world.point(DVec3::from(c.map(f64::from))).as_vec3().to_array();
        tracer.clip = r.clip.map(|(low, high)| (corner(low), corner(high)));
        let mut view = tracer.view(&self.posed(r), &mut |_| {});
        for region in self.regions.iter().filter(|region| region.rectangle.is_some()) {
            let choice = r.values.choice(&control_of(region));
            if choice != FILMED
                && let Some(overlay) = self.overlay(choice, region)?
            {
                overlay.put(m, &r.camera, &r.world_from_camera, &mut view);
            }
        }
        Ok(view)
    }

    /// Draws outlines of the regions, brighter where a view shows them, and axes of their poses.
    fn outline(&self, r: &ViewRequest, picture: &mut ImageU8) {
        let (camera, pose) = (&r.camera, &r.world_from_camera);
        let camera_from_world = pose.inverse();
        let at = |p: DVec3| {
            let q = camera_from_world.point(p);
            (q.z > 0.0).then(|| camera.project(q)).flatten().map(|p| (p.x, p.y))
        };
        for (k, region) in self.regions.iter().enumerate() {
            let Some(word) = OnSurface::of(region) else { continue };
            let [low, high] = word.bounds;
            let corners = [low, low.with_x(high.x), high, high.with_x(low.x)];
            let sides = (0..4 * SIDE).map(|i| corners[i / SIDE].lerp(corners[(i / SIDE + 1) % 4], (i % SIDE) as f64 / SIDE as f64));
            let points: Vec<_> = sides.map(|p| at(word.rectangle.reading_point(p))).collect();
            let is_seen = in_view::labelled(&self.model, &word, camera, pose).is_some();
            let color = class_color(k as u8 + 1).map(|v| if is_seen { v } else { v / 3 });
            for (i, from) in points.iter().enumerate() {
                if let (Some(from), Some(to)) = (*from, points[(i + 1) % points.len()]) {
                    plot::line(picture, from, to, LINE, color);
                }
            }
            let (middle, frame) = (word.rectangle.reading_point(0.5 * (low + high)), word.rectangle.reading_frame(0.5 * (low + high)));
            let length = AXES * (high.y - low.y);
            for (axis, color) in [frame.x_axis, frame.y_axis, frame.z_axis].into_iter().zip(AXIS_COLORS) {
                if let (true, Some(from), Some(to)) = (is_seen, at(middle), at(middle + axis * length)) {
                    plot::line(picture, from, to, LINE, color);
                }
            }
        }
    }
}

/// Control of a region's writing.
fn control_of(region: &PlacedRegion) -> String {
    format!("writing_{}", region.id)
}

impl ViewedModel for ViewedText {
    const FIGURES: &'static [(&'static str, &'static str)] = &[("loss", "Loss"), ("psnr", "PSNR"), ("cross_entropy", "Cross entropy")];
    const CHARTS: &'static [(&'static str, &'static str)] = &[("psnr", "PSNR")];

    fn capture(&self) -> &Capture {
        &self.model.capture
    }

    fn origin(&self) -> Origin {
        self.model.origin
    }

    fn layers(&self) -> Vec<ViewLayer> {
        let mut out = vec![ViewLayer::new("rgb", "Color")];
        if self.model.classes.is_some() {
            let classes: Vec<(&str, [u8; 3])> =
                self.model.labels.classes.iter().enumerate().map(|(k, c)| (&c.transcription[..], class_color(k as u8 + 1))).collect();
            out.push(ViewLayer::new("classes", "Regions").with_classes(&classes));
        }
        out.push(ViewLayer::new("depth", "Depth").with_scale(&[[255; 3], [26; 3]], "near", "far", ""));
        out
    }

    fn controls(&self) -> Vec<ViewControl> {
        let placed = || self.regions.iter().filter(|r| r.rectangle.is_some());
        let mut out = Vec::new();
        if placed().next().is_some() {
            out.push(ViewControl {
                id: "outlines".into(),
                label: "Outlines and poses".into(),
                help:
                    "Quadrilaterals of the regions in space; axes along the reading direction (red), up (green), toward the reader (blue)"
                        .into(),
                layers: Vec::new(),
                input: ControlInput::Toggle { default: true },
            });
        }
        out.extend(placed().map(|region| {
            let filmed = (FILMED.to_string(), format!("{} (filmed)", region.transcription));
            let options = std::iter::once(filmed).chain(self.writing(region.id)).collect();
            ViewControl {
                id: control_of(region),
                label: format!("Writing of {:?}", region.transcription),
                help: "Edits that diorama text edit has made; open the page again after new ones".into(),
                layers: vec!["rgb".into()],
                input: ControlInput::Pick { options, default: FILMED.into() },
            }
        }));
        out
    }

    fn view(&self, r: &ViewRequest) -> Result<ImageU8> {
        let mut view = self.draw(r)?;
        match &r.layer[..] {
            "rgb" => {}
            "classes" => {
                let shares = self.model.shares(&self.posed(r), &mut |_| ()).unwrap_or_default();
                let count = self.model.labels.count();
                for (pixel, shares) in view.rgb.data.chunks_exact_mut(3).zip(shares.chunks_exact(count)) {
                    let tint = |k: usize| (1..count).map(|c| shares[c] * class_color(c as u8)[k] as f32 / 255.0).sum::<f32>();
                    let text = TINT * (1.0 - shares[0]).clamp(0.0, 1.0);
                    (0..3).for_each(|k| pixel[k] = (1.0 - text) * pixel[k] + TINT * tint(k));
                }
            }
            "depth" => {
                let opaque = || view.opacity.data.iter().zip(&view.depth.data).filter(|(o, _)| **o > SURFACE).map(|(_, d)| *d);
                let (near, far) = opaque().fold((f32::INFINITY, 0.0f32), |(a, b), d| (a.min(d), b.max(d)));
                let shade = |(o, d): (&f32, &f32)| if *o > SURFACE { 1.0 - 0.9 * (d - near) / (far - near).max(1e-6) } else { 0.0 };
                let shades: Vec<f32> = view.opacity.data.iter().zip(&view.depth.data).map(shade).collect();
                view.rgb.data.chunks_exact_mut(3).zip(shades).for_each(|(p, s)| p.fill(s));
            }
            other => return Err(PipelineError::Usage(format!("layer {other:?}: expected rgb, classes or depth"))),
        }
        let mut picture = view.rgb.to_u8();
        if self.regions.iter().any(|region| region.rectangle.is_some()) && r.values.switch("outlines") {
            self.outline(r, &mut picture);
        }
        Ok(picture)
    }

    fn point(&self, one_pixel: &ViewRequest) -> Option<[f64; 3]> {
        let posed = self.posed(one_pixel);
        let view = self.model.surface_view(&posed);
        let along = posed.camera.direction(0.5, 0.5).normalize() * view.depth.data[0] as f64;
        (view.opacity.data[0] > SURFACE).then(|| self.model.model_from_world.inverse().point(posed.pose.point(along)).to_array())
    }

    fn export(&self, run: &Path, _: &MeshRequest, _: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64)> {
        let what = format!("{}: a run of text makes no meshes; train the capture with `diorama train`", run.display());
        Err(PipelineError::Usage(what))
    }
}
