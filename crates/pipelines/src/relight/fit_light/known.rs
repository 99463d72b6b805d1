//! Which surfaces of a view training knows: those that at least two of its cameras see. And which of them a photograph shows as well, whatever
//! its light: people and cars before them have no likeness to their albedo.

use super::Shot;
use crate::relight::outdoor::model::SceneModel;
use crate::relight::outdoor::normal_maps::sees;
use crate::relight::outdoor::render::SceneView;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_geom::color::srgb_from_linear;
use diorama_geom::glam::DVec3;
use diorama_geom::image::box_means;
use diorama_geom::{Image, ImageU8};
use diorama_kernels::ops::ray_generation::PosedCamera;

/// Pixels along the longer side of the distances that are compared, and cameras at most.
const LONGEST: f64 = 96.0;
const CAMERAS: usize = 48;
/// Cameras that must see a surface.
const FEWEST: usize = 2;
/// By how much larger a pixel of such a camera may be on the surface: what is seen coarsely only is a blur from close by.
const COARSER: f64 = 2.0;

/// Share of the longer side by which windows reach to each side, and the correlation in them from which pictures are alike; deviations up to
/// which a window of albedo is even, and one of the photograph shows shades.
const LIKENESS: usize = 32;
const ALIKE: f64 = 0.4;
const EVEN: f64 = 0.06;
const SHADED: f64 = 0.15;

/// Distances that the cameras of training see.
pub struct Known(Vec<(PosedCamera, Image)>);

impl Known {
    pub fn of(model: &SceneModel) -> Known {
        let mut cameras: Vec<PosedCamera> = Vec::new();
        for c in model.cameras() {
            if !cameras.iter().any(|other| other.pose == c.pose && other.camera == c.camera) {
                cameras.push(c);
            }
        }
        let step = cameras.len().div_ceil(CAMERAS).max(1);
        let seen = cameras.into_iter().step_by(step).map(|c| {
            let shrink = (LONGEST / c.camera.width.max(c.camera.height) as f64).min(1.0);
            let size = |n: u32| ((n as f64 * shrink).round() as u32).max(1);
            let small = PosedCamera { camera: c.camera.resized(size(c.camera.width), size(c.camera.height)), pose: c.pose };
            let tracer: Tracer = model.tracer(Quality::Full);
            (small, tracer.layers(&small, &model.unlit_codes(), &mut |_| {}).depth)
        });
        Known(seen.collect())
    }

    /// Leaves out of a photograph what fewer than two cameras of training see as finely.
    pub fn keep(&self, shot: &mut Shot, view: &SceneView) {
        let (w, h) = (shot.photo.width, shot.photo.height);
        let all = || ImageU8 { width: w, height: h, channels: 1, data: vec![255; w * h] };
        let camera = shot.camera;
        let focal = |c: &PosedCamera| c.camera.fx / c.camera.width.max(c.camera.height) as f64;
        // In parts of the longer side: photographs of one capture have about as many pixels.
        let size = |c: &PosedCamera, point: DVec3| (point - c.pose.translation).length() / focal(c);
        let mask = shot.mask.get_or_insert_with(all);
        for (i, v) in mask.data.iter_mut().enumerate() {
            let point = point(&camera, view, i);
            // The sky is no surface and needs nobody to see it.
            let is_seen = |(c, depth): &&(PosedCamera, Image)| size(c, point) <= COARSER * size(&camera, point) && sees(c, depth, point);
            if view.opacity.data[i] > super::SURFACE && self.0.iter().filter(is_seen).take(FEWEST).count() < FEWEST {
                *v = 0;
            }
        }
    }
}

/// Whether the photograph looks like the model's albedo around each pixel, up to brightness and contrast; where albedo is even, whether the
/// photograph shows no more than shades.
pub fn alike(shot: &Shot, view: &SceneView) -> Vec<bool> {
    let (w, h) = (shot.photo.width, shot.photo.height);
    let gray = |rgb: [f32; 3]| (0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2]) as f64;
    let photo: Vec<f64> = (0..w * h).map(|i| gray(shot.rgb(i).map(|v| v as f32 / 255.0))).collect();
    // Of the model, what it has no surface for looks like the photograph.
    let model: Vec<f64> = (0..w * h)
        .map(|i| {
            let albedo: [f32; 3] = std::array::from_fn(|k| srgb_from_linear(view.albedo.data[3 * i + k].clamp(0.0, 1.0)));
            if view.opacity.data[i] > super::SURFACE { gray(albedo) } else { photo[i] }
        })
        .collect();
    let radius = (w.max(h) / LIKENESS).max(2);
    let mean = |of: &dyn Fn(usize) -> f64| box_means(&(0..w * h).map(of).collect::<Vec<_>>(), w, h, radius);
    let (a, b) = (mean(&|i| photo[i]), mean(&|i| model[i]));
    let (aa, bb, ab) = (mean(&|i| photo[i] * photo[i]), mean(&|i| model[i] * model[i]), mean(&|i| photo[i] * model[i]));
    (0..w * h)
        .map(|i| {
            let (va, vb) = ((aa[i] - a[i] * a[i]).max(0.0), (bb[i] - b[i] * b[i]).max(0.0));
            let is_even = vb < EVEN * EVEN && va < SHADED * SHADED;
            is_even || (ab[i] - a[i] * b[i]) > ALIKE * (va * vb).sqrt()
        })
        .collect()
}

/// Where the ray of a pixel meets its surface.
pub fn point(camera: &PosedCamera, view: &SceneView, i: usize) -> DVec3 {
    let (x, y) = (i % view.depth.width, i / view.depth.width);
    let direction = camera.pose.rotation * camera.camera.direction(x as f64 + 0.5, y as f64 + 0.5).normalize();
    camera.pose.translation + direction * view.depth.data[i] as f64
}
