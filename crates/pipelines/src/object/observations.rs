//! Pixels in which training photographs show sparse points: what stands there is as far away as the point.

use super::model::ObjectModel;
use diorama_engine::samplers::pixels::Observation;
use diorama_geom::capture::SparsePoint;

/// Fewest training photographs that show a point, and largest mean reprojection error in their pixels: else its distance is unsure.
const FEWEST: usize = 3;
pub(super) const LARGEST_ERROR: f32 = 2.0;

/// Most observations that are kept, evenly taken from all.
const MOST: usize = 1 << 20;

/// What the training photographs show of the capture's sparse points.
pub(super) fn of(model: &ObjectModel) -> Vec<Observation> {
    let capture = &model.capture;
    let mut image_of = vec![None; capture.frames.len()];
    model.train.iter().enumerate().for_each(|(image, frame)| image_of[*frame] = Some(image));
    let (scale, near) = (model.model_from_world.scale, model.config.sampling.near);
    let cameras: Vec<_> =
        capture.frames.iter().map(|f| (f.camera.reduced(model.config.reduction()), f.world_from_camera.inverse())).collect();
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
        // Rays begin beyond what is closer, so that no sample could be there.
        (is_inside && distance > near).then_some(observation)
    });
    seen.collect()
}

/// What a user should know of `n` observations.
pub(super) fn note(model: &ObjectModel, n: usize) -> Option<String> {
    match n {
        0 if model.depth() == 0.0 || model.capture.points.is_empty() => None,
        0 => {
            let why = "nobody says which photographs see them (diorama prepare does), or fewer than three do";
            Some(format!("the sparse points tell no distances: {why}"))
        }
        n => Some(format!("sparse points tell the distance of {n} pixels (--set loss.depth=0: do not use them)")),
    }
}
