//! Distances of pixels that show sparse points of structure from motion.

use diorama_engine::samplers::pixels::Observation;
use diorama_geom::capture::SparsePoint;
use diorama_geom::{Capture, Reduction};

/// Fewest training photographs that show a point, and largest mean reprojection error in their pixels: else its distance is unsure.
const FEWEST: usize = 3;
pub const LARGEST_ERROR: f32 = 2.0;
/// Most observations that are kept, evenly taken from all.
const MOST: usize = 1 << 20;
/// Fewest observations with which photographs are not compared.
pub const ENOUGH: usize = 1000;

/// What training photographs, given by their frames and reduced, show of the capture's sparse points; `scale` is that of the model's space.
pub fn observe(capture: &Capture, train: &[usize], reduction: Reduction, scale: f64) -> Vec<Observation> {
    let mut image_of = vec![None; capture.frames.len()];
    train.iter().enumerate().for_each(|(image, frame)| image_of[*frame] = Some(image));
    let cameras: Vec<_> = capture.frames.iter().map(|f| (f.camera.reduced(reduction), f.world_from_camera.inverse())).collect();
    let is_trained = |f: &&u32| image_of[**f as usize].is_some();
    let is_sure = |p: &&SparsePoint| p.frames.iter().filter(is_trained).count() >= FEWEST && p.error <= LARGEST_ERROR;
    let shown = || capture.points.iter().filter(is_sure).flat_map(|p| p.frames.iter().filter(is_trained).map(move |f| (p, *f as usize)));
    let step = shown().count().div_ceil(MOST).max(1);
    let seen = shown().step_by(step).filter_map(|(p, frame)| {
        let image = image_of[frame]?;
        let (camera, camera_from_world) = &cameras[frame];
        let q = camera_from_world.point(p.position);
        let px = camera.project(q)?;
        let is_inside = (0.0..camera.width as f64).contains(&px.x) && (0.0..camera.height as f64).contains(&px.y);
        let distance = (q.length() * scale) as f32;
        let observation = Observation { image: image as u32, x: px.x as u32, y: px.y as u32, distance };
        is_inside.then_some(observation)
    });
    seen.collect()
}
