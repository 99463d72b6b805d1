//! Source of the viewer for data sets and for files of points or Gaussian splats, of which there is no field yet.

use super::viewing::THUMBNAIL;
use crate::error::Result;
use diorama_data::{colmap, json, photo, splat_ply};
use diorama_engine::renderers::splat;
use diorama_engine::renderers::volume::View;
use diorama_geom::capture::focus_point;
use diorama_geom::glam::DVec3;
use diorama_geom::splats::Splats;
use diorama_geom::view_controls::{ControlValues, ViewLayer};
use diorama_geom::view_source::{MeasuredLength, MeshRequest, ViewFrame, ViewRequest, ViewScene, ViewSource, ViewStatus};
use diorama_geom::{Camera, Capture, Image, ImageU8, Pose, Similarity};
use std::path::{Path, PathBuf};

/// Views around a file that has no photographs, in degrees of field of view.
const AROUND: usize = 8;
const FOV_DEG: f64 = 50.0;
/// Size in pixels of the pictures from there.
const SIDE: u32 = 480;
const BACKGROUND: [f32; 3] = [0.1; 3];

/// Points, and the photographs that go with them.
pub struct PointsView {
    scene: ViewScene,
    photos: Vec<PathBuf>,
    splats: Splats,
}

impl PointsView {
    /// A capture with its points, where it has any: `ply_file_path` of `transforms.json`, or COLMAP's.
    ///
    /// # Errors
    /// When the points cannot be read.
    pub fn of_capture(data: &Path, capture: &Capture) -> Result<PointsView> {
        let splats = points(data, &capture.world_from_capture)?.unwrap_or_default();
        let photos = capture.frames.iter().map(|f| f.image.clone()).collect();
        let s = capture.scene;
        let corner = |sign: f64| (s.center + DVec3::splat(sign * s.half * s.aabb_scale as f64)).to_array();
        let bounds = (corner(-1.0), corner(1.0));
        Ok(Self::new(data, capture.frames.iter().map(ViewFrame::from).collect(), photos, splats, bounds, capture.world_from_capture))
    }

    /// A PLY of points or Gaussian splats, z up, seen from around.
    ///
    /// # Errors
    /// When the file is no such PLY.
    pub fn of_file(file: &Path) -> Result<PointsView> {
        let splats = splat_ply::read(file)?;
        let side = |k: usize| {
            let mut v: Vec<f32> = splats.positions.iter().map(|p| p[k]).collect();
            v.sort_by(f32::total_cmp);
            // Strays would make everything else small.
            let at = |share: f64| v.get(((v.len().max(1) - 1) as f64 * share) as usize).copied().unwrap_or(0.0) as f64;
            (at(0.02), at(0.98))
        };
        let sides = [side(0), side(1), side(2)];
        let (lo, hi) = (DVec3::from(sides.map(|s| s.0)), DVec3::from(sides.map(|s| s.1)));
        let (middle, reach) = ((lo + hi) * 0.5, ((hi - lo).length() * 0.5).max(1e-6));
        let camera = Camera::pinhole(SIDE, SIDE * 3 / 4, FOV_DEG.to_radians());
        let frame = |i: usize| {
            let a = i as f64 / AROUND as f64 * std::f64::consts::TAU;
            let eye = middle + DVec3::new(a.cos(), a.sin(), 0.5).normalize() * reach * 2.5;
            let pose = Pose::look_at(eye, middle, DVec3::Z);
            ViewFrame { name: format!("{:.0} degrees", a.to_degrees()), camera, world_from_camera: pose, held_out: false }
        };
        let bounds = ((middle - DVec3::splat(reach)).to_array(), (middle + DVec3::splat(reach)).to_array());
        Ok(Self::new(file, (0..AROUND).map(frame).collect(), Vec::new(), splats, bounds, Similarity::IDENTITY))
    }

    fn new(
        of: &Path,
        frames: Vec<ViewFrame>,
        photos: Vec<PathBuf>,
        splats: Splats,
        bounds: ([f64; 3], [f64; 3]),
        world_from_capture: Similarity,
    ) -> PointsView {
        let poses: Vec<Pose> = frames.iter().map(|f| f.world_from_camera).collect();
        let (focus, distance) = focus_point(&poses);
        let name = of.canonicalize().unwrap_or(of.to_path_buf()).file_name().unwrap_or_default().to_string_lossy().into_owned();
        let note = match splats.len() {
            0 => "This data set has no points: only its cameras can be shown until it is trained.",
            _ => "",
        };
        let scene = ViewScene {
            name,
            frames,
            layers: layers(),
            controls: Vec::new(),
            note: note.into(),
            is_run: false,
            focus: focus.to_array(),
            distance,
            world_from_capture,
            bounds,
            crop: None,
            measured: None,
            path: None,
        };
        PointsView { scene, photos, splats }
    }

    /// Number of points.
    pub fn points(&self) -> usize {
        self.splats.len()
    }

    fn draw(&self, r: &ViewRequest) -> View {
        let Some((lo, hi)) = r.clip else { return splat::render(&self.splats, &r.camera, &r.world_from_camera, BACKGROUND) };
        let mut inside = Splats::default();
        let s = &self.splats;
        for i in (0..s.len()).filter(|i| (0..3).all(|k| (lo[k]..=hi[k]).contains(&s.positions[*i][k]))) {
            inside.push(s.positions[i], s.rgb_srgb[i], s.opacities[i], s.scales[i], s.rotations[i]);
        }
        splat::render(&inside, &r.camera, &r.world_from_camera, BACKGROUND)
    }
}

/// Points of a data set in the world, where it has any. Those that `transforms.json` names stand in the frame of its poses.
fn points(data: &Path, world_from_capture: &Similarity) -> Result<Option<Splats>> {
    let file = data.join("transforms.json");
    if file.exists() {
        let map = json::read(&file)?;
        let named = map.get("ply_file_path").and_then(|v| v.as_str());
        return match named.map(|n| diorama_data::import::locate(data, n, &file, "ply_file_path")).transpose()?.flatten() {
            Some(ply) => Ok(Some(splat_ply::read(&ply)?)),
            None => Ok(None),
        };
    }
    match colmap::find_model(data).filter(|m| m.join("points3D.bin").exists()) {
        Some(model) => {
            let found = colmap::points(&model)?;
            let point = |p: &colmap::Point| (p.position.as_vec3().to_array(), p.rgb.map(|v| v as f32 / 255.0));
            let mut splats = Splats::of_points(found.iter().map(point));
            splats.transform(world_from_capture);
            Ok(Some(splats))
        }
        None => Ok(None),
    }
}

/// One value per pixel as gray.
fn gray(values: &Image, of: impl Fn(f32) -> f32) -> ImageU8 {
    let data = values.data.iter().flat_map(|v| [diorama_geom::color::u8_from_unit(of(*v)); 3]).collect();
    ImageU8 { width: values.width, height: values.height, channels: 3, data }
}

/// Points have no surface: no normals, and what there is of them is opacity.
fn layers() -> Vec<ViewLayer> {
    vec![
        ViewLayer::new("rgb", "Color"),
        ViewLayer::new("depth", "Depth").with_scale(&[[255; 3], [26; 3]], "near", "far", ""),
        ViewLayer::new("opacity", "Opacity").with_scale(&[[0; 3], [255; 3]], "0", "1", ""),
    ]
}

const NO_RUN: &str = "this is no run: train it first, then view the run";

impl ViewSource for PointsView {
    fn scene(&self) -> ViewScene {
        self.scene.clone()
    }

    fn status(&self) -> ViewStatus {
        ViewStatus::default()
    }

    fn view(&self, r: &ViewRequest) -> std::result::Result<ImageU8, String> {
        let view = self.draw(r);
        match &r.layer[..] {
            "rgb" => Ok(view.rgb.to_u8()),
            "depth" => {
                let seen = || view.depth.data.iter().copied().filter(|d| *d > 0.0);
                let (lo, hi) = seen().fold((f32::MAX, f32::MIN), |(a, b), d| (a.min(d), b.max(d)));
                Ok(gray(&view.depth, |d| if d > 0.0 { 1.0 - 0.9 * (d - lo) / (hi - lo).max(1e-6) } else { 0.0 }))
            }
            "opacity" => Ok(gray(&view.opacity, |v| v)),
            other => Err(format!("there is no layer {other:?}")),
        }
    }

    fn point(&self, r: &ViewRequest, x_px: f64, y_px: f64) -> Option<[f64; 3]> {
        let view = self.draw(r);
        let (x, y) = (x_px as usize, y_px as usize);
        (view.opacity.pixel(x, y)[0] > 0.3).then(|| {
            let along = r.camera.direction(x as f64 + 0.5, y as f64 + 0.5);
            r.world_from_camera.point(along * view.depth.pixel(x, y)[0] as f64).to_array()
        })
    }

    fn thumbnail(&self, frame: usize) -> std::result::Result<ImageU8, String> {
        let f = self.scene.frames.get(frame).ok_or_else(|| format!("there is no photograph {frame}"))?;
        match self.photos.get(frame) {
            Some(p) => photo::load_small(p, THUMBNAIL).map_err(|e| e.to_string()),
            None => {
                let camera = f.camera.resized(THUMBNAIL as u32, THUMBNAIL as u32 * 3 / 4);
                let (layer, values) = ("rgb".into(), ControlValues::default());
                self.view(&ViewRequest { camera, world_from_camera: f.world_from_camera, layer, values, clip: None })
            }
        }
    }

    fn save_crop(&self, _: Option<([f32; 3], [f32; 3])>) -> std::result::Result<(), String> {
        Err(NO_RUN.into())
    }

    fn save_measured(&self, _: Option<MeasuredLength>) -> std::result::Result<(), String> {
        Err(NO_RUN.into())
    }

    fn save_path(&self, _: &str) -> std::result::Result<PathBuf, String> {
        Err(NO_RUN.into())
    }

    fn open_path(&self, _: &str) -> std::result::Result<String, String> {
        Err(NO_RUN.into())
    }

    fn export(&self, _: &MeshRequest, _: &mut dyn FnMut(&str, usize, usize)) -> std::result::Result<(PathBuf, f64), String> {
        Err(NO_RUN.into())
    }
}
