//! A trained scene as data sets are drawn from it: its field, its text regions, and what its photographs show.

use super::super::field::model::TextModel;
use super::super::field::recipe;
use super::super::label::in_view::{self, OnSurface, READABLE};
use super::super::placed::{self, PlacedRegion};
use crate::error::{PipelineError, Result};
use diorama_engine::renderers::view::View;
use diorama_engine::renderers::volume::Quality;
use diorama_geom::glam::{DQuat, DVec2, DVec3};
use diorama_geom::{Camera, Lens, Pose};
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::path::Path;

/// Pixels along the longer side of the depth maps of the photographs.
pub(super) const COARSE: u32 = 64;

/// Width and height of a picture that is reduced to `side` pixels along its longer side; smaller ones are enlarged to it.
pub(super) fn coarse_size((width, height): (u32, u32), side: u32) -> [u32; 2] {
    let longer = width.max(height) as f64;
    [width, height].map(|v| ((v as f64 * side as f64 / longer) as u32).max(1))
}

/// A region as a photograph shows it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Member {
    /// Index into the scene's regions.
    pub region: usize,
    /// Rotation from the region's frame to the camera's.
    pub camera_from_region: DQuat,
    /// Place of its middle in widths and heights of the picture, and its area over the picture's.
    pub center: [f64; 2],
    pub area_ratio: f64,
}

/// A scene.
pub struct SynthScene {
    pub name: String,
    pub model: TextModel,
    /// Those with a rectangle.
    pub regions: Vec<PlacedRegion>,
    /// Of all training photographs in which a region can be read.
    pub members: Vec<Member>,
    /// Median light that these photographs receive from the middle of each region: 1 but for fog.
    pub lights: Vec<f32>,
    /// Poses of the training photographs in the world, and their coarse views; empty before [`SynthScene::look`].
    pub photographs: Vec<(Pose, PosedCamera, View)>,
}

impl SynthScene {
    /// Loads a run and its regions.
    ///
    /// # Errors
    /// When the run or its regions cannot be read, or no region can be read in any photograph.
    pub fn load(name: String, run: &Path, progress: &mut dyn FnMut(f64)) -> Result<SynthScene> {
        let (model, _) = recipe::load(run, None)?;
        let regions: Vec<PlacedRegion> = placed::read(run)?.into_iter().filter(|r| r.rectangle.is_some()).collect();
        let mut members = Vec::new();
        let mut lights: Vec<Vec<f32>> = regions.iter().map(|_| Vec::new()).collect();
        for (k, frame) in model.train.iter().enumerate() {
            progress(k as f64 / model.train.len() as f64);
            let f = &model.capture.frames[*frame];
            for (i, region) in regions.iter().enumerate() {
                let own = OnSurface::of(region).and_then(|w| in_view::labelled(&model, &w, &f.camera, &f.world_from_camera));
                let Some(word) = own else { continue };
                let Some(pose) = word.pose.filter(|_| word.visibility >= READABLE) else { continue };
                let (rotation, center) = placed::from_rows(&pose.text_pose);
                let size = [f.camera.width as f64, f.camera.height as f64];
                let Some(at) = f.camera.project(center) else { continue };
                let middle = region.rectangle.map(|r| r.reading_point(DVec2::ZERO)).into_iter().collect::<Vec<_>>();
                lights[i].extend(in_view::transmittance(&model, f.world_from_camera.translation, &middle, region.front));
                members.push(Member {
                    region: i,
                    camera_from_region: DQuat::from_mat3(&rotation),
                    center: [at.x / size[0], at.y / size[1]],
                    area_ratio: in_view::area(&word.polygon) / (size[0] * size[1]),
                });
            }
        }
        if members.is_empty() {
            let what = "no region can be read in any training photograph; label one that shows it larger";
            return Err(PipelineError::Usage(format!("{}: {what}", run.display())));
        }
        let median = |mut v: Vec<f32>| {
            v.sort_by(f32::total_cmp);
            v.get(v.len() / 2).copied().unwrap_or(1.0)
        };
        let lights = lights.into_iter().map(median).collect();
        Ok(SynthScene { name, model, regions, members, lights, photographs: Vec::new() })
    }

    /// Renders coarse views of the training photographs, which checks of cameras compare with.
    pub fn look(&mut self) {
        let coarse = |frame: &usize| {
            let posed = self.model.posed(*frame);
            let size = coarse_size((posed.camera.width, posed.camera.height), COARSE);
            let coarse = PosedCamera { camera: posed.camera.resized(size[0], size[1]), ..posed };
            let view = self.model.tracer(Quality::Full).view(&coarse, &mut |_| ());
            (self.model.capture.frames[*frame].world_from_camera, coarse, view)
        };
        self.photographs = self.model.train.iter().map(coarse).collect();
    }

    /// A pinhole camera of a size with the photographs' field of view over the longer side.
    pub fn camera(&self, (width, height): (u32, u32)) -> Camera {
        let c = &self.model.capture.frames[self.model.train[0]].camera;
        let (longer, focal) = if c.width >= c.height { (c.width as f64, c.fx) } else { (c.height as f64, c.fy) };
        let f = focal * width.max(height) as f64 / longer;
        Camera { width, height, fx: f, fy: f, cx: 0.5 * width as f64, cy: 0.5 * height as f64, lens: Lens::Pinhole }
    }

    /// A camera in model space.
    pub fn posed(&self, camera: &Camera, pose: &Pose) -> PosedCamera {
        PosedCamera { camera: *camera, pose: self.model.model_from_world.pose(pose) }
    }

    /// Whether a photograph shows a point in model space: in its picture and not behind what its depth says, up to a share of it.
    pub fn shows(&self, photograph: usize, point: DVec3, tolerance: f64) -> bool {
        let (_, posed, view) = &self.photographs[photograph];
        let seen = posed.pose.inverse().point(point);
        let Some(p) = (seen.z > 0.0).then(|| posed.camera.project(seen)).flatten() else { return false };
        let (x, y) = (p.x.floor(), p.y.floor());
        if x < 0.0 || y < 0.0 || x >= posed.camera.width as f64 || y >= posed.camera.height as f64 {
            return false;
        }
        let i = y as usize * posed.camera.width as usize + x as usize;
        view.opacity.data[i] > 0.5 && seen.length() < (1.0 + tolerance) * view.depth.data[i] as f64
    }
}
